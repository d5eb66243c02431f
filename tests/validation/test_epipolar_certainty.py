"""The counts of the certainty check, on a few facades."""

from collections import Counter

from thesisrecon.epipolar.configuration import Configuration
from validation.studies.epipolar_synthetic import (
    certainty_metrics,
    certainty_table,
    check_degeneracy,
    facade_pairs,
    judge_pairs,
    named_rightly,
)


def test_no_wrong_f_of_a_facade_is_called_sure():
    cells, ratios = judge_pairs(facade_pairs(25), 1)
    everything = sum(cells.values(), Counter())
    assert everything.total() == 25
    assert everything["wrong and sure"] == 0
    assert everything["wrong and unsure"] > 0
    assert len(ratios) == 25 - everything["refused"]
    table = certainty_table(cells).splitlines()
    assert len(table) == 2 + len(cells)
    assert table[0].count("|") == table[2].count("|")


def test_shares_are_of_the_right_groups():
    cells = {
        "scene, i + 1": Counter({"right and sure": 19, "right and unsure": 1}),
        "scene, i + 4": Counter({"right and unsure": 50, "wrong and unsure": 9, "wrong and sure": 1}),
    }
    wrong, unsure = certainty_metrics(cells)
    assert wrong.values["ours"] == 0.1
    assert wrong.verdict == "missed"
    assert unsure.values["ours"] == 0.05
    assert unsure.verdict == "reached"


def test_names_are_counted():
    assert named_rightly(Configuration.PLANE, 0.25, 100, 5, wrong=0.3) == 1.0
    rows = check_degeneracy(60, 1, wrong=0.0)
    assert len(rows) == 20
    assert {row.verdict for row in rows} == {"reported"}
