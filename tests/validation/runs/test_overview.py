"""The first screen of a report."""

from dataclasses import replace

import pytest

from validation.runs.overview import changes, cost_ratio, overview
from validation.runs.results import Results, Row


def row(key, value, reference, *, direction="at most", limit=None, verdict="reported"):
    return Row(key, value, "px", direction, limit, reference, "", verdict)


@pytest.mark.parametrize(
    ("value", "reference", "direction", "expected"),
    [
        (2.0, {"COLMAP": 4.0, "OpenCV": 8.0}, "at most", 0.5),
        (2.0, {"COLMAP": 4.0, "OpenCV": 8.0}, "at least", 4.0),
        (2.0, {"COLMAP": None, "ours, fast": 1.0}, "at most", None),
        (None, {"COLMAP": 1.0}, "at most", None),
        (0.0, {"COLMAP": 1.0}, "at most", None),
    ],
)
def test_a_ratio_above_one_is_always_worse(value, reference, direction, expected):
    one = row("a/b/c", value, reference, direction=direction)
    assert cost_ratio(one) == expected
    assert cost_ratio(replace(one, ranked=False)) is None


def test_the_worst_stage_is_drawn_on_top():
    rows = [
        row("epipolar/yard/one", 1.0, {"OpenCV": 2.0}),
        row("stereo/yard/one", 3.0, {"OpenCV": 1.0}),
        row("stereo/yard/two", 12.0, {"OpenCV": 1.0}),
        row("stereo/street/one", 1.0, {}),
    ]
    section = overview(Results(rows, [], {}, {}, {}), None)
    dots, means = section["plots"][0]["figure"]["data"]
    # The last category is at the top.
    assert means["y"] == ["epipolar/yard", "stereo/yard"]
    assert means["x"] == pytest.approx([0.5, 6.0])
    assert sorted(dots["x"]) == [0.5, 3.0, 12.0]
    assert "In 1 of 2" in section["notes"][0]
    assert "no earlier run" in section["notes"][1]


def test_changes_since_the_last_run_are_stated():
    held = row("a/yard/x", 1.0, {}, limit=2.0, verdict="reached")
    same = row("a/yard/y", 1.0, {}, limit=2.0, verdict="reached")
    before = Results([held, same], [], {}, {}, {})
    broke = replace(held, value=3.0, verdict="missed")
    now = Results([broke, same], [], {}, {}, {})
    assert changes(now, before) == ["Broken since the last run: a/yard/x, 1 before, 3 now."]
    assert changes(before, now) == ["Reached again: a/yard/x, 3 before, 1 now."]
    assert changes(now, now) == ["No limit of 2 changed its verdict since the last run."]
