"""Kernels of bundle adjustment, blocks of many cameras, and covariances against trials."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.optimize.bundle_scenes import make_block, perturbed, project_block
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.geometry.small_matrices import floored_diagonal
from thesisrecon.optimize.bundle import covariance as bundle_covariance
from thesisrecon.optimize.bundle import projection, projective, scatter, schur
from thesisrecon.optimize.bundle.covariance import robust_sigma
from thesisrecon.optimize.bundle.elimination import ReducedSums, revert_crossing_points
from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from thesisrecon.optimize.bundle.projection import (
    Jacobians,
    MetricCameras,
    Observations,
    Weighting,
    sort_observations,
)
from thesisrecon.optimize.bundle.scatter import _gram_matrix, block_scatter, linearise_fit, pose_uncertainty
from thesisrecon.optimize.bundle.schur import BundleSystem, build_layout
from thesisrecon.optimize.least_squares import huber
from thesisrecon.records import IntrinsicsPrior
from validation.scenes.walks import make_walk


def _linearized_metric(block, xy, delta=np.inf, sigma=1.0):
    c, n = block.cameras, len(xy)
    width = c.intrinsics.shape[1]
    J = Jacobians.empty(n, 6, width)
    model = projection.MetricModel(c.R, c.t, c.intrinsics, c.group, block.X)
    seen, weighting = block.seen(xy), Weighting(sigma, delta)
    own = np.zeros(0, dtype=np.int64)
    cost = projection.linearize_metric(model, seen, weighting, own, np.arange(width), J)
    assert projection.metric_cost(model, seen, weighting) == pytest.approx(cost, rel=1e-12)
    return cost, J


def _moved(cameras, pose, intrinsics):
    turn = Rotation.from_rotvec(pose[:, :3]).as_matrix()
    q = cameras.intrinsics + intrinsics
    q[:, 0] = cameras.intrinsics[:, 0] * np.exp(intrinsics[:, 0])
    t = np.einsum("vab,vb->va", turn, cameras.t) + pose[:, 3:]
    return projection.MetricCameras(turn @ cameras.R, t, q, cameras.group)


@pytest.mark.parametrize("lens", [(), (-0.03, 0.02)])
def test_metric_jacobians_match_finite_differences(lens):
    block = make_block(k1=0.05, lens=lens, groups=2)
    _, J = _linearized_metric(block, block.xy + 3.0)
    shapes, h = ((len(block.cameras.R), 6), (2, 6 + len(lens)), block.X.shape), 1e-6

    def moved(steps):
        pose, intrinsics, X = steps
        return project_block(_moved(block.cameras, pose, intrinsics), block.X + X, block.view, block.point)

    for kind, found in enumerate((J.A, J.E, J.B)):
        for c in range(shapes[kind][1]):
            ends = []
            for step in (h, -h):
                steps = [np.zeros(shape) for shape in shapes]
                steps[kind][:, c] = step
                ends.append(moved(steps))
            slope = (ends[0] - ends[1]) / (2.0 * h)
            np.testing.assert_allclose(found[:, :, c], slope, rtol=2e-5, atol=2e-4)


@pytest.mark.parametrize("size", [0.0, 1e-9, 5e-5, 1e-3, 1.0, 3.0])
def test_poses_move_by_the_exponential_map(size):
    rng = np.random.default_rng(3)
    R, t = Rotation.random(9, random_state=rng).as_matrix(), rng.normal(size=(9, 3))
    step = size * rng.normal(size=(9, 6))
    R_out, t_out = np.empty_like(R), np.empty_like(t)
    projection.move_poses(R, t, step, R_out, t_out)
    turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
    np.testing.assert_allclose(R_out, turn @ R, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(t_out, np.einsum("vab,vb->va", turn, t) + step[:, 3:], rtol=1e-14, atol=2e-15)


@pytest.mark.parametrize("delta", [1e6, 1.0])
def test_projective_jacobians_match_finite_differences(delta):
    rng = np.random.default_rng(4)
    P, X = rng.normal(size=(3, 12)), rng.normal(size=(7, 4))
    P, X = (rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (P, X))
    view, point = (a.ravel() for a in np.meshgrid(np.arange(3), np.arange(7)))
    xy, J, state = rng.normal(size=(21, 2)), Jacobians.empty(21, 11, 0), projective.UnitState.at(P, X)
    given = state, Observations(view, point, xy), Weighting(1.0, delta)
    cost = projective.linearize_projective(*given, J)
    assert projective.projective_cost(*given) == pytest.approx(cost, rel=1e-12)

    def residuals(steps):
        moved = np.empty_like(P), np.empty_like(X)
        projective.tangent_step(P, state.vP, state.bP, steps[0], moved[0])
        projective.tangent_step(X, state.vX, state.bX, steps[1], moved[1])
        u = np.einsum("kab,kb->ka", moved[0].reshape(3, 3, 4)[view], moved[1][point])
        return u[:, :2] / u[:, 2:] - xy

    r = residuals((np.zeros((3, 11)), np.zeros((7, 3))))
    rho, weight = huber(np.sum(r**2, axis=1), delta)
    assert cost == pytest.approx(0.5 * rho.sum())
    np.testing.assert_allclose(J.residual, np.sqrt(weight)[:, None] * r, rtol=1e-12)
    for kind, found in enumerate((J.A, J.B)):
        for c in range(found.shape[2]):
            ends = []
            for h in (1e-7, -1e-7):
                steps = np.zeros((3, 11)), np.zeros((7, 3))
                steps[kind][:, c] = h
                ends.append(residuals(steps))
            slope = np.sqrt(weight)[:, None] * (ends[0] - ends[1]) / 2e-7
            np.testing.assert_allclose(found[:, :, c], slope, rtol=1e-4, atol=1e-5 * np.abs(found).max())


def test_the_loss_of_the_kernels_is_that_of_numpy():
    block = make_block()
    noise = np.random.default_rng(0).normal(size=block.xy.shape) * 2.0
    cost, J = _linearized_metric(block, block.xy - noise, 1.5, 2.0)
    s = np.sum((noise / 2.0) ** 2, axis=1)
    rho, weight = huber(s, 1.5)
    assert cost == pytest.approx(0.5 * rho.sum())
    np.testing.assert_allclose(J.residual, np.sqrt(weight)[:, None] * noise / 2.0, rtol=1e-9, atol=1e-9)


def _full_jacobian(J, layout):
    """All columns of one problem side by side: blocks of the views, border, points."""
    o, index, C = layout.observations, layout.index, layout.width
    edge = C * (len(index.row) - 1)
    seen = o.seen
    full = np.zeros((2 * len(seen.xy), layout.size + 3 * (len(o.start) - 1)))
    for k in range(len(seen.xy)):
        rows, v, j = slice(2 * k, 2 * k + 2), index.block[seen.view_index[k]], seen.point_index[k]
        if v >= 0:
            full[rows, C * v : C * v + C] = J.A[k]
        for f, column in enumerate(index.common[seen.view_index[k]]):
            if column >= 0:
                full[rows, edge + column] += J.E[k, :, f]
        full[rows, layout.size + 3 * j : layout.size + 3 * j + 3] = J.B[k]
    return full


@pytest.mark.parametrize("solver", ["chosen", "banded"])
@pytest.mark.parametrize("twice", [False, True])
def test_elimination_gives_the_step_of_the_full_dense_system(solver, twice):
    block = make_block(views=6, points=30, groups=2)
    rng = np.random.default_rng(2)
    view = block.view.copy()
    if twice:
        view[1] = view[0]
    seen = Observations(view, block.point, block.xy + rng.normal(size=block.xy.shape))
    o = sort_observations(seen, 6, 30)
    c = block.cameras
    # View 0 is fixed; focals are per view, the rest belongs to two groups, one without third coefficient.
    own, common = np.array([0]), np.arange(1, 6)
    columns = np.arange(5) + 5 * c.group[:, None]
    columns[c.group == 1, 4] = -1
    layout = build_layout(o, np.arange(6) - 1, width=7, common=columns, border=9)
    assert layout.solver is None
    if solver == "banded":
        layout = replace(layout, solver=schur.BandedCholesky(np.array([2, 0, 1, 4, 3]), 4))
    J = layout.jacobians()
    model = projection.MetricModel(c.R, c.t, c.intrinsics, c.group, block.X)
    cost = projection.linearize_metric(model, o.seen, Weighting(1.0, np.inf), own, common, J)
    gradient = np.zeros(layout.size)
    gradient[[6, 40]] = [3.0, -3.0]
    Q = np.zeros((layout.size, layout.size))
    Q[np.ix_([38, 42], [38, 42])] += [[3e4, -3e4], [-3e4, 3e4]]
    Q[np.ix_([6, 40], [6, 40])] += [[2e4, -2e4], [-2e4, 2.5e4]]
    i, j = np.nonzero(Q)
    system = BundleSystem(cost, layout, J, (i, j, Q[i, j], gradient))
    (camera_step, point_step), gain, of_cameras = system.solve(1e-3)

    full, r, D = _full_jacobian(J, layout), J.residual.ravel(), layout.size
    H, g = full.T @ full, full.T @ r
    H[:D, :D] += Q
    g[:D] += gradient
    damped = H + 1e-3 * np.diag(floored_diagonal(np.diag(H)))
    expected = np.linalg.solve(damped, -g)
    np.testing.assert_allclose(camera_step, expected[:D], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(point_step.ravel(), expected[D:], rtol=1e-5, atol=1e-8)
    assert gain == pytest.approx(-g @ expected - 0.5 * expected @ H @ expected, rel=1e-5)
    # The gain of the cameras is without that of the points alone.
    of_points = g[D:] @ np.linalg.solve(damped[D:, D:], g[D:])
    assert of_cameras == pytest.approx(0.5 * (-g @ expected - of_points), rel=1e-4)


@pytest.mark.parametrize("kind", ["sorted", "falling", "any", "twice"])
def test_observations_of_any_order_are_sorted_by_point_and_view(kind):
    rng = np.random.default_rng(0)
    some = np.sort(rng.permutation(35)[:20])
    orders = {
        "sorted": some,
        "falling": some[::-1],
        "any": rng.permutation(some),
        "twice": rng.integers(35, size=60),
    }
    point, view = np.divmod(orders[kind], 5)
    given = Observations(view, point, rng.normal(size=(len(view), 2)))
    o = sort_observations(given, 5, 8)
    assert o.order.tolist() == sorted(range(len(view)), key=lambda k: (point[k], view[k], k))
    assert o.start.tolist() == [np.sum(point < j) for j in range(9)]
    for name in ("view_index", "point_index", "xy"):
        np.testing.assert_array_equal(o.unsort(getattr(o.seen, name)), getattr(given, name))
    for one in ((5, 0), (-1, 0), (0, 8), (0, -1)):
        beyond = Observations(*np.array(one)[:, None], np.zeros((1, 2)))
        refuses(ValueError, "beyond the 5 views or 8 points", sort_observations, beyond, 5, 8)


def test_dense_sparse_and_banded_systems_are_one_matrix():
    rng, b, C, e = np.random.default_rng(0), 5, 3, 2
    edge, (row, column) = b * C, np.triu_indices(b)
    A = rng.normal(size=(edge + e, 60))
    S, rhs = A @ A.T, rng.normal(size=edge + e)
    # Views 0 and 3 have no common points.
    S[:3, 9:12] = S[9:12, :3] = 0.0
    views, seen = S[:edge, :edge].reshape(b, C, b, C).swapaxes(1, 2), (row != 0) | (column != 3)
    row, column = row[seen], column[seen]
    parts = views[row, column], S[:edge, edge:].reshape(b, C, e), S[edge:, edge:].copy(), rhs
    system = schur.ReducedSystem(
        row, column, ReducedSums(*(p.copy() for p in parts), *np.zeros((2, edge + e)))
    )
    for _ in range(2):
        np.testing.assert_array_equal(np.triu(system.dense()), np.triu(S))
        np.testing.assert_array_equal(system.sparse().toarray(), S)
        for order in (np.arange(b), rng.permutation(b), rng.permutation(b)):
            banded = schur.BandedCholesky(order, b - 1)
            np.testing.assert_allclose(banded.solve(system), np.linalg.solve(S, rhs), rtol=1e-9)
        np.testing.assert_allclose(schur.solve_dense(system), np.linalg.solve(S, rhs), rtol=1e-9)
        more = rng.uniform(1.0, 9.0, edge + e)
        schur.add_diagonal(system.sums, np.flatnonzero(row == column), more)
        S += np.diag(more)


def test_chunks_give_the_sums_of_the_whole(monkeypatch):
    block = make_block(views=6, points=200, groups=1)
    cameras, X = perturbed(block)
    seen, free = block.seen(), ~np.isin(np.arange(6), [1, 2, 5])
    whole = refine_metric_bundle(cameras, X, seen, free=free)
    monkeypatch.setattr(schur, "CHUNK", 100)
    np.testing.assert_allclose(refine_metric_bundle(cameras, X, seen, free=free).X, whole.X, atol=1e-6)


@pytest.mark.parametrize("solve", [schur.solve_dense, schur.BandedCholesky(np.arange(3), 2).solve])
@pytest.mark.parametrize("spoiled", ["views", "corner", "rhs"])
@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan])
def test_every_solver_detects_an_indefinite_system(solve, spoiled, value):
    row, column = np.array([0, 0, 1, 1, 2]), np.array([0, 1, 1, 2, 2])
    blocks, border, corner = np.zeros((5, 2, 2)), np.full((3, 2, 1), 0.1), np.eye(1)
    blocks[row == column] = np.eye(2)
    sums = ReducedSums(blocks, border, corner, np.ones(7), *np.zeros((2, 7)))
    system = schur.ReducedSystem(row, column, sums)
    full = np.triu(system.dense()) + np.triu(system.dense(), 1).T
    np.testing.assert_allclose(full @ solve(system), 1.0)
    what = {"views": blocks, "corner": corner, "rhs": sums.rhs}[spoiled]
    what *= value
    if spoiled != "rhs" or np.isnan(value):
        assert solve(system) is None


def test_the_solver_is_chosen_by_the_pattern_of_the_blocks():
    def chosen(n, pairs):
        return schur.choose_solver(*np.array(sorted(pairs)).T, n, 6, 4)

    near = {(i, j) for i in range(400) for j in range(i, min(i + 8, 400))}
    ring = near | {(j, i + 400) for i in range(-8, 0) for j in range(i + 8)}
    rng = np.random.default_rng(0)
    wild = {tuple(sorted(rng.integers(0, 2000, 2))) for _ in range(20000)} | {(i, i) for i in range(2000)}
    assert chosen(400, near).reach == 7
    assert isinstance(chosen(400, ring), schur.BandedCholesky)
    assert chosen(2000, wild) is None
    assert chosen(150, {(i, j) for i in range(150) for j in range(i, 150)}) is None


def test_a_bending_loss_keeps_the_gradient_and_bends_the_curvature():
    block = make_block()
    c, n = block.cameras, len(block.xy)
    xy = block.xy + np.random.default_rng(1).normal(size=block.xy.shape)
    model = projection.MetricModel(c.R, c.t, c.intrinsics, c.group, block.X)
    seen, own, common = block.seen(xy), np.array([0, 3]), np.array([4, 5])
    plain, bent = Jacobians.empty(n, 8, 2), Jacobians.empty(n, 8, 2)
    for J, least in ((plain, 1.0), (bent, 0.2)):
        projection.linearize_metric(model, seen, Weighting(1.0, 1.1, least), own, common, J)
    for a, b in ((plain.A, bent.A), (plain.E, bent.E), (plain.B, bent.B)):
        gradient = np.einsum("kic,ki->kc", a, plain.residual)
        np.testing.assert_allclose(np.einsum("kic,ki->kc", b, bent.residual), gradient, rtol=1e-9, atol=1e-9)
    # Curvature of rho along the residual e over that of plain reweighting, by differences of its slope in s.
    e = project_block(c, block.X, block.view, block.point) - xy
    s = np.sum(e**2, axis=1)
    slope = (huber(s * 1.00001, 1.1)[1] - huber(s * 0.99999, 1.1)[1]) / (2e-5 * s)
    expected = np.maximum(1.0 + 2.0 * s * slope / huber(s, 1.1)[1], 0.2)
    along = np.einsum("kic,ki->kc", plain.A, e)[:, 4] ** 2, np.einsum("kic,ki->kc", bent.A, e)[:, 4] ** 2
    np.testing.assert_allclose(along[1] / along[0], expected, rtol=2e-3, atol=2e-3)


def test_noise_is_found_beside_outliers_and_leverages_are_those_of_the_points():
    rng = np.random.default_rng(0)
    # Orthonormal columns in any unit, also of a point on one ray.
    B = rng.normal(size=(7, 2, 3))
    B[5:, :, 2] = 0.0
    point = np.array([0, 0, 0, 2, 2, 3, 3])
    for unit in (1e-8, 1.0, 1e8):
        Q = bundle_covariance.orthonormal_columns(unit * B, point, 4)
        for rows in (point == 0, point == 2, point == 3):
            J, q = B[rows].reshape(-1, 3), Q[rows].reshape(-1, 3)
            np.testing.assert_allclose(q @ q.T, J @ np.linalg.pinv(J), atol=1e-9)
    rng = np.random.default_rng(0)
    residual, leverage = 0.3 * rng.normal(size=(5000, 2)), np.zeros((5000, 2))
    assert robust_sigma(residual, leverage, 0) == pytest.approx(0.3, rel=0.02)
    residual[:100] *= 100.0
    assert robust_sigma(residual, leverage, 0) == pytest.approx(0.3, rel=0.04)
    # A coordinate keeps the share of its variance that neither its point nor the cameras took.
    leverage[:] = 0.5
    assert robust_sigma(np.sqrt(0.25) * residual, leverage, 2500) == pytest.approx(0.3, rel=0.04)
    leverage[2500:], residual[2500:] = 1.0, 0.0
    assert robust_sigma(np.sqrt(0.25) * residual, leverage, 2500) == pytest.approx(0.3, rel=0.05)
    assert robust_sigma(residual, np.ones_like(leverage), 0) == 0.0
    assert robust_sigma(np.zeros((0, 2)), np.zeros((0, 2)), 0) == 0.0


@pytest.mark.parametrize("d", [3, 4])
def test_steps_of_points_across_a_focal_plane_are_undone(d):
    before, row = np.ones((3, d)), np.array([[0.0, 0.0, 1.0, 0.5]])
    after = before * [[2.0], [-2.0], [-2.0]]
    revert_crossing_points(np.arange(4), np.zeros(3, dtype=np.int64), row, row, before, after)
    np.testing.assert_array_equal(after, before * [[2.0], [1.0], [1.0]])


FREE = np.array([True, False, False, True, True, True])
SIGMA = 0.5


def _scatter(block, xy, *, loss=20.0):
    """The fit of all but aspect and skew, its linearisation, and the scatter of its blocks."""
    q = block.cameras.intrinsics
    prior = IntrinsicsPrior.unshared(q, np.full_like(q, np.inf))
    options = BundleOptions(sigma_px=SIGMA, loss_px=loss * SIGMA, max_iterations=30, covariance=True)
    fit = refine_metric_bundle(
        block.cameras, block.X, block.seen(xy), free=FREE, prior=prior, options=options
    )
    linear = linearise_fit(fit.cameras, fit.X, block.seen(xy), FREE, prior, (SIGMA, loss * SIGMA))
    return fit, linear, block_scatter(linear)


def test_the_scatter_of_nearly_undetermined_cameras_is_not_measurable():
    """Their variances are so large that rounding leaves nothing of what is expected."""
    block = make_block(points=200)
    linear = _scatter(block, block.xy + SIGMA * np.random.default_rng(0).normal(size=block.xy.shape))[1]
    lost = replace(linear, taken=3.0 * linear.taken, solve=lambda B: 1e9 * linear.solve(B))
    found = block_scatter(lost)
    assert np.isnan(found.overdispersion)
    assert np.isnan(found.ratio).all()


def test_the_variances_are_those_of_bundle_adjustment_and_grow_with_the_intrinsics():
    block = make_block(points=200)
    fit, linear, scatter = _scatter(
        block, block.xy + SIGMA * np.random.default_rng(0).normal(size=block.xy.shape)
    )
    ratio = (SIGMA / fit.sigma_px) ** 2
    expected = ratio * np.diagonal(fit.intrinsics_covariance, axis1=1, axis2=2)
    expected[:, 0] /= fit.cameras.intrinsics[:, 0] ** 2
    np.testing.assert_allclose(scatter.variance, expected, rtol=0.02)
    np.testing.assert_allclose(scatter.shared_variance, scatter.variance[0], rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(scatter.ratio[0]), ~FREE)
    assert scatter.blocks >= 8
    poses = pose_uncertainty(linear, 1e-3)
    own = np.sqrt(np.diag(poses.covariance))
    np.testing.assert_allclose(own, np.sqrt(scatter.variance[0][FREE]), rtol=1e-6)
    R, covariance = fit.cameras.R, ratio * fit.pose_covariance
    centre = np.einsum("vba,vbc,vcd->vad", R, covariance[:, 3:, 3:], R)
    expected = np.concatenate([np.diagonal(c, axis1=1, axis2=2) for c in (covariance[:, :3, :3], centre)], 1)
    np.testing.assert_allclose(poses.variances(1.0, own, 0.0), expected, rtol=0.03)
    wider = poses.variances(1.0, 3.0 * own, 0.0) - poses.variances(1.0, own, 0.0)
    np.testing.assert_allclose(wider, 8.0 * (poses.variances(1.0, own, 0.0) - poses.variance), rtol=1e-6)


def test_independent_noise_of_any_distribution_has_ratio_one_and_shared_noise_is_seen():
    block = make_block(points=400)
    rng, found, poses = np.random.default_rng(1), [], []
    for _ in range(12):
        noise = SIGMA * rng.normal(size=block.xy.shape)
        heavy = np.where(rng.random(len(noise)) < 0.2, 4.0, 1.0)[:, None] * noise
        scatters = _scatter(block, block.xy + noise)[2], _scatter(block, block.xy + heavy, loss=1.5)[2]
        found.append([(s.median_ratio, s.overdispersion) for s in scatters])
        poses.append(scatters[0].pose_ratios)
    np.testing.assert_allclose(np.mean(poses, axis=(0, 2)), 1.0, atol=0.2)
    (normal_ratio, normal_dispersion), (heavy_ratio, heavy_dispersion) = np.mean(found, axis=0)
    assert normal_ratio == pytest.approx(1.0, abs=0.15)
    assert normal_dispersion == pytest.approx(1.0, abs=0.12)
    assert heavy_dispersion == pytest.approx(1.0, abs=0.15)
    # Four times as wide in a fifth of the matches: more than the size of the core says.
    assert heavy_ratio > 1.3
    # A smooth field of errors in each image beside a little noise.
    wave = rng.normal(size=(len(block.cameras.R), 2, 2))
    field = np.sin(np.einsum("kab,kb->ka", wave[block.view], block.xy / 150.0))
    noise = 0.3 * SIGMA * rng.normal(size=field.shape) + SIGMA * field
    assert _scatter(block, block.xy + noise)[2].overdispersion > 2.0
    noise[block.view != 2] -= SIGMA * field[block.view != 2]
    of_one = _scatter(block, block.xy + noise)[2].pose_ratios.max(axis=(0, 2))
    assert of_one[2] > 1.5 * np.median(of_one)


@pytest.mark.parametrize("own", [False, True])
def test_the_scatter_of_a_street_is_that_of_dense_information(monkeypatch, own):
    views = 120
    walk = make_walk(views, np.random.default_rng(0))
    cameras, free = walk.cameras, np.array([True, False, False, False, False, True])
    if own:
        rows = np.tile(cameras.intrinsics, (views, 1))
        cameras = replace(cameras, intrinsics=rows, group=np.arange(views), shared=None)
    std = np.tile([100.0, 0, 0, 0, 0, 0.1], (len(cameras.intrinsics), 1))
    prior = IntrinsicsPrior.unshared(cameras.intrinsics, std)
    options = BundleOptions(sigma_px=0.5, loss_px=1.0, max_iterations=15)
    fit = refine_metric_bundle(cameras, walk.X, walk.seen, free=free, prior=prior, options=options)
    monkeypatch.setattr(scatter, "_MANY", 100)
    found = []
    for share in (0.0, 0.5):
        monkeypatch.setattr(scatter, "_SPARSE", share)
        found.append(block_scatter(linearise_fit(fit.cameras, fit.X, walk.seen, free, prior, (0.5, 1.0))))
    dense, sparse = found
    for name, rtol in (
        ("variance", 1e-5),
        ("shared_variance", 1e-5),
        ("ratio", 1e-4),
        ("overdispersion", 1e-4),
    ):
        np.testing.assert_allclose(getattr(sparse, name), getattr(dense, name), rtol=rtol)
    A = scipy.sparse.random_array((300, 40), density=0.2, format="csr", rng=np.random.default_rng(0))
    np.testing.assert_array_equal(_gram_matrix(A), (A.T @ A).toarray())


def test_faults_of_the_camera_model_move_the_cameras_as_an_adjustment_does():
    block, eps = make_block(points=200), 1e-4
    q = block.cameras.intrinsics[block.cameras.group[block.view]]
    exact, linear, _ = _scatter(block, block.xy)
    x, y = ((block.xy - q[:, 3:5]) / q[:, :1]).T
    fields = [(0 * x, y), (y, 0 * x), (3 * x**2 + y**2, 2 * x * y), (2 * x * y, x**2 + 3 * y**2)]
    poses = pose_uncertainty(linear, 1e-3)
    for n, field in enumerate(fields):
        moved = _scatter(block, block.xy + eps * q[:, :1] * np.array(field).T)[0]
        turned = np.swapaxes(moved.cameras.R, 1, 2) @ exact.cameras.R
        angle = np.degrees(Rotation.from_matrix(turned).as_rotvec())
        stated = np.degrees(eps * np.einsum("vba,vb->va", exact.cameras.R, poses.fault[:, :3, n]))
        # Without the rotation of the whole, which no image determines.
        stated, found = (a - a.mean(axis=0) for a in (stated, angle))
        assert np.abs(angle).max() > 0.0
        np.testing.assert_allclose(stated, -found, atol=0.03 * np.abs(stated).max())
        rows = moved.cameras.intrinsics[0], exact.cameras.intrinsics[0]
        change = np.append(np.log(rows[0][0] / rows[1][0]), (rows[0] - rows[1])[1:])[FREE]
        stated = eps * poses.intrinsic_fault[:, n]
        own = np.sqrt(np.diag(poses.covariance))
        np.testing.assert_allclose(stated / own, change / own, atol=0.03 * np.abs(stated / own).max())


def _own_focals(block, populations):
    """Focals of their own, the rest common; with ``populations`` views 1 to 5 are of one kind, 0 is held."""
    c = block.cameras
    rows = np.tile(c.intrinsics[0], (6, 1))
    rows[:, 0] = [1200.0, 1150.0, 1240.0, 1180.0, 1210.0, 1260.0]
    shared = np.zeros((6, 6), dtype=np.int64)
    shared[:, 0] = np.arange(6)
    cameras = MetricCameras(c.R, c.t, rows, np.arange(6), shared)
    if not populations:
        return cameras, None
    std = np.full((6, 6), np.inf)
    std[0, 0] = 0.0
    spread = np.array([0.03, *[np.inf] * 5])
    return cameras, IntrinsicsPrior.unshared(rows, std, kind=np.array([-1, 1, 1, 1, 1, 1]), spread=spread)


@pytest.mark.parametrize("populations", [False, True])
def test_the_banded_way_gives_the_covariances_of_the_dense_one(monkeypatch, populations):
    block = make_block(k1=0.02, points=60)
    cameras, prior = _own_focals(block, populations)
    xy = project_block(cameras, block.X, block.view, block.point)
    xy += 0.3 * np.random.default_rng(0).normal(size=xy.shape)
    options, fits = BundleOptions(covariance=True, point_covariance=True), []
    for largest in (bundle_covariance.MAX_DENSE, 0):
        monkeypatch.setattr(bundle_covariance, "MAX_DENSE", largest)
        seen = block.seen(xy)
        fits.append(refine_metric_bundle(cameras, block.X, seen, free=FREE, prior=prior, options=options))
    for name, axes in (("intrinsics", 0), ("pose", (1, 2)), ("point", (1, 2))):
        dense, banded = (getattr(fit, f"{name}_covariance") for fit in fits)
        scale = np.abs(dense).max(axis=axes, keepdims=True) + 1e-30
        assert (np.abs(banded - dense) / scale).max() < 1e-3
    assert bool(fits[0].intrinsics_covariance[0, 0, 0] > 0.0) is not populations


def _inner_frame(block):
    """Origin and scale of the frame inside, where the gauge is the inner one, and its motions of the poses
    (6 V, 7) and the points (3 N, 7)."""
    origin = np.median(block.X, axis=0)
    scale = 1.0 / np.median(np.linalg.norm(block.X - origin, axis=1))
    R = block.cameras.R
    t, X = scale * (block.cameras.t + R @ origin), scale * (block.X - origin)
    poses = np.block([[0.0 * R, -R, np.zeros((len(t), 3, 1))], [-R, -cross_matrix(t) @ R, t[:, :, None]]])
    points = np.concatenate([np.tile(np.eye(3), (len(X), 1, 1)), -cross_matrix(X), X[:, :, None]], axis=2)
    return origin, scale, poses.reshape(-1, 7), points.reshape(-1, 7)


@pytest.mark.parametrize("populations", [False, True])
def test_errors_are_as_large_as_the_covariances_say(populations):
    block = make_block(k1=0.02, points=60)
    cameras, prior = _own_focals(block, populations)
    rng, sigma, c = np.random.default_rng(11), 0.4, block.cameras
    origin, scale, G, G_points = _inner_frame(block)
    options = BundleOptions(sigma, np.inf, 15, covariance=True, point_covariance=True)
    z_intrinsics, z_poses, z_points, sigmas = [], [], [], []
    for _ in range(120):
        true = cameras.intrinsics.copy()
        if prior is not None:
            # The truth of each member is drawn from the hierarchical prior.
            true[1:, 0] = 1200.0 * np.exp(0.03 * rng.normal(size=5))
        start = MetricCameras(c.R, c.t, true, np.arange(6), cameras.shared)
        xy = project_block(start, block.X, block.view, block.point)
        seen = block.seen(xy + sigma * rng.normal(size=xy.shape))
        fit = refine_metric_bundle(start, block.X, seen, free=FREE, prior=prior, options=options)
        std = np.sqrt(fit.intrinsics_covariance[:, range(6), range(6)])
        free = std > 0.0
        z_intrinsics.append(((fit.cameras.intrinsics - true)[free] / std[free]) ** 2)
        turn = Rotation.from_matrix(fit.cameras.R @ np.swapaxes(c.R, 1, 2))
        shift = fit.cameras.t - np.einsum("vab,vb->va", turn.as_matrix(), c.t + c.R @ origin)
        shift += fit.cameras.R @ origin
        delta = np.concatenate([turn.as_rotvec(), scale * shift], axis=1).ravel()
        moved = np.linalg.lstsq(G, delta, rcond=None)[0]
        delta -= G @ moved
        units = np.array([1.0, 1.0, 1.0, scale, scale, scale])
        z_poses.append(delta**2 / (np.diagonal(fit.pose_covariance, axis1=1, axis2=2) * units**2).ravel())
        delta = (fit.X - block.X) - (G_points @ moved).reshape(-1, 3) / scale
        z_points.append(np.einsum("na,nab,nb->n", delta, np.linalg.inv(fit.point_covariance), delta) / 3.0)
        sigmas.append(fit.sigma_px)
    for z, within in ((z_intrinsics, 0.08), (z_poses, 0.08), (z_points, 0.05)):
        assert np.sqrt(np.mean(z)) == pytest.approx(1.0, abs=within)
    assert np.mean(sigmas) == pytest.approx(sigma, rel=0.01)
