"""Metrics of the validation: images, intervals and cameras."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.synthetic import reconstruction_of
from thesisrecon.camera import compose_camera, project_camera
from thesisrecon.records import IntrinsicInterval, MetricResult, Tracks
from thesisrecon.views._image_similarity import GREY
from validation.metrics.cameras import (
    TrueCameras,
    measure_cameras,
    measure_reprojection,
    relative_centre_error,
    rotation_errors_deg,
)
from validation.metrics.image_similarity import psnr_db, ssim
from validation.metrics.intervals import focal_errors_pct, interval_scores, join_scores
from validation.runs.tables import number
from validation.studies.calibration_coverage import run_trial


def test_psnr_is_that_of_the_mean_square():
    truth = np.zeros((4, 5, 3))
    assert psnr_db(truth, truth) == np.inf
    assert psnr_db(truth + 255.0, truth) == 0.0
    wrong = truth.copy()
    wrong[0] = 25.5
    where = np.zeros((4, 5), dtype=bool)
    where[0] = True
    assert psnr_db(wrong, truth, where=where) == pytest.approx(20.0)
    assert psnr_db(wrong, truth) == pytest.approx(20.0 + 10.0 * np.log10(4.0))


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "-"), (np.nan, "-"), (np.inf, "inf"), (12345, "12345"), (1553.4, "1553"), (0.03384, "0.0338")],
)
def test_numbers_have_three_digits_and_thousands_all(value, text):
    assert number(value) == text


def test_similarity_of_structure_is_the_formula_of_windows():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.0, 255.0, (24, 30, 3))
    other = truth + rng.normal(0.0, 30.0, truth.shape)
    x, y = truth @ GREY, other @ GREY
    at = np.arange(-5, 6)
    w = np.exp(-0.5 * (at / 1.5) ** 2)
    w = np.outer(w, w) / w.sum() ** 2
    values = []
    for r in range(5, 19):
        for c in range(5, 25):
            a, b = x[r - 5 : r + 6, c - 5 : c + 6], y[r - 5 : r + 6, c - 5 : c + 6]
            ma, mb = (w * a).sum(), (w * b).sum()
            va, vb, vab = (w * a * a).sum() - ma**2, (w * b * b).sum() - mb**2, (w * a * b).sum() - ma * mb
            c1, c2 = 2.55**2, 7.65**2
            values.append((2 * ma * mb + c1) * (2 * vab + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))
    assert ssim(other, truth) == pytest.approx(np.mean(values), rel=1e-9)
    assert ssim(truth, truth) == pytest.approx(1.0)


K = np.array([[1000.0, 0.0, 500.0], [0.0, 1002.001, 300.0], [0.0, 0.0, 1.0]])


def result_of(values):
    """A result that states these focals, their sigmas and sources; the last view is not registered."""
    n = len(values) + 1
    model = reconstruction_of(np.zeros((n, 3, 4)), (1000, 600), registered=np.arange(n) < n - 1, sigma_px=1.0)
    intervals = [
        {
            "focal_px": IntrinsicInterval(value, std, source),
            "principal_x_px": IntrinsicInterval(503.0, 1.0, source),
            "principal_y_px": IntrinsicInterval(300.0, 0.0, "assumed"),
        }
        for value, std, source in values
    ]
    return MetricResult(model, (*intervals, {}), {}, True)


def test_deviations_are_counted_in_stated_sigmas():
    result = result_of([(1003.0, 1.0, "own"), (1011.0, 1.0, "own"), (1001.0, 10.0, "own")])
    scores = interval_scores(result, np.tile(K, (4, 1, 1)))
    assert scores.z[:3, 0] == pytest.approx([2.0, 10.0, 0.0], abs=1e-3)
    assert np.isnan(scores.z[3]).all()
    assert np.isnan(scores.z[:, 2]).all()
    assert scores.holding((0,)) == pytest.approx(1 / 3)
    assert scores.worst((1,)) == pytest.approx(3.0)
    assert scores.std_rel[2] == pytest.approx(10.0 / 1001.0)
    assert join_scores([scores, scores]).z.shape == (8, 3)


def test_focal_errors_are_of_the_geometric_mean_and_unknown_without_a_camera():
    found = np.array([np.diag([1001.0005, 1001.0005, 1.0]), np.zeros((3, 3))])
    errors = focal_errors_pct(found, np.array([K, K]))
    assert errors[0] == pytest.approx(0.0, abs=1e-4)
    assert np.isnan(errors[1])


@pytest.mark.parametrize("cameras", ["shared", "per-image"])
def test_a_synthetic_trial_states_intervals_that_hold_its_truth(cameras):
    found = run_trial("shared" if cameras == "shared" else "per-image", 0)
    assert found is not None
    scores, result = found
    assert result.trusted
    assert len(scores.z) == (1 if cameras == "shared" else len(result.intrinsics))
    assert scores.worst() < 5.0


V, N = 6, 30


def _truth():
    rng = np.random.default_rng(2)
    K = np.broadcast_to([[1000.0, 0, 510.0], [0, 1002.0, 390.0], [0, 0, 1]], (V, 3, 3)).copy()
    R = Rotation.from_rotvec(rng.normal(0, 0.3, (V, 3))).as_matrix()
    return TrueCameras(K, R, rng.normal(0, 1, (V, 3)) - [0, 0, 6])


def _reconstruction(truth, *, k1=0.0):
    """The truth seen in another world frame: turned, shrunk and moved."""
    rng = np.random.default_rng(3)
    turn, shrink, move = Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix(), 0.1, np.array([3.0, 2.0, 1.0])
    C = shrink * truth.C @ turn.T + move
    R = truth.R @ turn.T
    t = -np.einsum("vij,vj->vi", R, C)
    X = np.column_stack([shrink * rng.normal(0, 1, (N, 3)) @ turn.T + move, np.ones(N)])
    view, point = (grid.ravel() for grid in np.meshgrid(np.arange(V), np.arange(N)))
    xy = np.concatenate(
        [project_camera(K, r, s, X[:, :3], distortion=k1) for K, r, s in zip(truth.K, R, t, strict=True)]
    )
    tracks = Tracks(view, point, xy.reshape(V, N, 2).transpose(1, 0, 2).reshape(-1, 2), V, N)
    # Any positive scale of P is the same camera.
    P, lens = 3.7 * compose_camera(truth.K, R, t), np.tile([k1, 0.0, 0.0], (V, 1))
    return reconstruction_of(P, (1020, 780), X=X, tracks=tracks, K=truth.K.copy(), distortion=lens)


def test_the_truth_in_another_frame_has_no_error():
    truth = _truth()
    errors = measure_cameras(_reconstruction(truth, k1=-0.1), truth)
    assert errors.focal_error_pct < 1e-12
    assert errors.principal_point_error_px == 0
    assert errors.centre_error == pytest.approx(0, abs=1e-12)
    assert errors.rotation_error_deg < 1e-12
    assert measure_reprojection(_reconstruction(truth, k1=-0.1)).rms_px < 1e-9


def test_known_errors_are_measured_in_their_units():
    truth = _truth()
    K = truth.K.copy()
    K[:, [0, 1], [0, 1]] *= 1.004
    K[:, :2, 2] += [3.0, -4.0]
    errors = measure_cameras(_reconstruction(replace(truth, K=K)), truth)
    assert errors.focal_error_pct == pytest.approx(0.4)
    assert errors.principal_point_error_px == pytest.approx(5.0)

    small = Rotation.from_rotvec([0, 0, np.radians(0.02)]).as_matrix()
    R = truth.R.copy()
    R[::2] = small @ R[::2]
    turned = measure_cameras(_reconstruction(replace(truth, R=R)), truth)
    assert turned.rotation_error_deg == pytest.approx(0.01, rel=0.05)

    moved = truth.C.copy()
    moved[0] += [0.0, 0.0, 0.06]
    centre = measure_cameras(_reconstruction(replace(truth, C=moved)), truth).centre_error
    assert centre is not None
    # The alignment takes part of one camera's 60 mm away and spreads the rest over all six.
    assert 0.004 < centre < 0.02
    errors = replace(errors, centre_error=0.1)
    assert relative_centre_error(errors, np.array([[0.0, 0, 0], [4.0, 0, 0]])) == pytest.approx(0.025)


def test_only_registered_views_count():
    truth = _truth()
    registered = np.arange(V) != 2
    ours = _reconstruction(truth)
    P = np.where(registered[:, None, None], ours.P, 0.0)
    assert ours.K is not None
    K = np.where(registered[:, None, None], ours.K, 0.0)
    partial = replace(ours, P=P, K=K, registered=registered)
    assert measure_cameras(partial, truth).focal_error_pct < 1e-12
    assert measure_reprojection(partial).observations == (V - 1) * N
    two = replace(partial, registered=np.arange(V) < 2)
    assert measure_cameras(two, truth).centre_error is None
    assert np.isnan(relative_centre_error(measure_cameras(two, truth), truth.C))
    with pytest.raises(ValueError, match="at least one registered"):
        measure_cameras(replace(partial, registered=np.zeros(V, bool)), truth)
    with pytest.raises(ValueError, match="one truth per view"):
        measure_cameras(partial, replace(truth, K=truth.K[1:]))


def test_reprojection_is_recomputed_from_inliers_alone():
    ours = _reconstruction(_truth())
    xy = ours.tracks.xy.copy()
    xy[:, 0] += 0.5
    xy[0] += 100.0
    inlier = np.arange(V * N) > 0
    measured = measure_reprojection(replace(ours, tracks=replace(ours.tracks, xy=xy), inlier=inlier))
    assert measured.median_px == pytest.approx(0.5)
    assert measured.rms_px == pytest.approx(0.5)
    assert measured.observations == V * N - 1
    with pytest.raises(ValueError, match="at least one inlier"):
        measure_reprojection(replace(ours, inlier=np.zeros(V * N, bool)))


def test_large_rotation_errors_are_angles_too():
    R = np.broadcast_to(np.eye(3), (5, 3, 3)).copy()
    R[0] = Rotation.from_rotvec([0, np.radians(120.0), 0]).as_matrix()
    angles = rotation_errors_deg(R, np.broadcast_to(np.eye(3), (5, 3, 3)))
    assert angles[0] - angles[1] > 80
    assert angles[0] + angles[1] == pytest.approx(120.0)
