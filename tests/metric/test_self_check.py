"""Checks of a metric model, shared cameras, and richer camera models."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metric.metric_stage import centre_error, run, scatter, with_xy
from tests.synthetic import make_scene, projective_reconstruction, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.metric import _adjustment, _model
from thesisrecon.metric._checks import (
    check_returned,
    check_views,
    returned_cameras,
    self_check,
    triangulable_observations,
    weakest_join,
)
from thesisrecon.metric._shared_camera import (
    check_shared_cameras,
    contradicted_focal_priors,
    deviations_of_images,
    inconsistent_principal_point,
)
from thesisrecon.metric._uncertainty import widen_by_camera_model, widen_unverified_focals
from thesisrecon.metric.refinement import MAX_REMAINING
from thesisrecon.optimize.bundle.identifiability import measure_motion
from thesisrecon.optimize.bundle.projection import MetricCameras
from thesisrecon.optimize.bundle.scatter import block_scatter
from thesisrecon.records import IntrinsicInterval, SelfCalibration, Tracks

SIGMAS, ANGLE = 7.0, 1e-3
STATED = {
    "focal_px": (0, 1.0), "aspect": (1, 0.0), "principal_x_px": (3, 1.0), "principal_y_px": (4, 1.0)
}  # fmt: skip


def true_model(scene, prior):
    group, shared = _model.camera_rows(prior)
    rows = np.zeros((len(shared), 8))
    K = scene.K[[int(np.flatnonzero(group == g)[0]) for g in range(len(shared))]]
    rows[:, 0], rows[:, 1], rows[:, 3:5] = K[:, 0, 0], 1.0, K[:, :2, 2]
    cameras = MetricCameras(scene.R, scene.t, rows, group, shared)
    views, points, seen = (np.ones(len(a), dtype=bool) for a in (scene.R, scene.X, scene.tracks.xy))
    return found_again(
        _model.MetricEstimate(scene.tracks, scene.sizes, cameras, views, scene.X, points, seen, 0.5)
    )


def found_again(model):
    return _model.retriangulate_tracks(model, sigmas=SIGMAS, min_angle=ANGLE)


def unshared(scene):
    return true_model(scene, prior_for(projective_reconstruction(scene)))


def stated(model, **std):
    """Intervals of every view; other standard deviations by name."""
    return [
        {
            name: IntrinsicInterval(float(model.cameras.intrinsics[g, column]), std.get(name, usual), "")
            for name, (column, usual) in STATED.items()
        }
        for g in model.cameras.group
    ]


def doubts_of(model, scene, *, K=None, **std):
    """Values and failed checks of the self-check."""
    calibration = SelfCalibration(np.eye(4), scene.K if K is None else K, 0.0 * scene.K, True, ())
    return self_check(model, calibration.K, stated(model, **std), sigmas=SIGMAS)[:2]


def setting(**known):
    scene = make_scene(sigma_px=0.5, seed=3)
    prior = prior_for(projective_reconstruction(scene), IntrinsicsOptions(**known))
    return scene, prior, true_model(scene, prior)


def test_a_right_model_is_not_doubted_whatever_its_start_was():
    scene, _, model = setting()
    check, failed_checks = doubts_of(model, scene)
    assert failed_checks == []
    assert check["confirmed_share_worst_view"] > 0.95
    alone = replace(model, inlier=model.tracks.view_index == 0)
    assert weakest_join(alone, np.ones(len(model.inlier), dtype=bool)) is None
    check, failed_checks = doubts_of(model, scene, K=0.6 * scene.K)
    assert failed_checks == []
    assert check["focal_change_since_calibration"] > 0.4
    assert doubts_of(model, scene, aspect=0.04)[1] == []
    (only,) = doubts_of(model, scene, aspect=0.062)[1]
    assert only.startswith("The aspect ratio of the pixels is determined only to 6%")


@pytest.mark.parametrize("views", [[0], [5], [1, 6]])
def test_cameras_that_stand_elsewhere_are_named_in_one_sentence(views):
    scene, _, model = setting()
    t = model.cameras.t.copy()
    t[views] += [0.4, -0.3, 0.2]
    spoiled = replace(model, cameras=replace(model.cameras, t=t))
    check, failed_checks = doubts_of(found_again(spoiled), scene)
    assert len(views) > 1 or check["confirmed_share_worst_view"] < 0.5
    named = "Images #1 and #6:" if len(views) > 1 else f"Image #{views[0]}:"
    assert any(doubt.startswith(named) for doubt in failed_checks)


def test_a_view_of_another_focal_asks_for_it():
    scene = make_scene(sigma_px=0.3, seed=4)
    factors = np.where(np.arange(8) == 2, 1.08, 1.0)
    # What the zoomed photograph shows, wherever it was explained before.
    tracks = changed(scene, factors, np.zeros((8, 2))).tracks
    zoomed = replace(unshared(scene), tracks=tracks, sigma_px=12.0)
    off = check_views(zoomed, sigmas=SIGMAS).focal_off
    np.testing.assert_allclose(off, np.log(factors), atol=0.01)
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
    adjustment = _adjustment.MetricAdjustment(prior, 0.0, 0.02)
    model = found_again(adjustment.run(model, iterations=10)[0])
    failed_checks = contradicted_focal_priors(model, adjustment)
    assert len(failed_checks) == reported
    assert all("contradict the given focal length" in doubt for doubt in failed_checks)
    # A known one is reported once, without advice on weights.
    _, prior, model = setting(focal="known", focal_px=1600.0)
    (only,) = contradicted_focal_priors(model, _adjustment.MetricAdjustment(prior, 0.0, 0.02))
    assert "shorter" in only
    assert "px" not in only
    assert "focal_std_rel" not in only
    _, without, model = setting()
    assert contradicted_focal_priors(model, _adjustment.MetricAdjustment(without, 0.0, 0.02)) == []


@pytest.mark.parametrize(("far", "fails"), [(0.09, False), (0.11, True), (np.inf, True)])
def test_an_adjustment_that_has_not_converged_is_not_trusted(far, fails):
    scene = make_scene(points=400, sigma_px=0.5, seed=3)
    check, failed_checks = doubts_of(replace(unshared(scene), sigmas_to_minimum=far), scene)
    assert check["sigmas_to_minimum"] == far
    assert any("not converged" in doubt for doubt in failed_checks) == fails


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
    model = unshared(scene)
    check, failed_checks = doubts_of(model, scene)
    assert failed_checks == []
    assert check["explained_share_worst_view"] > 0.9
    assert 0.2 < triangulable_observations(model).mean() < 0.9


def test_a_principal_point_far_off_is_doubted_where_the_scene_contradicts_itself_too():
    scene = make_scene(sigma_px=0.3, principal_shift=(140.0, 0.0), seed=3)
    prior = prior_for(projective_reconstruction(scene))
    adjustment = _adjustment.MetricAdjustment(prior, 0.0, 0.02)
    off, middle = true_model(scene, prior), true_model(make_scene(seed=3), prior)
    for model, contradiction, doubts in ((off, 3.0, 0), (off, 12.0, 1), (middle, 12.0, 0)):
        assert len(inconsistent_principal_point(model, adjustment, scatter(contradiction))) == doubts


def settled(scene, **options):
    """The model as the metric stage ends with it: adjusted and triangulated by turns."""
    prior = prior_for(projective_reconstruction(scene), IntrinsicsOptions(**options))
    adjustment = _adjustment.MetricAdjustment(prior, 0.0, 0.02)
    model = replace(true_model(scene, adjustment.prior), sigma_px=30.0)
    for _ in range(3):
        model = adjustment.run(found_again(model), iterations=10)[0]
    return model, adjustment


def changed(scene, factors, shift_px):
    """Photographs zoomed about the principal point and moved."""
    view = scene.tracks.view_index
    centre = scene.K[view, :2, 2]
    return with_xy(scene, centre + factors[view, None] * (scene.tracks.xy - centre) + shift_px[view])


def test_one_camera_and_own_cameras_are_not_doubted():
    for views in (3, 8):
        scene = make_scene(views=views, sigma_px=0.5, seed=5)
        test = check_shared_cameras(*settled(scene))
        assert test.failed_checks == ()
        assert test.misfit == 1.0
    scene = make_scene(sigma_px=0.3, zoom=0.2, seed=8)
    assert check_shared_cameras(*settled(scene, cameras="per-image")).failed_checks == ()
    assert run(make_scene(sigma_px=0.3, points=500, seed=7)).limitations == ()


@pytest.mark.parametrize(("views", "zoom"), [(8, 1.04), (8, 1.08), (3, 1.03), (3, 1.06)])
def test_images_zoomed_in_turn_are_detected(views, zoom):
    factors, sigma = np.where(np.arange(views) % 2 == 0, 1.0, zoom), 0.3 if views == 8 else 0.1
    scene = make_scene(views=views, sigma_px=sigma, seed=6 if views == 8 else 9)
    found = check_shared_cameras(*settled(changed(scene, factors, np.zeros((views, 2)))))
    (only,) = (*found.failed_checks, *found.warnings)
    assert views == 3 or ("shared focal length" in only and not found.warnings)
    # The sentence holds at any size of the images.
    assert "px" not in only


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
            model = adjustment.run(model, settled=_adjustment.SETTLED, keep_noise=True)[0]
            deviations = deviations_of_images(model, adjustment, critical=False, contradicted=False)
            widths.append(deviations.focal)
            noise = np.sqrt(block_scatter(adjustment.linearised(model)).variance[0, 0])
            focal = model.cameras.intrinsics[0, 0] / scene.K[0, 0, 0]
            sigmas.append(np.log(focal) / np.hypot(noise, widths[-1]))
    assert np.abs(sigmas).max() < 2.0
    assert max(widths[:2]) < 0.007
    assert min(widths[2:]) > 0.01
    assert min(widths[2:]) > 3.0 * max(widths[:2])
    # Contradicted by all images together, the deviations are not averaged over smaller ones.
    deviations = deviations_of_images(model, adjustment, critical=False, contradicted=True)
    assert deviations.focal > widths[-1]


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


def test_uninformative_images_widen_the_interval_with_a_warning():
    found = check_shared_cameras(*settled(make_scene(views=3, points=60, sigma_px=0.5, seed=2)))
    assert found.failed_checks == ()
    assert ["cannot be verified" in said for said in found.warnings] == [True]
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
    cropped = changed(scene, np.ones(8), np.random.default_rng(1).uniform(-80.0, 80.0, (8, 2)))
    (only,) = check_shared_cameras(*settled(cropped, **options)).failed_checks
    assert "principal point" in only or "shared focal length" in only
    assert check_shared_cameras(*settled(scene, **options)).failed_checks == ()


def test_blurred_images_and_crops_that_determine_their_principal_point_are_trusted():
    scene = make_scene(sigma_px=0.3, points=500, seed=3)
    blurred = scene.tracks.view_index == 4
    noise = np.random.default_rng(0).normal(0.0, 1.5, scene.tracks.xy.shape)
    scene = with_xy(scene, scene.tracks.xy + blurred[:, None] * noise)
    assert doubts_of(found_again(replace(unshared(scene), sigma_px=1.0)), scene)[1] == []
    scene = make_scene(sigma_px=0.5, seed=3, principal_shift=(300.0, 0.0))
    model = unshared(scene)
    assert doubts_of(model, scene)[1] == []
    (only,) = doubts_of(model, scene, principal_x_px=40.0)[1]
    assert "long side away from the image centre, and the images hardly determine it" in only


@pytest.mark.parametrize("kind", ["crops", "zooms"])
def test_images_cropped_or_zoomed_one_by_one_get_own_values_and_are_right(kind):
    scene, crops, zooms = make_scene(sigma_px=0.3, points=500, seed=7), np.zeros((8, 2)), np.ones(8)
    if kind == "crops":
        crops = np.random.default_rng(1).uniform(-80.0, 80.0, (8, 2))
    else:
        zooms = np.where(np.arange(8) % 2 == 0, 1.0, 1.08)
    result = run(changed(scene, zooms, crops))
    assert result.trusted, result.failed_checks
    (limitation,) = result.limitations
    assert limitation.startswith("Each image has its own")
    value, std = np.array([(f.value, f.std) for f in (i["focal_px"] for i in result.intrinsics)]).T
    error = value / (1500.0 * zooms) - 1.0
    assert np.abs(error).max() < 0.01
    assert (np.abs(error) < 3.0 * std / value).all()
    assert centre_error(result, scene) < 0.01


def test_what_no_intrinsic_explains_is_named_and_widens_the_interval():
    """Images bent in a way that no intrinsic describes, each differently: a stabiliser or rolling shutter."""
    scene = make_scene(sigma_px=0.1, points=500, seed=7)
    view, xy = scene.tracks.view_index, scene.tracks.xy.copy()
    shear = np.random.default_rng(2).normal(0.0, 0.002, len(scene.K))
    xy[:, 0] += shear[view] * (xy[:, 1] - scene.K[view, 1, 2])
    result = run(with_xy(scene, xy))
    assert result.trusted, result.failed_checks
    assert any("contradict a shared" in text for text in result.limitations)
    focal, x = (result.intrinsics[0][name] for name in ("focal_px", "principal_x_px"))
    for interval, truth in ((focal, 1500.0), (x, scene.K[0, 0, 2])):
        assert "camera model" in interval.source
        assert abs(interval.value - truth) < 2.0 * interval.std
    assert focal.std < 0.05 * focal.value
    assert centre_error(result, scene) < 0.02


@pytest.mark.parametrize("ratio", [1.25, 0.9])
def test_pixels_that_are_not_square_are_found_and_named(ratio):
    """As frames of a video are stored; they look like images zoomed and cropped one by one."""
    scene = make_scene(sigma_px=0.2, points=400, seed=3)
    xy = scene.tracks.xy * [1.0, ratio]
    result = run(with_xy(scene, xy))
    assert result.trusted, result.failed_checks
    assert any("pixels are not square" in text for text in result.limitations)
    own = result.intrinsics[0]
    for name, truth in (("aspect", ratio), ("focal_px", scene.K[0, 0, 0])):
        assert abs(own[name].value - truth) < 3.0 * own[name].std < 0.02 * truth
    assert centre_error(result, scene) < 0.01


def test_held_out_blocks_and_differences_of_models():
    _, _, model = setting()
    held = _adjustment.held_out_observations(model)
    t = model.tracks
    assert 0.1 < len(held) / model.inlier.sum() < 0.3
    left = model.inlier.copy()
    left[held] = False
    seen = np.bincount(t.point_index[left], minlength=t.n_points)
    assert (seen[t.point_index[held]] >= 2).all()
    # Neighbouring points are held out together.
    view = t.view_index == 0
    mine = np.isin(np.flatnonzero(view), held)
    X = model.X[t.point_index[view]]
    nearest = np.argsort(np.linalg.norm(X[:, None] - X[None], axis=2), axis=1)[:, 1]
    assert mine[nearest[mine]].mean() > 2 * mine.mean()
    cameras = model.cameras
    same = replace(model, cameras=replace(cameras, t=3.0 * cameras.t))
    assert _adjustment.camera_differences(model, same).centre < 1e-9
    longer = cameras.intrinsics * np.where(np.arange(8) == _model.FOCAL, 1.02, 1.0)
    zoomed = replace(model, cameras=replace(cameras, intrinsics=longer))
    assert _adjustment.camera_differences(model, zoomed).focal == pytest.approx(np.log(1.02))
    assert _adjustment.camera_differences(model, zoomed).harmless


def test_a_model_of_two_of_the_images_is_checked_without_the_others():
    scene, _, model = setting()
    prior = prior_for(
        projective_reconstruction(scene), IntrinsicsOptions(focal="known", focal_px=float(scene.K[0, 0, 0]))
    )
    two = found_again(replace(model, registered=np.arange(len(scene.K)) < 2))
    # Two centres are equal up to a similarity, whatever the cameras are.
    assert not _adjustment.camera_differences(two, two).harmless
    none = [{} if k > 1 else one for k, one in enumerate(stated(two))]
    motion = measure_motion(returned_cameras(two))
    report = check_returned(two, _adjustment.MetricAdjustment(prior, 0.0, 0.02), motion, none)
    assert report.identifiable


def test_a_richer_model_of_one_camera_predicts_no_better_and_one_of_crops_far_better():
    scene = make_scene(sigma_px=0.3, seed=7)
    shift = np.random.default_rng(1).uniform(-80.0, 80.0, (8, 2))
    for images, low, high in ((scene, 0.9, 1.3), (changed(scene, np.ones(8), shift), 0.0, MAX_REMAINING)):
        simple = settled(images)
        shared = simple[1].prior.shared.copy()
        shared[:, (_model.FOCAL, *_model.CENTRE)] = np.arange(len(shared))[:, None]
        model, adjustment = _adjustment.with_prior(*simple, replace(simple[1].prior, shared=shared))
        model = adjustment.run(model, iterations=25)[0]
        assert low < _adjustment.remaining_cost(simple, (model, adjustment)) < high


def test_each_model_is_tried_once_and_known_intrinsics_stay_known():
    free = setting()[1]
    known = setting(principal_point="known")[1]
    focal = np.arange(8) == _model.FOCAL
    assert list(_adjustment.richer_models(focal, free)) == [(_model.FOCAL,), (_model.FOCAL, *_model.CENTRE)]
    assert list(_adjustment.richer_models(focal, known)) == [(_model.FOCAL,)]
    assert list(_adjustment.richer_models(np.zeros(8, bool), free)) == []
    # Known in some images only: the others may have been zoomed.
    some = replace(
        free, std=np.where((np.arange(8) < 4)[:, None] & (np.arange(6) == _model.FOCAL), 0.0, free.std)
    )
    assert list(_adjustment.richer_models(focal, some)) == [(_model.FOCAL,), (_model.FOCAL, *_model.CENTRE)]
    assert list(_adjustment.richer_models(focal, setting(focal="known", focal_px=1500.0)[1])) == []
