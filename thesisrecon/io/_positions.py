"""Known camera positions from CSV files: lengths, or latitude, longitude and height (WGS84)."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median_low
from typing import NamedTuple

from thesisrecon.errors import UsageError
from thesisrecon.io._files import read_text, shortened

Place = tuple[float, float, float]
_SEMI_MAJOR_M, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563
_HEIGHT = {
    "alt",
    "altitude",
    "gpsaltitude",
    "gpsalt",
    "ele",
    "elev",
    "elevation",
    "height",
    "h",
    "z",
    "up",
    "u",
}
_NAME = {"name", "image", "imagename", "img", "file", "filename", "sourcefile", "label", "photo", "path"}
_DEGREES = (
    {"lat", "latitude", "gpslatitude", "gpslat"},
    {"lon", "long", "lng", "longitude", "gpslongitude", "gpslong", "gpslon", "gpslng"},
    _HEIGHT,
)
_LENGTHS = ({"x", "east", "easting", "e"}, {"y", "north", "northing", "n"}, _HEIGHT)
"""Words of a header for the columns."""
_QUALITY = {"error", "accuracy", "acc", "sigma", "std", "stdev", "variance"}
_ORDER = [0, 1, 2, 3]
"""Columns without a header: name,x,y,z."""


class Positions(NamedTuple):
    """Positions by image name; those of degrees in metres east, north and up of an origin."""

    places: dict[str, Place]
    origin: Place | None = None  #: latitude and longitude in degrees, height in metres


class _Header(NamedTuple):
    columns: Sequence[int]  #: of the name and of three coordinates
    width: int
    degrees: bool = False


def read_positions(path: Path) -> Positions:
    """Read camera positions: one "name,x,y,z" per line, or columns in the order of a header.

    Columns of latitude and longitude are degrees: the positions become metres east, north and up of their
    median.
    """
    header, found = _Header(_ORDER, 4), dict[str, Place]()
    for number, cells in _rows(path):
        if number == 0:
            header = _header_of(cells, path)
            continue
        places = [cells[k].strip() for k in header.columns] if len(cells) == header.width else []
        try:
            name, *values = places
            x, y, z = map(float, values)
            if name in found or not all(map(math.isfinite, (x, y, z))):
                raise ValueError
            if header.degrees and (abs(x) > 90.0 or abs(y) > 360.0):
                raise ValueError
        except ValueError:
            what = (
                "the name, latitude, longitude and height of an image, in decimal degrees and metres"
                if header.degrees
                else "name,x,y,z with finite numbers"
            )
            row = shortened(",".join(cells).strip())
            raise UsageError(
                f"line {number} of {path} must hold {what}, one line per image; got {row!r}"
            ) from None
        found[name] = x, y, z
    if not header.degrees or not found:
        return Positions(found)
    latitudes, longitudes, heights = zip(*found.values(), strict=True)
    # The median is one of the positions near most of them, also beside those without a fix (0, 0).
    origin = median_low(latitudes), median_low(longitudes), median_low(heights)
    return Positions({name: _east_north_up(place, origin) for name, place in found.items()}, origin)


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and cells; number 0 marks a header, which may be a comment before the first line."""
    comment, first = list[str](), True
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            (cells,) = csv.reader(
                [line.lstrip("# ") if line.lstrip().startswith("#") else line], skipinitialspace=True
            )
        except (ValueError, csv.Error):
            cells = [line]
        if line.lstrip().startswith("#"):
            comment = cells
            continue
        if first:
            first = False
            if not any(map(_is_number, cells[1:])):
                yield 0, cells
                continue
            if len(comment) == len(cells):
                yield 0, comment
        yield number, cells


def _header_of(cells: Sequence[str], path: Path) -> _Header:
    words = [set(re.findall("[a-z]+", cell.lower())) for cell in cells]
    words = [set() if found & _QUALITY else found for found in words]

    def column(wanted: set[str], taken: Sequence[int | None] = ()) -> int | None:
        return next((k for k, found in enumerate(words) if found & wanted and k not in taken), None)

    latitude, longitude = column(_DEGREES[0]), column(_DEGREES[1])
    degrees = latitude is not None or longitude is not None
    x, y = (latitude, longitude) if degrees else (column(_LENGTHS[0]), column(_LENGTHS[1]))
    z = column(_HEIGHT, (x, y))
    name = column(_NAME, (x, y, z))
    name = name if name is not None else next((k for k in range(len(cells)) if k not in (x, y, z)), None)
    if x is not None and y is not None and z is not None and name is not None:
        return _Header((name, x, y, z), len(cells), degrees)
    if degrees:
        raise UsageError(
            f"the header of {path} must name a column each of latitude, longitude and height, such as "
            f"name,lat,lon,alt, separated by commas; got {shortened(','.join(cells))!r}"
        )
    return _Header(_ORDER, 4)


def _east_north_up(place: Place, origin: Place) -> Place:
    """Metres in the tangent plane of the WGS84 ellipsoid at the origin."""
    dx, dy, dz = (a - b for a, b in zip(_geocentric(place), _geocentric(origin), strict=True))
    latitude, longitude = math.radians(origin[0]), math.radians(origin[1])
    outwards = math.cos(longitude) * dx + math.sin(longitude) * dy
    return (
        math.cos(longitude) * dy - math.sin(longitude) * dx,
        math.cos(latitude) * dz - math.sin(latitude) * outwards,
        math.cos(latitude) * outwards + math.sin(latitude) * dz,
    )


def _geocentric(place: Place) -> Place:
    latitude, longitude, height = math.radians(place[0]), math.radians(place[1]), place[2]
    square = _FLATTENING * (2.0 - _FLATTENING)
    normal = _SEMI_MAJOR_M / math.sqrt(1.0 - square * math.sin(latitude) ** 2)
    across = (normal + height) * math.cos(latitude)
    return (
        across * math.cos(longitude),
        across * math.sin(longitude),
        (normal * (1.0 - square) + height) * math.sin(latitude),
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
