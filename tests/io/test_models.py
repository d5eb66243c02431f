"""Models of every format as one record, compared with pycolmap and with the formats' own definitions."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import thesisrecon as tr
from tests.conftest import refuses
from tests.io.test_colmap import NAMES, export, scene
from thesisrecon.camera import camera_of_row
from thesisrecon.errors import UsageError
from thesisrecon.io._models import read_model

R = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()  # world to camera
CENTRE = np.array([1.0, -2.0, 0.5])
KINDS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR",
)  # fmt: skip
AHEAD = np.array([[0.2, -0.1, 1.0], [-0.4, 0.3, 1.5], [0.0, 0.0, 2.0]])
RADIAL = {"SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 2, "FULL_OPENCV": 3}


def rig_model(pycolmap):
    """Two frames of a rig with one camera of each kind; each image sees three points."""
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    for number, kind in enumerate(KINDS, start=1):
        camera = pycolmap.Camera.create_from_model_name(number, kind, 500.0, 640, 480)
        params = camera.params
        if kind != "EQUIRECTANGULAR":
            two = len(camera.focal_length_idxs()) == 2
            params[: 4 if two else 3] = [500.0, 505.0, 310.0, 250.0] if two else [500.0, 310.0, 250.0]
            for k, place in enumerate({"FULL_OPENCV": (4, 5, 8)}.get(kind, (4, 5) if two else (3, 4))):
                if k < RADIAL.get(kind, 0):
                    params[place] = 0.1 * (k + 1)
        camera.params = params
        model.add_camera(camera)
        offset = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1 * number, 0, 0])), [0.1 * number, 0, 0])
        if number == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, offset)
    model.add_rig(rig)
    X = np.random.default_rng(2).normal(0, 1, (3, 3))
    for x in X:
        model.add_point3D(x, pycolmap.Track(), np.array([7, 8, 9], np.uint8))
    for f in range(2):
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(R), [0.0, f, 4.0])
        images = []
        for number in range(1, len(KINDS) + 1):
            seen = [pycolmap.Point2D(np.array([10.0 * k + number, 20.5])) for k in range(4)]
            image = pycolmap.Image(
                name=f"{f}/böld {number}.jpg", points2D=seen, camera_id=number, image_id=f * 100 + number
            )
            image.frame_id = f + 1
            frame.add_data_id(image.data_id)
            images.append(image)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(f + 1)
    for image in model.images.values():
        for k in range(3):
            model.add_observation(k + 1, pycolmap.TrackElement(image.image_id, k))
    return model, X


@pytest.mark.references
@pytest.mark.parametrize("text", [True, False])
def test_a_rig_with_cameras_of_all_kinds_is_read_as_pycolmap_reads_it(tmp_path, text):
    import pycolmap

    theirs, X = rig_model(pycolmap)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (theirs.write_text if text else theirs.write_binary)(tmp_path / "sparse" / "0")
    ours = read_model(str(tmp_path))
    np.testing.assert_allclose(ours.X, X, atol=1e-12)
    np.testing.assert_array_equal(ours.colors, np.tile([7, 8, 9], (3, 1)))
    assert len(ours.views) == 2 * len(KINDS)
    assert len(ours.xy) == 3 * len(ours.views)
    images = {image.name: image for image in theirs.images.values()}
    for i, view in enumerate(ours.views):
        image = images[view.name]
        camera, kind = image.camera, KINDS[view.camera - 1]
        np.testing.assert_allclose(view.R, image.cam_from_world().rotation.matrix(), atol=1e-12)
        np.testing.assert_allclose(view.centre, image.projection_center(), atol=1e-12)
        assert view.size == (640, 480)
        if kind == "EQUIRECTANGULAR":
            assert view.K is None
        else:
            focal = camera.params[camera.focal_length_idxs()]
            np.testing.assert_array_equal(np.diag(view.K)[:2], [focal[0], focal[-1]])
            np.testing.assert_array_equal(view.K[:2, 2], camera.params[camera.principal_point_idxs()] - 0.5)
        if kind in RADIAL:
            expected = [0.1 * (k + 1) if k < RADIAL[kind] else 0.0 for k in range(3)]
            np.testing.assert_allclose(view.distortion, expected)
        elif kind in ("FOV", "RAD_TAN_THIN_PRISM_FISHEYE", "EUCM", "EQUIRECTANGULAR"):
            assert view.distortion is None
        else:
            ours_there = camera_of_row((view.K, np.eye(3), np.zeros(3)), view.size, view.distortion)
            expected = camera.img_from_cam(AHEAD) - 0.5
            np.testing.assert_allclose(ours_there.project(AHEAD), expected, atol=1e-9)
        here = ours.view_index == i
        np.testing.assert_array_equal(ours.point_index[here], [0, 1, 2])
        np.testing.assert_allclose(ours.xy[here, 0], 10.0 * np.arange(3) + view.camera - 0.5)


@pytest.mark.references
def test_tangential_distortion_is_read(tmp_path):
    import pycolmap

    export(tmp_path, scene(k=(-0.1, 0.05, -0.02)))
    model = pycolmap.Reconstruction(tmp_path)
    model.cameras[1].params = [*model.cameras[1].params[:6], 1e-4, *model.cameras[1].params[7:]]
    (tmp_path / "text").mkdir()
    model.write_text(tmp_path / "text")
    view = read_model(tmp_path / "text").views[0]
    ours = camera_of_row((view.K, np.eye(3), np.zeros(3)), view.size, view.distortion)
    assert ours.lens == "brown"
    np.testing.assert_allclose(ours.project(AHEAD), model.cameras[1].img_from_cam(AHEAD) - 0.5, atol=1e-9)


CAMERA = {"K": [[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], "R": R.tolist(), "width": 640, "height": 480}


def test_cameras_by_list_or_table_and_the_points_of_a_run(tmp_path):
    ours = {**CAMERA, "t": (-R @ CENTRE).tolist(), "distortion": [0.1, 0, 0]}
    listed = [{**ours, "name": name} for name in NAMES]
    table = {name: {**CAMERA, "C": CENTRE.tolist()} for name in NAMES}
    for file, cameras in (("cameras.json", listed[::-1]), ("truth.json", table)):
        (tmp_path / file).write_text(json.dumps({"cameras": cameras}), encoding="utf-8")
    export(tmp_path / "sparse" / "0", scene())
    run, truth = read_model(tmp_path), read_model(tmp_path / "truth.json")
    assert run.names == NAMES[::-1]
    assert truth.names == NAMES
    for view, k1 in ((run.views[0], 0.1), (truth.views[0], 0.0)):
        np.testing.assert_allclose(view.centre, CENTRE, atol=1e-12)
        np.testing.assert_array_equal(view.distortion, [k1, 0, 0])
        np.testing.assert_array_equal(view.K, CAMERA["K"])
        assert view.size == (640, 480)
    colmap = read_model(tmp_path / "sparse" / "0")
    np.testing.assert_array_equal(run.X, colmap.X)
    names = np.array(NAMES)
    np.testing.assert_array_equal(names[::-1][run.view_index], np.array(colmap.names)[colmap.view_index])


@pytest.mark.parametrize("kind", ["tum", "kitti"])
def test_trajectories_are_camera_to_world(tmp_path, kind):
    x, y, z, w = Rotation.from_matrix(R.T).as_quat()
    rows = {
        "tum": f"# time x y z qx qy qz qw\n\n1305031102.1753 1 -2 0.5 {x} {y} {z} {w}\n1.5 0 0 0 0 0 0 2\n",
        "kitti": " ".join(f"{v:.7e}" for v in np.column_stack([R.T, CENTRE]).ravel()) + "\n" + "1 0 0 0 " * 3,
    }
    path = tmp_path / "poses.txt"
    path.write_text(rows[kind].replace("1 0 0 0 1 0 0 0 1 0 0 0", "1 0 0 0 0 1 0 0 0 0 1 0"))
    first, second = read_model(path).views
    names = {"tum": ["1305031102.1753", "1.5"], "kitti": ["000000", "000001"]}
    assert [first.name, second.name] == names[kind]
    np.testing.assert_allclose(first.R, R, atol=1e-6)
    np.testing.assert_allclose(first.centre, CENTRE, atol=1e-6)
    np.testing.assert_array_equal(second.R, np.eye(3))
    assert first.K is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no pose; give the folder of a run"),
        ("a b c", "line 1 of .* is 'a b c'; each line needs a pose of 8"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0", "line 2 of"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 nan 0", "line 2 of"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0", "line 2 of"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1", "holds '1' twice; each view needs a name of its own"),
        ("2 0 0 0 0 2 0 0 0 0 2 0", "line 1 of"),
    ],
)
def test_other_texts_are_refused(tmp_path, text, words):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    refuses(UsageError, words, read_model, path)


def test_other_paths_are_refused(tmp_path):
    refuses(UsageError, "holds no model; give the folder of a run", read_model, tmp_path)
    refuses(UsageError, r"there is no .*nowhere; give", read_model, tmp_path / "nowhere")
    (tmp_path / "images.bin").write_bytes(b"\xff" * 99)
    refuses(UsageError, "is not a UTF-8 text", read_model, tmp_path / "images.bin")


@pytest.mark.references
@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("cameras", "SIMPLE_PINHOLE", "LYTRO", "cameras.txt is not a valid COLMAP file"),
        ("cameras", "600", "-600", "camera 1 needs finite parameters and positive focal lengths"),
        ("cameras", "1 SIMPLE", "2 SIMPLE", "image 'a b.jpg' of the COLMAP model refers to a missing camera"),
        ("images", "1 a b.jpg", "1", "images.txt is not a valid COLMAP file"),
        ("points3D", "\n1 ", "\n99 ", "refers to a missing point"),
        ("points3D", "\n1 ", f"\n{10**30} ", "points3D.txt is not a valid COLMAP file"),
    ],
)
def test_a_damaged_text_model_is_refused(tmp_path, file, old, new, words):
    import pycolmap

    export(tmp_path / "binary", scene())
    pycolmap.Reconstruction(tmp_path / "binary").write_text(tmp_path)
    path = tmp_path / f"{file}.txt"
    path.write_text(path.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    refuses(UsageError, words, read_model, tmp_path)


@pytest.mark.parametrize(
    ("camera", "sentence"),
    [
        ("1 PINHOLE 0 96 100 100 64 48", "the sides must be whole numbers from 1 to"),
        ("1 PINHOLE 128 -1 100 100 64 48", "the sides must be whole numbers from 1 to"),
        ("1 PINHOLE 128 99999999999 100 100 64 48", "the sides must be whole numbers from 1 to"),
        ("1 PINHOLE 128 96 100 0 64 48", "positive focal lengths"),
        ("1 PINHOLE 128 96 100 -100 64 48", "positive focal lengths"),
        ("1 OPENCV_FISHEYE 128 96 100 -1 64 48 0 0 0 0", "positive focal lengths"),
        ("1 SIMPLE_RADIAL 128 96 -100 64 48 0", "positive focal lengths"),
        ("1 PINHOLE 128 96 inf 100 64 48", "finite parameters"),
        ("1 PINHOLE 128 96 100 100 nan 48", "finite parameters"),
        ("1 PINHOLE 128 96 1e300 1e300 64 48", "finite parameters"),
        ("1 PINHOLE 128 96 1e-300 1e-300 64 48", "finite parameters"),
        ("1 PINHOLE 128 96 100 100 64", "another number of parameters"),
    ],
)
def test_impossible_cameras_of_a_colmap_model_are_refused(tmp_path, camera, sentence):
    for name, text in (("cameras", camera), ("images", ""), ("points3D", "")):
        (tmp_path / f"{name}.txt").write_text(text + "\n")
    refuses(UsageError, sentence, read_model, tmp_path)


@pytest.mark.references
def test_a_reconstruction_of_pycolmap_is_a_model_wherever_its_folder_is(tmp_path):
    import pycolmap

    # Enough points for a run of its own.
    X, K = np.random.default_rng(0).uniform(-1, 1, (200, 3)), np.diag([900.0, 900, 1])
    K[:2, 2] = 319.5, 239.5
    angles = np.radians([[0, -30, 5], [25, -15, 0], [-5, 0, 20], [15, 15, 0], [-20, 25, 5]])
    turns, t = Rotation.from_euler("xyz", angles).as_matrix(), np.tile([0, 0, 6.0], (5, 1))
    xy = np.stack([tr.Camera(K, r, t[0], (640, 480)).project(X) for r in turns])
    xy += np.random.default_rng(1).normal(0, 0.3, xy.shape)
    known = tr.reconstruction_from_cameras(K, turns, t, sizes=(640, 480), X=X, xy=xy)
    tr.export(known, tmp_path / "ours", to="colmap")
    folder = tmp_path / "ours" / "sparse" / "0"
    model, names = pycolmap.Reconstruction(folder), list(tr.read_cameras(folder))
    positions = {image.name: 2.0 * image.projection_center() for image in model.images.values()}

    def exported(given, to):
        folder = tr.export(given, tmp_path / to / type(given).__name__, to=to).file.parent
        files = (one for one in sorted(folder.rglob("*")) if one.is_file() and "json" not in one.name)
        return [one.read_bytes() for one in files]

    calls = {
        "align": lambda given: tr.align_to_positions(given, positions)[0],
        "scaled": lambda given: tr.scaled(given, names[0], names[1], 2.0),
        "compare": lambda given: tr.compare_models(given, folder),
        "colmap": lambda given: exported(given, "colmap"),
        "bundle": tr.bundle_adjust,
        "bundle of arrays": lambda given: tr.bundle_adjust(given, X, xy, free=()),
        "again": lambda given: tr.reconstruct_from_colmap(given).metric.reconstruction,
    }  # fmt: skip
    for name, call in calls.items():
        assert call(model) == call(folder), name
    assert abs(tr.bundle_adjust(model).cameras[0].K[0, 0] - 900.0) < 9.0
    empty = pycolmap.Reconstruction()
    for call in calls.values():
        with pytest.raises(ValueError, match=r"camera|no observations|image of the model|unknown image"):
            call(empty)
