"""Intervals against the truth, and the studies of parts of a set."""

from dataclasses import replace

import numpy as np
import pytest

from thesisrecon.records import IntrinsicInterval, MetricResult, Reconstruction, Tracks
from validation.metrics.intervals import focal_errors_pct, interval_scores, join_scores
from validation.studies.calibration_coverage import run_trial
from validation.studies.calibration_parts import named, without
from validation.studies.subsets import Matched

K = np.array([[1000.0, 0.0, 500.0], [0.0, 1002.001, 300.0], [0.0, 0.0, 1.0]])


def result_of(values):
    """A result that states these focals, their sigmas and sources; the last view is not registered."""
    n = len(values) + 1
    nothing = np.zeros(0, dtype=np.int64)
    registered = np.arange(n) < n - 1
    model = Reconstruction(
        "metric", np.zeros((n, 3, 4)), np.zeros((0, 4)), registered, np.zeros(0, dtype=bool),
        np.zeros(0, dtype=bool), Tracks(nothing, nothing, np.zeros((0, 2)), n, 0),
        np.tile(np.array([1000, 600]), (n, 1)), 1.0, ("",) * n,
    )  # fmt: skip
    intervals = [
        {
            "focal_px": IntrinsicInterval(value, std, source),
            "principal_x_px": IntrinsicInterval(503.0, 1.0, source),
            "principal_y_px": IntrinsicInterval(300.0, 0.0, "assumed"),
        }
        for value, std, source in values
    ]
    return MetricResult(model, (*intervals, {}), {}, True)


def test_deviations_are_counted_in_stated_sigmas():
    result = result_of([(1003.0, 1.0, "own"), (1011.0, 1.0, "own"), (1001.0, 10.0, "own")])
    scores = interval_scores(result, np.tile(K, (4, 1, 1)))
    assert scores.z[:3, 0] == pytest.approx([2.0, 10.0, 0.0], abs=1e-3)
    assert np.isnan(scores.z[3]).all()
    assert np.isnan(scores.z[:, 2]).all()
    assert scores.holding((0,)) == pytest.approx(1 / 3)
    assert scores.worst((1,)) == pytest.approx(3.0)
    assert scores.std_rel[2] == pytest.approx(10.0 / 1001.0)
    assert join_scores([scores, scores]).z.shape == (8, 3)


def test_focal_errors_are_of_the_geometric_mean_and_unknown_without_a_camera():
    found = np.array([np.diag([1001.0005, 1001.0005, 1.0]), np.zeros((3, 3))])
    errors = focal_errors_pct(found, np.array([K, K]))
    assert errors[0] == pytest.approx(0.0, abs=1e-4)
    assert np.isnan(errors[1])


def test_a_camera_is_named_by_a_wide_interval_a_borrowed_value_a_sentence_or_its_absence():
    values = [(1000.0, 1.0, "own"), (1000.0, 50.0, "own"), (1000.0, 1.0, "borrowed from the others")]
    result = result_of([*values, (1000.0, 1.0, "own")])
    result = replace(result, warnings=("the focal length of view 3 is not determined by its own matches",))
    assert [named(result, view) for view in range(5)] == [False, True, True, True, True]


def test_observations_are_taken_from_one_view_with_the_points_they_leave_alone():
    view, point = np.array([0, 1, 0, 1, 2]), np.array([0, 0, 1, 1, 1])
    tracks = Tracks(view, point, np.zeros((5, 2)), 3, 2)
    matched = Matched("small", tracks, (), np.tile([8, 6], (3, 1)), np.ones(3))
    less = without(matched, np.array([True, False, True, False, False]), 0).tracks
    assert less.view_index.tolist() == [1, 2]
    assert less.point_index.tolist() == [1, 1]


@pytest.mark.parametrize("cameras", ["shared", "per-image"])
def test_a_synthetic_trial_states_intervals_that_hold_its_truth(cameras):
    found = run_trial("shared" if cameras == "shared" else "per-image", 0)
    assert found is not None
    scores, result = found
    assert result.trusted
    assert len(scores.z) == (1 if cameras == "shared" else len(result.intrinsics))
    assert scores.worst() < 5.0
