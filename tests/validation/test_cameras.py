from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesisrecon.geometry.camera_matrix import compose_camera, project_camera
from thesisrecon.records import Reconstruction, Tracks
from validation.metrics.cameras import TrueCameras, measure_cameras, measure_reprojection, rotation_errors_deg

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
    every = np.ones
    return Reconstruction(
        "metric",
        # Any positive scale of P is the same camera.
        3.7 * compose_camera(truth.K, R, t),
        X,
        every(V, bool),
        every(N, bool),
        every(V * N, bool),
        tracks,
        np.tile([1020, 780], (V, 1)),
        0.1,
        ("",) * V,
        truth.K.copy(),
        np.tile([k1, 0.0, 0.0], (V, 1)),
    )


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
