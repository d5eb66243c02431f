"""The scenes of the validation: made again byte for byte, with true geometry."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from validation.runs.records import ReportOptions
from validation.runs.scenes import load_images
from validation.scenes.courtyard import build_courtyard
from validation.scenes.fixtures import (
    SIZE,
    courtyard_cameras,
    courtyard_poses,
    encode_depth,
    render_image,
    versions,
    write_cube,
)
from validation.scenes.materials import Material
from validation.scenes.pose import Pose
from validation.scenes.raycast import Surface, build_world, trace
from validation.scenes.real import (
    REAL_SCENES,
    ROOT,
    load_fixture_depth,
    load_fixture_scene,
    load_real_scene,
    read_scene,
)

FOLDER = ROOT / "fixtures" / "courtyard"


@pytest.fixture(scope="module")
def scene():
    return load_fixture_scene("courtyard")


def lift(scene, view):
    """Pixels (N, 2) and space points (N, 3) of the true depth of a view."""
    depth, stride = load_fixture_depth(view)
    row, col = np.nonzero(~np.isnan(depth))
    xy = np.column_stack([col, row]) * float(stride)
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(scene.K[view]).T
    return xy, (rays * depth[row, col, None]) @ scene.R[view] + scene.C[view]


def look_up(a, xy):
    """Bilinear samples of a at xy, all inside."""
    c, r = np.floor(xy[:, 0]).astype(int), np.floor(xy[:, 1]).astype(int)
    fx, fy = xy[:, 0] - c, xy[:, 1] - r
    top = a[r, c] * (1 - fx) + a[r, c + 1] * fx
    return top * (1 - fy) + (a[r + 1, c] * (1 - fx) + a[r + 1, c + 1] * fx) * fy


def seen_in(scene, X, view):
    """Pixels and depth of X in a view, and which lie inside its image by a pixel or two."""
    x = (X - scene.C[view]) @ scene.R[view].T @ scene.K[view].T
    xy = x[:, :2] / x[:, 2:]
    inside = (xy > 2).all(axis=1) & (xy < np.array(SIZE) - 4).all(axis=1) & (x[:, 2] > 0)
    return xy, x[:, 2], inside


def test_the_set_has_the_documented_size(scene):
    assert len(scene.image_paths) >= 12
    assert sum(p.stat().st_size for p in FOLDER.rglob("*") if p.is_file()) < 8e6
    assert max(SIZE) == 1024
    for path in scene.image_paths:
        with Image.open(path) as image:
            assert image.size == SIZE
            assert not image.getexif()
    assert (scene.K[0] == scene.K).all()
    off = scene.K[0, :2, 2] - (np.array(SIZE) - 1) / 2
    assert (np.abs(off) > 12).all()
    assert scene.K[0, 0, 0] == scene.K[0, 1, 1]


@pytest.mark.parametrize(("i", "j"), [(0, 1), (3, 5), (8, 6), (12, 13)])
def test_depth_of_one_view_agrees_with_that_of_another(scene, i, j):
    X = lift(scene, i)[1]
    depth, stride = load_fixture_depth(j)
    xy, z, inside = seen_in(scene, X, j)
    xy = np.where(inside[:, None], xy, 2.0) / stride
    there = look_up(depth, xy)
    # At a depth edge interpolation means nothing: compare where the four samples lie on one smooth surface.
    r, c = xy[:, 1].astype(int), xy[:, 0].astype(int)
    around = np.stack([depth[r, c], depth[r + 1, c], depth[r, c + 1], depth[r + 1, c + 1]])
    compared = inside & ~np.isnan(there) & (np.ptp(around, axis=0) < 0.04)
    difference = (z - there)[compared]
    visible = np.abs(difference) < 0.02
    assert visible.mean() > 0.6
    assert np.median(np.abs(difference[visible])) < 3e-4
    # A nearer surface of view j may hide the point (z > there); a farther one would mean a hole in the scene.
    assert (difference < -0.02).mean() < 2e-3


def test_a_view_is_made_again_byte_for_byte():
    view = 4
    jpeg, depth = render_image(build_courtyard(), courtyard_poses()[view], view)
    kept = (FOLDER / "images" / f"{view:04d}.jpg").read_bytes()
    cameras = (FOLDER / "cameras.json").read_text(encoding="utf-8")
    made_with = json.loads(cameras)["made_with"]
    assert courtyard_cameras(made_with) == cameras
    if made_with == versions():
        assert jpeg == kept
        assert encode_depth(depth) == (FOLDER / "depth" / f"{view:04d}.png").read_bytes()
    # Another library version may round or encode otherwise; the picture stays.
    a, b = (np.asarray(Image.open(io.BytesIO(data)), dtype=float) for data in (jpeg, kept))
    assert np.abs(a - b).mean() < 0.5
    stored = np.asarray(Image.open(FOLDER / "depth" / f"{view:04d}.png"), dtype=int)
    assert (np.abs(stored - depth.astype(int)) <= 1).mean() > 0.999


def test_the_file_is_made_again_byte_for_byte(tmp_path):
    write_cube(tmp_path)
    assert (tmp_path / "cube.npz").read_bytes() == (ROOT / "fixtures" / "cube" / "cube.npz").read_bytes()


SET_SIZES = {"fountain-P11": 11, "Herz-Jesus-P8": 8, "kermit": 11}


@pytest.mark.real
@pytest.mark.parametrize("name", REAL_SCENES)
def test_real_scenes(name):
    scene = load_real_scene(name)
    if scene is None:
        pytest.skip("the real images are not on this machine")
    assert len(scene.image_paths) == SET_SIZES[name]
    assert [p.name for p in scene.image_paths] == sorted(p.name for p in scene.image_paths)
    assert scene.has_truth == (name != "kermit")
    if scene.has_truth:
        np.testing.assert_allclose(np.linalg.det(scene.R), 1.0, atol=1e-4)
        assert scene.K.shape == (SET_SIZES[name], 3, 3)


def test_absent_images_are_none(monkeypatch, tmp_path):
    monkeypatch.setenv("THESISRECON_DATA", str(tmp_path))
    assert load_real_scene("kermit") is None
    monkeypatch.setenv("THESISRECON_DATA", str(tmp_path / "nowhere"))
    assert load_real_scene("kermit") is None


def test_an_image_without_its_truth_is_named(tmp_path):
    (tmp_path / "images").mkdir()
    for name in ("a.jpg", "b.JPG", "notes.txt"):
        (tmp_path / "images" / name).touch()
    assert [p.name for p in read_scene(tmp_path, "x").image_paths] == ["a.jpg", "b.JPG"]
    camera = {"name": "a.jpg", "K": np.eye(3).tolist(), "R": np.eye(3).tolist(), "t": [0, 0, 0]}
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": [camera]}))
    with pytest.raises(ValueError, match=r"b\.JPG"):
        read_scene(tmp_path, "x")


RAY_K = np.array([[90.0, 0.0, 33.0], [0.0, 90.0, 22.0], [0.0, 0.0, 1.0]])


RAY_SIZE = (64, 48)


RIGHT, DOWN, FORWARD = np.eye(3)


SUN = np.array([0.2, -0.6, -0.7])


def material(height):
    grey = np.full((*height.shape, 3), 0.5, np.float32)
    return Material(grey, height.astype(np.float32), 0.01)


def wall(height):
    """A wall 2 m x 2 m, 2 m in front of a camera at the origin, its normal towards the camera."""
    surface = Surface(np.array([-1.0, 1.0, 2.0]), RIGHT, -DOWN, (2.0, 2.0), 0)
    return build_world([[surface]], [material(height)], SUN)


def view(world, **options):
    return trace(world, Pose(RAY_K, np.eye(3), np.zeros(3)), RAY_SIZE, **options)


def test_cylinder_depth_is_the_closed_form():
    radius, distance = 0.4, 2.0
    drum = Surface(np.array([0.0, 1.0, distance]), RIGHT, -DOWN, (2 * np.pi * radius, 2.0), 0, radius=radius)
    flat = np.zeros((201, round(2 * np.pi * radius / 0.01) + 1))
    depth = view(build_world([[drum]], [material(flat)], SUN))[1]
    x = (np.arange(RAY_SIZE[0]) - RAY_K[0, 2]) / RAY_K[0, 0]
    a, b, c = 1.0 + x * x, -distance, distance**2 - radius**2
    inside = b * b - a * c
    expected = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0.0)
    np.testing.assert_allclose(depth, np.tile(expected, (RAY_SIZE[1], 1)), atol=5e-6)
    assert (depth > 0).any()
    assert (depth == 0).any()


def test_cameras_beside_flat_images_are_their_truth(scene, tmp_path):
    for name in ("0004.jpg", "0007.jpg"):
        (tmp_path / name).symlink_to(FOLDER / "images" / name)
    options = ReportOptions(tmp_path / "out", ("own",), (), folders={"own": str(tmp_path)})
    assert not load_images("own", options).has_truth
    (tmp_path / "cameras.json").symlink_to(FOLDER / "cameras.json")
    np.testing.assert_array_equal(load_images("own", options).C, scene.C[[4, 7]])
    (tmp_path / "other.jpg").symlink_to(FOLDER / "images" / "0009.jpg")
    with pytest.raises(
        ValueError, match=r"must have a camera with K for every image; it lacks \['other.jpg'"
    ):
        load_images("own", options)
