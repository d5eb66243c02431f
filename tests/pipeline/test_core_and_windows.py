"""Many views: a core of them is reconstructed and calibrated, the others join calibrated, in windows."""

from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import refuses
from tests.metric.metric_stage import centre_error
from tests.synthetic import TrueScene, make_scene, projective_reconstruction, true_pairs, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.errors import StageFailure
from thesisrecon.metric import _model, _resection, _shared_camera
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.optimize.bundle import schur
from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from thesisrecon.pipeline.large_sets import CORE_VIEWS, MAX_CORES, calibrate_with_core, calibrated_part
from thesisrecon.projective._model import select_core
from thesisrecon.projective.incremental import OUTSIDE_CORE, IncrementalProjective
from thesisrecon.records import SelfCalibration, Tracks
from thesisrecon.selfcalibration.quadric import HypothesesAndRefinement
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
    adjust = _resection.adjust_window

    def counted(model, adjustment, views):
        windows.append(int(views.sum()))
        return adjust(model, adjustment, views)

    monkeypatch.setattr(_resection, "adjust_window", counted)
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
    monkeypatch.setattr(
        _shared_camera, "check_shared_cameras", lambda *a: tests.append(check(*a)) or tests[-1]
    )
    reconstruct(scene, 8)
    reconstruct(zoomed, 8)
    assert not tests[0].found
    assert tests[1].contradicted[0]


class OfFewViews:
    """A method that fails for more than ``most`` views and notes those it was given."""

    def __init__(self, most, *, identifiable=True):
        self.most, self.identifiable, self.given = most, identifiable, []

    def calibrate(self, projective, **_):
        self.given.append(projective.registered)
        if projective.registered.sum() > self.most:
            raise StageFailure("self-calibration failed", f"{projective.registered.sum()} views", "fewer")
        K = projective.registered[:, None, None] * np.eye(3)
        return SelfCalibration(np.eye(4), K, np.zeros_like(K), self.identifiable, ())


def bent_scene():
    """Eleven views of which the last three are in another projective frame than the rest."""
    scene = make_scene(views=11, points=400, sigma_px=0.2, seed=2)
    projective = projective_reconstruction(scene)
    P = projective.P.copy()
    rng = np.random.default_rng(0)
    P[8:] = P[8:] @ (np.eye(4) + 0.5 * rng.normal(size=(4, 4)))
    # They are tied to the others by fewer points.
    inlier = projective.inlier & (
        (projective.tracks.view_index < 8) | (rng.random(len(projective.inlier)) < 0.5)
    )
    return scene, replace(projective, P=P, inlier=inlier)


def test_a_core_calibrates_what_a_bent_reconstruction_cannot_and_the_metric_stage_adds_the_rest():
    scene, projective = bent_scene()
    prior, method = prior_for(projective), HypothesesAndRefinement()
    with pytest.raises(StageFailure):
        method.calibrate(projective, prior=prior, rng=np.random.default_rng(0))
    calibration = calibrate_with_core(method, projective, prior=prior, rng=np.random.default_rng(0))
    used = calibration.K[:, 0, 0] > 0
    assert used.sum() == CORE_VIEWS
    assert not used[8:].any()
    part = calibrated_part(projective, calibration)
    result = MetricRefinement().refine(part, calibration, prior=prior, rng=np.random.default_rng(0))
    assert result.trusted, result.failed_checks
    assert result.reconstruction.registered.all()
    np.testing.assert_allclose(result.reconstruction.K[:, 0, 0], 1500.0, rtol=5e-3)
    assert centre_error(result, scene) < 0.01


def test_the_first_core_that_determines_the_calibration_is_taken_and_tries_are_limited():
    projective = projective_reconstruction(make_scene(views=12))
    prior = prior_for(projective)
    whole = calibrate_with_core(method := OfFewViews(12), projective, prior=prior, rng=None)
    assert len(method.given) == 1
    assert calibrated_part(projective, whole) is projective
    for method, tries in ((OfFewViews(5), 2), (OfFewViews(5, identifiable=False), 1 + MAX_CORES)):
        calibration = calibrate_with_core(method, projective, prior=prior, rng=None)
        assert len(method.given) == tries
        assert len({views.tobytes() for views in method.given}) == tries
        assert (calibration.K[:, 0, 0] > 0).tolist() == method.given[1].tolist()
        part = calibrated_part(projective, calibration)
        seen = np.bincount(part.tracks.point_index[part.inlier], minlength=part.tracks.n_points)
        assert ((seen >= 2) == part.valid).all()
        assert (part.X[~part.valid] == 0).all()
    refuses(StageFailure, "12 views", calibrate_with_core, OfFewViews(4), projective, prior=prior, rng=None)
