"""Metrics of the validation: numbers, intervals, cameras, and the comparison with COLMAP."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.synthetic import reconstruction_of
from thesisrecon.camera import compose_camera, project_camera
from thesisrecon.records import IntrinsicInterval, MetricResult, Tracks
from validation.metrics import cameras
from validation.references.colmap import map_with_pycolmap, read_run, reconstruct_with_pycolmap
from validation.runs.records import Outcome
from validation.scenes.real import Scene, load_fixture_scene
from validation.studies.against_colmap import COLMAP, OURS, Run, check_reconstruction

V, N = 6, 30


def test_deviations_are_counted_in_stated_sigmas():
    K = np.array([[1000.0, 0.0, 500.0], [0.0, 1002.001, 300.0], [0.0, 0.0, 1.0]])
    # The last view is not registered.
    model = reconstruction_of(np.zeros((4, 3, 4)), (1000, 600), registered=np.arange(4) < 3, sigma_px=1.0)
    intervals = [
        {
            "focal_px": IntrinsicInterval(value, std, "own"),
            "principal_x_px": IntrinsicInterval(503.0, 1.0, "own"),
            "principal_y_px": IntrinsicInterval(300.0, 0.0, "assumed"),
        }
        for value, std in ((1003.0, 1.0), (1011.0, 1.0), (1001.0, 10.0))
    ]
    scores = cameras.interval_scores(MetricResult(model, (*intervals, {}), {}, True), np.tile(K, (4, 1, 1)))
    assert scores[:3, 0] == pytest.approx([2.0, 10.0, 0.0], abs=1e-3)
    assert np.isnan(scores[3]).all()
    assert np.isnan(scores[:, 2]).all()
    assert scores[2, 3] == pytest.approx(10.0 / 1001.0)


def _truth():
    rng = np.random.default_rng(2)
    K = np.broadcast_to([[1000.0, 0, 510.0], [0, 1002.0, 390.0], [0, 0, 1]], (V, 3, 3)).copy()
    R = Rotation.from_rotvec(rng.normal(0, 0.3, (V, 3))).as_matrix()
    return K, R, rng.normal(0, 1, (V, 3)) - [0, 0, 6]


def _reconstruction(truth, *, k1=0.0):
    """The truth seen in another world frame: turned, shrunk and moved."""
    rng = np.random.default_rng(3)
    turn, shrink, move = Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix(), 0.1, np.array([3.0, 2.0, 1.0])
    K, R, C = truth[0], truth[1] @ turn.T, shrink * truth[2] @ turn.T + move
    t = -np.einsum("vij,vj->vi", R, C)
    X = np.column_stack([shrink * rng.normal(0, 1, (N, 3)) @ turn.T + move, np.ones(N)])
    view, point = (grid.ravel() for grid in np.meshgrid(np.arange(V), np.arange(N)))
    xy = np.concatenate(
        [project_camera(k, r, s, X[:, :3], distortion=k1) for k, r, s in zip(K, R, t, strict=True)]
    )
    tracks = Tracks(view, point, xy.reshape(V, N, 2).transpose(1, 0, 2).reshape(-1, 2), V, N)
    # Any positive scale of P is the same camera.
    P, lens = 3.7 * compose_camera(K, R, t), np.tile([k1, 0.0, 0.0], (V, 1))
    return reconstruction_of(P, (1020, 780), X=X, tracks=tracks, K=K.copy(), distortion=lens)


def test_the_truth_in_another_frame_has_no_error():
    truth = _truth()
    errors = cameras.measure_cameras(_reconstruction(truth, k1=-0.1), truth)
    assert max(errors.focal_error_pct, errors.rotation_error_deg, errors.centre_error) < 1e-9
    assert errors.principal_point_error_px == 0
    assert cameras.measure_reprojection(_reconstruction(truth, k1=-0.1)).rms_px < 1e-9


def test_known_errors_are_measured_in_their_units():
    truth = _truth()
    K, R, C = (part.copy() for part in truth)
    K[:, [0, 1], [0, 1]] *= 1.004
    K[:, :2, 2] += [3.0, -4.0]
    errors = cameras.measure_cameras(_reconstruction((K, *truth[1:])), truth)
    assert errors.focal_error_pct == pytest.approx(0.4)
    assert errors.principal_point_error_px == pytest.approx(5.0)
    R[::2] = Rotation.from_rotvec([0, 0, np.radians(0.02)]).as_matrix() @ R[::2]
    turned = cameras.measure_cameras(_reconstruction((truth[0], R, truth[2])), truth)
    assert turned.rotation_error_deg == pytest.approx(0.01, rel=0.05)
    C[0] += [0.0, 0.0, 0.06]
    # The alignment takes part of one camera's 60 mm away and spreads the rest over all six.
    assert 0.004 < cameras.measure_cameras(_reconstruction((*truth[:2], C)), truth).centre_error < 0.02
    errors = replace(errors, centre_error=0.1)
    assert cameras.relative_centre_error(errors, np.array([[0.0, 0, 0], [4.0, 0, 0]])) == pytest.approx(0.025)


def test_only_registered_views_count():
    truth, registered = _truth(), np.arange(V) != 2
    ours = _reconstruction(truth)
    P, K = (np.where(registered[:, None, None], a, 0.0) for a in (ours.P, ours.K))
    partial = replace(ours, P=P, K=K, registered=registered)
    assert cameras.measure_cameras(partial, truth).focal_error_pct < 1e-12
    assert cameras.measure_reprojection(partial).observations == (V - 1) * N
    two = replace(partial, registered=np.arange(V) < 2)
    assert cameras.measure_cameras(two, truth).centre_error is None
    assert np.isnan(cameras.relative_centre_error(cameras.measure_cameras(two, truth), truth[2]))
    with pytest.raises(ValueError, match="at least one registered"):
        cameras.measure_cameras(replace(partial, registered=np.zeros(V, bool)), truth)


def test_reprojection_is_recomputed_from_inliers_alone():
    ours = _reconstruction(_truth())
    xy = ours.tracks.xy.copy()
    xy[:, 0] += 0.5
    xy[0] += 100.0
    inlier = np.arange(V * N) > 0
    measured = cameras.measure_reprojection(replace(ours, tracks=replace(ours.tracks, xy=xy), inlier=inlier))
    assert (measured.median_px, measured.rms_px) == pytest.approx((0.5, 0.5))
    assert measured.observations == V * N - 1


def test_models_of_pycolmap_are_returned_in_our_types(tmp_path):
    pytest.importorskip("pycolmap")
    scene = load_fixture_scene()
    images = tmp_path / "images"
    images.mkdir()
    views = slice(4, 9)
    for path in scene.image_paths[views]:
        with Image.open(path) as whole:
            small = whole.resize((whole.width // 2, whole.height // 2))
        exif = Image.Exif()
        exif[0x8769] = {0x920A: 5.0, 0xA405: 300}
        small.save(images / path.name, quality=95, exif=exif)
    reconstruct_with_pycolmap(images, tmp_path / "out")
    model, seconds = read_run(images, tmp_path / "out")
    assert model.registered.sum() == 5
    assert set(seconds) == {"extract", "match", "map"}
    K = np.diag([0.5, 0.5, 1.0]) @ scene.K[views]
    errors = cameras.measure_cameras(model, (K, scene.R[views], scene.C[views]))
    # A focal length of 300 mm in EXIF would have been believed and barely refined.
    assert errors.focal_error_pct < 5
    assert errors.rotation_error_deg < 1
    again, _ = read_run(images, tmp_path / "out")
    np.testing.assert_array_equal(again.P, model.P)
    for mapper in ("incremental", "global"):
        map_with_pycolmap(
            images, tmp_path / mapper, matched=tmp_path / "out", lens="OPENCV", mapper=mapper,
            refine_principal_point=True,
        )  # fmt: skip
        opencv, _ = read_run(images, tmp_path / mapper)
        moved = opencv.K[opencv.registered, :2, 2] - (np.array(small.size) - 1.0) / 2.0
        assert opencv.distortion.shape[1] > 3, "the decentring of OPENCV"
        assert np.abs(moved).min() > 1e-3, "the principal point is free"


def test_rows_hold_both_methods_and_a_failure_misses_its_targets():
    model = _reconstruction(_truth())
    ours = Run(Outcome(Path(), "", 9.0, 12.0, 500.0), model, {"reprojection_rms_px": 1.0})
    colmap = Run(Outcome(Path(), "", 10.0, 15.0, 300.0), model)
    failed = Run(Outcome(Path(), "no pair was found", 3.0, 5.0, 100.0), None)
    scene = Scene("fountain-P11", tuple(Path(f"{k}.png") for k in range(V)), *_truth())
    checked = [check_reconstruction(scene, {OURS: o, COLMAP: colmap}) for o in (ours, failed)]
    rows, missed = ({row.name: row for row in found} for found in checked)
    assert rows["wall time"].target == 10.0
    # The residuals here are zero, so a claim of one pixel is far off.
    verdicts = {"registered": "reached", "focal error": "reached", "wall time": "reached"}
    verdicts |= {"rms it claims off by": "missed", "observations a point": "reported"}
    assert {name: rows[name].verdict for name in verdicts} == verdicts
    assert (missed["focal error"].verdict, missed["focal error"].values[OURS]) == ("missed", None)
    assert missed["registered"].values[OURS] == 0
