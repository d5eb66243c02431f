"""Metrics of the validation: numbers, intervals and cameras."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.synthetic import reconstruction_of
from thesisrecon.camera import compose_camera, project_camera
from thesisrecon.records import IntrinsicInterval, MetricResult, Tracks
from validation.metrics.cameras import (
    TrueCameras,
    measure_cameras,
    measure_reprojection,
    relative_centre_error,
)
from validation.metrics.intervals import interval_scores, join_scores
from validation.runs.tables import number

V, N = 6, 30


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "-"), (np.nan, "-"), (np.inf, "inf"), (12345, "12345"), (1553.4, "1553"), (0.03384, "0.0338")],
)
def test_numbers_have_three_digits_and_thousands_all(value, text):
    assert number(value) == text


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
    scores = interval_scores(MetricResult(model, (*intervals, {}), {}, True), np.tile(K, (4, 1, 1)))
    assert scores.z[:3, 0] == pytest.approx([2.0, 10.0, 0.0], abs=1e-3)
    assert np.isnan(scores.z[3]).all()
    assert np.isnan(scores.z[:, 2]).all()
    assert scores.holding((0,)) == pytest.approx(1 / 3)
    assert scores.std_rel[2] == pytest.approx(10.0 / 1001.0)
    assert join_scores([scores, scores]).z.shape == (8, 3)


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
    assert max(errors.focal_error_pct, errors.rotation_error_deg, errors.centre_error) < 1e-9
    assert errors.principal_point_error_px == 0
    assert measure_reprojection(_reconstruction(truth, k1=-0.1)).rms_px < 1e-9


def test_known_errors_are_measured_in_their_units():
    truth = _truth()
    K, R, C = truth.K.copy(), truth.R.copy(), truth.C.copy()
    K[:, [0, 1], [0, 1]] *= 1.004
    K[:, :2, 2] += [3.0, -4.0]
    errors = measure_cameras(_reconstruction(replace(truth, K=K)), truth)
    assert errors.focal_error_pct == pytest.approx(0.4)
    assert errors.principal_point_error_px == pytest.approx(5.0)
    R[::2] = Rotation.from_rotvec([0, 0, np.radians(0.02)]).as_matrix() @ R[::2]
    turned = measure_cameras(_reconstruction(replace(truth, R=R)), truth)
    assert turned.rotation_error_deg == pytest.approx(0.01, rel=0.05)
    C[0] += [0.0, 0.0, 0.06]
    # The alignment takes part of one camera's 60 mm away and spreads the rest over all six.
    assert 0.004 < measure_cameras(_reconstruction(replace(truth, C=C)), truth).centre_error < 0.02
    errors = replace(errors, centre_error=0.1)
    assert relative_centre_error(errors, np.array([[0.0, 0, 0], [4.0, 0, 0]])) == pytest.approx(0.025)


def test_only_registered_views_count():
    truth, registered = _truth(), np.arange(V) != 2
    ours = _reconstruction(truth)
    P, K = (np.where(registered[:, None, None], a, 0.0) for a in (ours.P, ours.K))
    partial = replace(ours, P=P, K=K, registered=registered)
    assert measure_cameras(partial, truth).focal_error_pct < 1e-12
    assert measure_reprojection(partial).observations == (V - 1) * N
    two = replace(partial, registered=np.arange(V) < 2)
    assert measure_cameras(two, truth).centre_error is None
    assert np.isnan(relative_centre_error(measure_cameras(two, truth), truth.C))
    with pytest.raises(ValueError, match="at least one registered"):
        measure_cameras(replace(partial, registered=np.zeros(V, bool)), truth)


def test_reprojection_is_recomputed_from_inliers_alone():
    ours = _reconstruction(_truth())
    xy = ours.tracks.xy.copy()
    xy[:, 0] += 0.5
    xy[0] += 100.0
    inlier = np.arange(V * N) > 0
    measured = measure_reprojection(replace(ours, tracks=replace(ours.tracks, xy=xy), inlier=inlier))
    assert (measured.median_px, measured.rms_px) == pytest.approx((0.5, 0.5))
    assert measured.observations == V * N - 1
