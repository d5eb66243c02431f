"""``python -m validation report|check``: every stage of ours beside the references, on the same inputs;
``ablate``: variants and parameters of ours beside each other."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from thesisrecon.errors import StageFailure, counted
from thesisrecon.runtime.signals import advised
from validation.ablation import command as ablation
from validation.harness.canaries import ask_canaries
from validation.harness.gates import read_gates
from validation.harness.page import write_pages
from validation.harness.process import own_cores
from validation.harness.records import Wishes
from validation.harness.results import Results, collect, compare, read_results, write_results
from validation.harness.scenes import load_photographs
from validation.harness.schedule import run_tasks
from validation.harness.stages import STAGES, available_scenes

LEAST_SIDE_PX = 64
"""Of depth maps: in smaller ones there is no window to match."""


def main(arguments: list[str] | None = None) -> int:
    """0: done, all gates hold; 1: a gate is broken (``check``); 2: a wrong wish."""
    parser = _parser()
    told = parser.parse_args(arguments)
    if told.command == "ablate":
        return ablation.run_command(told)
    try:
        wishes = _wishes(told)
        other = read_results(told.against) if getattr(told, "against", None) else None
        gates = read_gates()
        for name in wishes.folders:
            load_photographs(name, wishes)
    except (ValueError, StageFailure) as error:
        print(f"validation: {error}", file=sys.stderr)
        return 2
    with advised("the same command begins again"):
        for words in ask_canaries(wishes).values():
            print(f"validation: {words}", file=sys.stderr)
        try:
            judged = run_tasks(wishes, STAGES, _tell)
        except ValueError as error:
            print(f"validation: {error}", file=sys.stderr)
            return 2
    results = collect(wishes, judged, gates)
    write_results(wishes.out, results)
    changes = None if other is None else compare(other, results)
    page = write_pages(wishes, STAGES, judged, results, changes)
    if told.command == "check":
        _print_gates(results)
    broken = counted(len(results.broken) + len(results.missing), "gate")
    print(f"{broken} broken; the page is {page}")
    return int(told.command == "check" and bool(results.broken or results.missing))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m validation", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, words in (
        ("report", "Run stages and references and write pages, tables and results.json."),
        ("check", "Only what the gates need, a line for each; exit code 1 where one is broken."),
    ):
        command = commands.add_parser(name, help=words, description=words)
        command.add_argument("-o", "--out", type=Path, required=name == "report", default=Path("out/check"))
        command.add_argument("--scenes", nargs="+", metavar="SCENE", help="by default all that are here")
        command.add_argument("--stages", nargs="+", choices=list(STAGES), help="by default all")
        command.add_argument("--images", type=Path, help="a folder of photographs of your own")
        command.add_argument("--quick", action="store_true", help="few scenes and few repetitions")
        command.add_argument("--seed", type=int, default=0)
        command.add_argument("--threads", type=int, default=len(own_cores()), help="tasks at a time")
        command.add_argument(
            "--resume", type=Path, help="the folder of a like run, whose references are taken as they are"
        )
        command.add_argument(
            "--methods", nargs="+", metavar="METHOD", help="of ours, those that run again with --resume"
        )
        command.add_argument("--time-limit", type=float, default=300.0, help="seconds for one task")
        command.add_argument(
            "--max-side", type=int, default=0, metavar="PX", help="long side of depth maps, by default small"
        )
        if name == "report":
            command.add_argument("--against", type=Path, help="the folder of another report, to compare with")
    ablation.add_parser(commands)
    return parser


def _wishes(told: argparse.Namespace) -> Wishes:
    """The wishes of the command line; ``ValueError`` names what is not there."""
    folders = {}
    if told.images is not None:
        if not told.images.is_dir():
            raise ValueError(f"there is no folder of photographs {told.images}")
        folders[told.images.resolve().name] = str(told.images.resolve())
    here = available_scenes(quick=told.quick)
    scenes = told.scenes or ([*folders] if folders else here)
    unknown = [s for s in scenes if s not in (*available_scenes(quick=False), *folders)]
    if unknown:
        raise ValueError(
            f"no scene is called {unknown[0]}; here are {', '.join(available_scenes(quick=False))}"
        )
    if told.methods and told.resume is None:
        raise ValueError("--methods says what runs again with --resume: name the folder of the run before")
    if told.threads < 1 or told.time_limit <= 0:
        raise ValueError("--threads and --time-limit are more than zero")
    if told.max_side and told.max_side < LEAST_SIDE_PX:
        raise ValueError(f"--max-side is at least {LEAST_SIDE_PX} px")
    return Wishes(
        out=told.out.resolve(),
        scenes=tuple(dict.fromkeys([*scenes, *folders])),
        stages=tuple(told.stages or STAGES),
        folders=folders,
        quick=told.quick,
        gates_only=told.command == "check",
        seed=told.seed,
        threads=min(told.threads, len(own_cores())),
        limit_s=told.time_limit,
        methods=tuple(told.methods or ()),
        resume="" if told.resume is None else str(told.resume.resolve()),
        side_px=told.max_side,
    )


def _tell(line: str) -> None:
    """Progress, where somebody looks."""
    if sys.stderr.isatty():
        print(line, file=sys.stderr, flush=True)


def _print_gates(results: Results) -> None:
    for row in results.rows:
        if row.limit is not None:
            sign = "<=" if row.direction == "at most" else ">="
            value = "nothing" if row.value is None else f"{row.value:.4g}"
            print(f"{row.verdict:8} {row.key}: {value} {sign} {row.limit:g} {row.unit}")
    for key in results.missing:
        why = [words for task, words in results.failures.items() if task.split("/")[:2] == key.split("/")[:2]]
        print(f"missed   {key}: nobody told this number{''.join(f' ({words})' for words in why[:1])}")
