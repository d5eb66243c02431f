"""The frame of a model: GPS positions of EXIF, and the direction up."""

import json
import math
import re
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageDraw
import pytest
from scipy.spatial.transform import Rotation

from tests.synthetic import photograph, reconstruction_of
from thesisrecon import UsageError, compare_models, load, read_cameras, reconstruct
from thesisrecon.config import ImageOptions
from thesisrecon.metric.world import up_direction, upright
from thesisrecon.records import MetricResult

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
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert re.search("east, north and up: 5 GPS positions fit to 0.0[0-9]+ m", page)
    assert 0.005 < world["rms_m"] < 0.1
    assert world["residual_m"][files[3].name] > 4e4
    assert np.allclose(load(tmp_path / "out").cameras[files[0].name].centre, ours[0])


def test_images_without_positions_keep_their_frame_and_say_so(tmp_path):
    files = sorted((HOME / "images").glob("*.jpg"))[:3]
    given = {"max_size": 320, "until": "metric", "threads": 1}
    plain = reconstruct(files, tmp_path / "a", **given)
    found = reconstruct(files, tmp_path / "b", set=["images.gps=true"], **given)
    assert any("frame: no image has a GPS position" in text for text in found.warnings)
    assert np.array_equal(found.cameras[0].t, plain.cameras[0].t)
    with pytest.raises(ValueError, match="gps_std_m"):
        ImageOptions(gps_std_m=2.0)


def turned(about_z, *, pitch=0.0, roll=0.0):
    """A camera that looks along the ground, turned about the vertical, then tilted and rolled (degrees)."""
    level = (
        np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ Rotation.from_euler("z", about_z, True).as_matrix()
    )
    return Rotation.from_euler("zx", [roll, pitch], True).as_matrix() @ level


def test_up_is_found_by_the_level_sides_of_images_also_of_turned_ones_and_from_above():
    rng, world = np.random.default_rng(2), Rotation.from_euler("xyz", [40, -70, 20], True).as_matrix()
    angles = rng.uniform(0, 90, 12)
    cases = [{"pitch": -10.0}, {"pitch": 30.0}, {"pitch": 90.0}]
    for case in cases:
        R = np.array(
            [turned(a, roll=rng.normal(0, 1) + 90 * (k % 4 == 0), **case) for k, a in enumerate(angles)]
        )
        u, roll = up_direction(R @ world.T)
        assert np.degrees(np.arccos(world[:, 2] @ u)) < 1.5, case
        assert 0.3 < roll < 2.0
    with pytest.raises(UsageError, match="one horizontal direction"):
        up_direction(np.array([turned(0.1 * a, pitch=a) for a in angles]))
    with pytest.raises(UsageError, match="rolled"):
        up_direction(np.array([turned(a, roll=40 * (-1) ** k) for k, a in enumerate(angles)]))


def room(upright_panels):
    """Images of a room with panels on its walls, upright or turned ones, by cameras that are held askew."""
    rng, world = np.random.default_rng(5), Rotation.from_euler("xyz", [40, -70, 20], True).as_matrix()
    K, images, rotations = np.array([[250.0, 0, 159.5], [0, 250, 119.5], [0, 0, 1]]), [], []
    walls = [(90.0 * side, place) for side in range(4) for place in np.arange(-2.2, 2.2, 0.7)]
    corners = np.array([[0, -0.2, -0.7], [0, 0.2, -0.7], [0, 0.2, 0.7], [0, -0.2, 0.7]])
    angles = np.zeros(len(walls)) if upright_panels else rng.uniform(-85, 85, len(walls))
    for k in range(8):
        R = turned(20.0 * k, roll=6 + rng.normal(0, 1), pitch=rng.uniform(-8, 8))
        image = PIL.Image.new("L", (320, 240), 120)
        for n, ((side, place), angle) in enumerate(zip(walls, angles, strict=True)):
            panel = Rotation.from_euler("x", angle, True).apply(corners)
            panel += np.array([2.5, place, 0.1 * (n % 5)])
            x = Rotation.from_euler("z", side, True).apply(panel) @ R.T @ K.T
            if (x[:, 2] > 0.1).all():
                shape = [tuple(p) for p in x[:, :2] / x[:, 2:]]
                PIL.ImageDraw.Draw(image).polygon(shape, fill=40 * (n % 3))
        images.append(photograph(np.asarray(image) + rng.normal(0, 2, (240, 320))))
        rotations.append(R @ world.T)
    P = K @ np.concatenate([rotations, np.zeros((8, 3, 1))], axis=2)
    model = reconstruction_of(P, (320, 240), K=np.tile(K, (8, 1, 1)))
    return MetricResult(model, (), {}, trusted=True), images, world[:, 2]


def test_vertical_lines_tell_up_better_than_cameras_that_are_held_askew():
    result, images, up = room(upright_panels=True)
    stood, facts = upright(result, images)
    move = stood.reconstruction.P[0, :, :3].T @ np.linalg.inv(result.reconstruction.P[0, :, :3]).T
    off = np.degrees(np.arccos((move @ up)[2]))
    assert facts["by"] == "vertical lines"
    assert facts["images"] >= 6
    assert off < 0.5
    assert off < 4 * facts["std_deg"] + 0.1
    assert facts["off_level_deg"] > 3.0


def test_without_vertical_lines_the_level_sides_of_the_images_tell_up_and_the_facts_say_so():
    result, images, _ = room(upright_panels=False)
    facts = upright(result, images)[1]
    assert facts["by"] == "level sides of the images"
    assert "std_deg" not in facts


def test_a_model_that_stands_upright_has_z_up(tmp_path):
    truth = read_cameras(HOME / "cameras.json")
    files = sorted((HOME / "images").glob("*.jpg"))[:5]
    given = {"max_size": 400, "until": "metric", "threads": 1}
    out = tmp_path / "out"
    result = reconstruct(files, out, set=["images.up=auto"], **given)
    found = compare_models(result, truth)
    up = found.similarity.R[:, 2]
    assert np.degrees(np.arccos(up[2])) < 1.0
    assert result.summary["world"]["by"] == "vertical lines"
    assert re.search(
        "points up by vertical lines, to 0.[0-9] degrees", (out / "report.html").read_text("utf-8")
    )
    assert np.allclose(load(out).cameras[0].t, result.cameras[0].t)
