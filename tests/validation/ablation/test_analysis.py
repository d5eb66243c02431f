"""What is said of rows: planted effects are found, others are not, failures are counted."""

import csv

import numpy as np
import pytest

from tests.validation.ablation.toy import Darts
from validation.ablation import Measure, Study, analyse
from validation.ablation.analysis import as_reported
from validation.ablation.page import write_tables
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


def test_scenes_with_parts_are_a_sample_and_the_table_names_it():
    level = {name: n for n, name in enumerate(BOARDS)}
    rows = on_boards(
        BOARDS, lambda p: 9.0 + level[p.scene] + (2.0 + 0.1 * level[p.scene]) * (p.variant == "aim = 1")
    )
    found = compared(rows, "aim = 1")
    assert (found.verdict, found.interval.count, found.interval.pairs) == ("worse", 6, 18)
    assert "] 6 scenes" in str(analyse(rows))
    assert compared(rows, "aim = 2").verdict == "no difference shown"


def test_only_pairs_count_and_failures_are_reported():
    rows = rows_of(darts(), lambda p: "no luck" if p.variant == "aim = 1" and p.seed < 15 else float(p.seed))
    analysis = analyse(rows)
    cell = next(c for c in analysis.cells if (c.variant, c.measure.name) == ("aim = 1", "miss"))
    assert (cell.rows, cell.failed) == (5, 15)
    assert not cell.on_front
    assert compared(rows, "aim = 1").interval.pairs == 5
    # On easier rows its mean would be another one; its rank counts what it failed at.
    ranks = {c.variant: c.rank for c in analysis.cells if c.measure.name == "miss"}
    assert ranks["aim = 1"] == pytest.approx((15 * 3.0 + 5 * 2.0) / 20)
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


def test_tables_hold_every_row_and_comparison(tmp_path):
    rows = rows_of(
        darts(conditions={"task.spread": [1.0, 2.0]}), lambda p: "gone" if p.seed == 3 else float(p.seed)
    )
    written = {path.name: path for path in write_tables(analyse(rows), tmp_path)}
    with written["rows.csv"].open(encoding="utf-8") as file:
        stated = list(csv.DictReader(file))
    assert len(stated) == 3 * 2 * 20
    assert stated[0]["axis:task.spread"] == "spread = 1"
    assert {r["failure"] for r in stated} == {"", "gone"}
    assert {r["miss"] for r in stated if r["failure"]} == {""}
    text = written["tables.md"].read_text()
    assert text.startswith("Commit ")
    assert "| miss, cm | spread = 1 | spread = 2 | cost, s |" in text
    with written["comparisons.csv"].open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 2 * 2 * 2
