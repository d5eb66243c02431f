"""What is said of rows, and intervals, p-values and effect sizes against a hand, SciPy and simulations."""

import numpy as np
import pytest
from scipy import stats

from tests.validation.ablation.toy import Darts
from validation.ablation import Measure, Study, analyse
from validation.ablation.analysis import as_reported
from validation.ablation.plan import Plan, plan_study
from validation.ablation.run import Row, Rows
from validation.ablation.statistics import STUDENTISED_FROM, holm, on_front, paired_interval, resampled_t


def rows_of(study, value):
    """Rows without running: ``value(planned row)`` is a number, or the reason why there is none."""
    plan, rows = study if isinstance(study, Plan) else plan_study(study), []
    for p in plan.rows:
        found = value(p)
        failed = isinstance(found, str)
        metrics = {} if failed else {"miss": found, "score": -found}
        reason = found if failed else ""
        cost = 2.0 + len(p.variant)
        rows.append(Row(p.key, p.variant, p.condition, p.scene, p.seed, metrics, reason, 1.0, cost))
    return Rows(plan, tuple(rows))


def darts(**more):
    stated = {"scenes": ["a"], "seeds": 20, "task": Darts()}
    return Study({"task.aim": [1.0, 2.0]}, **{**stated, **more})


def compared(rows, variant, measure="miss"):
    found = analyse(rows).comparisons
    return next(c for c in found if (c.variant, c.measure.name) == (variant, measure))


def test_a_planted_effect_of_one_deviation_is_found_and_nothing_else():
    found, false, trials = 0, 0, 100
    plan = plan_study(darts(metrics=["miss"]))
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        level = 10.0 * rng.normal(size=20)
        noise = {(p.variant, p.seed): rng.normal() for p in plan.rows}

        def value(p, level=level, noise=noise):
            # The deviation of a difference of two draws is sqrt 2.
            planted = np.sqrt(2.0) * (p.variant == "aim = 2")
            return float(level[p.seed] + noise[p.variant, p.seed] + planted)

        rows = rows_of(plan, value)
        found += compared(rows, "aim = 2").verdict == "worse"
        false += compared(rows, "aim = 1").verdict != "no difference shown"
    assert found >= 0.95 * trials
    assert false <= 0.05 * trials + 2


def test_quotients_where_all_values_allow_them():
    ratio = darts(metrics=[Measure("miss", ratio=True)])
    rows = rows_of(ratio, lambda p: (1.0 + p.seed) * (2.0 if p.variant == "aim = 1" else 1.0))
    found = compared(rows, "aim = 1")
    assert found.ratio
    assert as_reported(found)[0] == pytest.approx(2.0)
    with_zero = rows_of(ratio, lambda p: float(p.seed) + (p.variant == "aim = 1"))
    assert not compared(with_zero, "aim = 1").ratio
    assert compared(with_zero, "aim = 1").interval.mean == 1.0


class Boards(Darts):
    """Darts on boards that are scenes; "a#1" is a part of the board "a"."""

    sample = "scenes"

    def scene_of(self, scene):
        return scene.partition("#")[0]


BOARDS = [f"{name}{part}" for name in "abcdef" for part in ("", "#1", "#2")]


def on_boards(scenes, value, *, ratio=False):
    study = darts(task=Boards(), scenes=scenes, seeds=3, metrics=[Measure("miss", ratio=ratio)])
    return rows_of(study, value)


def test_seeds_and_parts_of_a_scene_are_no_sample_of_scenes():
    rows = on_boards(BOARDS[:6], lambda p: 1.0 + 0.1 * np.sin(9.0 * p.seed) + (p.variant == "aim = 1"))
    found = compared(rows, "aim = 1")
    assert found.interval.mean == pytest.approx(1.0)
    assert (found.verdict, found.interval.count) == ("no sample", 2)
    assert "fewer than 3 scenes are no sample" in analyse(rows).warnings[0]
    assert "[" not in str(analyse(rows)).split("warning")[-1].partition("\n\n")[2]


def test_only_pairs_count_and_failures_are_reported():
    rows = rows_of(darts(), lambda p: "no luck" if p.variant == "aim = 1" and p.seed < 15 else float(p.seed))
    analysis = analyse(rows)
    cell = next(c for c in analysis.cells if (c.variant, c.measure.name) == ("aim = 1", "miss"))
    assert (cell.rows, cell.failed) == (5, 15)
    assert not cell.on_front
    assert compared(rows, "aim = 1").interval.pairs == 5
    assert "17 (15 of 20 failed)" in str(analysis)
    assert "| aim = 1 | a (15 seeds) | no luck |" in str(analysis)


def test_each_step_of_a_ladder_is_also_compared_with_the_one_before():
    ladder = darts(mode="ladder", start="bottom")
    height = {"bottom": 5.0, "aim = 1": 3.0, "aim = 2": 2.5}
    analysis = analyse(rows_of(ladder, lambda p: height[p.variant] + 0.1 * np.sin(p.seed * len(p.variant))))
    steps = {c.variant: c for c in analysis.steps if c.measure.name == "miss"}
    assert (steps["aim = 2"].against, steps["aim = 1"].against) == ("aim = 1", "bottom")
    assert steps["aim = 2"].interval.mean == pytest.approx(-0.5, abs=0.1)
    against = {c.variant: c for c in analysis.comparisons if c.measure.name == "miss"}
    assert against["aim = 2"].interval.mean == pytest.approx(-2.5, abs=0.1)


def test_five_differences_by_hand():
    # 1 2 3 4 5: mean 3, variance 2.5, standard error sqrt(2.5 / 5), t = 4.2426 with 4 degrees of freedom,
    # whose 97.5 % quantile is 2.7764; Hedges' factor 1 - 3 / 15.
    found = paired_interval([np.arange(1.0, 6.0)], "draws")
    assert found.mean == 3.0
    assert found.low == pytest.approx(3.0 - 2.7764 * 0.70711, abs=1e-4)
    assert found.high == pytest.approx(3.0 + 2.7764 * 0.70711, abs=1e-4)
    assert found.p == pytest.approx(0.0132, abs=1e-4)
    assert found.effect == pytest.approx(3.0 / 1.58114 * 0.8, abs=1e-4)
    assert (found.pairs, found.sample, found.count) == (5, "draws", 5)


def test_two_scenes_are_welch():
    # The mean of two means has the standard error and the freedom of Welch's test of their difference.
    rng = np.random.default_rng(2)
    a, b = rng.normal(1.0, 1.0, 5), rng.normal(2.0, 3.0, 7)
    found, known = paired_interval([a, b], "draws"), stats.ttest_ind(a, -b, equal_var=False)
    assert found.mean == pytest.approx((a.mean() + b.mean()) / 2.0)
    assert found.p == pytest.approx(known.pvalue)
    low, high = known.confidence_interval(0.95)
    assert (2.0 * found.low, 2.0 * found.high) == pytest.approx((low, high))


def test_the_studentised_bootstrap_is_that_of_scipy():
    d = np.random.default_rng(3).exponential(size=STUDENTISED_FROM)
    t = resampled_t([[np.array([v]) for v in d]], resamples=20000)

    def statistic(x, axis=-1):
        return (x.mean(axis=axis) - d.mean()) / (x.std(axis=axis, ddof=1) / np.sqrt(x.shape[axis]))

    known = stats.bootstrap(
        (d,), statistic, n_resamples=20000, rng=np.random.default_rng(4), method="percentile"
    )
    for q in (0.5, 0.9, 0.95):
        assert np.quantile(t, q) == pytest.approx(
            np.quantile(np.abs(known.bootstrap_distribution), q), rel=0.04
        )


@pytest.mark.parametrize("count", [5, 20])
def test_at_most_five_per_cent_of_null_effects_are_reported(count):
    rng, trials = np.random.default_rng(7), 400
    found = [paired_interval([rng.standard_t(3, size=count)], "draws") for _ in range(trials)]
    held = sum(f.low <= 0.0 <= f.high for f in found)
    # Two standard deviations of a count of trials that each hold in 95 of 100.
    assert held >= 0.95 * trials - 2.0 * np.sqrt(trials * 0.05 * 0.95)
    assert sum(f.p > 0.05 for f in found) == pytest.approx(held, abs=2)


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, float("nan")])[:3] == pytest.approx([0.03, 0.06, 0.06])
    assert np.isnan(holm([0.01, float("nan")])[1])
    assert holm([0.6, 0.7]) == pytest.approx([1.0, 1.0])
    assert holm([]) == []


def test_the_front_is_not_dominated():
    cost, loss = np.array([1.0, 2.0, 3.0, 2.0, np.nan]), np.array([5.0, 3.0, 4.0, 3.0, 0.0])
    assert on_front(cost, loss).tolist() == [True, True, False, True, False]
