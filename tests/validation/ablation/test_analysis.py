"""What is said of rows, and intervals, p-values and effect sizes against a hand, SciPy and simulations."""

import numpy as np
import pytest
from scipy import stats

from tests.validation.ablation.toy import Darts
from validation.ablation import Measure, Study, analyse, statistics
from validation.ablation.analysis import as_reported
from validation.ablation.plan import Plan, plan_study
from validation.ablation.run import Row, Rows


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
    cells = {c.variant: c.mean for c in analyse(rows).cells}
    assert cells["aim = 1"] / cells["unchanged"] == pytest.approx(2.0)
    assert cells["unchanged"] == pytest.approx(stats.gmean(np.arange(1.0, 21.0)))


def test_a_zero_counts_as_the_smallest_number_and_negative_ones_are_subtracted():
    ratio = darts(metrics=[Measure("miss", ratio=True)])
    rows = rows_of(ratio, lambda p: (p.seed + p.seed % 2) * (2.0 if p.variant == "aim = 1" else 1.0))
    assert as_reported(compared(rows, "aim = 1"))[0] == pytest.approx(2.0 ** (19 / 20))
    assert any("zeros of miss count as its smallest positive number, 2" in w for w in analyse(rows).warnings)
    rows = rows_of(ratio, lambda p: p.seed - 0.5 + (p.variant == "aim = 1"))
    assert not compared(rows, "aim = 1").ratio
    assert compared(rows, "aim = 1").interval.mean == 1.0
    assert any("compared by differences" in w for w in analyse(rows).warnings)


def survivors(plan, trial, *, better, give_up):
    """Rows of a method that fails where it would be worst, beside one that never does."""
    rng = np.random.default_rng(trial)
    hard = rng.normal(size=len(plan.rows))
    noise = {(p.variant, p.scene, p.seed): rng.normal() for p in plan.rows}
    level = {(p.scene, p.seed): hard[n] for n, p in enumerate(plan.rows)}
    own = {at[1:]: 0.3 * level[at[1:]] + v for at, v in noise.items() if at[0] == "aim = 1"}
    limit = np.quantile(list(own.values()), 1.0 - give_up)

    def value(p):
        at = p.scene, p.seed
        if p.variant == "aim = 1":
            return "too hard" if own[at] > limit else better * np.exp(own[at])
        return np.exp(0.3 * level[at] + noise[(p.variant, *at)])

    return rows_of(plan, value)


@pytest.mark.parametrize("sample", ["draws", "scenes"])
@pytest.mark.parametrize("better", [1.0, 0.95])
def test_a_method_that_gives_up_its_worst_rows_is_never_better(sample, better):
    more = {"draws": {}, "scenes": {"task": Boards(), "scenes": [*"abcdefghijkl"], "seeds": 2}}[sample]
    plan = plan_study(darts(metrics=[Measure("miss", ratio=True)], **more))
    found = [compared(survivors(plan, n, better=better, give_up=0.3), "aim = 1") for n in range(20)]
    assert all(c.fails > c.succeeds for c in found)
    assert "better" not in {c.verdict for c in found}
    mixed = "better where both succeed, fails more"
    assert {mixed, "fails more"} & {c.verdict for c in found}
    assert any(as_reported(c)[2] < 1.0 for c in found)  # Numbers alone would have said "better"


def test_failures_on_both_sides_are_decided_by_ranks():
    # "aim = 1" is better by one where both succeed; each fails alone on eight rows.
    fails = {"aim = 1": range(8), "unchanged": range(8, 16), "aim = 2": ()}

    def value(p):
        number = 0.1 * np.sin(len(p.variant) * p.seed) - (p.variant == "aim = 1")
        return "no luck" if p.seed in fails[p.variant] else number

    found = compared(rows_of(darts(), value), "aim = 1")
    assert (found.fails, found.succeeds, found.interval.pairs) == (8, 8, 4)
    assert found.verdict == "no difference shown"
    good = compared(
        rows_of(darts(), lambda p: "no" if p.seed < 9 and p.variant == "unchanged" else 1.0), "aim = 1"
    )
    assert (good.verdict, good.fails, good.succeeds) == ("fails less", 0, 9)


def test_infinite_errors_are_the_worst():
    plan = plan_study(darts(metrics=["miss"]))
    rows = [
        Row(*p[:5], {"miss": 1.0} if p.seed < 12 or p.variant != "aim = 1" else {}, "", 1.0, 1.0)
        for p in plan.rows
    ]
    found = compared(Rows(plan, tuple(rows)), "aim = 1")
    assert (found.fails, found.verdict) == (8, "fails more")
    ranks = {c.variant: c.rank for c in analyse(Rows(plan, tuple(rows))).cells}
    assert ranks == pytest.approx({"unchanged": 1.8, "aim = 1": 2.4, "aim = 2": 1.8})


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
    assert cell.median == 17.0
    assert "- (15 of 20 failed)" in str(analysis)
    assert "fails on 15 rows more and 0 fewer, p < 1e-4" in str(analysis)
    assert "| aim = 1 | a (15 seeds) | no luck |" in str(analysis)


def test_a_scene_without_truth_has_not_failed():
    class WithoutTruth(Darts):
        def unavailable(self, scene):
            return ("miss",) if scene == "b" else ()

    rows = rows_of(darts(scenes=["a", "b"], task=WithoutTruth()), lambda p: float(p.seed))
    cells = {(c.variant, c.measure.name): (c.rows, c.failed) for c in analyse(rows).cells}
    assert cells["aim = 1", "miss"] == (20, 0)
    assert cells["aim = 1", "score"] == (40, 0)


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
    found = statistics.paired_interval([np.arange(1.0, 6.0)], "draws")
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
    found, known = statistics.paired_interval([a, b], "draws"), stats.ttest_ind(a, -b, equal_var=False)
    assert found.mean == pytest.approx((a.mean() + b.mean()) / 2.0)
    assert found.p == pytest.approx(known.pvalue)
    low, high = known.confidence_interval(0.95)
    assert (2.0 * found.low, 2.0 * found.high) == pytest.approx((low, high))


def test_the_studentised_bootstrap_is_that_of_scipy():
    d = np.random.default_rng(3).exponential(size=statistics.STUDENTISED_FROM)
    t = statistics.resampled_t([[np.array([v]) for v in d]], resamples=20000)

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
    found = [statistics.paired_interval([rng.standard_t(3, size=count)], "draws") for _ in range(trials)]
    held = sum(f.low <= 0.0 <= f.high for f in found)
    # Two standard deviations of a count of trials that each hold in 95 of 100.
    assert held >= 0.95 * trials - 2.0 * np.sqrt(trials * 0.05 * 0.95)
    assert sum(f.p > 0.05 for f in found) == pytest.approx(held, abs=2)


@pytest.mark.parametrize("count", [9, 40])
def test_signed_ranks_are_those_of_scipy(count):
    d = np.random.default_rng(count).normal(0.4, 1.0, count)
    mean, p = statistics.signed_rank_test([np.array([v]) for v in d])
    known = stats.wilcoxon(d, method="exact" if count < 12 else "asymptotic", correction=False)
    assert p == pytest.approx(known.pvalue, rel=1e-9 if count < 12 else 1e-2)
    ranks = stats.rankdata(np.abs(d))
    assert mean == pytest.approx(np.sum(np.sign(d) * ranks) / count**2)
    k = np.argmax(np.abs(d))
    d[k] = np.copysign(np.inf, d[k])
    assert statistics.signed_rank_test([np.array([v]) for v in d]) == pytest.approx((mean, p))


def test_signed_ranks_of_scenes_keep_the_level():
    rng, trials = np.random.default_rng(8), 400
    for scenes in (6, 20):
        found = []
        for _ in range(trials):
            shift = rng.normal(size=scenes)  # Rows of one scene have an error in common
            found.append(
                statistics.signed_rank_test([s + 0.3 * rng.normal(size=rng.integers(1, 5)) for s in shift])[1]
            )
        assert np.mean(np.array(found) <= 0.05) <= 0.05 + 2.0 * np.sqrt(0.05 * 0.95 / trials)


def test_success_is_compared_exactly():
    # Six rows on which only one fails, one on which only the other does: 2 (1 + 7) / 2^7.
    assert statistics.sign_test(np.array([1.0] * 6 + [-1.0] + [0.0] * 9)) == pytest.approx(0.125)
    assert np.isnan(statistics.sign_test(np.zeros(3)))


def test_p_falls_below_what_resamples_resolve():
    found = []
    for seed in range(40):
        d = np.random.default_rng(seed).normal(1.8, 1.0, 20)
        found.append(np.log(statistics.paired_interval([d], "draws").p / stats.ttest_1samp(d, 0.0).pvalue))
    assert np.median(np.abs(found)) <= np.log(5.0)
    assert max(np.exp(found)) <= 1e4
    small = statistics.paired_interval([np.random.default_rng(1).normal(3.0, 1.0, 20)], "draws").p
    assert 0.0 < small < 1e-6


def test_holm_by_hand():
    assert statistics.holm([0.01, 0.04, 0.03, float("nan")])[:3] == pytest.approx([0.03, 0.06, 0.06])
    assert np.isnan(statistics.holm([0.01, float("nan")])[1])
    assert statistics.holm([0.6, 0.7]) == pytest.approx([1.0, 1.0])
    assert statistics.holm([]) == []


def test_the_front_is_not_dominated():
    cost, loss = np.array([1.0, 2.0, 3.0, 2.0, np.nan]), np.array([5.0, 3.0, 4.0, 3.0, 0.0])
    assert statistics.on_front(cost, loss).tolist() == [True, True, False, True, False]
