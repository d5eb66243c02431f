"""The scenes of the validation: made again byte for byte, with true geometry."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import thesisrecon
from validation.ablation.tasks.reconstruction import Reconstruction
from validation.command import main
from validation.runs.models import report_models
from validation.runs.records import ReportOptions, load_images
from validation.scenes import fixtures
from validation.scenes.courtyard import build_courtyard
from validation.scenes.layout import SETS
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
    jpeg, depth = fixtures.render_image(build_courtyard(), fixtures.courtyard_poses()[view], view)
    kept = (FOLDER / "images" / f"{view:04d}.jpg").read_bytes()
    cameras = (FOLDER / "cameras.json").read_text(encoding="utf-8")
    made_with = json.loads(cameras)["made_with"]
    assert fixtures.courtyard_cameras(made_with) == cameras
    if made_with == fixtures.versions():
        assert jpeg == kept
        assert fixtures.encode_depth(depth) == (FOLDER / "depth" / f"{view:04d}.png").read_bytes()
    # Another library version may round or encode otherwise; the picture stays.
    a, b = (np.asarray(Image.open(io.BytesIO(data)), dtype=float) for data in (jpeg, kept))
    assert np.abs(a - b).mean() < 0.5
    stored = np.asarray(Image.open(FOLDER / "depth" / f"{view:04d}.png"), dtype=int)
    assert (np.abs(stored - depth.astype(int)) <= 1).mean() > 0.999


def test_the_file_is_made_again_byte_for_byte(tmp_path):
    fixtures.write_cube(tmp_path)
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


def write_colmap(folder, names, K, R, t):
    """COLMAP's text, with the centre of the first pixel at 0.5."""
    folder.mkdir(parents=True)
    cameras, images = [], []
    for i, (n, k, r, move) in enumerate(zip(names, K, R, t, strict=True), start=1):
        cameras.append(f"{i} PINHOLE 1024 768 {numbers(np.diag(k)[:2], k[:2, 2] + 0.5)}")
        images.append(f"{i} {numbers(np.roll(Rotation.from_matrix(r).as_quat(), 1), move)} {i} {n}\n")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", [])):
        (folder / f"{name}.txt").write_text("\n".join([*lines, ""]))


def write_truth(kind, folder, names, K, R, C):
    """Write true cameras in a format of data sets; return the model."""
    t, stems = -np.einsum("vab,vb->va", R, C), [Path(n).stem for n in names]
    each = list(zip(stems, K, R, t, strict=True))
    place = folder / FORMATS[kind][1]
    if kind == "COLMAP":
        write_colmap(place, names, K, R, t)
    elif kind == "ETH3D":
        write_colmap(place, [f"dslr_images_undistorted/{n}" for n in names], K, R, t)
    elif kind == "Middlebury":
        rows = [f"{n} {numbers(*camera)}" for n, *camera in zip(names, K, R, t, strict=True)]
        place.write_text("\n".join([str(len(rows)), *rows]))
    elif kind == "BlendedMVS":
        place.mkdir()
        for n, k, r, move in each:
            M = np.vstack([np.c_[r, move], [0, 0, 0, 1]])
            (place / f"{n}_cam.txt").write_text(f"extrinsic {numbers(M)} intrinsic {numbers(k)} 1 2")
    elif kind in ("P", "DTU"):
        place.mkdir()
        for n, k, r, move in each:
            file = f"{n}.P" if kind == "P" else f"pos_{n.split('_')[1]}.txt"
            (place / file).write_text(numbers(k @ np.c_[r, move]))
    elif kind == "transforms.json":
        frames = []
        for n, k, r, c in zip(names, K, R, C, strict=True):
            M = np.vstack([np.c_[r.T @ np.diag([1, -1, -1]), c], [0, 0, 0, 1]]).tolist()
            more = {"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2] + 0.5, "cy": k[1, 2] + 0.5}
            frames.append({"file_path": n, "transform_matrix": M, "w": 1024, "h": 768, **more})
        place.write_text(json.dumps({"frames": frames}))
    elif kind == "TUM":
        quaternions = Rotation.from_matrix(np.swapaxes(R, 1, 2)).as_quat()
        times = [float(n) + 0.003 for n in stems]
        lines = [f"{n:.6f} {numbers(c, q)}" for n, c, q in zip(times, C, quaternions, strict=True)]
        place.write_text("\n".join(lines))
    elif kind == "KITTI":
        place.write_text("\n".join(numbers(np.c_[r.T, c]) for r, c in zip(R, C, strict=True)))
    if kind in ("TUM", "KITTI", "K"):
        np.savetxt(folder / "K.txt", K[0])
    return place


# Names of images in each format, and where its truth stands.
FORMATS = {
    "COLMAP": ("{}.jpg", "sparse/0"),
    "Middlebury": ("{}.jpg", "dino_par.txt"),
    "TUM": ("130503110{}.175304.jpg", "groundtruth.txt"),
    "KITTI": ("00000{}.jpg", "poses.txt"),
    "BlendedMVS": ("0000000{}.jpg", "cams"),
    "DTU": ("rect_00{}_3_r5000.jpg", "cal18"),
    "ETH3D": ("DSC_028{}.jpg", "dslr_calibration_undistorted"),
    "transforms.json": ("{}.jpg", "transforms.json"),
    "P": ("{}.jpg", "cameras"),
    "K": ("{}.jpg", "K.txt"),
}


@pytest.mark.parametrize("kind", FORMATS)
def test_truth_of_any_format_in_study_report_and_compare(kind, scene, tmp_path):
    """A model with 1 % more focal length is right but for that; the truth lacks the fourth image."""
    chosen = [4, 7, 10, 12]
    names = [FORMATS[kind][0].format(k) for k in range(4)]
    for name, k in zip(names, chosen, strict=True):
        (tmp_path / name).symlink_to(scene.image_paths[k])
    K, R, C = (part[chosen] for part in scene.cameras)
    truth = write_truth(kind, tmp_path, names[:3], K[:3], R[:3], C[:3])
    found = load_images("own", ReportOptions(tmp_path / "out", ("own",), (), folders={"own": str(tmp_path)}))
    if kind == "K":
        assert found.truth is None
        np.testing.assert_allclose(found.K, K, rtol=1e-12)
    else:
        assert found.known.tolist() == [True, True, True, False]
        for part, true in zip(found.truth, (K, R, C), strict=True):
            np.testing.assert_allclose(part[:3], true[:3], rtol=1e-6, atol=1e-6)
    model = tmp_path / "model.json"
    wide = np.diag([1.01, 1.01, 1.0])
    cameras = [
        {"name": n, "width": 1024, "height": 768, "K": (k @ wide).tolist(), "R": r.tolist(), "C": c.tolist()}
        for n, k, r, c in zip(names, K, R, C, strict=True)
    ]
    model.write_text(json.dumps({"cameras": cameras}), encoding="utf-8")
    compared = thesisrecon.compare_models(model, truth)
    assert len(compared.names) == (4 if kind == "K" else 3)
    without_K = kind in ("TUM", "KITTI")
    np.testing.assert_allclose(compared.focal_error_rel, np.nan if without_K else 0.01, rtol=1e-5)
    np.testing.assert_allclose(compared.centre_error, np.nan if kind == "K" else 0.0, atol=1e-6)
    report_models({"mine": model}, ("truth", truth), tmp_path / "report")
    lines = json.loads((tmp_path / "report" / "numbers.json").read_text(encoding="utf-8"))
    reported = {line["name"]: line["mine"] for line in lines}
    assert reported.get("AUC@1°") == (None if kind == "K" else pytest.approx(100.0, abs=1e-3))
    assert reported.get("focal error, median") == (None if without_K else pytest.approx(1.0, rel=1e-4))


def download(kind, folder, names, K, R, C):
    """Write the truth of a data set as it is downloaded; return the folder of a scene and that of images."""
    if kind == "strecha":
        images, cameras = folder / "images", folder / "gt_dense_cameras"
        cameras.mkdir()
        for n, k, r, c in zip(names, K, R, C, strict=True):
            rows = [*map(numbers, k), "0 0 0", *map(numbers, r.T), numbers(c), "1024 768"]
            (cameras / f"{n}.camera").write_text("\n".join(rows))
        return folder, images
    if kind == "tanks-and-temples":
        poses = [np.vstack([np.c_[r.T, c], [0, 0, 0, 1]]) for r, c in zip(R, C, strict=True)]
        text = [line for i, M in enumerate(poses) for line in (f"{i} {i} 0", *map(numbers, M))]
        (folder / "Barn_COLMAP_SfM.log").write_text("\n".join(text))
        np.savetxt(folder / "K.txt", K[0])
        return folder, folder / "images"
    form, images = {
        "eth3d": ("ETH3D", folder / "images" / "dslr_images_undistorted"),
        "dtu": ("DTU", folder / "Rectified" / "scan1"),
        "middlebury-mvs": ("Middlebury", folder),
        "phototourism": ("COLMAP", folder / "dense" / "images"),
    }[kind]
    place = write_truth(form, folder, names, K, R, C)
    moved = {"dtu": "Calibration/cal18", "phototourism": "dense/sparse"}.get(kind)
    if moved:
        (folder / moved).parent.mkdir(exist_ok=True)
        place.rename(folder / moved)
    return (images if kind == "dtu" else folder), images


@pytest.mark.parametrize("kind", SETS)
def test_a_download_is_laid_out_by_one_command(kind, scene, tmp_path, capsys):
    source, out, chosen = tmp_path / "download", tmp_path / "out", [4, 7, 10]
    source.mkdir()
    pattern = {"dtu": "rect_00{}_3_r5000.png", "tanks-and-temples": "00000{}.jpg"}.get(kind, "{}.jpg")
    names = [pattern.format(k + 1) for k in range(3)]
    K, R, C = (part[chosen] for part in scene.cameras)
    folder, images = download(kind, source, names, K, R, C)
    images.mkdir(parents=True, exist_ok=True)
    for name, k in zip(names, chosen, strict=True):
        (images / name).symlink_to(scene.image_paths[k])
    command = ["layout", kind, str(folder), "-o", str(out)]
    assert main(command) == 0
    assert capsys.readouterr().out == f"3 images, 3 with a camera: {out}\n"
    options = ReportOptions(tmp_path, ("own",), (), folders={"own": str(out)})
    for part, true in zip(load_images("own", options).cameras, (K, R, C), strict=True):
        np.testing.assert_allclose(part, true, rtol=1e-6, atol=1e-6)
    assert main(command) == 2
    assert "is not empty" in capsys.readouterr().err
    assert main(["layout", kind, str(tmp_path), "-o", str(tmp_path / "none")]) == 2
    assert " has no " in capsys.readouterr().err


def test_poses_alone_and_k_alone_are_truths_without_the_other(scene, tmp_path):
    options = ReportOptions(tmp_path / "out", ("own",), (), folders={"own": str(tmp_path)})
    chosen = [4, 7, 10]
    for number, k in enumerate(chosen):
        (tmp_path / f"{number:06d}.jpg").symlink_to(scene.image_paths[k])
    K, R, C = (part[chosen] for part in scene.cameras)
    write_truth("KITTI", tmp_path, ["0", "1", "2"], K, R, C)
    (tmp_path / "K.txt").unlink()
    task, poses = Reconstruction(), load_images("own", options)
    assert poses.K is None
    assert not poses.has_truth
    assert poses.known.all()
    np.testing.assert_allclose(poses.truth[1], R, atol=1e-12)
    np.testing.assert_allclose(poses.truth[2], C, atol=1e-12)
    assert task.unavailable(str(tmp_path)) == {"focal_error_pct"}
    key = task.scene_key(str(tmp_path))
    (tmp_path / "poses.txt").unlink()
    np.savetxt(tmp_path / "K.txt", K[0])
    found = load_images("own", options)
    assert found.truth is None
    assert {"centre_error_mm", "auc1_pct"} <= task.unavailable(str(tmp_path))
    assert task.scene_key(str(tmp_path)) != key
    np.testing.assert_allclose(found.K, K)
    (tmp_path / "K.txt").write_text("1 2 3")
    with pytest.raises(ValueError, match=r"K.txt must hold the 3 x 3 numbers of K"):
        load_images("own", options)
