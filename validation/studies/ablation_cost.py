"""What a study costs beside its rows: ``python -m validation.studies.ablation_cost``.

Overhead: processor time of a study on one thread over that of calling the same task for the same rows in a
loop, the two in turn. Efficiency on two processes: the share of the time of both in which a row is being
carried out, from the call until it returns, start of the processes included. Ratios within one run, so that
other work on the machine touches them little. The exit code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from validation.ablation import Study, ablate
from validation.ablation.plan import plan_study
from validation.ablation.study import Place
from validation.ablation.tasks.fundamental import FundamentalOfCube
from validation.metrics.record import Metric, markdown_table

OVERHEAD_PCT, EFFICIENCY = 5.0, 0.85


def the_study(seeds: int) -> Study:
    """Rows of about a quarter of a second: shorter than most."""
    return Study(
        {"epipolar.threshold_px": [0.5, 2.0]},
        ["cube"],
        seeds=seeds,
        task=FundamentalOfCube(outliers=0.3, pairs=16),
    )


def direct_s(study: Study) -> float:
    """Processor time of the rows of a study, called one after the other."""
    rows, place = plan_study(study).rows, Place(Path(), Path())
    start = time.process_time()
    for row in rows:
        row.setting.task.run(row.setting.config, row.scene, row.seed, place)
    return time.process_time() - start


def studied_s(study: Study) -> float:
    """Processor time of the same rows as a study on one thread, from the plan to the last row on disk."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        ablate(study, folder, executor="local", threads=1)
        return time.process_time() - start


def check_overhead(seeds: int, rounds: int) -> Metric:
    """The median over rounds of what a study adds, in percent of the rows."""
    study = the_study(seeds)
    direct_s(study)
    ratios = sorted(100.0 * (studied_s(study) / direct_s(study) - 1.0) for _ in range(rounds))
    value = {"ours": ratios[len(ratios) // 2]}
    return Metric("study", "overhead over calling the task", "%", value, "ours", OVERHEAD_PCT)


def check_efficiency(seeds: int) -> Metric:
    """The share of the time of two processes in which they carry out rows."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        rows = ablate(the_study(seeds), folder, executor="processes", threads=2)
        elapsed = time.perf_counter() - start
    value = {"ours": sum(row.seconds for row in rows) / (2.0 * elapsed)}
    note = f"{len(rows)} rows in {elapsed:.0f} s"
    return Metric("study", "efficiency on 2 processes", "", value, "ours", EFFICIENCY, False, note)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both; 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.ablation_cost", description=__doc__)
    parser.add_argument("--seeds", type=int, default=8, help="of the overhead")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--long-seeds", type=int, default=60, help="of the efficiency")
    wishes = parser.parse_args(arguments)
    rows = [check_overhead(wishes.seeds, wishes.rounds), check_efficiency(wishes.long_seeds)]
    print(markdown_table(rows))
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
