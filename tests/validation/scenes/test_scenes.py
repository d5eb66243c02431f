"""The scenes of the validation: made again byte for byte, with true geometry."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from validation.runs.records import ReportOptions, load_images
from validation.scenes.courtyard import build_courtyard
from validation.scenes.fixtures import (
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
from validation.scenes.real import ROOT, load_fixture_scene, read_scene

FOLDER = ROOT / "fixtures" / "courtyard"


@pytest.fixture(scope="module")
def scene():
    return load_fixture_scene("courtyard")


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
RIGHT, DOWN, _ = np.eye(3)
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
