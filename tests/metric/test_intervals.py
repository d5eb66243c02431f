"""Stated intervals hold the truth as often as they say; how cameras of one kind scatter, and who borrows."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.metric.metric_stage import refine, scatter, with_few_points, with_xy
from tests.synthetic import TrueScene, looking_along, make_scene
from thesisrecon.camera import project_camera
from thesisrecon.metric import _adjustment, _uncertainty, refinement
from thesisrecon.metric._adjustment import tail_width
from thesisrecon.metric._model import FOCAL
from thesisrecon.records import Tracks
from validation.metrics.cameras import pose_scores


def test_deviations_and_noise_are_of_the_stated_size_on_normal_noise():
    """Of lenses decentred by about as much as is expected, which 300 points hardly show."""
    deviations, noise, poses = [], [], []
    for seed in range(16):
        p = 1e-3 * np.random.default_rng(seed).normal(size=2)
        scene = decentred_scene(seed, p, sigma_px=0.5, points=300, principal_shift=(5.0, -3.0))
        result, K = refine(scene), scene.K[0]
        names = {"focal_px": K[0, 0], "principal_x_px": K[0, 2], "principal_y_px": K[1, 2]}
        found = result.intrinsics[0]
        deviations += [(found[name].value - truth) / found[name].std for name, truth in names.items()]
        # Three unknowns of each point and six of each pose take their share of the residuals.
        left = 1.0 - (3 * scene.tracks.n_points + 6 * scene.tracks.n_views) / (2 * len(scene.tracks.xy))
        noise.append(result.reconstruction.sigma_px / 0.5 / np.sqrt(left))
        poses.append(pose_scores(result, scene.R, scene.centres))
    # 48 squares of normal numbers: a standard error of 0.1.
    assert 0.7 < np.sqrt(np.mean(np.square(deviations))) < 1.32
    assert np.mean(noise) == pytest.approx(1.0, abs=0.04)
    assert 0.8 < np.sqrt(np.mean(np.square(poses))) < 1.2


def test_the_last_model_is_at_the_minimum_of_its_inliers_which_have_no_wrong_pixel(monkeypatch):
    """The distance to the minimum is computed again, from what is returned."""
    ends, finish, accepted = [], refinement.finish_metric, []
    monkeypatch.setattr(refinement, "finish_metric", lambda *given: ends.append(finish(*given)) or ends[-1])

    def distance(scene, xy):
        inlier = refine(with_xy(scene, xy)).reconstruction.inlier
        model, adjustment = ends[-1][:2]
        return adjustment.run(model, iterations=0, keep_noise=True)[1].sigmas_to_minimum, inlier

    heavy = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        scene = make_scene(sigma_px=0.5, points=300, seed=seed)
        xy, wrong = scene.tracks.xy.copy(), rng.random(len(scene.tracks.xy)) < 0.02
        angle, off = rng.uniform(0.0, 2.0 * np.pi, wrong.sum()), 0.5 * rng.uniform(9.0, 13.0, wrong.sum())
        # With heavy tails many observations are near the limit, and inliers change until the end.
        heavy.append(distance(scene, xy + 0.5 * rng.standard_t(2.0, size=xy.shape))[0])
        xy[wrong] += off[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        far, inlier = distance(scene, xy)
        accepted.append(inlier[wrong].mean())
        assert inlier[~wrong].mean() > 0.998
        assert far < 0.01
    # Adjustments between which inliers are chosen again end at a tenth of a standard deviation.
    assert max(heavy) < 0.006
    assert np.mean(accepted) < 0.15


@pytest.mark.parametrize("views", [3, 6])
def test_one_adjustment_ends_where_its_predicted_gain_says(monkeypatch, views):
    """With heavy tails it converges linearly: the gain left is that at which it ends, and not a step less."""
    ends, finish, rng = [], refinement.finish_metric, np.random.default_rng(0)
    monkeypatch.setattr(refinement, "finish_metric", lambda *given: ends.append(finish(*given)) or ends[-1])
    scene = make_scene(sigma_px=0.5, points=150, views=views, seed=0)
    refine(with_xy(scene, scene.tracks.xy + 0.5 * rng.standard_t(2.0, size=scene.tracks.xy.shape)))
    model, adjustment = ends[-1][:2]

    def off(start):
        return adjustment.run(start, iterations=0, keep_noise=True)[1].sigmas_to_minimum

    for longer in (1.01, 1.1, 1.3):
        rows = model.cameras.intrinsics.copy()
        rows[:, FOCAL] *= longer
        start = replace(model, cameras=replace(model.cameras, intrinsics=rows))
        assert off(start) > 4.0
        # Half the square of the distance in standard deviations is 1e-4, between choices of inliers 5e-3.
        assert off(adjustment.run(start, settled=_adjustment.SETTLED, keep_noise=True)[0]) < 0.02
        assert off(adjustment.run(start, keep_noise=True)[0]) < 0.08


def test_less_noise_is_a_narrower_interval_and_heavy_tails_bring_the_floor():
    wide, narrow = (
        refine(make_scene(sigma_px=sigma, points=300, seed=1)).intrinsics[0]["focal_px"].std
        for sigma in (0.5, 0.05)
    )
    assert narrow < min(0.2 * wide, 5e-4 * 1500.0)
    scene, rng = make_scene(sigma_px=0.05, points=300, seed=1), np.random.default_rng(0)
    wide = rng.random(len(scene.tracks.xy)) < 0.25
    noise = np.where(wide[:, None], 0.25, 0.0) * rng.normal(size=scene.tracks.xy.shape)
    own = refine(with_xy(scene, scene.tracks.xy + noise)).intrinsics[0]
    focal = own["focal_px"]
    assert focal.std > 0.8e-3 * focal.value
    assert "error floor" in focal.source
    # Decentring of 1e-3 moves the principal point by 5 px, but the observations exclude it.
    for name, truth in zip(("principal_x_px", "principal_y_px"), scene.K[0, :2, 2], strict=True):
        assert abs(own[name].value - truth) < 2.0 * own[name].std < 4.0


def test_model_error_and_tails_are_seen():
    for contradiction, misfit, blocks, share in (
        (1.0, 1.0, 32, 0.0), (2.5, 1.0, 32, 1.0), (1.0, 2.5, 32, 1.0), (1.0, 1.0, 1, 1.0),
    ):  # fmt: skip
        assert _uncertainty.lack_of_fit(scatter(contradiction, blocks), misfit) == share
    assert 0.0 < _uncertainty.lack_of_fit(scatter(1.5), 1.0) < 1.0
    lengths = np.linalg.norm(np.random.default_rng(0).normal(size=(4000, 2)), axis=1)
    assert tail_width(lengths, 1.0) == pytest.approx(1.0, abs=0.05)
    assert tail_width(10.0 * lengths, 1.0) == 3.0


def test_other_estimates_have_intervals_that_hold_the_truth():
    """Aspect, skew and the whole lens; priors are reported as assumed."""
    scene = make_scene(sigma_px=0.5, points=300, seed=2)
    found = refine(scene, aspect="constant", skew="constant", skew_std_px=50.0)
    for name, truth in (("aspect", 1.0), ("skew_px", 0.0), ("k2", 0.0), ("k3", 0.0)):
        interval = found.intrinsics[0][name]
        assert interval.std > 0.0
        assert abs(interval.value - truth) < 5.0 * interval.std
    assert found.intrinsics[0]["aspect"].std < 0.01
    assert 0.01 < found.intrinsics[0]["skew_px"].std < 50.0
    usual = refine(scene).intrinsics[0]
    assert [(usual[n].value, usual[n].std) for n in ("aspect", "skew_px")] == [(1.0, 0.0), (0.0, 0.0)]


def ring_of(seed, *, k1=0.0, shift=(7.0, 0.0), points=1500):
    """24 views, 15 degrees apart, of an object on a turntable, in the middle of the images."""
    rng, size = np.random.default_rng(seed), np.array([480, 640])
    normal = rng.normal(size=(points, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    X, axes, towards = normal * [0.55, 0.8, 0.55], [], []
    for angle in np.arange(24) * np.pi / 12:
        towards.append([np.sin(angle) * np.cos(0.18), -np.sin(0.18), -np.cos(angle) * np.cos(0.18)])
        shake = Rotation.from_rotvec(np.radians(0.1) * rng.normal(size=3)).as_matrix()
        axes.append(shake @ looking_along(-np.array(towards[-1])))
    R, centres = np.array(axes), 8.4 * np.array(towards)
    t = -np.einsum("vab,vb->va", R, centres)
    K = np.eye(3)
    K[[0, 1], [0, 1]], K[:2, 2] = 1540.0, (size - 1) / 2 + shift
    # Points are seen from less than 45 degrees off their normal.
    near = (np.array(towards) @ normal.T > np.cos(np.pi / 4)) & (rng.random((24, points)) < 0.7)
    kept = near.sum(axis=0) >= 2
    point, view = np.nonzero(near[:, kept].T)
    xy = np.empty((len(view), 2))
    for v in range(24):
        xy[view == v] = project_camera(K, R[v], t[v], X[kept][point[view == v]], distortion=k1)
    xy += 0.02 * rng.normal(size=xy.shape)
    tracks = Tracks(view, point, xy, 24, int(kept.sum()))
    return TrueScene(np.tile(K, (24, 1, 1)), R, t, X[kept], k1, tracks, np.tile(size, (24, 1)))


@pytest.mark.parametrize("k1", [0.0, -0.25])
def test_the_interval_of_a_ring_holds_the_focal_length_of_a_lens_without_distortion(k1):
    """The points leave the border of the images empty: whether the lens bends is hardly determined."""
    scene = ring_of(0, k1=k1, points=4000)
    found, straight = refine(scene), refine(scene, k1="known").intrinsics[0]
    assert found.trusted
    own = found.intrinsics[0]
    for name, truth in (("focal_px", 1540.0), ("k1", k1), ("principal_x_px", 246.5)):
        assert abs(own[name].value - truth) < 2.0 * own[name].std
        assert abs(own[name].value - straight[name].value) < 1.5 * own[name].std
    # The price where the lens is straight is small.
    assert k1 or own["focal_px"].std < 0.01 * own["focal_px"].value


def test_a_principal_point_that_rests_on_its_prior_has_the_tails_of_the_prior():
    """Along the axis of a turntable; it is 4 % of the long side off, where 1 % is expected."""
    for seed in range(2):
        own = refine(ring_of(seed, shift=(7.0, -25.0))).intrinsics[0]["principal_y_px"]
        assert abs(own.value - 294.5) < 2.576 * own.std
        assert own.std < 20.0


def decentred_scene(seed, p, *, sigma_px=0.3, points=800, **settings):
    """The usual cap of cameras with decentring coefficients ``p`` (Brown 1966)."""
    scene = make_scene(points=points, seed=seed, **settings)
    focal, centre = scene.K[0, 0, 0], scene.K[0, :2, 2]
    x, y = ((scene.tracks.xy - centre) / focal).T
    square, rng = x * x + y * y, np.random.default_rng(seed)
    moved = (
        2.0 * x * y * p[0] + (square + 2.0 * x * x) * p[1],
        (square + 2.0 * y * y) * p[0] + 2.0 * x * y * p[1],
    )
    noise = sigma_px * rng.normal(size=scene.tracks.xy.shape)
    return with_xy(scene, scene.tracks.xy + focal * np.column_stack(moved) + noise)


def z_scores(own, truth):
    return [(own[name].value - value) / own[name].std for name, value in truth.items()]


@pytest.mark.parametrize("p", [(1e-3, -1e-3), (3e-4, -2e-4)])
def test_a_decentring_that_few_images_leave_possible_is_in_the_intervals(p):
    """It moves the principal point by up to 13 standard deviations of the noise; the smaller one by 6."""
    worst, turned = [], []
    for seed in range(4):
        scene = decentred_scene(seed, p, views=12)
        result, K = refine(scene), scene.K[0]
        truth = {"focal_px": K[0, 0], "principal_x_px": K[0, 2], "principal_y_px": K[1, 2]}
        worst.append(np.abs(z_scores(result.intrinsics[0], truth)).max())
        turned.append(np.nanmax(np.abs(pose_scores(result, scene.R, scene.centres)[:, :3])))
    assert max(worst) < 3.0
    assert max(turned) < 4.0


def test_a_nearly_straight_lens_is_decentred_where_that_predicts_better():
    for p in ((1e-3, -8e-4), (0.0, 0.0)):
        scene = decentred_scene(1, p, views=20, points=2500)
        result, K = refine(scene), scene.K[0]
        own, truth = result.intrinsics[0], {"focal_px": K[0, 0], "principal_x_px": K[0, 2]}
        assert result.trusted
        assert ("p1" in own) == any(p)
        assert (
            np.abs(z_scores(own, truth | dict(zip(("p1", "p2"), p, strict=True) if any(p) else ()))).max()
            < 3.0
        )
        # A decentred lens whose p1 and p2 are left out moves it by 5 px.
        assert own["principal_x_px"].std < 1.0


def test_the_spread_is_that_of_the_values_beyond_their_noise_and_the_error_of_the_model():
    rng = np.random.default_rng(1)
    std = rng.uniform(0.002, 0.01, 30)
    same = _uncertainty.estimate_spread(std * rng.normal(size=30), std, std)
    assert same < 0.004
    zoomed = _uncertainty.estimate_spread(rng.normal(0.0, 0.3, 30) + std * rng.normal(size=30), std, std)
    assert zoomed == pytest.approx(0.3, rel=0.5)
    rng = np.random.default_rng(2)
    std = np.full(12, 0.01)
    values = [0.02 * rng.normal(size=12) + std * rng.normal(size=12) for _ in range(200)]
    assert np.median([_uncertainty.estimate_spread(v, std, std) for v in values]) == pytest.approx(
        0.02, rel=0.15
    )
    assert np.median([_uncertainty.estimate_spread(v, std, 5.0 * std) for v in values]) < 0.005
    assert _uncertainty.estimate_spread(np.zeros(1), np.ones(1), np.ones(1)) == np.inf


def prior_of(value, kind, shared, std=1e-3):
    std = np.full(value.shape, std)
    return _uncertainty.estimate_hierarchical_prior(
        _uncertainty.PerCameraEstimates(value, std, 0.0 * std, np.array(kind)), shared
    )


def test_one_zoomed_camera_does_not_pull_the_rest_and_kinds_have_spreads_of_their_own():
    rng = np.random.default_rng(3)
    value = 0.001 * rng.normal(size=(9, 8))
    value[4, 0] += 0.4
    found = prior_of(value, [0] * 9, np.tile(np.arange(9)[:, None], (1, 8)))
    np.testing.assert_array_equal(found.kind, np.where(np.arange(9) == 4, -1, 0))
    assert found.spread[0, 0] < 0.005
    assert _uncertainty.find_outliers(value[:, 0], np.full(9, 0.001)).sum() == 1
    rng = np.random.default_rng(5)
    value = np.zeros((12, 8))
    value[:6, 0], value[6:, 0] = 0.001 * rng.normal(size=6), 0.2 * rng.normal(size=6)
    value[:6, 3], value[6:, 3] = 20.0 * rng.normal(size=6), 0.001 * rng.normal(size=6)
    own = np.tile(np.arange(12)[:, None], (1, 8))
    found = prior_of(value, np.repeat([0, 1], 6), own)
    assert found.spread[0, 0] < 0.005 < 0.05 < found.spread[6, 0]
    assert found.spread[6, 3] < 0.005 < 5.0 < found.spread[0, 3]


def test_shrinking_needs_several_of_one_kind_and_matches_that_say_less():
    value, own = np.zeros((4, 8)), np.tile(np.arange(4)[:, None], (1, 8))
    assert prior_of(value, [0] * 4, np.zeros_like(own), std=0.01) is None
    assert prior_of(value, [0, 0, 1, 2], own, std=0.01) is None
    assert prior_of(value, [0] * 4, own, std=0.01) is not None
    lent = _uncertainty.FocalShrinkage(np.array([0.02, 0.001, 0.02]), np.array([0.1, 0.1, 0.9]))
    assert [lent.is_shrunk(view, 0.005) for view in range(3)] == [True, False, False]
    assert "8% (1 sigma)" in _uncertainty.FocalShrinkage(np.array([0.08]), np.ones(1)).warnings([0], 0.05)[0]


def test_a_badly_determined_focal_is_shrunk_and_named():
    scene = with_few_points(make_scene(sigma_px=0.5, points=400, seed=11), 3, 30)
    alone, together = (refine(scene, cameras="per-image", common_prior=common) for common in (False, True))
    wide, narrow = alone.intrinsics[3]["focal_px"], together.intrinsics[3]["focal_px"]
    assert narrow.std < 0.7 * wide.std
    assert "shrunk towards the other cameras" in narrow.source
    assert "shrunk" not in wide.source
    stated = float(narrow.source.split("own matches alone: ")[1].split("%")[0]) / 100.0
    # As in the adjustment that has no other cameras of its kind to rest on.
    assert stated == pytest.approx(wide.std / wide.value, rel=0.15)
    for result in (alone, together):
        assert result.reconstruction.registered.all()
        for view, intervals in enumerate(result.intrinsics):
            focal = intervals["focal_px"]
            assert abs(focal.value - scene.K[view, 0, 0]) < 4.0 * focal.std
    if wide.std > 0.06 * wide.value:
        assert any("#3" in said for said in alone.warnings)
