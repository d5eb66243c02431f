"""Many views: a core is reconstructed projectively, the others join calibrated, in windows."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metric.test_metric_refinement import centre_error
from tests.synthetic import TrueScene, make_scene, true_pairs, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.metric import _model, _resection, _shared_camera, refinement
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.optimize.bundle import schur
from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from thesisrecon.projective._model import select_core
from thesisrecon.projective.incremental import OUTSIDE_CORE, IncrementalProjective
from thesisrecon.records import Tracks
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from validation.scenes.walks import SIZE, make_walk


def street(views):
    """A street whose images share points with their neighbours only."""
    walk = make_walk(views, np.random.default_rng(1), sigma_px=0.3, denser=4)
    c, seen = walk.cameras, walk.seen
    tracks = Tracks(seen.view_index, seen.point_index, seen.xy, views, len(walk.X))
    return TrueScene(c.K, c.R, c.t, walk.X, 0.02, tracks, np.tile(SIZE, (views, 1)))


def reconstruct(scene, core_views, *, options=None):
    """The projective and the metric result."""
    method = IncrementalProjective(core_views=core_views)
    pairs = [pair for pair in true_pairs(scene) if pair.inliers >= 16]
    found = method.reconstruct(scene.tracks, pairs, scene.sizes, rng=np.random.default_rng(0))
    prior, rng = prior_for(found, options or IntrinsicsOptions()), np.random.default_rng(0)
    calibration = HypothesesAndRefinement().calibrate(found, prior=prior, rng=rng)
    return found, MetricRefinement().refine(found, calibration, prior=prior, rng=rng)


@pytest.mark.parametrize("zoom", [0.0, 0.2])
def test_a_core_and_resections_give_the_cameras_of_the_whole(zoom):
    scene = make_scene(views=24, points=250, sigma_px=0.4, zoom=zoom, seed=11)
    options = IntrinsicsOptions(focal="free" if zoom else "constant")
    whole, metric = reconstruct(scene, 0, options=options)
    core, metric_of_core = reconstruct(scene, 8, options=options)
    assert whole.registered.all()
    assert core.registered.sum() == 8
    assert {core.reasons[v] for v in np.flatnonzero(~core.registered)} == {OUTSIDE_CORE}
    assert metric_of_core.trusted
    assert metric_of_core.reconstruction.registered.all()
    assert centre_error(metric_of_core, scene) < 1.05 * centre_error(metric, scene)
    focals = np.array([[r.reconstruction.K[:, 0, 0]] for r in (metric, metric_of_core)])
    np.testing.assert_allclose(*focals, rtol=1e-4)
    std = np.array([[v["focal_px"].std for v in r.intrinsics] for r in (metric, metric_of_core)])
    np.testing.assert_allclose(*std, rtol=0.2)


def test_a_long_street_grows_from_its_core_in_windows(monkeypatch):
    scene = street(60)
    monkeypatch.setattr(_resection, "MANY_VIEWS", 12)
    windows = []
    adjust = _resection._adjust_window

    def counted(model, adjustment, views):
        windows.append(int(views.sum()))
        return adjust(model, adjustment, views)

    monkeypatch.setattr(_resection, "_adjust_window", counted)
    found, metric = reconstruct(scene, 12)
    assert found.registered.sum() <= 12
    assert metric.reconstruction.registered.all()
    assert centre_error(metric, scene) < 0.005
    assert 0 < sum(windows) < 48


def with_repeated_windows(scene, here, there, count=80):
    """Windows at view ``here`` that stand again at view ``there``, matched as if they were the same."""
    rng, C = np.random.default_rng(4), np.array([-R.T @ t for R, t in zip(scene.R, scene.t, strict=True)])
    shown = np.flatnonzero(scene.tracks.view_index == here)
    X = scene.X[rng.choice(scene.tracks.point_index[shown], count, replace=False)]
    views, points, pixels = [], [], []
    for copy in (X, X + C[there] - C[here]):
        for v in range(len(C)):
            seen = copy @ scene.R[v].T + scene.t[v]
            xy = (seen @ scene.K[v].T)[:, :2] / seen[:, 2:]
            k = np.flatnonzero((seen[:, 2] > 0.5) & (xy > 0).all(axis=1) & (xy < scene.sizes[v]).all(axis=1))
            k = k if abs(v - (here if copy is X else there)) < 6 else k[:0]
            views.append(np.full(len(k), v))
            points.append(k + len(scene.X))
            pixels.append(xy[k] + rng.normal(0, 0.3, (len(k), 2)))
    t = scene.tracks
    v, p = (np.concatenate([a, *b]) for a, b in ((t.view_index, views), (t.point_index, points)))
    xy, order = np.concatenate([t.xy, *pixels]), np.lexsort((v, p))
    tracks = Tracks(v[order], p[order], xy[order], t.n_views, len(scene.X) + count)
    return replace(scene, X=np.concatenate([scene.X, X]), tracks=tracks)


def test_a_view_of_other_windows_waits_until_the_model_reaches_it(monkeypatch):
    scene = with_repeated_windows(street(60), 12, 50)
    monkeypatch.setattr(_resection, "MANY_VIEWS", 12)
    _, metric = reconstruct(scene, 12)
    assert metric.reconstruction.registered.all()
    assert centre_error(metric, scene) < 0.01


@pytest.mark.parametrize("limits", [{"MAX_OBSERVATIONS": 3000}, {"MANY_VIEWS": 11, "LONG_PER_VIEW": 250}])
def test_points_that_hold_every_view_are_enough(monkeypatch, limits):
    scene = make_scene(views=12, points=900, sigma_px=0.4, seed=12)
    for name, value in limits.items():
        monkeypatch.setattr(_model, name, value)
    kept = []
    restrict = _model.restrict_points
    monkeypatch.setattr(_model, "restrict_points", lambda m, p: kept.append(len(p)) or restrict(m, p))
    _, metric = reconstruct(scene, 0)
    assert 250 <= kept[0] < 600
    r = metric.reconstruction
    assert metric.trusted
    assert r.tracks is scene.tracks
    assert min(r.valid.mean(), r.inlier.mean()) > 0.99
    assert centre_error(metric, scene) < 2e-3


def test_images_of_other_groups_do_not_make_a_set_large():
    scene = make_scene(views=12, points=100)
    t = scene.tracks
    wide = replace(t, view_index=t.view_index + 30, n_views=45)
    assert _model.seen_views(t) == _model.seen_views(wide) == 12
    n = len(t.xy)
    model = _model.MetricEstimate(
        wide, np.tile(scene.sizes[:1], (45, 1)), None, np.ones(45, bool), scene.X,
        np.ones(100, bool), np.ones(n, bool), 0.5,
    )  # fmt: skip
    assert _model.with_enough_points(model) is model


def test_a_core_has_ties_with_parallax_and_doubles():
    pairs = true_pairs(make_scene(views=12, points=60))
    core = select_core(pairs, 12, 5)
    assert core.sum() == 5
    # Views whose matches one homography explains stay outside; so do views without any pair.
    flat = [p for p in pairs if p.i >= 2]
    assert not select_core(flat, 12, 12)[:2].any()
    method = IncrementalProjective(core_views=3)
    assert [int(method._core(pairs, 12, attempt).sum()) for attempt in range(3)] == [3, 6, 12]


def test_fixed_cameras_stay_and_the_others_converge():
    walk = make_walk(12, np.random.default_rng(0), sigma_px=0.0)
    cameras, X = walk.start(np.random.default_rng(1), size=0.01)
    fixed = np.arange(12) < 9
    for name in ("R", "t"):
        getattr(cameras, name)[fixed] = getattr(walk.cameras, name)[fixed]
    cameras = replace(cameras, intrinsics=walk.cameras.intrinsics)
    fit = refine_metric_bundle(cameras, X, walk.seen, free=np.zeros(6, bool), fixed=fixed)
    np.testing.assert_array_equal(fit.cameras.t[fixed], cameras.t[fixed])
    np.testing.assert_array_equal(fit.cameras.R[fixed], cameras.R[fixed])
    np.testing.assert_allclose(fit.cameras.t, walk.cameras.t, atol=1e-5)
    assert np.abs(fit.residual_px).max() < 1e-3


def test_threads_do_not_change_the_adjustment():
    walk = make_walk(150, np.random.default_rng(0), denser=3)
    assert len(walk.seen.xy) > 3 * schur.CHUNK
    cameras, X = walk.start(np.random.default_rng(1))
    fits = [
        refine_metric_bundle(
            cameras, X, walk.seen, free=np.ones(6, bool), options=BundleOptions(max_iterations=4, threads=n)
        )
        for n in (1, 3)
    ]
    np.testing.assert_array_equal(fits[0].X, fits[1].X)
    np.testing.assert_array_equal(fits[0].cameras.intrinsics, fits[1].cameras.intrinsics)


def test_points_are_chosen_until_every_cell_has_enough():
    rng = np.random.default_rng(3)
    length = rng.integers(2, 9, 400)
    start = np.concatenate([[0], np.cumsum(length)])
    cell = np.concatenate([rng.choice(50, n, replace=False) for n in length])
    order, keep, needed = rng.permutation(400), np.zeros(400, dtype=bool), np.full(50, 12)
    left, expected = needed.copy(), np.zeros(400, dtype=bool)
    for j in order:
        mine = cell[start[j] : start[j + 1]]
        if np.mean(left[mine] > 0) >= 0.5:
            expected[j] = True
            np.subtract.at(left, mine, 1)
    _model.choose_points(order, start, cell, needed, keep)
    np.testing.assert_array_equal(keep, expected)
    np.testing.assert_array_equal(needed, left)
    assert 0.2 < keep.mean() < 0.6
    assert left.max() <= 3


def test_points_are_chosen_again_by_their_residuals(monkeypatch):
    scene = street(40)
    rng, n = np.random.default_rng(2), scene.tracks.n_points
    noisy = np.arange(n) % 2 == 0
    shift = rng.normal(0.0, 1.0, scene.tracks.xy.shape) * noisy[scene.tracks.point_index, None]
    tracks = replace(scene.tracks, xy=scene.tracks.xy + shift)
    cameras = make_walk(40, np.random.default_rng(1)).cameras
    model = _model.MetricEstimate(
        tracks, scene.sizes, cameras, np.ones(40, bool), scene.X, np.ones(n, bool),
        np.ones(len(tracks.xy), bool), 0.5,
    )  # fmt: skip
    monkeypatch.setattr(_model, "MAX_OBSERVATIONS", len(tracks.xy) // 4)
    few = _model.with_enough_points(model)
    chosen, points = _model.with_precise_points(few, tracks)
    assert len(points) == chosen.tracks.n_points

    def positions(tracks):
        return {tuple(row) for row in tracks.xy.tolist()}

    noisy_xy = positions(replace(tracks, xy=tracks.xy[noisy[tracks.point_index]]))
    by_length, by_residual = (len(positions(m.tracks) & noisy_xy) / len(m.tracks.xy) for m in (few, chosen))
    assert by_residual < 0.5 * by_length
    assert np.bincount(chosen.tracks.view_index, minlength=40).min() >= 20


def test_shared_intrinsics_of_many_views_are_tested_in_runs(monkeypatch):
    scene = make_scene(views=24, points=250, sigma_px=0.4, seed=13)
    K = scene.K.copy()
    K[8:11, :2, :2] *= 1.02
    zoomed = with_poses(replace(scene, K=K), scene.R, scene.centres)
    noise = np.random.default_rng(0).normal(0.0, 0.4, zoomed.tracks.xy.shape)
    zoomed = replace(zoomed, tracks=replace(zoomed.tracks, xy=zoomed.tracks.xy + noise))
    monkeypatch.setattr(_shared_camera, "MAX_VIEWS", 12)
    monkeypatch.setattr(_shared_camera, "RUN", 4)
    tests = []
    check = _shared_camera.check_shared_cameras
    monkeypatch.setattr(refinement, "check_shared_cameras", lambda *a: tests.append(check(*a)) or tests[-1])
    reconstruct(scene, 8)
    reconstruct(zoomed, 8)
    assert not tests[0].found
    assert tests[1].contradicted[0]
