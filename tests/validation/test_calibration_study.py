"""Calibration on real images: tables, zoomed images and the dinosaur."""

from dataclasses import replace

import numpy as np
import pytest

import thesisrecon
from tests.validation.test_metrics import _reconstruction, _truth
from thesisrecon.config import PipelineConfig
from thesisrecon.intrinsics import IntrinsicsOptions
from validation.metrics.intervals import IntervalScores, focal_errors_pct, holding_std, interval_scores
from validation.scenes.dinosaur import load_dinosaur
from validation.scenes.real import Scene, load_real_scene
from validation.scenes.zoomed import rezoom_scene
from validation.studies import coverage
from validation.studies.calibration_real import CameraRows, _pooled
from validation.studies.coverage import one_camera
from validation.studies.dinosaur import compare, to_metrics
from validation.studies.main_job import COLMAP, OURS


def rows_of(models):
    truth = _truth()
    return CameraRows("a set", Scene("a set", (), truth.K, truth.R, truth.C), models)


def value(rows, name, method=OURS):
    return next(row for row in rows if row.name == name).values[method]


def one_off():
    """The truth but for a focal that is 1 % too long."""
    model = _reconstruction(_truth())
    assert model.K is not None
    K = model.K.copy()
    K[2, :2, :2] *= 1.01
    return replace(model, K=K)


def test_a_method_that_failed_has_no_camera_and_no_error():
    rows = rows_of({OURS: one_off(), COLMAP: None})
    rows.registered()
    rows.focals(0.2, 0.5)
    rows.poses(3.3, 0.05)
    assert [metric.verdict for metric in rows] == [
        "reached", "reached", "missed", "reached", "reached",
    ]  # fmt: skip
    assert value(rows, "focal error, median") == pytest.approx(0.0, abs=1e-9)
    assert value(rows, "focal error, worst") == pytest.approx(1.0)
    assert value(rows, "cameras registered of 6", COLMAP) == 0.0
    assert value(rows, "focal error, worst", COLMAP) is None
    assert np.isinf(rows.all_focals(None)).all()


def test_missing_cameras_count_in_pooled_results():
    errors = {OURS: [np.array([0.1, 0.3]), np.array([0.2, np.inf])]}
    registered, median, worst = _pooled("all", errors)
    assert registered.values[OURS] == 3.0
    assert registered.verdict == "missed"
    assert median.values[OURS] == pytest.approx(0.25)
    assert worst.values[OURS] == pytest.approx(0.3)


def test_a_value_that_all_views_share_counts_once():
    scores = IntervalScores(np.array([[np.nan] * 3, [1.0] * 3, [1.0] * 3]), np.array([np.nan, 0.1, 0.1]))
    assert one_camera(scores, "shared").z.shape == (1, 3)
    assert one_camera(scores, "per-image") is scores


def test_without_a_trusted_result_no_coverage_is_reached(monkeypatch):
    monkeypatch.setattr(coverage, "run_trial", lambda *_: None)
    assert "missed" in [row.verdict for row in coverage.check_coverage("shared", range(3))]


def test_cameras_that_err_together_make_a_share_as_unsure_as_scenes_do():
    def scene(z, cameras):
        return IntervalScores(np.full((cameras, 3), z), np.full(cameras, 0.1))

    alone = [scene(5.0 if n % 10 == 0 else 0.0, 1) for n in range(100)]
    assert holding_std(alone, (0,)) == pytest.approx(np.sqrt(0.1 * 0.9 / 99))
    together = [scene(5.0 if n % 10 == 0 else 0.0, 8) for n in range(100)]
    assert holding_std(together, (0,)) == pytest.approx(holding_std(alone, (0,)))


ZOOM_MEDIAN_PCT, ZOOM_WORST_PCT = 0.5, 3.0


@pytest.mark.real
def test_zoomed_and_cropped_photographs_are_calibrated_each_for_itself(tmp_path):
    whole = load_real_scene("Herz-Jesus-P8")
    if whole is None:
        pytest.skip("the photographs of Herz-Jesus-P8 are not on this machine (THESISRECON_DATA)")
    scene = rezoom_scene(whole, tmp_path / "images", seed=0)
    config = PipelineConfig(intrinsics=IntrinsicsOptions(cameras="per-image"))
    result = thesisrecon.reconstruct(
        list(scene.image_paths), tmp_path / "out", config=config, seed=0, until="metric"
    )
    assert result.metric is not None
    assert result.metric.trusted, result.metric.failed_checks
    found = result.metric.reconstruction
    assert found.registered.all()
    assert found.K is not None
    assert scene.K is not None
    errors = focal_errors_pct(found.K, scene.K)
    assert np.median(errors) <= ZOOM_MEDIAN_PCT
    assert errors.max() <= ZOOM_WORST_PCT
    assert interval_scores(result.metric, scene.K).holding() >= 0.92


@pytest.fixture(scope="module")
def comparison():
    dinosaur = load_dinosaur()
    if dinosaur is None:
        pytest.skip("the dinosaur's tracks are not on this machine")
    return compare(dinosaur)


@pytest.mark.real
def test_all_cameras_are_found_and_explain_the_tracks_as_well_as_the_published_ones(comparison):
    missed = [row for row in to_metrics(comparison) if row.verdict == "missed"]
    assert not missed, missed


@pytest.mark.real
def test_hardly_an_observation_is_refused_and_the_noise_is_small(comparison):
    found = comparison.reconstruction
    assert found.inlier.mean() > 0.97
    assert found.valid.mean() > 0.98
    assert comparison.rms_px(comparison.ours) < 0.45
    assert np.nanmedian(comparison.ours.px) < 0.25
