"""The scenes of the validation: made again byte for byte, with true geometry."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

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
from validation.scenes.real_pairs import camera_pairs

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


def test_an_image_without_its_truth_is_not_known(tmp_path):
    (tmp_path / "images").mkdir()
    for name in ("a.jpg", "b.JPG", "notes.txt"):
        (tmp_path / "images" / name).touch()
    assert [p.name for p in read_scene(tmp_path, "x").image_paths] == ["a.jpg", "b.JPG"]
    camera = {"name": "a.jpg", "K": np.eye(3).tolist(), "R": np.eye(3).tolist(), "t": [0, 0, 0]}
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": [camera]}))
    assert read_scene(tmp_path, "x").known.tolist() == [True, False]
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": [camera | {"name": "z.jpg"}]}))
    with pytest.raises(ValueError, match=r"has a camera of no image of x: z.jpg there, a.jpg, b.JPG here"):
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
    # Of an image that the truth does not have nothing is known.
    (tmp_path / "other.jpg").symlink_to(FOLDER / "images" / "0009.jpg")
    partly = load_images("own", options)
    assert partly.known.tolist() == [True, True, False]
    np.testing.assert_array_equal(partly.truth[2][:2], scene.C[[4, 7]])
    assert not partly.has_truth
    with pytest.raises(ValueError, match="the cameras of own are not known"):
        _ = partly.cameras
    assert list(camera_pairs(partly, tmp_path)) == []


def numbers(*arrays):
    return " ".join(f"{v:.17g}" for a in arrays for v in np.ravel(a))


def write_truth(kind, folder, names, K, R, C):
    """Write true cameras in a format of data sets."""
    t = -np.einsum("vab,vb->va", R, C)
    if kind == "par.txt":
        rows = [f"{n} {numbers(*camera)}" for n, *camera in zip(names, K, R, t, strict=True)]
        (folder / "dino_par.txt").write_text("\n".join([str(len(rows)), *rows]))
    elif kind == "cams":
        (folder / "cams").mkdir()
        for n, k, r, move in zip(names, K, R, t, strict=True):
            text = (
                f"extrinsic {numbers(np.vstack([np.c_[r, move], [0, 0, 0, 1]]))} intrinsic {numbers(k)} 1 2"
            )
            (folder / "cams" / f"{Path(n).stem}_cam.txt").write_text(text)
    elif kind == "P":
        (folder / "cameras").mkdir()
        for n, k, r, move in zip(names, K, R, t, strict=True):
            (folder / "cameras" / f"{Path(n).stem}.P").write_text(numbers(k @ np.c_[r, move]))
    elif kind == "transforms.json":
        frames = []
        for n, k, r, c in zip(names, K, R, C, strict=True):
            M = np.vstack([np.c_[r.T @ np.diag([1, -1, -1]), c], [0, 0, 0, 1]]).tolist()
            more = {
                "fl_x": k[0, 0],
                "fl_y": k[1, 1],
                "cx": k[0, 2] + 0.5,
                "cy": k[1, 2] + 0.5,
                "w": 8,
                "h": 6,
            }
            frames.append({"file_path": n, "transform_matrix": M, **more})
        (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    elif kind == "TUM":
        quaternions = Rotation.from_matrix(np.swapaxes(R, 1, 2)).as_quat()
        lines = [f"{Path(n).stem} {numbers(c, q)}" for n, c, q in zip(names, C, quaternions, strict=True)]
        (folder / "groundtruth.txt").write_text("\n".join(lines))
        np.savetxt(folder / "K.txt", K[0])


@pytest.mark.parametrize("kind", ["par.txt", "cams", "P", "transforms.json", "TUM"])
def test_truth_of_any_format_is_that_of_the_images(kind, scene, tmp_path):
    chosen = [4, 7]
    names = [scene.image_paths[k].name for k in chosen]
    for name in (*names, "0009.jpg"):
        (tmp_path / name).symlink_to(FOLDER / "images" / name)
    write_truth(kind, tmp_path, names, scene.K[chosen], scene.R[chosen], scene.C[chosen])
    options = ReportOptions(tmp_path / "out", ("own",), (), folders={"own": str(tmp_path)})
    found = load_images("own", options)
    assert found.known.tolist() == [True, True, False]
    for part, true in zip(found.truth, scene.cameras, strict=True):
        np.testing.assert_allclose(part[:2], true[chosen], rtol=1e-6, atol=1e-8)


def test_k_alone_is_a_truth_of_intrinsics(scene, tmp_path):
    (tmp_path / "0004.jpg").symlink_to(FOLDER / "images" / "0004.jpg")
    np.savetxt(tmp_path / "K.txt", scene.K[0])
    options = ReportOptions(tmp_path / "out", ("own",), (), folders={"own": str(tmp_path)})
    found = load_images("own", options)
    assert found.truth is None
    np.testing.assert_allclose(found.K[0], scene.K[0])
    (tmp_path / "K.txt").write_text("1 2 3")
    with pytest.raises(ValueError, match=r"K.txt must hold the 3 x 3 numbers of K"):
        load_images("own", options)
