"""``python -m validation ablate STUDY.toml -o OUT``."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from signal import SIGINT

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from thesisrecon.errors import UsageError, counted
from thesisrecon.io._files import printable
from thesisrecon.runtime._signals import CODES, with_resume_advice
from validation.ablation.analysis import analyse, failures_of
from validation.ablation.page import write_analysis
from validation.ablation.plan import Plan, plan_study, read_study
from validation.ablation.run import ProgressCallback, Rows, State, ablate, parts_of, read_rows

KEPT = "run the same command to continue from the finished rows in {}"
SHOWN = 20
"""Most failures that are printed."""
STUDIES = Path(__file__).parent / "studies"


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command ``ablate`` among the others."""
    text = "Compare variants and parameters over scenes and seeds, with intervals."
    command = commands.add_parser("ablate", help=text, description=text)
    shipped = ", ".join(sorted(p.stem for p in STUDIES.glob("*.toml")))
    command.add_argument(
        "study", metavar="STUDY", help=f"TOML file, or the name of a shipped study: {shipped}"
    )
    command.add_argument(
        "-o", "--out", type=Path, required=True, help="output folder; a rerun continues from its rows"
    )
    command.add_argument("--executor", default="processes", help="local or processes (default)")
    command.add_argument(
        "--threads", type=int, help="number of parallel rows (default: number of processors)"
    )
    command.add_argument("--plan", action="store_true", help="print the plan only")
    command.add_argument("--read", action="store_true", help="only analyse the rows in OUT")


def run_command(parsed: argparse.Namespace) -> int:
    """Run a study; exit code 0: done, 2: wrong option, 3: every row failed, 130: interrupted."""
    try:
        study = read_study(_path(parsed.study))
        if parsed.plan:
            print(plan_summary(plan_study(study)))
            return 0
        if parsed.read:
            rows = read_rows(study, parsed.out)
        else:
            with with_resume_advice(KEPT.format(parsed.out)), progress_view() as on_progress:
                rows = ablate(
                    study,
                    parsed.out,
                    executor=parsed.executor,
                    threads=parsed.threads,
                    on_progress=on_progress,
                )
        page = write_analysis(analyse(rows), parsed.out)
    except UsageError as error:
        print(f"ablate: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print("; ".join(("ablate: interrupted", *map(str, stop.args))), file=sys.stderr)
        return CODES[SIGINT]
    print(_summary(rows, page))
    return 3 if rows and all(r.failure for r in rows) else 0


def _path(name: str) -> Path:
    shipped = STUDIES / f"{name}.toml"
    return shipped if not Path(name).exists() and shipped.is_file() else Path(name)


def plan_summary(plan: Plan) -> str:
    """Return the size of a study: rows and shared steps."""
    unique = list({row.key: row for row in plan.rows}.values())
    shared = Counter(part.step for part in parts_of(unique) if part.step)
    steps = ", ".join(f"{step} ({count})" for step, count in shared.items())
    parts = [
        f"{counted(len(plan.variants), 'variant')}: {'; '.join(v.name for v in plan.variants)}",
        f"baseline: {plan.baseline}",
        f"{len(plan.conditions)} conditions" if len(plan.conditions) > 1 else "",
        f"{counted(len({r.scene for r in unique}), 'scene')}, {counted(len(plan.seeds), 'seed')}: "
        f"{counted(len(unique), 'row')}",
        f"computed once for several rows: {steps}" if steps else "",
    ]
    return "\n".join(part for part in parts if part)


def _summary(rows: Rows, page: Path) -> str:
    failed = sum(bool(r.failure) for r in rows)
    found = [f"{f.variant} failed on {f.scene}: {f.why}" for f in failures_of(rows)]
    more = [f"... and {len(found) - SHOWN} more on the page"] if len(found) > SHOWN else []
    text = counted(len(rows), "row") + f", {failed} of them failed" * bool(failed)
    return "\n".join([*map(printable, found[:SHOWN]), *more, f"{text}; the page is {page}"])


@contextmanager
def progress_view() -> Iterator[ProgressCallback]:
    """Show finished and failed rows and the estimated remaining time."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=None)

        def report(state: State) -> None:
            steps = f"{state.steps_done} of {state.steps} shared steps" if state.steps else ""
            text = f"{steps}, {state.failed} failed" if state.failed else steps
            progress.update(task, total=state.total, completed=state.done, description=text)

        yield report
