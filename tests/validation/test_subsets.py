"""The check on random subsets: what is taken of a set, and what its numbers mean."""

from dataclasses import replace

import numpy as np

from tests.synthetic import make_scene, true_pairs
from validation.studies.subsets import OUTCOMES, Matched, Trial, run_trial, table_row, take_views


def matched_scene():
    scene = make_scene(views=9, points=400, sigma_px=0.3, seed=4)
    return Matched("synthetic", scene.tracks, true_pairs(scene), scene.sizes, scene.K[:, 0, 0])


def test_a_subset_holds_the_views_their_pairs_and_the_points_that_two_of_them_see():
    whole, views = matched_scene(), np.array([1, 4, 7])
    kept = np.arange(400) < 250
    part = take_views(whole, views, kept)
    assert part.tracks.n_views == 3
    assert np.bincount(part.tracks.point_index).min() >= 2
    assert {(pair.i, pair.j) for pair in part.pairs} == {(0, 1), (0, 2), (1, 2)}
    t = whole.tracks
    seen = np.zeros((9, 400), dtype=bool)
    seen[t.view_index, t.point_index] = True
    assert part.tracks.n_points == int(((seen[views].sum(axis=0) >= 2) & kept).sum())
    mine = part.tracks.xy[part.tracks.view_index == 1]
    theirs = t.xy[t.view_index == 4]
    assert all((np.abs(theirs - xy).max(axis=1) == 0.0).any() for xy in mine)


def test_a_trial_finds_the_focal_length_and_is_the_same_twice():
    first, again = (run_trial(matched_scene(), "shared", 3) for _ in range(2))
    assert first.right
    assert not first.failed_checks
    assert first.registered == len(first.views)
    assert replace(first, seconds=0.0) == replace(again, seconds=0.0)


def test_what_came_of_a_trial_is_told_apart():
    wrong = Trial(0, (0, 1), 2, 10.0, 12.0, (), 1, 1.0)
    shifted = replace(wrong, median_pct=np.nan, reasons=("pure translation",))
    trials = {
        "right": replace(wrong, median_pct=1.0),
        "open": replace(wrong, interval_pct=11.0),
        "refused": replace(shifted, failed_checks=("close to a pure translation",)),
        "refused, another reason": replace(shifted, failed_checks=("too few points",)),
        "right, doubted": replace(wrong, median_pct=1.0, failed_checks=("no",)),
        "wrong": wrong,
        "crash": replace(wrong, median_pct=np.nan, crash="ValueError: no"),
    }
    assert tuple(trials) == OUTCOMES
    assert [trial.outcome for trial in trials.values()] == list(OUTCOMES)
    assert replace(wrong, failed_checks=("no",)).outcome == "refused"
    assert shifted.outcome == "wrong"
    assert "| s | shared | 7 | 1 | 1 | 1 | 1 | 1 | 1 | 1 | 5.50 |" in table_row(
        "s", "shared", [*trials.values()]
    )
