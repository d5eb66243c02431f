"""The studies of chapter 5 in small: what they claim of the methods holds, and their tables are whole."""

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("poselib")
pytest.importorskip("pycolmap")

from thesisrecon.errors import StageFailure
from validation.studies import epipolar_methods
from validation.studies.epipolar_methods import (
    DEFAULT,
    GOLD,
    METHODS,
    Method,
    Setting,
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


def test_a_method_without_a_result_is_counted():
    def refuse(*_):
        raise StageFailure("no")

    result = measure(Method("none", refuse), [make_trial(Setting(1.0, 20), 0)], Setting(1.0, 20))
    assert (result.failures, result.trials) == (1, 1)
    assert np.isinf(result.rms_ratio)
    assert "1 none" in epipolar_methods.report([result])
