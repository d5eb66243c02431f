"""Coverage of stated intervals, and the dinosaur."""

import numpy as np
import pytest

from validation.metrics.intervals import IntervalScores, holding_std
from validation.scenes.dinosaur import load_dinosaur
from validation.studies import calibration_coverage
from validation.studies.dinosaur import compare, to_metrics


def test_without_a_trusted_result_no_coverage_is_reached(monkeypatch):
    monkeypatch.setattr(calibration_coverage, "run_trial", lambda *_: None)
    assert "missed" in [row.verdict for row in calibration_coverage.check_coverage("shared", range(3))]


def test_cameras_that_err_together_make_a_share_as_unsure_as_scenes_do():
    def scene(z, cameras):
        return IntervalScores(np.full((cameras, 3), z), np.full(cameras, 0.1))

    alone = [scene(5.0 if n % 10 == 0 else 0.0, 1) for n in range(100)]
    assert holding_std(alone, (0,)) == pytest.approx(np.sqrt(0.1 * 0.9 / 99))
    together = [scene(5.0 if n % 10 == 0 else 0.0, 8) for n in range(100)]
    assert holding_std(together, (0,)) == pytest.approx(holding_std(alone, (0,)))


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
