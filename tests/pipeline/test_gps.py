"""GPS positions of EXIF: the frame of the model, and observations of the adjustment."""

import json
import math
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from thesisrecon import load, read_cameras, reconstruct
from thesisrecon.config import ImageOptions

HOME = Path(__file__).parents[2] / "fixtures" / "courtyard"
LATITUDE, LONGITUDE, HEIGHT = -33.9, 18.4, 120.0


def degrees_of(place):
    """Latitude, longitude and height of metres east, north and up of the origin, to a millimetre."""
    sin = math.sin(math.radians(LATITUDE))
    square, root = 0.00669437999014, math.sqrt(1.0 - 0.00669437999014 * sin * sin)
    meridian, normal = 6378137.0 * (1 - square) / root**3, 6378137.0 / root
    east, north, up = place
    latitude = LATITUDE + math.degrees(north / (meridian + HEIGHT))
    longitude = LONGITUDE + math.degrees(east / ((normal + HEIGHT) * math.cos(math.radians(LATITUDE))))
    return latitude, longitude, HEIGHT + up


def with_gps(source, target, place):
    """A copy of an image with a position in EXIF."""
    latitude, longitude, height = degrees_of(place)
    with PIL.Image.open(source) as image:
        exif = image.getexif()
        gps = exif.get_ifd(0x8825)
        for n, (value, names) in ((1, (latitude, "NS")), (3, (longitude, "EW"))):
            size = abs(value)
            whole, minutes = int(size), (size % 1.0) * 60.0
            gps[n] = names[value < 0.0]
            gps[n + 1] = (whole, int(minutes), (minutes % 1.0) * 60.0)
        gps[5], gps[6] = b"\0", height
        image.save(target, exif=exif, quality="keep")


def test_the_model_is_in_metres_east_north_and_up_and_says_how_well_the_positions_fit(tmp_path):
    truth, rng = read_cameras(HOME / "cameras.json"), np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    files = sorted((HOME / "images").glob("*.jpg"))[:6]
    for path in files:
        place = truth[path.name].centre + rng.normal(0.0, 0.02, 3)
        # One without a fix.
        place = place + np.array([5e4, 0.0, 0.0]) if path == files[3] else place
        with_gps(path, tmp_path / "images" / path.name, place)
    given = {"max_size": 480, "until": "metric", "threads": 1, "set": {"images.gps": True}}
    result = reconstruct(tmp_path / "images", tmp_path / "out", **given)
    ours = np.array([result.cameras[path.name].centre for path in files])
    theirs = np.array([truth[path.name].centre for path in files])
    # Without a rotation and a scale: only the origin is that of the positions.
    off = ours - theirs
    assert np.abs(off - np.median(off, axis=0)).max() < 0.1
    world = json.loads((tmp_path / "out" / "summary.json").read_text())["world"]
    assert world["used"] == 5
    assert 0.005 < world["rms_m"] < 0.1
    assert world["residual_m"][files[3].name] > 4e4
    assert np.allclose(load(tmp_path / "out").cameras[files[0].name].centre, ours[0])


def test_images_without_positions_keep_their_frame_and_say_so(tmp_path):
    files = sorted((HOME / "images").glob("*.jpg"))[:3]
    given = {"max_size": 320, "until": "metric", "threads": 1}
    plain = reconstruct(files, tmp_path / "a", **given)
    found = reconstruct(files, tmp_path / "b", set=["images.gps=true"], **given)
    assert any("no image has a GPS position" in text for text in found.warnings)
    assert np.array_equal(found.cameras[0].t, plain.cameras[0].t)
    with pytest.raises(ValueError, match="gps_std_m"):
        ImageOptions(gps_std_m=2.0)
