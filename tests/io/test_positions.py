"""Camera positions from files: columns by their header, degrees in metres, and a sentence for the rest."""

import math

import numpy as np
import pytest

from tests.api.test_alignment import make_model, true_positions
from tests.conftest import refuses
from thesisrecon import UsageError, align_to_positions
from thesisrecon.io._models import read_positions

ORIGIN = (47.36998, 8.54012, 412.0)
A, E2 = 6378137.0, 0.00669437999014


def degrees(place, origin=ORIGIN):
    """Latitude, longitude and height of metres east, north and up, by the radii of curvature."""
    latitude = math.radians(origin[0])
    normal = A / math.sqrt(1 - E2 * math.sin(latitude) ** 2)
    meridian = normal * (1 - E2) / (1 - E2 * math.sin(latitude) ** 2)
    east, north, up = place
    return (
        origin[0] + math.degrees(north / (meridian + origin[2])),
        origin[1] + math.degrees(east / ((normal + origin[2]) * math.cos(latitude))),
        origin[2] + up,
    )


def write(path, header, order, rows):
    """Rows (name, lat, lon, alt) in that order of columns."""
    lines = [
        ",".join(str(row[k]) if isinstance(row[k], str) else f"{row[k]:.10f}" for k in order) for row in rows
    ]
    path.write_text("\n".join([*([header] if header else []), *lines]) + "\n")
    return path


HEADERS = {
    "name,lat,lon,alt": (0, 1, 2, 3), "image,latitude,longitude,altitude": (0, 1, 2, 3),
    "name,lng,lat,height": (0, 2, 1, 3), "alt,long,lat,file": (3, 2, 1, 0),
    "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude": (0, 1, 2, 3),
    "#Label,X/Longitude,Y/Latitude,Z/Altitude": (0, 2, 1, 3),
    "imagename,latitude [decimal degrees],longitude [decimal degrees],altitude [meter]": (0, 1, 2, 3),
    "Name,Lat,Lon,Alt,Accuracy_alt (m)": (0, 1, 2, 3, 3), "# name, lat, lon, ele": (0, 1, 2, 3),
}  # fmt: skip


@pytest.mark.parametrize("header", HEADERS)
def test_degrees_become_metres_east_north_and_up(tmp_path, header):
    model = make_model(9)
    truth = {name: np.array(place) * 3.0 for name, place in true_positions(model).items()}
    rows = [(name, *degrees(place)) for name, place in truth.items()]
    path = write(tmp_path / "gps.csv", header, HEADERS[header], rows)
    aligned, report = align_to_positions(model, path)
    # The tangent plane at the median differs by less than a millimetre over this site.
    assert np.abs(report.residual).max() < 1e-3
    found = np.array([view.centre for view in aligned.views])
    expected = np.array([truth[view.name] for view in aligned.views])
    expected -= [sorted(column)[4] for column in expected.T]
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert report.origin == pytest.approx(np.median([row[1:] for row in rows], axis=0), abs=1e-9)
    assert "converted to metres east, north and up of latitude 47.3" in str(report)


def test_positions_without_a_fix_are_outliers(tmp_path):
    model = make_model(9)
    rows = [(name, *degrees(place)) for name, place in true_positions(model).items()]
    rows[0] = (rows[0][0], 0.0, 0.0, 0.0)
    _, report = align_to_positions(model, write(tmp_path / "gps.csv", "name,lat,lon,alt", (0, 1, 2, 3), rows))
    assert report.inlier.tolist() == [False] + [True] * 8
    assert np.abs(report.residual[1:]).max() < 1e-3


@pytest.mark.parametrize(("place", "arc_m"), [((0.0, 10.0, 0.0), 111_319.49), ((1.0, 0.0, 0.0), 110_574.3)])
def test_a_degree_on_the_ellipsoid_has_its_known_length(tmp_path, place, arc_m):
    """A degree of longitude on the equator, and the first degree of latitude; the chord is 6 m shorter."""
    other = (0.0, 11.0, 0.0) if place[1] else (0.0, 0.0, 0.0)
    rows = [("a", *place), ("b", *other)]
    found = read_positions(write(tmp_path / "gps.csv", "name,lat,lon,alt", (0, 1, 2, 3), rows)).places
    assert math.dist(found["a"], found["b"]) == pytest.approx(arc_m, abs=3.0)


@pytest.mark.parametrize("header", ["", "name,x,y,z", "name,a,b,c"])
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (0, 2, 1, 3)])
@pytest.mark.parametrize("origin", [ORIGIN, (-33.9, 151.2, 20.0), (51.5, -0.1, 40.0), (1.3, 103.8, 9.0)])
def test_degrees_without_a_header_are_refused(tmp_path, header, order, origin):
    model = make_model(6)
    rows = [(name, *degrees(place, origin)) for name, place in true_positions(model).items()]
    path = write(tmp_path / "gps.csv", header, order, rows)
    refuses(UsageError, "look like latitude and longitude in degrees", align_to_positions, model, path)
    mapping = {row[0]: row[1:] for row in rows}
    refuses(UsageError, "look like latitude and longitude in degrees", align_to_positions, model, mapping)


@pytest.mark.parametrize("scale", [1.0, 0.01])
@pytest.mark.parametrize("offset", [(0, 0, 0), (0.05, 0.02, 1.0), (2600000, 1200000, 400)])
def test_lengths_are_no_degrees(tmp_path, scale, offset):
    model = make_model(6)
    truth = {name: np.array(place) for name, place in true_positions(model).items()}
    middle = np.mean(list(truth.values()), axis=0)
    rows = [(name, *((place - middle) * scale + offset)) for name, place in truth.items()]
    _, report = align_to_positions(model, write(tmp_path / "local.csv", "", (0, 1, 2, 3), rows))
    assert np.abs(report.residual).max() < 1e-5
    assert report.origin is None


@pytest.mark.parametrize(("header", "order"), [
    ("name,y,x,z", (0, 2, 1, 3)), ("z,y,x,image", (3, 2, 1, 0)),
    ("name,Easting,Northing,Height", (0, 1, 2, 3)),
    ("name,north,east,up", (0, 2, 1, 3)), ("label,x [m],y [m],z [m],error", (0, 1, 2, 3, 3)),
    ("photo,this,that,other", (0, 1, 2, 3)),
])  # fmt: skip
def test_a_header_orders_the_columns(tmp_path, header, order):
    rows = [("a", 1.0, 2.0, 3.0), ("b", 4.0, 5.0, 6.5)]
    found = read_positions(write(tmp_path / "p.csv", header, order, rows))
    assert found.places == {row[0]: row[1:] for row in rows}
    assert found.origin is None


@pytest.mark.parametrize(("text", "words"), [
    ("name,lat,lon\na,1,2\n", "must name a column each of latitude, longitude and height"),
    ("name,lat,x,z\na,1,2,3\n", "must name a column each"),
    ("name;lat;lon;alt\na;1;2;3\n", "separated by commas"),
    ("name,lat,lon,alt\na,1,2,3\nb,95,2,3\n", "line 3 of .* must hold the name, .* in decimal degrees"),
    ("name,lat,lon,alt\na,47 deg 22' 11.9 N,2,3\n", "line 2 of .* in decimal degrees and metres"),
    ("name,lat,lon,alt\na,1,2,3\na,1,2,3\n", "line 3 of .* one line per image"),
    ("a,1,2,3,4\n", "line 1 of .* must hold name,x,y,z"),
])  # fmt: skip
def test_unclear_files_are_refused_with_a_sentence(tmp_path, text, words):
    (tmp_path / "p.csv").write_text(text)
    refuses(UsageError, words, read_positions, tmp_path / "p.csv")
