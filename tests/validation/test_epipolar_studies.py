"""The studies of chapter 5 in small: what they claim of the methods holds, and their tables are whole."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("poselib")
pytest.importorskip("pycolmap")

from thesisrecon.errors import StageFailure
from validation.ablation.tasks.fundamental import measure_pair
from validation.runs.study import run_study
from validation.scenes.cube import cube_pairs, make_cube
from validation.studies import epipolar_methods
from validation.studies.epipolar_methods import (
    DEFAULT,
    GOLD,
    METHODS,
    NORMALISED,
    OWN,
    RAW,
    Method,
    Result,
    Setting,
    check_methods,
    make_trial,
    measure,
    run_methods,
)

BY_NAME = {m.name: m for m in METHODS}
CRITERIA = ("Sampson (5.4)", "epipolar distance (5.6)", "gold standard")


@pytest.fixture(scope="module")
def clean():
    """Every method at 1 px and 60 matches, 25 trials, by its label."""
    return {r.label: r for r in run_methods([Setting(1.0, 60)], METHODS, 25)}


def test_the_gold_standard_is_at_the_bound_and_nothing_is_far_below_it(clean):
    assert clean[GOLD].rms_ratio < 1.15
    assert clean[f"{DEFAULT}, 3 sigma"].rms_ratio < 1.15
    assert min(r.rms_ratio for r in clean.values()) > 0.85
    assert all(r.failures == 0 and r.time_ms > 0.0 for r in clean.values())


def test_normalised_pixels_are_better_than_raw_ones_and_a_criterion_better_than_both(clean):
    assert clean[GOLD].rms_ratio < clean[NORMALISED].rms_ratio < 0.5 * clean[RAW].rms_ratio
    assert clean[NORMALISED].rms_ratio == pytest.approx(clean["OpenCV FM_8POINT"].rms_ratio, rel=1e-3)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_both_parameterisations_reach_one_minimum(criterion):
    for seed in range(10):
        trial = make_trial(Setting(0.5, 50), seed)
        rows, orthonormal = (
            BY_NAME[f"{criterion}, {kind}"].fundamental(trial.xy1, trial.xy2, threshold_px=1.0, seed=0)
            for kind in ("thesis' rows", "orthonormal")
        )
        assert rows is not None
        assert orthonormal is not None
        assert min(np.linalg.norm(rows - s * orthonormal) for s in (1.0, -1.0)) < 1e-6


def test_wrong_matches_are_for_robust_methods_alone():
    setting = Setting(0.5, 100, 0.2)
    trial = make_trial(setting, 0)
    assert len(trial.xy1) == 100
    assert len(trial.exact1) == 80
    some = [BY_NAME[name] for name in (GOLD, "Algorithm 2, Sampson", "least median of squares", DEFAULT)]
    results = {r.label: r for r in run_methods([setting], some, 8)}
    assert GOLD not in results
    assert results[f"{DEFAULT}, 3 sigma"].rms_ratio < 1.4
    assert results["least median of squares"].rms_ratio < 2.5
    assert BY_NAME[GOLD].fundamental(trial.xy1, trial.xy2, threshold_px=1.0, seed=0) is not None
    assert measure(BY_NAME[GOLD], [trial], setting).rms_ratio > 5.0


def test_a_method_without_a_result_is_counted():
    def refuse(*_):
        raise StageFailure("no")

    result = measure(Method("none", refuse), [make_trial(Setting(1.0, 20), 0)], Setting(1.0, 20))
    assert (result.failures, result.trials) == (1, 1)
    assert np.isinf(result.rms_ratio)
    assert "1 none" in epipolar_methods.report([result])


def test_a_trial_without_a_result_misses_the_bound():
    setting = Setting(1.0, 20)
    all_found = Result(DEFAULT, setting, False, 1.0, 0.95, 1.0, 0, 10)
    for result, verdict in ((all_found, "reached"), (replace(all_found, failures=1), "missed")):
        assert [row.verdict for row in check_methods(setting, [result])] == [verdict]


def test_pairs_of_the_cube_share_more_than_a_face():
    sequence = make_cube()
    pairs = cube_pairs(sequence)
    assert 100 < len(pairs) < 27 * 26 / 2
    for pair in pairs:
        assert min(np.ptp(pair.X, axis=0)) > 0.5


def test_perfect_projections_give_perfect_epipolar_lines():
    for pair in cube_pairs(make_cube())[::40]:
        for method in OWN:
            F = method.fundamental(pair.xy1, pair.xy2, threshold_px=1.0, seed=0)
            assert measure_pair(F, pair)[0] < 1e-8, method.name


def test_the_command_states_if_the_bound_was_reached(capsys):
    base = ["--trials", "30", "--points", "100", "--noise", "0.5", "--wrong", "0"]
    assert run_study("epipolar-methods", [*base, "--methods", NORMALISED]) == 0
    missed = run_study("epipolar-methods", [*base, "--methods", GOLD])
    printed = capsys.readouterr().out
    assert printed.count("RMS (median)") == 2
    # With 30 trials only, the gold standard may miss its bound; the exit code is what the table states.
    assert missed == ("missed" in printed)
