"""Rows and verdicts of the study of whole reconstructions."""

from dataclasses import replace

import pytest

from tests.validation.test_metrics import V, _reconstruction, _truth
from validation.metrics.record import Metric, markdown_table
from validation.studies.main_job import COLMAP, OURS, Outcome, check_reconstruction


def _rows(scene, outcomes, *, n_views=V):
    return {row.name: row for row in check_reconstruction(scene, n_views, _truth(), outcomes)}


def test_rows_hold_both_methods_and_judge_ours():
    model = _reconstruction(_truth())
    ours, colmap = Outcome(model, 9.0, 500.0, 12.0, claimed_rms_px=1.0), Outcome(model, 10.0, 300.0, 15.0)
    rows = _rows("fountain-P11", {OURS: ours, COLMAP: colmap})
    assert rows[f"cameras registered of {V}"].verdict == "reached"
    assert rows["focal error"].verdict == "reached"
    assert rows["mean camera-centre error"].unit == "mm"
    assert rows["wall time"].target == 10.0
    assert rows["wall time"].verdict == "reached"
    # The residuals here are zero, so a claim of one pixel is far off.
    assert rows["rms it claims off by"].verdict == "missed"
    assert rows["points"].verdict == "reported"


def test_a_failure_misses_its_targets_and_breaks_nothing():
    failed = Outcome(None, 3.0, 100.0, 5.0, failure="no pair was found")
    rows = _rows(
        "fountain-P11", {OURS: failed, COLMAP: Outcome(_reconstruction(_truth()), 10.0, 300.0, 15.0)}
    )
    assert rows["focal error"].verdict == "missed"
    assert rows["focal error"].values[OURS] is None
    assert rows[f"cameras registered of {V}"].values[OURS] == 0
    assert "| focal error, % | - |" in markdown_table(list(rows.values()))


def test_kermit_may_miss_cameras_only_with_reasons():
    ours = Outcome(_reconstruction(_truth()), 3.0, 100.0, 5.0)
    few = {f"{n}.jpg": "too few points in common" for n in range(11 - V)}
    name = "cameras registered of 11"
    silent = check_reconstruction("kermit", 11, None, {OURS: ours})
    spoken = check_reconstruction("kermit", 11, None, {OURS: replace(ours, reasons=few)})
    assert {row.name: row.verdict for row in silent}[name] == "missed"
    assert {row.name: row.verdict for row in spoken}[name] == "reached"
    assert {row.name: row.note for row in spoken}[name] == "5 missing, each with its reason"


@pytest.mark.parametrize(
    ("value", "at_most", "verdict"),
    [(1.0, True, "reached"), (1.1, True, "missed"), (1.1, False, "reached"), (0.9, False, "missed")],
)
def test_a_target_has_a_side(value, at_most, verdict):
    assert Metric("s", "n", "", {"ours": value}, "ours", 1.0, at_most).verdict == verdict
