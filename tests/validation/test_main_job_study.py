"""Rows and verdicts of the study of whole reconstructions."""

import pytest

from tests.validation.test_metrics import V, _reconstruction, _truth
from validation.runs.gates import read_gates
from validation.runs.tables import Metric, markdown_table
from validation.scenes.real import Scene
from validation.studies import against_colmap
from validation.studies.against_colmap import COLMAP, OURS, Outcome, check_reconstruction


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


def test_the_bounds_are_the_gates_of_the_report_whatever_reasons_are_given():
    reasons = {f"{n}.jpg": "too few points in common" for n in range(11 - V)}
    ours = Outcome(_reconstruction(_truth()), 3.0, 100.0, 5.0, reasons=reasons)
    rows = {row.name: row for row in check_reconstruction("kermit", 11, None, {OURS: ours})}
    assert rows["cameras registered of 11"].target == 9.0
    assert rows["cameras registered of 11"].verdict == "missed"
    rows = _rows("fountain-P11", {OURS: ours})
    for name, gate in (("focal error", "focal-error"), ("mean camera-centre error", "centre-error")):
        assert rows[name].target == read_gates()[f"cameras/fountain-P11/{gate}"].limit
    assert all(
        row.target is None for name, row in _rows("a set", {OURS: ours}).items() if "claims" not in name
    )


def test_a_run_that_failed_is_not_hidden_by_one_that_did_not(tmp_path, monkeypatch):
    model = _reconstruction(_truth())
    for failing in ([False, True], [True, False]):
        runs = [
            Outcome(None if fails else model, 9.0 - fails, 1.0, 1.0, failure="no" * fails)
            for fails in failing
        ]
        left = {method: list(runs) for method in against_colmap.METHODS}
        monkeypatch.setattr(against_colmap, "run_method", lambda m, *_, left=left, **__: left[m].pop())
        scene = Scene("a set", tuple(tmp_path / f"{n}.png" for n in range(V)))
        _, outcomes = against_colmap.measure_scene(scene, tmp_path, threads=1, repeats=2, environment={})
        assert all(outcome.failure == "no" for outcome in outcomes.values())


@pytest.mark.parametrize(
    ("value", "at_most", "verdict"),
    [(1.0, True, "reached"), (1.1, True, "missed"), (1.1, False, "reached"), (0.9, False, "missed")],
)
def test_a_target_has_a_side(value, at_most, verdict):
    assert Metric("s", "n", "", {"ours": value}, "ours", 1.0, at_most).verdict == verdict
