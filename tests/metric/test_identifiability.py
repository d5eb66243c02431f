"""Motion and identifiability are those of the cameras and points that are returned, not of the beginning."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.conftest import real_data
from tests.metric.metric_stage import true_calibration, with_few_points
from tests.metric.test_verdicts import looking, project
from tests.synthetic import looking_along, make_scene, projective_reconstruction, with_poses
from thesisrecon import reconstruct, reconstruct_from_tracks
from thesisrecon.config.intrinsics import prior_for
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.optimize.bundle.identifiability import (
    CalibrationProblem,
    UpgradedCameras,
    identifiability_report,
    measure_motion,
    nearest_critical_motion,
)
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations
from thesisrecon.pipeline.large_sets import restrict_views
from thesisrecon.records import IdentifiabilityReport, IntrinsicsPrior
from thesisrecon.selfcalibration._upgrade import check_identifiability

SETS = (
    "truth/temple/images", "truth/lego/images", "truth/dino/images", "truth/kitti1/images",
    "truth/fern/images", "strecha/fountain-P11/images", "strecha/Herz-Jesus-P8/images", "kermit/images",
)  # fmt: skip
WITHIN = 0.05


def recomputed(R, C, X):
    """The measures that sentences state, from cameras and points alone."""
    measures = measure_motion(UpgradedCameras(np.ones(len(R)), R, C, X))
    names = "largest_rotation_deg rotation_axis_spread_deg scene_planarity_ratio centre_spread_over_distance"
    return {name: measures[name] for name in (*names.split(), "axial_translation_over_distance")}


def assert_returned(summary, R, C, X):
    for name, value in recomputed(R, C, X).items():
        assert summary["motion"]["evidence"][name] == pytest.approx(value, rel=WITHIN, abs=1e-6), name


def assert_written(folder):
    """The numbers in ``summary.json`` are those of ``cameras.json`` and ``points.ply``."""
    summary, cameras = (json.loads((folder / f"{n}.json").read_text()) for n in ("summary", "cameras"))
    R, t = (np.array([camera[name] for camera in cameras["cameras"]]) for name in ("R", "t"))
    X = np.asarray(trimesh.load(folder / "points.ply").vertices)
    assert_returned(summary, R, -np.einsum("vba,vb->va", R, t), X)


def assert_points_seen(found):
    """Reasons against images name the number of returned points that these observe."""
    few = [v for v, reason in enumerate(found.reasons) if reason.startswith("sees ")]
    for view in few:
        points = found.tracks.point_index[found.tracks.view_index == view]
        assert found.reasons[view].startswith(f"sees {found.valid[points].sum()} point")
    return few


def grown(scene, first, *, report=None):
    """The model that grows from the ``first`` views, and the report on these."""
    whole = projective_reconstruction(scene)
    start = restrict_views(whole, np.isin(np.arange(len(scene.R)), first))
    prior, calibration = prior_for(whole), true_calibration(scene)
    K = np.where(start.registered[:, None, None], calibration.K, 0.0)
    upgrade = replace(calibration.candidates[0], K=K)
    report = report or check_identifiability(start, upgrade, prior)
    calibration = replace(
        calibration, K=K, candidates=(upgrade,), identifiability=report,
        identifiable=report.identifiable, reasons=() if report.identifiable else report.sentences,
    )  # fmt: skip
    metric = MetricRefinement().refine(start, calibration, prior=prior, rng=np.random.default_rng(0))
    assert metric.reconstruction.registered.all()
    assert metric.identifiability is not None
    return metric, report


def noisy(scene, sigma_px=0.3, seed=1):
    noise = np.random.default_rng(seed).normal(0.0, sigma_px, scene.tracks.xy.shape)
    return replace(scene, tracks=replace(scene.tracks, xy=scene.tracks.xy + noise))


def arc():
    """Cameras of which the first five do not rotate and the others go round the scene."""
    views, still = 14, 5
    scene = make_scene(views=views, points=500, seed=5)
    angle = np.radians(np.concatenate([np.zeros(still), np.linspace(5.0, 104.0, views - still)]))
    C = np.column_stack([7.0 * np.sin(angle), np.linspace(-1.5, 1.5, views), -7.0 * np.cos(angle)])
    C[:still, 0] = np.linspace(-0.8, 0.8, still)
    roll = 20.0 * np.linspace(0.0, 1.0, views)[:, None] ** 2
    R = Rotation.from_euler("z", roll, degrees=True).as_matrix() @ [looking_along(-c) for c in C]
    R[:still] = looking_along(-C[0])
    return noisy(with_poses(scene, R, C))


def test_a_start_without_rotation_that_becomes_an_arc_is_described_as_an_arc():
    scene = arc()
    metric, start = grown(scene, range(5))
    found = metric.identifiability
    assert start.motion == "pure translation"
    assert not start.identifiable
    truth = recomputed(scene.R, scene.centres, scene.X)["largest_rotation_deg"]
    assert found.evidence["largest_rotation_deg"] == pytest.approx(truth, rel=WITHIN)
    assert found.identifiable
    assert metric.trusted, metric.failed_checks
    assert not any("translation" in text for text in found.sentences)


def test_a_flat_start_that_becomes_a_deep_scene_is_not_called_planar():
    scene = make_scene(views=12, points=600, seed=6)
    scene.X[:350, 2] = 0.0
    t = scene.tracks
    # The first five views see the flat part only.
    keep = (t.view_index >= 5) | (t.point_index < 350)
    tracks = replace(t, view_index=t.view_index[keep], point_index=t.point_index[keep], xy=t.xy[keep].copy())
    scene = noisy(with_poses(replace(scene, tracks=tracks), scene.R, scene.centres))
    metric, start = grown(scene, range(5))
    assert start.motion == "planar scene"
    assert start.critical
    found = metric.identifiability
    assert found.motion != "planar scene" or not found.critical
    assert found.evidence["scene_planarity_ratio"] > 0.1
    assert metric.trusted, metric.failed_checks


def test_a_general_start_does_not_excuse_a_degenerate_end():
    """A report that says that the beginning was general, and cameras that did not rotate."""
    scene = make_scene(views=8, points=400, seed=7)
    still = noisy(with_poses(scene, np.tile(scene.R[:1], (8, 1, 1)), scene.centres))
    general = IdentifiabilityReport(True, "planar scene", False, {"largest_rotation_deg": 60.0})
    metric, _ = grown(still, range(8), report=general)
    found = metric.identifiability
    assert found.motion == "pure translation"
    assert found.critical
    assert not found.identifiable
    assert not metric.trusted
    assert any("pure translation" in text for text in metric.failed_checks)


def test_the_reason_against_an_image_counts_the_returned_points():
    """Image 7 sees 12 points; eight are matched too badly to be in the model."""
    scene = with_few_points(make_scene(points=300, seed=6), 7, 12)
    t, rng = scene.tracks, np.random.default_rng(0)
    bad = np.isin(t.point_index, t.point_index[t.view_index == 7][:8])
    xy = t.xy + rng.normal(0.0, np.where(bad, 12.0, 0.3)[:, None], t.xy.shape)
    whole = projective_reconstruction(replace(scene, tracks=replace(t, xy=xy)))
    found = MetricRefinement().refine(
        restrict_views(whole, np.arange(8) != 7), true_calibration(scene), prior=prior_for(whole),
        rng=np.random.default_rng(0),
    ).reconstruction  # fmt: skip
    assert assert_points_seen(found) == [7]
    assert found.valid[t.point_index[t.view_index == 7]].sum() < 12


def test_a_toy_on_a_table_is_no_plane():
    rng = np.random.default_rng(0)
    table = rng.uniform(-1.0, 1.0, (900, 3)) * [1.0, 1.0, 0.002]
    toy = rng.uniform([0.05, -0.05, 0.1], [0.35, 0.25, 0.4], (100, 3))
    scene = make_scene(views=8, seed=1)
    cameras = UpgradedCameras(np.full(8, 1.0), scene.R, scene.centres, np.concatenate([table, toy]))
    assert nearest_critical_motion(measure_motion(cameras))[1] > 1.0
    flat = nearest_critical_motion(measure_motion(replace(cameras, X=table)))
    assert flat[0] == "planar scene"
    assert flat[1] < 1.0


@pytest.mark.parametrize("turned", [0, 1, 4])
def test_a_strip_whose_end_turns_round_rotated_about_the_optical_axis(turned):
    """Nadir images of which the last are rolled by 180 degrees: no translation alone, nor a zoom by -1."""
    roll = np.where(np.arange(10) < 10 - turned, 0.0, 180.0)
    R = Rotation.from_euler("z", roll[:, None], degrees=True).as_matrix()
    C = np.column_stack([np.linspace(-3.0, 3.0, 10), np.linspace(-0.2, 0.4, 10) ** 2, np.zeros(10)])
    X = np.random.default_rng(2).uniform([-4.0, -3.0, 5.0], [4.0, 3.0, 6.0], (300, 3))
    measures = measure_motion(UpgradedCameras(np.full(10, 1.0), R, C, X))
    name, distance = nearest_critical_motion(measures)
    assert distance < 1.0
    assert name == ("rotation about the optical axis" if turned else "pure translation")
    assert measures["largest_rotation_deg"] == pytest.approx(180.0 if turned else 0.0, abs=1e-6)


def test_summary_and_warnings_are_about_the_returned_cameras():
    """An arc that begins with parallel views, from tracks to the summary."""
    rng, size, focal = np.random.default_rng(3), (1200, 900), 1000.0
    X = rng.uniform([-2.0, -1.5, -1.5], [2.0, 1.5, 1.5], (400, 3))
    angle = np.radians(np.linspace(-45.0, 45.0, 9))
    C = np.column_stack([7.0 * np.sin(angle), -7.0 * np.cos(angle), rng.uniform(-1.0, 1.0, 9)])
    roll = Rotation.from_euler("z", rng.uniform(-20.0, 20.0, (9, 1)), degrees=True).as_matrix()
    R = roll @ np.array([looking(rng.normal(0.0, 0.2, 3) - c) for c in C])
    xy = project(X, R, C, focal, size, np.tile((np.array(size) - 1) / 2, (9, 1)))
    result = reconstruct_from_tracks(xy + rng.normal(0.0, 0.3, xy.shape), [size] * 9)
    R, C = (np.array([getattr(c, name) for c in result.cameras.values()]) for name in ("R", "centre"))
    assert_returned(result.summary, R, C, result.points)
    assert result.summary["identifiable"] is True
    start = result.summary["self_calibration"]
    assert start["images"] <= 9
    assert set(start) == {"images", "identifiable", "motion"}


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_stated_numbers_of_photographs_are_those_of_the_written_cameras(name, tmp_path):
    result = reconstruct(real_data(name), tmp_path, until="metric", max_size=512)
    assert_written(tmp_path)
    assert_points_seen(result.metric.reconstruction)
    assert result.summary["motion"]["nearest_critical"] == result.metric.identifiability.motion


def test_the_focal_std_is_that_of_all_observations_and_not_of_the_ones_adjusted():
    """A model is adjusted to a share of its observations; the evidence is that of the whole."""
    scene = make_scene(sigma_px=0.5, seed=3)
    t, n = scene.tracks, scene.tracks.n_views
    intrinsics = np.tile([1500.0, 1.0, 0.0, *scene.K[0, :2, 2], 0.0, 0.0, 0.0], (n, 1))
    cameras = MetricCameras(scene.R, scene.t, intrinsics, np.arange(n), np.zeros((n, 8), dtype=np.int64))
    std = np.tile([np.inf, 0.0, 0.0, 15.0, 15.0, 0.0, 0.0, 0.0], (n, 1))
    found = []
    for kept, share in ((np.ones(len(t.xy), dtype=bool), 1.0), (t.point_index < 75, 0.25)):
        seen = Observations(t.view_index[kept], t.point_index[kept], t.xy[kept])
        prior, longest = IntrinsicsPrior.unshared(intrinsics, std), np.full(n, 1536.0)
        problem = CalibrationProblem(cameras, scene.X, seen, prior, 0.5, share, longest, np.arange(n))
        found.append(identifiability_report(problem, 20).evidence["focal_std_rel"])
    assert found[1] == pytest.approx(found[0], rel=0.4)
