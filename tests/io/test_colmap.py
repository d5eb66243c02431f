import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import compose_camera, project_camera
from thesisrecon.io.colmap import colmap_from_reconstruction, reconstruction_from_colmap
from thesisrecon.io.colmap_model import ColmapModel, ColmapPoints, read_colmap_model, write_colmap_model
from thesisrecon.records import Reconstruction, Tracks

V, N = 5, 40
NAMES = ["a b.jpg", "böld.jpg", "c.jpg", "d.jpg", "e.jpg"]
SIZE = (512, 384)


def _scene(*, k1=0.0, aspect=1.0, noise_px=0.3):
    """Five views of forty points; view 3 is not registered, every ninth point not valid, some outliers."""
    rng = np.random.default_rng(5)
    X = np.column_stack([rng.uniform(-1, 1, (N, 3)), np.ones(N)])
    K = np.broadcast_to([[600.0, 0, 250.3], [0, 600.0 * aspect, 195.1], [0, 0, 1]], (V, 3, 3)).copy()
    R = Rotation.from_rotvec(rng.normal(0, 0.4, (V, 3))).as_matrix()
    t = np.column_stack([rng.normal(0, 0.3, (V, 2)), rng.uniform(4, 6, V)])
    registered = np.arange(V) != 3
    valid = np.arange(N) % 9 != 4
    view, point = (grid.ravel() for grid in np.meshgrid(np.arange(V), np.arange(N)))
    xy = np.array(
        [
            project_camera(K[i], R[i], t[i], X[j : j + 1, :3], distortion=k1)[0]
            for i, j in zip(view, point, strict=True)
        ]
    )
    X[~valid] = 0
    return Reconstruction(
        stratum="metric",
        P=np.where(registered[:, None, None], compose_camera(K, R, t), 0.0),
        X=X,
        registered=registered,
        valid=valid,
        inlier=rng.random(V * N) > 0.15,
        tracks=Tracks(view, point, xy + rng.normal(0, noise_px, xy.shape), V, N),
        sizes=np.tile(SIZE, (V, 1)),
        sigma_px=noise_px,
        reasons=tuple("" if known else "too few points" for known in registered),
        K=np.where(registered[:, None, None], K, 0.0),
        distortion=np.tile([k1, 0.0, 0.0], (V, 1)),
    )


def _export(reconstruction, *, scales=None):
    return colmap_from_reconstruction(
        reconstruction,
        NAMES,
        colors=np.random.default_rng(0).integers(0, 256, (N, 3), dtype=np.uint8),
        groups=np.zeros(V, dtype=np.int64),
        scales=np.full(V, 1.0) if scales is None else scales,
    )


def _plain_names(model):
    images = tuple(replace(image, name=image.name.replace(" ", "_")) for image in model.images)
    return replace(model, images=images)


@pytest.mark.parametrize(
    ("k1", "aspect", "kind"),
    [
        (0.0, 1.0, "SIMPLE_PINHOLE"),
        (0.0, 1.01, "PINHOLE"),
        (-0.12, 1.0, "SIMPLE_RADIAL"),
        (-0.12, 1.01, "OPENCV"),
    ],
)
@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("scale", [(1.0, 1.0), (2.0, 2.0), (1.5, 1.4987)])
def test_pycolmap_projects_as_we_do(tmp_path, k1, aspect, kind, binary, scale):
    pycolmap = pytest.importorskip("pycolmap")
    ours = _scene(k1=k1, aspect=aspect)
    model = _plain_names(_export(ours, scales=np.tile(scale, (V, 1))))
    if scale[0] == scale[1]:
        assert {camera.model for camera in model.cameras} == {kind}
    write_colmap_model(tmp_path, model, binary=binary)
    theirs = pycolmap.Reconstruction(tmp_path)

    assert theirs.num_reg_images() == 4
    compared = 0
    for i in np.flatnonzero(ours.registered):
        image = theirs.images[int(i) + 1]
        assert image.name == NAMES[i].replace(" ", "_")
        camera = theirs.cameras[image.camera_id]
        np.testing.assert_array_equal((camera.width, camera.height), np.rint(np.multiply(SIZE, scale)))
        pose = np.linalg.solve(ours.K[i], ours.P[i])
        for seen in image.points2D:
            j = seen.point3D_id - 1
            xy = project_camera(ours.K[i], pose[:, :3], pose[:, 3], ours.X[j : j + 1, :3], distortion=k1)[0]
            projected = image.project_point(theirs.points3D[j + 1].xyz)
            np.testing.assert_allclose(projected, (xy + 0.5) * scale, atol=1e-6, rtol=0)
            k = int(j * V + i)
            np.testing.assert_allclose(seen.xy, (ours.tracks.xy[k] + 0.5) * scale, atol=1e-9, rtol=0)
            assert ours.inlier[k]
            compared += 1
    assert compared == len(model.points.track_image) > 100
    stored = theirs.compute_mean_reprojection_error()
    theirs.update_point_3d_errors()
    assert theirs.compute_mean_reprojection_error() == pytest.approx(stored, abs=1e-9)


@pytest.mark.parametrize("binary", [True, False])
def test_round_trip_keeps_every_byte(tmp_path, binary):
    model = _plain_names(_export(_scene(k1=0.05)))
    write_colmap_model(tmp_path / "first", model, binary=binary)
    write_colmap_model(tmp_path / "second", read_colmap_model(tmp_path / "first"), binary=binary)
    first = {path.name: path.read_bytes() for path in (tmp_path / "first").iterdir()}
    second = {path.name: path.read_bytes() for path in (tmp_path / "second").iterdir()}
    assert first == second
    assert len(first) == 5


@pytest.mark.parametrize("binary", [True, False])
def test_files_of_pycolmap_are_read_and_written_back_alike(tmp_path, binary):
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2,
        num_cameras_per_rig=1,
        num_frames_per_rig=3,
        num_points3D=30,
        num_points2D_without_point3D=4,
    )
    theirs = pycolmap.synthesize_dataset(options)
    (tmp_path / "theirs").mkdir()
    (theirs.write_binary if binary else theirs.write_text)(tmp_path / "theirs")
    model = read_colmap_model(tmp_path / "theirs")
    assert len(model.images) == 6
    assert len(model.points.ids) == 30
    write_colmap_model(tmp_path / "ours", model)
    again = pycolmap.Reconstruction(tmp_path / "ours")
    again.write_binary(tmp_path / "ours")
    theirs.write_binary(tmp_path / "theirs")
    for name in ("cameras.bin", "points3D.bin", "images.bin"):
        assert (tmp_path / "ours" / name).read_bytes() == (tmp_path / "theirs" / name).read_bytes()


def test_images_that_share_a_rig_are_read_with_their_whole_poses(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=4, num_points3D=20
        )
    )
    theirs.write_binary(tmp_path)
    read = reconstruction_from_colmap(read_colmap_model(tmp_path))
    names = sorted(image.name for image in theirs.images.values())
    for image in theirs.images.values():
        pose = np.linalg.solve(read.K[names.index(image.name)], read.P[names.index(image.name)])
        np.testing.assert_allclose(pose, image.cam_from_world().matrix(), atol=1e-9)


def test_folder_without_rigs_and_frames_is_read(tmp_path):
    model = _export(_scene())
    write_colmap_model(tmp_path, model)
    whole = read_colmap_model(tmp_path)
    (tmp_path / "rigs.bin").unlink()
    (tmp_path / "frames.bin").unlink()
    old = read_colmap_model(tmp_path)
    assert old.cameras == whole.cameras
    assert [image.name for image in old.images] == [NAMES[i] for i in (0, 1, 2, 4)]


def test_import_restores_the_export(tmp_path):
    ours = _scene(k1=-0.08)
    write_colmap_model(tmp_path, _export(ours))
    back = reconstruction_from_colmap(read_colmap_model(tmp_path), names=NAMES)
    np.testing.assert_array_equal(back.registered, ours.registered)
    np.testing.assert_allclose(back.P, ours.P, atol=1e-9)
    np.testing.assert_allclose(back.K, ours.K, atol=1e-10)
    np.testing.assert_array_equal(back.distortion[:, 0], np.where(ours.registered, -0.08, 0.0))
    assert not back.distortion[:, 1:].any()
    assert back.reasons[3] == "not in the COLMAP model"
    assert back.sigma_px == pytest.approx(0.3, rel=0.3)
    kept = ours.inlier & ours.registered[ours.tracks.view_index] & ours.valid[ours.tracks.point_index]
    kept &= np.bincount(ours.tracks.point_index[kept], minlength=N)[ours.tracks.point_index] >= 2
    np.testing.assert_allclose(back.tracks.xy, ours.tracks.xy[kept], atol=1e-9)
    np.testing.assert_array_equal(back.tracks.view_index, ours.tracks.view_index[kept])
    keys = back.tracks.point_index * V + back.tracks.view_index
    assert (np.diff(keys) > 0).all()


def test_views_of_a_group_share_a_camera_only_where_their_intrinsics_agree():
    ours = _scene()
    assert len(_export(ours).cameras) == 1
    K = ours.K.copy()
    K[1, 0, 0] = K[1, 1, 1] = 650.0
    P = ours.P.copy()
    P[1] = K[1] @ np.linalg.solve(ours.K[1], ours.P[1])
    model = _export(replace(ours, K=K, P=P))
    assert [image.camera_id for image in model.images] == [1, 2, 1, 1]


def test_cameras_carry_the_sizes_of_the_photographs():
    ours, scales = _scene(), np.full(V, 3.001)
    guessed = _export(ours, scales=scales).cameras[0]
    assert (guessed.width, guessed.height) == (1537, 1152)
    model = colmap_from_reconstruction(
        ours,
        NAMES,
        colors=np.zeros((N, 3), np.uint8),
        groups=np.zeros(V, dtype=np.int64),
        scales=scales,
        original_sizes=np.tile((1537, 1155), (V, 1)),
    )
    assert (model.cameras[0].width, model.cameras[0].height) == (1537, 1155)


def test_a_point_seen_twice_in_an_image_keeps_its_first_observation():
    model = _export(_scene())
    image, points = model.images[0], model.points
    # Point 0 is listed once more, by a second image point of the same image.
    extra = replace(
        image, xy=np.vstack([image.xy, [[9.0, 9.0]]]), point_ids=np.append(image.point_ids, points.ids[0])
    )
    at = points.track_start[1]
    twice = replace(
        points,
        track_start=points.track_start + (np.arange(len(points.track_start)) > 0),
        track_image=np.insert(points.track_image, at, image.image_id),
        track_xy=np.insert(points.track_xy, at, len(image.xy)),
    )
    doubled = replace(model, images=(extra, *model.images[1:]), points=twice)
    once, again = reconstruction_from_colmap(model), reconstruction_from_colmap(doubled)
    np.testing.assert_array_equal(once.tracks.xy, again.tracks.xy)


def test_export_rejects_values_that_colmap_cannot_store():
    ours = _scene()
    K = ours.K.copy()
    K[:, 0, 1] = 2.0
    with pytest.raises(ValueError, match="skew"):
        _export(replace(ours, K=K))
    with pytest.raises(ValueError, match="metric"):
        _export(replace(ours, stratum="projective"))
    P = ours.P.copy()
    P[0, 0] *= 1.1
    with pytest.raises(ValueError, match="no rotation"):
        _export(replace(ours, P=P))
    with pytest.raises(ValueError, match="finite scales"):
        _export(ours, scales=np.zeros(V))


def test_import_refuses_distortion_it_has_no_camera_for():
    model = _export(_scene())
    fisheye = replace(
        model.cameras[0], model="OPENCV_FISHEYE", params=(500.0, 500.0, 250.0, 200.0, 0.1, 0, 0, 0)
    )
    with pytest.raises(StageFailure, match="OPENCV_FISHEYE"):
        reconstruction_from_colmap(replace(model, cameras=(fisheye,)))
    tangential = replace(
        model.cameras[0], model="OPENCV", params=(500.0, 500.0, 250.0, 200.0, 0.1, 0, 0.01, 0)
    )
    with pytest.raises(StageFailure, match="three radial"):
        reconstruction_from_colmap(replace(model, cameras=(tangential,)))
    harmless = replace(model.cameras[0], model="RADIAL", params=(500.0, 250.0, 200.0, 0.1, 0.0))
    back = reconstruction_from_colmap(replace(model, cameras=(harmless,)))
    np.testing.assert_array_equal(back.distortion[0], [0.1, 0.0, 0.0])
    with pytest.raises(ValueError, match="names must hold"):
        reconstruction_from_colmap(model, names=["other.jpg"])


def test_a_lens_of_three_coefficients_goes_out_and_comes_back(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    ours = replace(_scene(), distortion=np.tile([-0.1, 0.05, -0.02], (V, 1)))
    model = _plain_names(_export(ours))
    assert {camera.model for camera in model.cameras} == {"FULL_OPENCV"}
    write_colmap_model(tmp_path, model)
    theirs = pycolmap.Reconstruction(tmp_path)
    for i in np.flatnonzero(ours.registered):
        pose = np.linalg.solve(ours.K[i], ours.P[i])
        X = ours.X[ours.valid, :3]
        xy = project_camera(ours.K[i], pose[:, :3], pose[:, 3], X, distortion=ours.distortion[i])
        projected = [theirs.images[int(i) + 1].project_point(x) for x in X]
        np.testing.assert_allclose(projected, xy + 0.5, atol=1e-6, rtol=0)
    back = reconstruction_from_colmap(model)
    np.testing.assert_allclose(back.distortion[0], ours.distortion[0])


def test_writing_refuses_an_inconsistent_model(tmp_path):
    model = _export(_scene())
    with pytest.raises(ValueError, match="does not exist"):
        write_colmap_model(tmp_path, replace(model, cameras=()))
    with pytest.raises(ValueError, match="not finite"):
        write_colmap_model(
            tmp_path, replace(model, points=replace(model.points, xyz=model.points.xyz * np.nan))
        )
    swapped = model.points.track_xy.copy()
    first, second = np.flatnonzero(model.points.track_image == 1)[:2]
    swapped[[first, second]] = swapped[[second, first]]
    crossed = replace(model, points=replace(model.points, track_xy=swapped))
    with pytest.raises(ValueError, match="refer to each other"):
        write_colmap_model(tmp_path, crossed)
    with pytest.raises(ValueError, match="blanks"):
        write_colmap_model(tmp_path, model, binary=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_files_cut_short_anywhere_are_refused_with_a_sentence(tmp_path, name, suffix):
    write_colmap_model(tmp_path, _plain_names(_export(_scene())), binary=suffix == ".bin")
    path = tmp_path / f"{name}{suffix}"
    whole = path.read_bytes()
    sentences = []
    sizes = np.unique(np.linspace(0, len(whole) - 1, 60).astype(int))
    for size in sizes:
        path.write_bytes(whole[:size])
        try:
            read_colmap_model(tmp_path)
        except StageFailure as failure:
            sentences.append(str(failure))
    assert all(str(tmp_path) in sentence for sentence in sentences)
    # Text cut at the end of a number can still be a well-formed file; binary never is.
    assert len(sentences) == len(sizes) if suffix == ".bin" else len(sentences) > 30


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("count", [2**20, 2**40, 2**63, 2**64 - 1])
def test_hostile_counts_allocate_nothing(tmp_path, name, count):
    write_colmap_model(tmp_path, _export(_scene()))
    path = tmp_path / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    with pytest.raises(StageFailure, match="too short"):
        read_colmap_model(tmp_path)


def test_numbers_that_are_not_finite_are_refused(tmp_path):
    write_colmap_model(tmp_path, _plain_names(_export(_scene())), binary=False)
    for name, field in (("cameras", 4), ("images", 1), ("points3D", 2)):
        path = tmp_path / f"{name}.txt"
        text = path.read_text(encoding="utf-8")
        lines = text.split("\n")
        place = next(n for n, line in enumerate(lines) if not line.startswith("#"))
        words = lines[place].split()
        for bad in ("nan", "inf", "1e999", "soup"):
            words[field] = bad
            lines[place] = " ".join(words)
            path.write_text("\n".join(lines), encoding="utf-8")
            with pytest.raises(StageFailure):
                read_colmap_model(tmp_path)
        path.write_text(text, encoding="utf-8")
    read_colmap_model(tmp_path)


@pytest.mark.parametrize("binary", [True, False])
def test_an_image_without_points_and_an_empty_model_survive_both_forms(tmp_path, binary):
    with pytest.raises(StageFailure, match="holds no COLMAP model"):
        read_colmap_model(tmp_path)
    model, none = _plain_names(_export(_scene())), np.zeros(0, np.int64)
    lonely = replace(model.images[0], image_id=99, name="z.jpg", xy=np.zeros((0, 2)), point_ids=none)
    model = replace(model, images=(lonely, *model.images))
    write_colmap_model(tmp_path / "lonely", model, binary=binary)
    back = read_colmap_model(tmp_path / "lonely")
    assert [len(image.xy) for image in back.images] == [len(image.xy) for image in model.images]
    assert back.images[0].name == "z.jpg"
    no_xyz = np.zeros((0, 3))
    points = ColmapPoints(
        none, no_xyz, no_xyz.astype(np.uint8), np.zeros(0), np.zeros(1, np.int64), none, none
    )
    write_colmap_model(tmp_path / "empty", ColmapModel((), (), points), binary=binary)
    assert read_colmap_model(tmp_path / "empty").images == ()


_SMALL = _export(_scene())
