"""The tensor of least reprojection error: its steps, its noise, what it refuses, and real photographs."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import real_data, refuses
from tests.geometry.properties import gap
from thesisrecon.api.pairs import estimate_trifocal
from thesisrecon.camera import decompose_camera
from thesisrecon.epipolar.three_view_estimation import (
    NO_SEGMENTS,
    _tensor_equations,
)
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix, camera_from_centre, project
from thesisrecon.geometry.homogeneous import homogenize, unit_normals
from thesisrecon.geometry.three_view import (
    cameras_from_tensor,
    tensor_epipoles,
    tensor_from_cameras,
    transfer_lines,
    transfer_points,
)


def three_cameras(rng):
    """Cameras 8 units from the origin, some 20 degrees apart."""
    K = calibration_matrix(1200.0, 1180.0, 640.0, 480.0, skew=3.0)
    cameras = []
    for turn in (-0.3, 0.1, 0.35):
        R = Rotation.from_rotvec([rng.normal(0.0, 0.1), turn, rng.normal(0.0, 0.1)]).as_matrix()
        cameras.append(camera_from_centre(K, R, rng.normal(0.0, 0.3, 3) - 8.0 * R[2]))
    return np.stack(cameras)


def matches(P, rng, n, m, sigma):
    """Points (3, n, 2) and segments (3, m, 2, 2) with noise."""
    X, A, B = (rng.uniform(-2.0, 2.0, (k, 3)) for k in (n, m, m))
    points = np.stack([project(camera, X) for camera in P])
    segments = np.stack([np.stack([project(camera, A), project(camera, B)], axis=1) for camera in P])
    return [a + rng.normal(0.0, sigma, a.shape) for a in (points, segments)]


def point_transfer_px(T, points):
    return np.linalg.norm(transfer_points(T, points[0], points[1]) - points[2], axis=1)


def line_transfer_px(T, segments):
    """RMS distance of the third segment's ends to the transferred line; (M,)."""
    ends = homogenize(segments)
    l1, l2 = np.cross(ends[:2, :, 0], ends[:2, :, 1])
    found = unit_normals(transfer_lines(T, l1, l2))
    return np.sqrt(np.mean(np.einsum("na,nea->ne", found, ends[2]) ** 2, axis=1))


@pytest.mark.parametrize(("n", "m"), [(7, 0), (0, 13), (4, 5), (40, 0), (0, 40), (20, 20)])
def test_exact_matches_give_the_tensor_of_their_cameras(n, m):
    rng = np.random.default_rng(n + m)
    P = three_cameras(rng)
    points, segments = matches(P, rng, n, m, 0.0)
    fit = estimate_trifocal(*points, segments=segments)
    assert gap(fit.T, tensor_from_cameras(*P)) < 1e-6
    assert (fit.point_residuals_px.shape, fit.line_residuals_px.shape) == ((3, n), (3, m, 2))
    assert gap(fit.T, tensor_from_cameras(*cameras_from_tensor(fit.T))) < 1e-9
    assert max(fit.point_residuals_px.max(initial=0.0), fit.line_residuals_px.max(initial=0.0)) < 1e-5


@pytest.mark.parametrize(("n", "m"), [(50, 0), (0, 50), (30, 30)])
def test_each_step_approaches_the_truth_and_reports_the_noise(n, m):
    errors, sigmas = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        P = three_cameras(rng)
        points, segments = matches(P, rng, n, m, 0.5)
        exact, _ = matches(P, rng, 100, 0, 0.0)
        equations = _tensor_equations(points, segments)
        algebraic = equations.solve_with_epipoles(*tensor_epipoles(equations.solve()))
        np.testing.assert_allclose(
            abs(np.sum(algebraic * tensor_from_cameras(*cameras_from_tensor(algebraic)))), 1.0, atol=1e-9
        )
        fit = estimate_trifocal(*points, segments=segments, loss_px=5.0)
        sigmas.append(fit.sigma_px)
        squares = np.sum(fit.point_residuals_px**2) + np.sum(fit.line_residuals_px**2)
        assert fit.sigma_px == pytest.approx(np.sqrt(squares / (3 * n + 2 * m - 18)), rel=1e-9)
        steps = (*map(equations.in_pixels, (equations.solve(), algebraic)), fit.T)
        errors.append([np.median(point_transfer_px(T, exact)) for T in steps])
    linear, constrained, refined = np.median(errors, axis=0)
    assert refined < 1.05 * constrained < 1.05 * linear
    assert refined < 1.0
    assert 0.44 < np.mean(sigmas) < 0.56


@pytest.mark.parametrize(("n", "m"), [(40, 0), (20, 20)])
def test_the_covariance_is_that_of_the_errors(n, m):
    rng = np.random.default_rng(n)
    P = three_cameras(rng)
    points, segments = matches(P, rng, n, m, 0.0)
    exact, _ = matches(P, rng, 30, 0, 0.0)
    # The transfer of fixed points by fixed lines through their matches is linear in T, before the division.
    x1, x2 = homogenize(exact[:2])
    l2 = unit_normals(np.cross(x2, rng.normal(size=x2.shape)))
    ratios = []
    for _ in range(40):
        moved, ends = (a + rng.normal(0.0, 0.3, a.shape) for a in (points, segments))
        fit = estimate_trifocal(*moved, segments=ends, loss_px=5.0)
        x3 = np.einsum("ni,nj,ijk->nk", x1, l2, fit.T)
        by_T = np.einsum("ni,nj,kl->nlijk", x1, l2, np.eye(3)).reshape(30, 3, 27) / x3[:, 2, None, None]
        by_T = by_T[:, :2] - (x3[:, :2] / x3[:, 2:])[:, :, None] * by_T[:, 2:]
        variance = np.einsum("nca,ab,ncb->nc", by_T, fit.covariance, by_T)
        ratios.append((x3[:, :2] / x3[:, 2:] - exact[2]) ** 2 / variance)
    assert 0.85 < np.mean(ratios) < 1.2


def test_the_covariance_reflects_points_near_a_plane():
    fits = []
    for depth in (1.0, 0.03):
        rng = np.random.default_rng(1)
        P, X = three_cameras(rng), rng.uniform(-2.0, 2.0, (60, 3)) * [1.0, 1.0, depth]
        points = np.stack([project(camera, X) for camera in P])
        fits.append(estimate_trifocal(*(points + rng.normal(0.0, 0.2, points.shape))))
    assert np.trace(fits[1].covariance) > 100.0 * np.trace(fits[0].covariance)
    assert fits[0].relative_std < 0.01 < fits[1].relative_std < 0.4


@pytest.mark.parametrize("sigma", [0.0, 0.2, 2.0])
@pytest.mark.parametrize("kind", ["plane", "rotation", "line", "twice", "chance"])
def test_matches_that_do_not_determine_a_tensor_are_named(kind, sigma):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        P, X = three_cameras(rng), rng.uniform(-2.0, 2.0, (40, 3))
        if kind == "plane":
            X[:, 2] = 0.3 * X[:, 0]
        if kind == "line":
            X = np.outer(np.linspace(-2.0, 2.0, 40), [1.0, 0.3, 0.2])
        if kind == "twice":
            X = np.tile(X[:5], (8, 1))
        if kind == "rotation":
            P = [camera_from_centre(*decompose_camera(p)[:2], np.array([0.0, 0.0, -8.0])) for p in P]
        points = np.stack([project(camera, X) for camera in P])
        if kind == "chance":
            points = rng.uniform(0.0, 1000.0, points.shape)
        noisy = points + rng.normal(0.0, sigma, points.shape)
        refuses(StageFailure, "do not determine", estimate_trifocal, *noisy)


def test_wrong_matches_do_not_spoil_the_tensor():
    rng = np.random.default_rng(5)
    P = three_cameras(rng)
    exact, _ = matches(P, rng, 100, 0, 0.0)
    # A few among points and segments, all of which the loss bears.
    points, segments = matches(P, rng, 100, 40, 0.3)
    points[2, :5] += rng.uniform(5.0, 15.0, (5, 2))
    robust = estimate_trifocal(*points, segments=segments, threshold_px=None)
    assert np.median(point_transfer_px(robust.T, exact)) < 0.5
    assert robust.point_residuals_px[:, :5].max(axis=0).min() > 1.0
    # Many, which are left out.
    points, _ = matches(P, rng, 120, 0, 0.3)
    points[2, :40] = rng.uniform(0.0, 1000.0, (40, 2))
    fit = estimate_trifocal(*points)
    assert fit.inliers[40:].mean() > 0.95
    assert fit.inliers[:40].sum() <= 2
    assert np.isnan(fit.point_residuals_px[:, ~fit.inliers]).all()
    assert np.median(point_transfer_px(fit.T, exact)) < 0.3
    few = estimate_trifocal(*points, confidence=0.99, max_samples=600)
    assert (few.inliers == fit.inliers).mean() > 0.95
    refuses(ValueError, "max_samples must be at least 10", estimate_trifocal, *points, max_samples=5)
    refuses(ValueError, "confidence must lie", estimate_trifocal, *points, confidence=1.0)


def test_wrong_calls_are_named():
    rng = np.random.default_rng(0)
    points, segments = matches(three_cameras(rng), rng, 8, 3, 0.0)
    point_like = np.repeat(segments[:, :, :1], 2, axis=2)
    for error, text, given, options in (
        (StageFailure, "too few matches", points[:, :6], {}),
        (StageFailure, "too few matches", (), {}),
        (StageFailure, "do not determine", np.ones((3, 8, 2)), {}),
        (ValueError, "finite", np.full((3, 8, 2), np.nan), {}),
        (ValueError, "needs xy1", np.ones((3, 8, 3)), {}),
        (ValueError, "needs xy1", np.ones((3, 5)), {}),
        (ValueError, "needs xy1.*segments", points, {"segments": segments[:, :, 0]}),
        (ValueError, "no length", points, {"segments": point_like}),
        (ValueError, "loss_px", points, {"loss_px": 0.0}),
    ):
        refuses(error, text, estimate_trifocal, *given, **options)


def _read(kind):
    """Corners (3, N, 2) or segments (3, M, 4) that are matched in all three views of merton1."""
    folder = real_data("merton1/2D")
    rows = [line.split() for line in (folder / f"nview-{kind}").read_text().splitlines()]
    index = np.array([[int(entry) for entry in row] for row in rows if "*" not in row])
    return np.stack([np.loadtxt(folder / f"{v + 1:03d}.{kind}")[index[:, v]] for v in range(3)])


@pytest.mark.real
@pytest.mark.parametrize("source", ["points", "lines", "both"])
def test_merton_college_is_transferred_into_the_third_view(source):
    points, segments = _read("corners"), _read("lines").reshape(3, -1, 2, 2)
    of_points, of_lines = [], []
    for fold in range(2):
        p, s = (np.arange(a.shape[1]) % 2 == fold for a in (points, segments))
        # Estimated from one half, measured on the other.
        fit = estimate_trifocal(
            *(() if source == "lines" else points[:, p]),
            segments=NO_SEGMENTS if source == "points" else segments[:, s],
        )
        of_points.append(point_transfer_px(fit.T, points[:, ~p]))
        of_lines.append(line_transfer_px(fit.T, segments[:, ~s]))
    assert np.median(np.concatenate(of_points)) <= 1.0
    assert np.median(np.concatenate(of_lines)) <= 1.0
