"""The measurement of the growth: its exponents, shares and table."""

from dataclasses import replace

import pytest

from validation.studies.growth import Growth, exponent, recall_of, table
from validation.studies.pair_choice import Choice, to_metrics

ROW = Growth(
    "all-pairs", 10, 45, 45, 2, 1.0, 0.0, 9.0, 10.0, None, ((0, 1, True), (0, 2, False), (1, 2, True))
)


def test_the_exponent_is_that_of_a_power():
    assert exponent([10, 30, 100], [3 * n**1.5 for n in (10, 30, 100)]) == pytest.approx(1.5)


def test_recall_counts_the_accepted_pairs_alone():
    assert recall_of(replace(ROW, pair_list=((0, 1, True), (0, 2, False))), ROW) == 0.5
    assert recall_of(ROW, ROW) == 1.0


def test_the_table_names_shares_and_exponents():
    more = replace(
        ROW, photographs=20, possible=190, tried=95, cpu_s=40.0, recall=0.985, overlapping_tried=1.0
    )
    text = table([ROW, more])
    assert "95 of 190 (50 %)" in text
    assert "| 100.0 % | 98.5 % |" in text
    assert "processor time 2.00" in text


def test_missed_pairs_are_told_and_judged():
    good, bad = (Choice("a", 100, 30, 20, missed) for missed in ((), (41,)))
    assert [metric.verdict for metric in to_metrics(good)] == ["reported", "reported", "reached"]
    row = to_metrics(bad)[-1]
    assert (row.verdict, row.values["overlap estimate"]) == ("missed", pytest.approx(95.0))
    assert "41 verified" in row.note
