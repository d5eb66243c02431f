from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.report.synthetic import made_up_run, projective_run
from thesisrecon.errors import StageFailure
from thesisrecon.records import DegeneracyReport, IntrinsicInterval
from thesisrecon.report import _assessment
from thesisrecon.report._data import ResidualSummary, summarize
from thesisrecon.results import RunResult

TIME = "Computing time"


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1520.34, 1.84, "1520.3 ± 1.8"), (1520.34, 4.2, "1520 ± 4"), (1520.34, 0.42, "1520.3 ± 0.4"),
        (-0.03012, 0.00042, "-0.0301 ± 0.0004"), (512.0, 0.0, "512 (fixed)"),
        (1520.34, float("inf"), "1520 (not determined)"),
    ],
)  # fmt: skip
def test_numbers_carry_as_many_digits_as_they_deserve(value, std, text):
    assert _assessment.plus_minus(value, std) == text


def test_shared_values_are_one_and_varying_ones_a_range():
    same = [IntrinsicInterval(800.0, 1.5, "a")] * 3
    assert _assessment._interval_text(same, "px") == "800.0 ± 1.5\u202fpx"
    varying = [*same, IntrinsicInterval(900.0, 1.5, "a")]
    assert _assessment._interval_text(varying, "px") == "800.0 to 900.0\u202fpx (± 1.5)"


def test_words_for_numbers():
    assert _assessment.decimals(0.256, 2) == "0.26"
    assert _assessment.decimals(float("nan"), 2) == "–"
    assert _assessment.grouped(1234567) == "1\u202f234\u202f567"
    assert _assessment.duration(3.04) == "3.0\u202fs"
    assert _assessment.duration(125) == "2\u202fmin 05\u202fs"
    assert _assessment.duration(7325) == "2\u202fh 02\u202fmin"
    assert _assessment._named_number("sigma_px", 0.19) == ("sigma", "0.19\u202fpx")
    assert _assessment._named_number("focal_spread_rel", 0.0008) == ("focal spread", "0.08\u202f%")
    assert _assessment._named_number("accepted", 26) == ("accepted", "26")
    assert _assessment._named_number("score", float("nan")) == ("score", "nan")


def test_the_assessment_is_honest():
    data = made_up_run(points=100)
    assert data.metric is not None
    assert _assessment.assess(data).word == "Trusted, but incomplete"
    phone = replace(data.metric, limitations=("image #1 is blurred",))
    assert _assessment.assess(replace(data, metric=phone)).reasons == ("Image #1 is blurred.",)
    doubt = replace(data.metric, trusted=False, failed_checks=("pure rotation",))
    assessment = _assessment.assess(replace(data, metric=doubt))
    assert (assessment.level, assessment.reasons) == ("doubt", ("Pure rotation.",))
    early = _assessment.assess(projective_run())
    assert early.level == "open"
    assert "projective reconstruction" in early.sentence


def test_a_failure_states_reason_evidence_and_advice():
    failure = StageFailure("no pair overlaps", "23 matches, 60 needed", "take more photographs")
    data = replace(projective_run(), reconstruction=None, until=None, failure=failure)
    assessment = _assessment.assess(replace(data, reports=data.reports[:2]))
    assert assessment.level == "bad"
    assert assessment.sentence == "No pair overlaps."
    assert assessment.reasons == ("23 matches, 60 needed.", "The last stage that finished was matches.")
    assert assessment.advice == "Take more photographs."


def test_the_head_of_the_page_summarises_the_run():
    labels = [fact.label for fact in _assessment.key_facts(made_up_run(points=100), None)]
    assert labels == ["Cameras registered", "Focal length", "Principal point", "Points", TIME]
    facts = _assessment.key_facts(made_up_run(points=100), ResidualSummary(1000, 0.8, 1.0, 2.0))
    assert facts[3].value == "0.80 px median"
    assert facts[3].note == "1.00 px RMS over 1\u202f000 observations; at working size 0.20 px median"
    early = replace(projective_run(), reconstruction=None)
    assert [fact.label for fact in _assessment.key_facts(early, None)] == ["Images", "Pairs accepted", TIME]


def test_pairs_that_leave_their_geometry_open_are_counted():
    run = replace(projective_run(), reconstruction=None)
    unsure = DegeneracyReport(False, ("one homography explains the matches (plane)",))
    pairs = tuple(replace(pair, degeneracy=unsure) if pair.accepted else pair for pair in run.pairs)
    early = replace(run, pairs=pairs)
    note = _assessment.key_facts(early, None)[1].note
    assert f"; {sum(pair.accepted for pair in pairs)} pairs with degenerate epipolar geometry" in note
    assert "degenerate" not in _assessment.key_facts(run, None)[1].note


def test_refused_images_are_those_without_a_camera():
    data = made_up_run(points=100)
    result = RunResult(Path(), data.images, data.unread, (), (), np.zeros(9, int), {}, metric=data.metric)
    assert list(result.refused) == ["notes.jpg", data.images[-1].name]
    assert result.refused[data.images[-1].name].startswith("only 14 matches")
    listed = summarize(result)["refused"]
    assert {entry["name"]: entry["reason"] for entry in listed} == result.refused
    assert replace(result, metric=None).refused == data.unread
