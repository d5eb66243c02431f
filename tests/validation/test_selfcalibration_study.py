"""The study of self-calibration: its scenes are what they say, its bound behaves as one, its tables count."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from thesisrecon.geometry.camera_matrix import project
from validation.metrics.focal_bound import focal_bound
from validation.metrics.record import markdown_table
from validation.scenes.cloud import make_cloud
from validation.scenes.rigs import cube_rig, noisy_tracks, projective_from_truth
from validation.studies.selfcalibration import (
    BOUND,
    WITH_BUNDLE,
    Cell,
    Trial,
    assumptions,
    cells,
    make_rig,
    read_trials,
    report,
    run_cell,
    targets,
)


@pytest.mark.parametrize("scene", ["cube", "cloud"])
@pytest.mark.parametrize("mode", ["constant", "zooming"])
def test_projective_cameras_of_exact_pixels_reproject_exactly(scene, mode):
    rng = np.random.default_rng(0)
    rig = make_rig(Cell(scene, mode, 0.0, 6), rng)
    rec = projective_from_truth(rig, noisy_tracks(rig, 0.0, rng), rng)
    assert rec.registered.all()
    for v in range(6):
        mine = rec.inlier & (rec.tracks.view_index == v)
        seen = project(rec.P[v], rec.X[rec.tracks.point_index[mine]])
        np.testing.assert_allclose(seen, rec.tracks.xy[mine], atol=1e-5)
    focals = rig.K[:, 0, 0]
    assert (np.ptp(focals) > 1.0) == (mode == "zooming")
    assert assumptions(rig, mode).group.max() == (5 if mode == "zooming" else 0)


def test_cameras_of_one_face_are_left_out_of_the_projective_stage():
    rng, rig = np.random.default_rng(0), cube_rig()
    rec = projective_from_truth(rig, noisy_tracks(rig, 1.0, rng), rng)
    assert rig.flat is not None
    assert rig.flat.sum() == 6
    np.testing.assert_array_equal(rec.registered, ~rig.flat)
    assert rec.sigma_px == pytest.approx(0.9, abs=0.1)


def test_the_bound_grows_with_noise_and_shrinks_with_cameras_and_priors():
    rig = make_cloud(9, np.random.default_rng(1), points=80)
    std = focal_bound(rig, 1.0, zooming=False, principal_std_px=15.0)
    np.testing.assert_allclose(std, std[0])
    # With what is known of the principal point scaled along, twice the noise is twice the deviation.
    np.testing.assert_allclose(
        focal_bound(rig, 2.0, zooming=False, principal_std_px=30.0), 2.0 * std, rtol=1e-4
    )
    assert focal_bound(rig.subset(np.arange(4)), 1.0, zooming=False, principal_std_px=15.0)[0] > 1.2 * std[0]
    assert (focal_bound(rig, 1.0, zooming=True, principal_std_px=15.0) > std[0]).all()
    assert focal_bound(rig, 1.0, zooming=False, principal_std_px=0.1)[0] <= std[0]
    scaled = replace(rig, X=3.0 * rig.X, C=3.0 * rig.C)
    np.testing.assert_allclose(focal_bound(scaled, 1.0, zooming=False, principal_std_px=15.0), std, rtol=1e-4)


def test_a_cell_measures_every_method_on_the_same_draws(tmp_path):
    cell = Cell("cloud", "constant", 0.0, 5)
    trials = run_cell(cell, ("nonlinear-quadric", "kruppa-equations", BOUND), range(2))
    assert [t.method for t in trials] == ["nonlinear-quadric", "kruppa-equations", BOUND] * 2
    assert all(t.median_pct < 3.0 for t in trials)
    text = report(trials)
    assert "| nonlinear-quadric |" in text
    assert "| cloud, constant | 5 cameras, 0 px |" in text
    assert "| draws of the others | 2 |" in text
    file = tmp_path / "trials.jsonl"
    file.write_text("".join(json.dumps(asdict(t)) + "\n" for t in [*trials, *trials]), encoding="utf-8")
    assert len(read_trials([file])) == len(trials)


def test_refusals_count_as_failures_and_targets_are_judged():
    def trial(seed, mode, median, worst):
        return Trial("cube", mode, 1.0, 27, seed, WITH_BUNDLE, median, worst, True, 1.0)

    some = [
        trial(0, "constant", 0.05, 0.05),
        trial(1, "constant", np.nan, np.nan),
        trial(2, "constant", 0.04, 0.04),
    ]
    assert "0.05 (67)" in report(some)
    text = markdown_table(targets([*some, trial(0, "zooming", 0.1, 4.0), trial(1, "zooming", 0.1, 6.0)]))
    assert "missed" in text
    assert "worst camera within 5 %, % of trials | 50 | >= 90 | missed" in text


def test_cells_cross_at_one_pixel_and_the_most_cameras():
    places = cells(["cube"], ["constant"], (0.5, 1.0, 2.0), (3, 27))
    assert [(c.sigma_px, c.views) for c in places] == [(0.5, 27), (1.0, 27), (2.0, 27), (1.0, 3)]


def test_the_report_crosses_at_one_pixel():
    places = [(1.0, 3), (1.0, 27), (0.5, 27), (2.0, 27)]
    text = report(
        [Trial("cloud", "zooming", s, v, 0, "linear-quadric", 0.2, 6.0, True, 1.0) for s, v in places]
    )
    assert "| 3 cameras, 1 px | 27 cameras, 1 px | 27 cameras, 0.5 px | 27 cameras, 2 px |" in text
    assert "0.2 (100, 0)" in text
