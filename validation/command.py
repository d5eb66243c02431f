"""Command line of the validation: ``python -m validation report|check|ablate|study``.

``report`` and ``check`` run every stage and the references on the same inputs, ``ablate`` compares variants
and parameters, ``study`` runs one of the measurements of :mod:`validation.studies`.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

from thesisrecon.errors import StageFailure, counted
from thesisrecon.io._outputs import join_claim
from thesisrecon.runtime._signals import with_resume_advice
from validation.ablation import command as ablation
from validation.runs.page import write_pages
from validation.runs.processes import own_cores
from validation.runs.records import ReportOptions
from validation.runs.report import run_tasks
from validation.runs.results import Results, collect, read_gates, read_results, write_results
from validation.runs.scenes import load_images
from validation.runs.study import MODULES, OF_PAGES, report_progress, run_studies, run_study
from validation.stages import STAGES, available_scenes

MIN_SIDE_PX = 64
"""Smallest long side of depth maps, for the matching window."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command; exit code 0: success, 1: a missed gate or bound, 2: a wrong option."""
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["study"] and given[1:2] != ["all"]:
        return run_studies(given[1:])
    parsed = _parser().parse_args(given)
    if parsed.command == "ablate":
        return ablation.run_command(parsed)
    if parsed.command == "study":
        return run_all(parsed.out)
    try:
        options = _report_options(parsed)
        gates = read_gates()
        for name in options.folders:
            load_images(name, options)
    except (ValueError, StageFailure) as error:
        print(f"validation: {error}", file=sys.stderr)
        return 2
    try:
        with with_resume_advice("run the same command to start again"), join_claim(options.out) as outputs:
            outputs.require(["index.html", "results.json", "options.json"])
            judged = run_tasks(options, STAGES, _print_progress)
            results, earlier = collect(options, judged, gates), _last_results(options)
            write_results(options.out, results)
            page = write_pages(options, STAGES, judged, results, earlier)
    except ValueError as error:
        print(f"validation: {error}", file=sys.stderr)
        return 2
    if parsed.command == "check":
        _print_gates(results)
    broken = counted(len(results.broken) + len(results.missing), "gate")
    print(f"{broken} broken; the page is {page}")
    return int(parsed.command == "check" and bool(results.broken or results.missing))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m validation", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, words in (
        ("report", "Run stages and references and write pages, tables and results.json."),
        ("check", "Run what the gates need and print a line for each; exit code 1 if one is broken."),
    ):
        command = commands.add_parser(name, help=words, description=words)
        command.add_argument("-o", "--out", type=Path, required=name == "report", default=Path("out/check"))
        command.add_argument("--scenes", nargs="+", metavar="SCENE", help="default: all on this machine")
        command.add_argument("--stages", nargs="+", choices=list(STAGES), help="default: all")
        command.add_argument("--images", type=Path, help="folder of your own images")
        command.add_argument("--quick", action="store_true", help="few scenes and repetitions")
        command.add_argument("--seed", type=int, default=0)
        command.add_argument("--threads", type=int, default=len(own_cores()), help="number of parallel tasks")
        command.add_argument(
            "--resume", type=Path, help="folder of an earlier run whose references are reused"
        )
        command.add_argument("--time-limit", type=float, default=300.0, help="limit of one task in seconds")
        command.add_argument(
            "--max-side", type=int, default=0, metavar="PX", help="long side of depth maps (default: small)"
        )
    ablation.add_parser(commands)
    # One study has its own parser.
    help_text = "Run one study, or all; --list shows them."
    study = commands.add_parser("study", help=help_text, description=run_all.__doc__)
    study.add_argument("name", choices=["all"], help="all: every study, ablation and the report")
    study.add_argument("-o", "--out", type=Path, required=True, help="folder for the tables")
    return parser


def _report_options(parsed: argparse.Namespace) -> ReportOptions:
    """Return the options as a record; ``ValueError`` names what does not exist."""
    folders = {}
    if parsed.images is not None:
        if not parsed.images.is_dir():
            raise ValueError(f"the folder of images {parsed.images} does not exist")
        folders[parsed.images.resolve().name] = str(parsed.images.resolve())
    here = available_scenes(quick=parsed.quick)
    scenes = parsed.scenes or ([*folders] if folders else here)
    unknown = [s for s in scenes if s not in (*available_scenes(quick=False), *folders)]
    if unknown:
        raise ValueError(
            f"no scene is called {unknown[0]}; choose from {', '.join(available_scenes(quick=False))}"
        )
    if parsed.resume is not None and parsed.resume.resolve() == parsed.out.resolve():
        raise ValueError("--resume names another folder than --out, whose earlier results are removed")
    if parsed.threads < 1 or parsed.time_limit <= 0:
        raise ValueError("--threads and --time-limit must be positive")
    if parsed.max_side and parsed.max_side < MIN_SIDE_PX:
        raise ValueError(f"--max-side must be at least {MIN_SIDE_PX} px")
    return ReportOptions(
        out=parsed.out.resolve(),
        scenes=tuple(dict.fromkeys([*scenes, *folders])),
        stages=tuple(parsed.stages or STAGES),
        folders=folders,
        quick=parsed.quick,
        gates_only=parsed.command == "check",
        seed=parsed.seed,
        threads=min(parsed.threads, len(own_cores())),
        limit_s=parsed.time_limit,
        resume="" if parsed.resume is None else str(parsed.resume.resolve()),
        side_px=parsed.max_side,
    )


def _last_results(options: ReportOptions) -> Results | None:
    """Results of the last run in the output folder, else of the resumed one; None without either."""
    for folder in (options.out, *([Path(options.resume)] if options.resume else [])):
        try:
            return read_results(folder)
        except ValueError:
            continue
    return None


def _print_progress(line: str) -> None:
    if sys.stderr.isatty():
        print(line, file=sys.stderr, flush=True)


def _print_gates(results: Results) -> None:
    for row in results.rows:
        if row.limit is not None:
            sign = "<=" if row.direction == "at most" else ">="
            value = "none" if row.value is None else f"{row.value:.4g}"
            print(f"{row.verdict:8} {row.key}: {value} {sign} {row.limit:g} {row.unit}")
    for key in results.missing:
        why = [words for task, words in results.failures.items() if task.split("/")[:2] == key.split("/")[:2]]
        print(f"missed   {key}: no method reported this number{''.join(f' ({words})' for words in why[:1])}")


def run_all(out: Path) -> int:
    """Make every table of the documentation, each in its own folder: all studies with the options of
    the pages, all ablations, and the report. One that ends with an error does not end the others; the exit
    code is the largest.
    """
    runs: dict[str, Callable[[], int]] = {}
    for name in MODULES:
        for number, options in enumerate(OF_PAGES.get(name, [[]])):
            folder = out / (f"{name}-{number + 1}" if number else name)
            words = f"study {name} {' '.join(options)}".rstrip()
            runs[words] = partial(run_study, name, ["-o", str(folder), *options])
    for path in sorted(ablation.STUDIES.glob("*.toml")):
        runs[f"ablation {path.stem}"] = partial(main, ["ablate", path.stem, "-o", str(out / path.stem)])
    runs["report"] = partial(main, ["report", "-o", str(out / "report")])
    largest = 0
    for words, run in runs.items():
        report_progress(words)
        try:
            code = run()
        except Exception:
            traceback.print_exc()
            code = 1
        largest = max(largest, code)
    return largest
