"""The tensor of least reprojection error: its steps, its noise, what it refuses, and real photographs."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon.api.pairs import estimate_trifocal
from thesisrecon.camera import decompose_camera
from thesisrecon.epipolar.three_view_estimation import (
    NO_SEGMENTS,
    _minimize_algebraic_error,
    _minimize_reprojection_error,
    _ReprojectionProblem,
    _tensor_equations,
    _TensorEquations,
)
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix, camera_from_centre, project
from thesisrecon.geometry.homogeneous import homogenize, unit_normals
from thesisrecon.geometry.three_view import (
    cameras_from_tensor,
    tensor_from_cameras,
    transfer_lines,
    transfer_points,
)

DATA = Path(os.environ.get("THESISRECON_DATA", Path(__file__).resolve().parents[2] / "../shared/data"))


def three_cameras(rng):
    """Cameras 8 units from the origin, some 20 degrees apart."""
    K = calibration_matrix(1200.0, 1180.0, 640.0, 480.0, skew=3.0)
    cameras = []
    for turn in (-0.3, 0.1, 0.35):
        R = Rotation.from_rotvec([rng.normal(0.0, 0.1), turn, rng.normal(0.0, 0.1)]).as_matrix()
        cameras.append(camera_from_centre(K, R, rng.normal(0.0, 0.3, 3) - 8.0 * R[2]))
    return np.stack(cameras)


def matches(P, rng, n, m, sigma):
    X, A, B = (rng.uniform(-2.0, 2.0, (k, 3)) for k in (n, m, m))
    points = np.stack([project(camera, X) for camera in P])
    segments = np.stack([np.stack([project(camera, A), project(camera, B)], axis=1) for camera in P])
    return (
        points + rng.normal(0.0, sigma, points.shape) if sigma else points,
        segments + rng.normal(0.0, sigma, segments.shape) if sigma else segments,
    )


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
    T = tensor_from_cameras(*P)
    assert min(np.linalg.norm(fit.T - T), np.linalg.norm(fit.T + T)) < 1e-6
    assert fit.point_residuals_px.shape == (3, n)
    assert fit.line_residuals_px.shape == (3, m, 2)
    cameras = tensor_from_cameras(*cameras_from_tensor(fit.T))
    assert min(np.linalg.norm(fit.T - cameras), np.linalg.norm(fit.T + cameras)) < 1e-9
    assert max(fit.point_residuals_px.max(initial=0.0), fit.line_residuals_px.max(initial=0.0)) < 1e-5


@dataclass(frozen=True)
class FickleEquations(_TensorEquations):
    """Equations whose solution has the other sign each time, as a singular vector may have."""

    calls: list[int] = field(default_factory=list)

    def solve_with_epipoles(self, e2, e3):
        self.calls.append(1)
        return super().solve_with_epipoles(e2, e3) * (-1.0) ** len(self.calls)


def test_the_least_error_does_not_hang_on_the_signs_of_singular_vectors():
    rng = np.random.default_rng(3)
    equations = _tensor_equations(*matches(three_cameras(rng), rng, 30, 0, 0.5))
    start = equations.solve()
    expected = _minimize_algebraic_error(equations, start)
    fickle = FickleEquations(equations.A, equations.noise, equations.transforms)
    found = _minimize_algebraic_error(fickle, start)
    assert len(fickle.calls) > 5
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.linalg.norm(equations.A @ expected.ravel()) < 1.0001 * np.linalg.norm(
        equations.A @ found.ravel()
    )


@pytest.mark.parametrize(("n", "m"), [(50, 0), (0, 50), (30, 30)])
def test_each_step_approaches_the_truth_and_reports_the_noise(n, m):
    errors, sigmas, levels = [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        P = three_cameras(rng)
        points, segments = matches(P, rng, n, m, 0.5)
        exact, _ = matches(P, rng, 100, 0, 0.0)
        equations = _tensor_equations(points, segments)
        levels.append(equations.noise_levels_px()[0])
        algebraic = _minimize_algebraic_error(equations, equations.solve())
        np.testing.assert_allclose(
            abs(np.sum(algebraic * tensor_from_cameras(*cameras_from_tensor(algebraic)))), 1.0, atol=1e-9
        )
        fit = estimate_trifocal(*points, segments=segments, loss_px=5.0)
        sigmas.append(fit.sigma_px)
        steps = (*map(equations.in_pixels, (equations.solve(), algebraic)), fit.T)
        errors.append([np.median(point_transfer_px(T, exact)) for T in steps])
    linear, constrained, refined = np.median(errors, axis=0)
    assert refined < 1.05 * constrained < 0.6 * linear
    assert refined < 1.0
    assert 0.44 < np.mean(sigmas) < 0.56
    # 26 of the 3 n + 2 m independent equations can be met.
    assert np.mean(levels) == pytest.approx(0.5 * np.sqrt(1.0 - 26.0 / (3 * n + 2 * m)), rel=0.1)


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
    spreads, weaknesses = [], []
    for depth in (1.0, 0.03):
        rng = np.random.default_rng(1)
        P = three_cameras(rng)
        X = rng.uniform(-2.0, 2.0, (60, 3)) * [1.0, 1.0, depth]
        points = np.stack([project(camera, X) for camera in P])
        fit = estimate_trifocal(*(points + rng.normal(0.0, 0.2, points.shape)))
        spreads.append(np.sqrt(np.trace(fit.covariance)))
        weaknesses.append(fit.relative_std)
    assert spreads[1] > 10.0 * spreads[0]
    assert weaknesses[0] < 0.01 < weaknesses[1] < 0.4


@pytest.mark.parametrize("sigma", [0.2, 2.0])
@pytest.mark.parametrize("kind", ["plane", "rotation", "line", "chance"])
def test_noisy_matches_that_cannot_work_are_named(kind, sigma):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        P, X = three_cameras(rng), rng.uniform(-2.0, 2.0, (40, 3))
        if kind == "plane":
            X[:, 2] = 0.3 * X[:, 0]
        if kind == "line":
            X = np.outer(np.linspace(-2.0, 2.0, 40), [1.0, 0.3, 0.2])
        if kind == "rotation":
            P = np.stack(
                [camera_from_centre(*decompose_camera(p)[:2], np.array([0.0, 0.0, -8.0])) for p in P]
            )
        points = np.stack([project(camera, X) for camera in P])
        if kind == "chance":
            points = rng.uniform(0.0, 1000.0, points.shape)
        with pytest.raises(StageFailure, match="do not determine"):
            estimate_trifocal(*(points + rng.normal(0.0, sigma, points.shape)))


def test_the_refinement_is_at_a_minimum_and_its_gradient_is_right():
    rng = np.random.default_rng(3)
    points, segments = matches(three_cameras(rng), rng, 9, 8, 1.0)
    equations = _tensor_equations(points, segments)
    linear, best = equations.solve(), _minimize_algebraic_error(equations, equations.solve())
    from_linear, from_best = (
        _ReprojectionProblem(T, points, segments, equations.transforms, 1.0) for T in (linear, best)
    )
    state, h = (np.zeros(18), np.zeros((17, 4))), 1e-7
    for _ in range(60):
        # The gradient is that of the cameras alone if points and lines fit them.
        state = from_linear.retract(state, np.zeros(18))
    gradient = from_linear.linearize(state).gradient
    for k, slope in enumerate(gradient):
        ahead, behind = (from_linear.cost(from_linear.retract(state, s * np.eye(18)[k])) for s in (h, -h))
        assert (ahead - behind) / (2.0 * h) == pytest.approx(slope, rel=1e-3, abs=1e-4 * abs(gradient).max())
    fits = [_minimize_reprojection_error(problem, equations) for problem in (from_linear, from_best)]
    assert fits[0].sigma_px == pytest.approx(fits[1].sigma_px, rel=1e-3)


def test_a_few_wrong_matches_do_not_spoil_the_tensor():
    rng = np.random.default_rng(5)
    P = three_cameras(rng)
    points, segments = matches(P, rng, 100, 40, 0.3)
    points[2, :5] += rng.uniform(5.0, 15.0, (5, 2))
    exact, _ = matches(P, rng, 100, 0, 0.0)
    robust = estimate_trifocal(*points, segments=segments, threshold_px=None)
    assert np.median(point_transfer_px(robust.T, exact)) < 0.5
    assert robust.point_residuals_px[:, :5].max(axis=0).min() > 1.0


def test_many_wrong_matches_are_left_out():
    rng = np.random.default_rng(6)
    P = three_cameras(rng)
    points, _ = matches(P, rng, 120, 0, 0.3)
    points[2, :40] = rng.uniform(0.0, 1000.0, (40, 2))
    exact, _ = matches(P, rng, 100, 0, 0.0)
    fit = estimate_trifocal(*points)
    assert fit.inliers[40:].mean() > 0.95
    assert fit.inliers[:40].sum() <= 2
    assert np.isnan(fit.point_residuals_px[:, ~fit.inliers]).all()
    assert np.median(point_transfer_px(fit.T, exact)) < 0.3


def test_matches_that_cannot_work_are_named():
    rng = np.random.default_rng(0)
    points, segments = matches(three_cameras(rng), rng, 6, 0, 0.0)
    refuses(StageFailure, "too few matches", estimate_trifocal, *points, segments=segments)
    refuses(StageFailure, "too few matches", estimate_trifocal)
    flat = np.column_stack([rng.uniform(-2.0, 2.0, (20, 2)), np.zeros(20)])
    line = np.outer(np.linspace(-1.0, 1.0, 20), [1.0, 0.5, 0.2])
    twice = np.tile(rng.uniform(-1.0, 1.0, (5, 3)), (4, 1))
    for special in (flat, line, twice):
        with pytest.raises(StageFailure, match="do not determine"):
            estimate_trifocal(*(project(camera, special) for camera in three_cameras(rng)))
    for n in (8, 20):
        refuses(StageFailure, "do not determine", estimate_trifocal, *np.ones((3, n, 2)))
    for wrong, text in (
        (np.full((3, 8, 2), np.nan), "finite"),
        (np.ones((3, 8, 3)), "needs xy1"),
        (np.ones((3, 5)), "needs xy1"),
    ):
        refuses(ValueError, text, estimate_trifocal, *wrong)
    refuses(ValueError, "loss_px", estimate_trifocal, *points, loss_px=0.0)


def _read(kind):
    """Corners (3, N, 2) or segments (3, M, 4) that are matched in all three views of merton1."""
    folder = DATA / "merton1" / "2D"
    rows = [line.split() for line in (folder / f"nview-{kind}").read_text().splitlines()]
    index = np.array([[int(entry) for entry in row] for row in rows if "*" not in row])
    return np.stack([np.loadtxt(folder / f"{v + 1:03d}.{kind}")[index[:, v]] for v in range(3)])


@pytest.mark.real
@pytest.mark.skipif(not (DATA / "merton1").is_dir(), reason="the photographs of merton1 are not here")
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


@pytest.mark.parametrize(("n", "m"), [(200, 0), (0, 200)])
def test_the_noise_of_the_equations_is_that_of_trials(n, m):
    rng = np.random.default_rng(4)
    zoomed = three_cameras(rng) * np.array([[0.4, 0.4, 1.0], [1.0, 1.0, 1.0], [1.6, 1.6, 1.0]])[:, :, None]
    exact = matches(zoomed, rng, n, m, 0.0)
    equations = _tensor_equations(*exact)
    t = equations.solve().ravel()
    squares = [
        np.sum((_tensor_equations(*(xy + rng.normal(0.0, 0.05, xy.shape) for xy in exact)).A @ t) ** 2)
        for _ in range(150)
    ]
    assert np.mean(squares) == pytest.approx(0.05**2 * np.sum((equations.noise @ t) ** 2), rel=0.05)
