"""Checks of a metric model: identifiability, self-check and shared cameras."""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic import make_scene, projective_reconstruction, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.metric._adjustment import SETTLED, MetricAdjustment
from thesisrecon.metric._checks import check_views, self_check, triangulable_observations
from thesisrecon.metric._model import (
    MetricEstimate,
    camera_rows,
    reproject_observations,
    retriangulate_tracks,
)
from thesisrecon.metric._shared_camera import (
    check_shared_cameras,
    contradicted_focal_priors,
    focal_std_of_deviations,
    inconsistent_principal_point,
)
from thesisrecon.metric._uncertainty import widen_by_camera_model, widen_unverified_focals
from thesisrecon.optimize.bundle.metric_kernels import MetricCameras
from thesisrecon.optimize.bundle.scatter import BlockScatter, block_scatter
from thesisrecon.records import IntrinsicInterval, SelfCalibration, Tracks

SIGMAS, ANGLE = 7.0, 1e-3
STATED = {
    "focal_px": (0, 1.0), "aspect": (1, 0.0), "principal_x_px": (3, 1.0), "principal_y_px": (4, 1.0)
}  # fmt: skip


def true_model(scene, prior):
    group, shared = camera_rows(prior)
    rows = np.zeros((len(shared), 8))
    first = [int(np.flatnonzero(group == g)[0]) for g in range(len(shared))]
    rows[:, :5] = [[scene.K[v, 0, 0], 1.0, 0.0, scene.K[v, 0, 2], scene.K[v, 1, 2]] for v in first]
    n = len(scene.R)
    cameras = MetricCameras(scene.R, scene.t, rows, group, shared)
    every = [np.ones(count, dtype=bool) for count in (n, len(scene.X), len(scene.tracks.xy))]
    model = MetricEstimate(scene.tracks, scene.sizes, cameras, every[0], scene.X, every[1], every[2], 0.5)
    return retriangulate_tracks(model, sigmas=SIGMAS, min_angle=ANGLE)


def stated(model, **std):
    """Intervals of every view; other standard deviations by name."""
    return [
        {
            name: IntrinsicInterval(float(model.cameras.intrinsics[g, column]), std.get(name, usual), "")
            for name, (column, usual) in STATED.items()
        }
        for g in model.cameras.group
    ]


def doubts_of(model, scene, **std):
    intervals = stated(model, **std)
    calibration = SelfCalibration(np.eye(4), scene.K, np.zeros_like(scene.K), True, ())
    return self_check(model, calibration, intervals, sigmas=SIGMAS)[:2]


def setting(**known):
    scene = make_scene(sigma_px=0.5, seed=3)
    prior = prior_for(projective_reconstruction(scene), IntrinsicsOptions(**known))
    return scene, prior, true_model(scene, prior)


def test_a_right_model_is_not_doubted():
    scene, _, model = setting()
    check, failed_checks = doubts_of(model, scene)
    assert failed_checks == []
    assert check["confirmed_share_worst_view"] > 0.95
    assert check["noise_ratio_worst_view"] < 1.5


@pytest.mark.parametrize("views", [[0], [5], [1, 6]])
def test_cameras_that_stand_elsewhere_are_named_in_one_sentence(views):
    scene, _, model = setting()
    t = model.cameras.t.copy()
    t[views] += [0.4, -0.3, 0.2]
    spoiled = replace(model, cameras=replace(model.cameras, t=t))
    check, failed_checks = doubts_of(retriangulate_tracks(spoiled, sigmas=SIGMAS, min_angle=ANGLE), scene)
    assert len(views) > 1 or check["confirmed_share_worst_view"] < 0.5
    named = "Images #1 and #6:" if len(views) > 1 else f"Image #{views[0]}:"
    assert any(doubt.startswith(named) for doubt in failed_checks)


def test_a_view_of_another_focal_asks_for_it():
    scene = make_scene(sigma_px=0.3, seed=4)
    view = scene.tracks.view_index == 2
    centre = scene.K[2, :2, 2]
    xy = np.where(view[:, None], centre + 1.08 * (scene.tracks.xy - centre), scene.tracks.xy)
    prior = prior_for(projective_reconstruction(scene))
    model = true_model(scene, prior)
    # What the zoomed photograph shows, wherever it was explained before.
    zoomed = replace(model, tracks=replace(scene.tracks, xy=xy), sigma_px=12.0)
    off = check_views(zoomed, sigmas=SIGMAS).focal_off
    assert off[2] == pytest.approx(np.log(1.08), abs=0.01)
    assert np.abs(np.delete(off, 2)).max() < 0.01
    assert any("Image #2: its own focal length" in doubt for doubt in doubts_of(zoomed, scene)[1])


def test_points_behind_a_camera_are_detected():
    scene, _, model = setting()
    R, t = model.cameras.R.copy(), model.cameras.t.copy()
    about = np.diag([-1.0, 1.0, -1.0])
    R[4], t[4] = about @ R[4], about @ t[4]
    behind = replace(model, cameras=replace(model.cameras, R=R, t=t))
    assert check_views(behind, sigmas=SIGMAS).behind[4] > 0.5
    assert any("#4" in doubt for doubt in doubts_of(behind, scene)[1])


@pytest.mark.parametrize(("off", "deviation", "reported"), [(1.0, 0.01, 0), (1.05, 0.003, 1), (1.05, 0.1, 0)])
def test_a_focal_that_the_images_contradict_is_reported(off, deviation, reported):
    _, prior, model = setting(focal_px=1500.0 * off, focal_std_rel=deviation)
    adjustment = MetricAdjustment(prior, 0.0, 0.02)
    model = adjustment.run(model, iterations=10)[0]
    model = retriangulate_tracks(model, sigmas=SIGMAS, min_angle=ANGLE)
    failed_checks = contradicted_focal_priors(model, adjustment)
    assert len(failed_checks) == reported
    assert all("contradict the given focal length" in doubt for doubt in failed_checks)


def test_a_contradicted_known_focal_is_reported_once_without_advice_on_weights():
    _, prior, model = setting(focal="known", focal_px=1600.0)
    failed_checks = contradicted_focal_priors(model, MetricAdjustment(prior, 0.0, 0.02))
    assert len(failed_checks) == 1
    assert "shorter" in failed_checks[0]
    assert "px" not in failed_checks[0]
    assert "focal_std_rel" not in failed_checks[0]
    _, without, model = setting()
    assert contradicted_focal_priors(model, MetricAdjustment(without, 0.0, 0.02)) == []


@pytest.mark.parametrize(("far", "fails"), [(0.09, False), (0.11, True), (np.inf, True)])
def test_an_adjustment_that_has_not_converged_is_not_trusted(far, fails):
    scene = make_scene(points=400, sigma_px=0.5, seed=3)
    model = true_model(scene, prior_for(projective_reconstruction(scene)))
    check, failed_checks = doubts_of(replace(model, sigmas_to_minimum=far), scene)
    assert check["sigmas_to_minimum"] == far
    assert any("not converged" in doubt for doubt in failed_checks) == fails


def test_the_middle_one_of_three_cameras_keeps_the_residuals_of_all_and_is_not_doubted():
    rng = np.random.default_rng(0)
    row = make_scene(views=3, points=400, seed=1)
    centres = row.centres[0] + np.outer([0.0, 1.0, 2.0], [1.0, 0.05, 0.0])
    row = with_poses(row, np.repeat(row.R[:1], 3, axis=0), centres)
    noisy = replace(row.tracks, xy=row.tracks.xy + rng.normal(0.0, 0.5, row.tracks.xy.shape))
    scene = replace(row, tracks=noisy)
    model = true_model(scene, prior_for(projective_reconstruction(scene)))
    noise = check_views(model, sigmas=SIGMAS).noise_px
    assert noise == pytest.approx(0.5, rel=0.2)
    view, point = model.tracks.view_index[model.inlier], model.tracks.point_index[model.inlier]
    xy, _ = reproject_observations(model, view, point)
    left = np.linalg.norm(xy - model.tracks.xy[model.inlier], axis=1)
    kept = [np.median(left[model.tracks.view_index[model.inlier] == v]) for v in range(3)]
    assert kept[1] > 1.3 * min(kept[0], kept[2])
    assert not any("noise" in doubt for doubt in doubts_of(model, scene)[1])


def test_two_images_from_one_place_are_not_rejected_for_points_only_they_share():
    scene = make_scene(points=400, sigma_px=0.0, seed=3)
    R, centres = scene.R.copy(), scene.centres.copy()
    R[1], centres[1] = R[0], centres[0] + 1e-4
    scene = with_poses(scene, R, centres)
    t, rng = scene.tracks, np.random.default_rng(0)
    # What both show and no other: most of their points lose their other views, and matches err together.
    alone = np.isin(t.point_index, np.flatnonzero(rng.random(t.n_points) < 0.7))
    keep = ~alone | (t.view_index < 2)
    xy = t.xy + np.where((alone & (t.view_index == 1))[:, None], 30.0, 0.3) * rng.normal(size=t.xy.shape)
    seen = [values[keep] for values in (t.view_index, t.point_index, xy)]
    scene = replace(scene, tracks=Tracks(*seen, t.n_views, t.n_points))
    model = true_model(scene, prior_for(projective_reconstruction(scene)))
    check, failed_checks = doubts_of(model, scene)
    assert failed_checks == []
    assert check["explained_share_worst_view"] > 0.9
    assert 0.2 < triangulable_observations(model).mean() < 0.9


def test_a_principal_point_far_off_is_doubted_where_the_scene_contradicts_itself_too():
    scene = make_scene(sigma_px=0.3, principal_shift=(140.0, 0.0), seed=3)
    prior = prior_for(projective_reconstruction(scene))
    model, adjustment = true_model(scene, prior), MetricAdjustment(prior, 0.0, 0.02)

    def scatter(contradiction):
        return BlockScatter(
            np.ones((1, 8)), np.ones(8), np.ones((1, 8)), np.ones((1, 8)), np.zeros((1, 8)), contradiction, 32
        )

    assert inconsistent_principal_point(model, adjustment, scatter(3.0)) == []
    assert len(inconsistent_principal_point(model, adjustment, scatter(12.0))) == 1
    middle = true_model(make_scene(seed=3), prior)
    assert inconsistent_principal_point(middle, adjustment, scatter(12.0)) == []


def settled(scene, **options):
    """The model as the metric stage ends with it: adjusted and triangulated by turns."""
    prior = prior_for(projective_reconstruction(scene), IntrinsicsOptions(**options))
    adjustment = MetricAdjustment(prior, 0.0, 0.02)
    model = true_model(scene, adjustment.prior)
    model = replace(model, sigma_px=30.0)
    for _ in range(3):
        model = retriangulate_tracks(model, sigmas=SIGMAS, min_angle=ANGLE)
        model = adjustment.run(model, iterations=10)[0]
    return model, adjustment


def changed(scene, factors, shift_px):
    """Photographs zoomed about the principal point and moved."""
    view = scene.tracks.view_index
    centre = scene.K[view, :2, 2]
    xy = centre + factors[view, None] * (scene.tracks.xy - centre) + shift_px[view]
    return replace(scene, tracks=replace(scene.tracks, xy=xy))


def test_one_camera_and_own_cameras_are_not_doubted():
    for views in (3, 8):
        scene = make_scene(views=views, sigma_px=0.5, seed=5)
        test = check_shared_cameras(*settled(scene))
        assert test.failed_checks == ()
        assert test.misfit == 1.0
    scene = make_scene(sigma_px=0.3, zoom=0.2, seed=8)
    assert check_shared_cameras(*settled(scene, cameras="per-image")).failed_checks == ()


@pytest.mark.parametrize("zoom", [1.04, 1.08])
def test_two_similar_zooms_in_turn_are_detected(zoom):
    scene = make_scene(sigma_px=0.3, seed=6)
    factors = np.where(np.arange(8) % 2 == 0, 1.0, zoom)
    failed_checks = check_shared_cameras(*settled(changed(scene, factors, np.zeros((8, 2))))).failed_checks
    assert len(failed_checks) == 1
    assert "shared focal length" in failed_checks[0]
    # The sentence holds at any size of the images.
    assert "px" not in failed_checks[0]


@pytest.mark.parametrize("views", [3, 4])
def test_deviations_of_few_images_are_learned_from_their_residuals(views):
    """Own principal points of 1 % of the long side widen the interval by their effect; no ones do not."""
    widths, sigmas = [], []
    for own in (0.0, 0.01):
        for seed in (2, 3):
            scene = make_scene(views=views, points=300, sigma_px=0.3, seed=seed)
            shift = own * scene.sizes[0].max() * np.random.default_rng(seed).normal(size=(views, 2))
            model, adjustment = settled(changed(scene, np.ones(views), shift))
            adjustment = replace(adjustment, inflation=block_scatter(adjustment.linearised(model)).inflation)
            model = adjustment.run(model, settled=SETTLED, keep_noise=True)[0]
            widths.append(focal_std_of_deviations(model, adjustment, critical=False, contradicted=False))
            noise = np.sqrt(block_scatter(adjustment.linearised(model)).variance[0, 0])
            focal = model.cameras.intrinsics[0, 0] / scene.K[0, 0, 0]
            sigmas.append(np.log(focal) / np.hypot(noise, widths[-1]))
    assert np.abs(sigmas).max() < 2.0
    assert max(widths[:2]) < 0.007
    assert min(widths[2:]) > 0.01
    assert min(widths[2:]) > 3.0 * max(widths[:2])
    # Contradicted by all images together, the deviations are not averaged over smaller ones.
    assert focal_std_of_deviations(model, adjustment, critical=False, contradicted=True) > widths[-1]


def test_harmless_differences_beyond_chance_widen_the_intervals():
    scene = make_scene(sigma_px=0.1, seed=6)
    factors = np.where(np.arange(8) % 2 == 0, 1.0, 1.008)
    test = check_shared_cameras(*settled(changed(scene, factors, np.zeros((8, 2)))))
    assert test.failed_checks == ()
    assert test.misfit > 4.0
    narrow = {"focal_px": IntrinsicInterval(1000.0, 1.0, ""), "aspect": IntrinsicInterval(1.0, 0.0, "")}
    (wide,) = widen_by_camera_model([narrow], (0.0, 0.0), test.misfit)
    assert wide["focal_px"].std == pytest.approx(np.sqrt(test.misfit))
    assert wide["aspect"] == narrow["aspect"]
    (moved,) = widen_by_camera_model([narrow], (0.01, 0.0), test.misfit)
    assert moved["focal_px"].std == pytest.approx(np.hypot(1.0, 10.0))


@pytest.mark.parametrize("zoom", [1.03, 1.06])
def test_one_zoomed_image_of_three_is_detected(zoom):
    scene = make_scene(views=3, sigma_px=0.1, seed=9)
    factors = np.array([1.0, zoom, 1.0])
    found = check_shared_cameras(*settled(changed(scene, factors, np.zeros((3, 2)))))
    assert len(found.failed_checks) + len(found.warnings) == 1


def test_uninformative_images_widen_the_interval_with_a_warning():
    found = check_shared_cameras(*settled(make_scene(views=3, points=60, sigma_px=0.5, seed=2)))
    assert found.failed_checks == ()
    assert len(found.warnings) == 1
    assert "cannot be verified" in found.warnings[0]
    assert (found.focal_std > 0.01).all()
    narrow = {"focal_px": IntrinsicInterval(1000.0, 1.0, "")}
    wide = widen_unverified_focals([narrow, narrow, {}], found.focal_std)
    assert wide[0]["focal_px"].std == pytest.approx(1000.0 * found.focal_std[0])
    assert wide[2] == {}


@pytest.mark.parametrize(
    "options",
    [{}, {"focal": "free"}, {"focal": "free", "principal_point": "known"}, {"principal_point": "known"}],
)
def test_crops_are_detected_under_any_prior(options):
    scene = make_scene(sigma_px=0.3, seed=7)
    shift = np.random.default_rng(1).uniform(-80.0, 80.0, (8, 2))
    failed_checks = check_shared_cameras(*settled(changed(scene, np.ones(8), shift), **options)).failed_checks
    assert len(failed_checks) == 1
    assert "principal point" in failed_checks[0] or "shared focal length" in failed_checks[0]
    right = settled(scene, **options)
    assert check_shared_cameras(*right).failed_checks == ()


def test_a_blurred_image_is_named_and_trusted():
    scene = make_scene(sigma_px=0.3, points=500, seed=3)
    blurred = scene.tracks.view_index == 4
    noise = np.random.default_rng(0).normal(0.0, 1.5, scene.tracks.xy.shape)
    scene = replace(scene, tracks=replace(scene.tracks, xy=scene.tracks.xy + blurred[:, None] * noise))
    model = replace(true_model(scene, prior_for(projective_reconstruction(scene))), sigma_px=1.0)
    model = retriangulate_tracks(model, sigmas=SIGMAS, min_angle=ANGLE)
    calibration = SelfCalibration(np.eye(4), scene.K, np.zeros_like(scene.K), True, ())
    _, failed_checks, limitations = self_check(model, calibration, stated(model), sigmas=SIGMAS)
    assert failed_checks == []
    assert len(limitations) == 1
    assert limitations[0].startswith("Image #4: reprojection noise")


def test_crops_that_determine_their_principal_point_are_trusted():
    scene = make_scene(sigma_px=0.5, seed=3, principal_shift=(300.0, 0.0))
    model = true_model(scene, prior_for(projective_reconstruction(scene)))
    assert doubts_of(model, scene)[1] == []
    (only,) = doubts_of(model, scene, principal_x_px=40.0)[1]
    assert "long side away from the image centre, and the images hardly determine it" in only


def test_an_uncertain_aspect_ratio_is_not_trusted():
    scene, _, model = setting()
    assert doubts_of(model, scene, aspect=0.04)[1] == []
    (only,) = doubts_of(model, scene, aspect=0.062)[1]
    assert only.startswith("The aspect ratio of the pixels is determined only to 6%")


def test_a_poor_start_is_no_evidence_against_the_end():
    scene, _, model = setting()
    calibration = SelfCalibration(np.eye(4), 0.6 * scene.K, np.zeros_like(scene.K), True, ())
    check, failed, _ = self_check(model, calibration, stated(model), sigmas=SIGMAS)
    assert check["focal_change_since_calibration"] > 0.4
    assert failed == []
