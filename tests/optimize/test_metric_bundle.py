from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import refuses
from tests.optimize.bundle_scenes import make_block, perturbed, project_block
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.optimize.bundle import schur
from thesisrecon.optimize.bundle.intrinsic_unknowns import number_unknowns
from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations
from thesisrecon.records import IntrinsicsPrior

FOCAL = np.array([True, False, False, False, False, False])
FOCAL_CENTRE_RADIAL = np.array([True, False, False, True, True, True])


def _refine(cameras, X, seen, *, free, prior=None, **options):
    return refine_metric_bundle(cameras, X, seen, free=free, prior=prior, options=BundleOptions(**options))


@pytest.mark.parametrize(("groups", "lens"), [(1, ()), (6, ()), (1, (-0.04, 0.05))])
def test_exact_observations_give_the_true_calibration_and_shape(groups, lens):
    block = make_block(k1=0.03, lens=lens, groups=groups, points=150)
    cameras, X = perturbed(block)
    free = ~np.isin(np.arange(6 + len(lens)), [1, 2])
    result = _refine(cameras, X, block.seen(), free=free, max_iterations=200, covariance=True)
    assert np.abs(result.residual_px).max() < 1e-3
    np.testing.assert_allclose(result.cameras.intrinsics, block.cameras.intrinsics, rtol=5e-3, atol=2e-3)
    assert (np.diagonal(result.intrinsics_covariance, axis1=1, axis2=2)[:, free] > 0.0).all()
    aligned = estimate_similarity(result.X, block.X).apply(result.X)
    np.testing.assert_allclose(aligned, block.X, atol=2e-3)
    seen = project_block(result.cameras, result.X, block.view, block.point)
    np.testing.assert_allclose(seen - block.xy, result.residual_px, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_an_adjustment_ends_when_the_cameras_are_settled(monkeypatch, seed):
    block, rng = make_block(points=600), np.random.default_rng(seed)
    cameras, X = perturbed(block)
    xy = block.xy + 0.3 * rng.normal(size=block.xy.shape)
    wrong = block.point % 10 == 0
    xy[wrong] += 4.0 * rng.normal(size=(wrong.sum(), 2))
    solved, solve = [], schur.BundleSystem.solve
    monkeypatch.setattr(schur.BundleSystem, "solve", lambda *given: solved.append(0) or solve(*given))
    options = {"sigma_px": 0.3, "loss_px": 0.3, "max_iterations": 200, "covariance": True}
    exact = _refine(cameras, X, block.seen(xy), free=FOCAL, **options)
    many = len(solved)
    early = _refine(cameras, X, block.seen(xy), free=FOCAL, settled=1e-3, **options)
    assert len(solved) - many < 0.6 * many
    std = np.sqrt(exact.intrinsics_covariance[0, 0, 0])
    assert abs(early.cameras.intrinsics[0, 0] - exact.cameras.intrinsics[0, 0]) < 0.05 * std
    # The contradictory points have not arrived.
    assert exact.cost < early.cost < exact.cost * 1.001


@pytest.mark.parametrize("groups", [1, 40])
def test_conjugate_gradients_find_the_minimum_and_covariances_of_cholesky(monkeypatch, groups):
    block, rng = make_block(views=40, points=300, groups=groups), np.random.default_rng(0)
    cameras, X = perturbed(block)
    seen, fixed = block.seen(block.xy + 0.3 * rng.normal(size=block.xy.shape)), np.arange(40) == 3
    prior = IntrinsicsPrior.unshared(cameras.intrinsics, np.full(cameras.intrinsics.shape, 0.1))
    options = {"free": FOCAL_CENTRE_RADIAL, "prior": prior, "covariance": True, "loss_px": 0.6}
    direct = _refine(cameras, X, seen, **options)
    monkeypatch.setattr(schur, "MANY_VIEWS", 30)
    monkeypatch.setattr(schur, "CHUNK", 1000)
    found, again = (_refine(cameras, X, seen, threads=threads, **options) for threads in (1, 2))
    assert found.cost == pytest.approx(direct.cost, rel=1e-8)
    np.testing.assert_allclose(found.cameras.intrinsics, direct.cameras.intrinsics, rtol=1e-5, atol=1e-5)
    variances = [np.diagonal(r.pose_covariance, axis1=1, axis2=2).mean(axis=0) for r in (found, direct)]
    np.testing.assert_allclose(*variances, rtol=0.15)
    of_focal = [r.intrinsics_covariance[:, 0, 0].mean() for r in (found, direct)]
    np.testing.assert_allclose(*of_focal, rtol=1e-4 if groups == 1 else 0.15)
    np.testing.assert_array_equal(found.X, again.X)
    one = refine_metric_bundle(cameras, X, seen, free=FOCAL, fixed=fixed, options=BundleOptions())
    np.testing.assert_array_equal(one.cameras.R[3], cameras.R[3])
    monkeypatch.undo()
    assert one.cost == pytest.approx(
        refine_metric_bundle(cameras, X, seen, free=FOCAL, fixed=fixed, options=BundleOptions()).cost,
        rel=1e-8,
    )


def test_cost_does_not_depend_on_the_frame():
    block = make_block()
    cameras, X = perturbed(block)
    seen = block.seen(block.xy + 0.5 * np.random.default_rng(0).normal(size=block.xy.shape))
    first = _refine(cameras, X, seen, free=FOCAL, max_iterations=60)
    s, shift, Q = 250.0, np.array([1e4, -3e3, 8e3]), block.cameras.R[2]
    R = cameras.R @ Q.T
    moved = replace(cameras, R=R, t=s * cameras.t - R @ shift)
    second = _refine(moved, s * X @ Q.T + shift, seen, free=FOCAL, max_iterations=60)
    assert second.cost == pytest.approx(first.cost, rel=1e-5)
    np.testing.assert_allclose(second.cameras.intrinsics, first.cameras.intrinsics, rtol=1e-4)


def test_a_tight_prior_holds_and_a_loose_one_yields():
    block = make_block()
    mean, std = block.cameras.intrinsics * [1.1, 1, 1, 1, 1, 1], np.full((1, 6), np.inf)
    for std_rel, focal in ((1e-7, 1320.0), (1.0, 1200.0)):
        std[0, 0] = std_rel
        options = {"prior": IntrinsicsPrior.unshared(mean, std), "sigma_px": 0.3, "max_iterations": 50}
        fit = _refine(block.cameras, block.X, block.seen(), free=FOCAL, **options)
        assert fit.cameras.intrinsics[0, 0] == pytest.approx(focal, rel=1e-3)


def test_unseen_parts_come_back_untouched():
    block = make_block()
    cameras, X = perturbed(block)
    X = np.concatenate([X, [[9.0, 9.0, 9.0]]])
    k = (block.view > 0) & (block.view < 5)
    seen = Observations(block.view[k], block.point[k], block.xy[k])
    result = _refine(cameras, X, seen, free=np.zeros(6, bool), covariance=True)
    fixed = [0, 5]
    np.testing.assert_array_equal(result.cameras.R[fixed], cameras.R[fixed])
    np.testing.assert_array_equal(result.cameras.t[fixed], cameras.t[fixed])
    np.testing.assert_array_equal(result.cameras.intrinsics, cameras.intrinsics)
    np.testing.assert_array_equal(result.X[-1], X[-1])
    assert not result.pose_covariance[fixed].any()
    # A point that no view sees has no effect, wherever it is.
    X[-1] = 1e6
    elsewhere = _refine(cameras, X, seen, free=np.zeros(6, bool))
    np.testing.assert_array_equal(elsewhere.X[:-1], result.X[:-1])


def test_degenerate_input_is_guarded():
    block = make_block()
    c, empty = block.cameras, np.zeros(0, dtype=np.int64)
    nothing = _refine(c, block.X, Observations(empty, empty, np.zeros((0, 2))), free=FOCAL, covariance=True)
    assert nothing.cost == 0.0
    # All cameras at one place: depths are free, nothing may raise.
    same, far = replace(c, t=np.zeros_like(c.t)), 0.1 * block.X + [0.0, 0.0, 5.0]
    start, turned = (
        _refine(same, far, block.seen(), free=FOCAL, covariance=True, max_iterations=n) for n in (0, 20)
    )
    assert turned.cost <= start.cost
    assert np.isfinite(turned.X).all()
    for field in ("sigma_px", "loss_px"):
        refuses(ValueError, "positive", BundleOptions, **{field: 0})
    torn = Observations(block.view, block.point[1:], block.xy)
    refuses(ValueError, "observations need", _refine, c, block.X, torn, free=FOCAL)


FOCALS = np.array([1000.0, 1100.0, 1200.0, 1300.0, 1400.0, 1500.0])


def _varied(block, focals=FOCALS, *, sigma=0.0):
    """The block with a focal of its own for each view, principal point and k1 common to all."""
    c = block.cameras
    rows = np.tile(c.intrinsics[0], (len(c.R), 1))
    rows[:, 0] = focals
    shared = np.zeros(rows.shape, dtype=np.int64)
    shared[:, 0] = np.arange(len(rows))
    cameras = MetricCameras(c.R, c.t, rows, np.arange(len(rows)), shared)
    xy = project_block(cameras, block.X, block.view, block.point)
    return cameras, xy + sigma * np.random.default_rng(4).normal(size=xy.shape)


def _population(cameras, spread, kind, std=None):
    """A prior of focals that scatter by ``spread`` about the mean of those of one kind."""
    std = np.full_like(cameras.intrinsics, np.inf) if std is None else std
    spreads = np.array([spread, *[np.inf] * 5])
    return IntrinsicsPrior.unshared(cameras.intrinsics, std, kind=np.array(kind), spread=spreads)


def test_focals_of_their_own_beside_a_common_principal_point_and_distortion():
    block = make_block(k1=0.02, points=120)
    cameras, xy = _varied(block, np.array([900.0, 1100.0, 1500.0, 1250.0, 1000.0, 1300.0]))
    start = cameras.intrinsics.copy()
    start[:, 0] *= 1.0 + 0.03 * np.cos(np.arange(6))
    start[:, 3:5] += [6.0, -5.0]
    moved = replace(cameras, intrinsics=start)
    found = _refine(moved, block.X, block.seen(xy), free=FOCAL_CENTRE_RADIAL, max_iterations=100).cameras
    np.testing.assert_allclose(found.intrinsics, cameras.intrinsics, rtol=1e-3, atol=2e-3)
    assert (found.intrinsics[:, 3:] == found.intrinsics[0, 3:]).all()
    assert len(np.unique(found.intrinsics[:, 0])) == 6


def test_a_std_of_zero_holds_one_camera_at_its_mean_while_others_move():
    block = make_block(groups=6)
    mean = block.cameras.intrinsics.copy()
    std = np.full_like(mean, np.inf)
    std[2, 0], mean[2, 0] = 0.0, 1234.0
    prior = IntrinsicsPrior.unshared(mean, std)
    fit = _refine(block.cameras, block.X, block.seen(), free=FOCAL, prior=prior, covariance=True)
    assert fit.cameras.intrinsics[2, 0] == pytest.approx(1234.0, rel=1e-12)
    assert not fit.intrinsics_covariance[2].any()
    others = np.delete(np.arange(6), 2)
    assert (fit.intrinsics_covariance[others, 0, 0] > 0.0).all()
    assert (np.abs(fit.cameras.intrinsics[others, 0] - 1200.0) > 1e-3).all()


def test_a_camera_without_a_determined_focal_borrows_from_its_population():
    block = make_block(points=150)
    focals = 1200.0 * np.exp(0.02 * np.array([-1.0, 0.5, 1.0, -0.5, 0.3, 0.8]))
    cameras, xy = _varied(block, focals, sigma=0.3)
    # View 5 keeps three points: a pose, but hardly a focal of its own.
    kept = (block.view != 5) | (np.cumsum(block.view == 5) <= 3)
    seen = Observations(block.view[kept], block.point[kept], xy[kept])
    start = cameras.intrinsics.copy()
    start[5, 0] = 3000.0
    options = {"prior": _population(cameras, 0.02, [0] * 6), "sigma_px": 0.3, "max_iterations": 100}
    start = replace(cameras, intrinsics=start)
    fit = _refine(start, block.X, seen, free=FOCAL, covariance=True, **options)
    f = fit.cameras.intrinsics[:, 0]
    np.testing.assert_allclose(f[:5], focals[:5], rtol=0.01)
    std = np.sqrt(fit.intrinsics_covariance[:, 0, 0]) / f
    assert abs(np.log(f[5]) - np.log(f[:5]).mean()) < 0.03
    # It is as uncertain as a member drawn at random: spread, and the mean known from five others.
    assert std[5] == pytest.approx(0.02 * np.sqrt(1.0 + 1.0 / 5.0), rel=0.15)
    assert (std[:5] < 0.01).all()


def test_the_population_is_the_quadratic_form_of_deviations_from_its_mean():
    cameras, _ = _varied(make_block())
    std = np.full_like(cameras.intrinsics, np.inf)
    std[1, 0], std[4, 0] = 0.0, 0.1
    prior = _population(cameras, 0.05, [0, 0, 0, 0, 7, -1], std)
    values, x, table = number_unknowns(cameras, np.ones(6, bool), FOCAL, prior)
    np.testing.assert_allclose(table, cameras.intrinsics, rtol=1e-14)
    assert (values.n_table, values.size) == (5, 6)
    log_f = np.log(cameras.intrinsics[:4, 0])
    x[-1] = log_f.mean()
    assert values.terms.cost(x) == pytest.approx(np.sum((log_f - log_f.mean()) ** 2) / 0.05**2 / 2.0)
    # Free values at the rows of 0, 2, 3 once the mean is marginalised: (I - 11'/4) / tau^2 of four members.
    Q = values.terms.information().toarray()
    marginal = Q[:5, :5] - np.outer(Q[:5, 5], Q[5, :5]) / Q[5, 5]
    np.testing.assert_allclose(marginal[:3, :3], (np.eye(3) - 0.25) / 0.05**2, atol=1e-9)
    np.testing.assert_allclose(marginal[3:, 3:], np.diag([100.0, 0.0]), atol=1e-9)
    slope = [(values.terms.cost(x + h) - values.terms.cost(x - h)) / 2e-6 for h in 1e-6 * np.eye(6)]
    np.testing.assert_allclose(values.terms.gradient(x), slope, atol=1e-5)


@pytest.mark.parametrize(
    ("shared", "distinct"), [(None, [0, 1, 2, 3, 4, 5]), ([0, 0, 1, 2, 2, 3], [0, 2, 3, 5])]
)
def test_a_population_counts_a_value_that_cameras_share_once(shared, distinct):
    cameras, _ = _varied(make_block())
    table = None
    if shared is not None:
        table = np.tile(np.arange(6)[:, None], (1, 6))
        table[:, 0] = shared
        cameras.intrinsics[:, 0] = cameras.intrinsics[np.array(distinct)[shared], 0]
    cameras = MetricCameras(cameras.R, cameras.t, cameras.intrinsics, cameras.group, table)
    prior = _population(cameras, 0.05, [0] * 6)
    values, x, _ = number_unknowns(cameras, np.ones(6, bool), FOCAL, prior)
    log_f = np.log(cameras.intrinsics[distinct, 0])
    assert values.size == len(distinct) + 1
    x[-1] = log_f.mean()
    assert values.terms.cost(x) == pytest.approx(np.sum((log_f - log_f.mean()) ** 2) / 0.05**2 / 2.0)
