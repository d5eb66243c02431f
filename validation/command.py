"""Command line of the validation: ``python -m validation report|check|limits|ablate|study|layout``.

``report`` and ``check`` run every stage and the references on the same inputs, ``limits`` moves the gates to
what they measured, ``ablate`` compares variants and parameters, ``study`` runs one of the measurements of
:mod:`validation.studies`, and ``layout`` brings public data sets into the form that all of them read.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from signal import SIGINT

from thesisrecon.errors import StageFailure, UsageError, counted
from thesisrecon.io._files import printable
from thesisrecon.io._outputs import join_claim
from thesisrecon.runtime._signals import CODES, with_resume_advice
from validation.ablation.analysis import analyse, compare_runs, failures_of
from validation.ablation.page import write_analysis
from validation.ablation.plan import STUDIES, Plan, plan_study, read_study
from validation.ablation.run import Rows, ablate, parts_of, read_earlier_rows, read_rows
from validation.runs.limits import move_limits, read_runs
from validation.runs.models import report_models
from validation.runs.page import write_pages
from validation.runs.processes import own_cores
from validation.runs.records import ReportOptions, load_images
from validation.runs.report import run_tasks
from validation.runs.results import Gate, Results, collect, read_gates, write_results
from validation.runs.study import MODULES, OF_PAGES, progress_lines, report_progress, run_studies, run_study
from validation.scenes.layout import SETS, lay_out
from validation.stages import STAGES, available_scenes

KEPT = "run the same command to continue from the finished rows in {}"
SHOWN = 20  # Most failures of an ablation that are printed
MIN_SIDE_PX = 64  # Smallest long side of depth maps, for the matching window


def main(arguments: list[str] | None = None) -> int:
    """Run the command; exit code 0: success, 1: a missed gate or bound, 2: a wrong option."""
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["study"] and given[1:2] != ["all"]:
        return run_studies(given[1:])
    parsed = _parser().parse_args(given)
    if parsed.command == "ablate":
        return run_ablation(parsed)
    if parsed.command == "layout":
        return _lay_out(parsed)
    if parsed.command == "study":
        return run_all(parsed.out)
    if parsed.command == "limits":
        return _move_limits(parsed)
    if parsed.command == "report" and (parsed.model or parsed.reference):
        return _report_models(parsed)
    try:
        options, gates = _report_options(parsed), read_gates()
        for name in options.folders:
            load_images(name, options)
        with with_resume_advice("run the same command to start again"), join_claim(options.out) as outputs:
            outputs.require(["index.html", "results.json", "options.json"])
            judged = run_tasks(options, STAGES, progress_lines())
            results = collect(options, judged, gates)
            write_results(options.out, results)
            page = write_pages(options, STAGES, judged, results)
    except (ValueError, StageFailure) as error:
        print(f"validation: {error}", file=sys.stderr)
        return 2
    if parsed.command == "check":
        _print_gates(results, gates)
    broken = counted(len(results.broken) + len(results.missing), "gate")
    print(f"{broken} broken; the page is {page}")
    if parsed.command != "check":
        return 0
    tested = sum(row.limit is not None for row in results.rows) + len(results.missing)
    print(f"{tested} of {len(gates)} gates were judged" + ("" if tested else ": that is no check"))
    if parsed.update:
        move_limits(read_runs([options.out]), write=True)
    return int(not tested or bool(results.broken or results.missing))


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
        command.add_argument("--time-limit", type=float, default=300.0, help="processor seconds of one task")
        if name == "report":
            text = "report an existing model (of any format that thesisrecon compare reads), and run nothing"
            command.add_argument("--model", action="append", metavar="NAME=PATH", default=[], help=text)
            text = "what the models are compared with: true cameras, or one more model"
            command.add_argument("--reference", metavar="[NAME=]PATH", help=text)
        if name == "check":
            text = "show and write the measured values and limits that this run moves"
            command.add_argument("--update", action="store_true", help=text)
        command.add_argument(
            "--max-side", type=int, default=0, metavar="PX", help="long side of depth maps (default: small)"
        )
    words = "Show how results of check and report (other seeds, processors, commits) move the limits."
    command = commands.add_parser("limits", help=words, description=words)
    command.add_argument("runs", nargs="+", type=Path, metavar="OUT", help="their folders")
    command.add_argument("--write", action="store_true", help="change validation/gates.toml")
    _add_ablate(commands)
    text = "Lay out a public data set as it was downloaded, for every command that takes a folder of images."
    sets = "; ".join(f"{name}: {one.about}" for name, one in SETS.items())
    layout = commands.add_parser("layout", help=text, description=f"{text} {sets}.")
    layout.add_argument("name", choices=list(SETS), metavar="SET", help=", ".join(SETS))
    layout.add_argument("folder", type=Path, help="folder of a scene of the download")
    layout.add_argument("-o", "--out", type=Path, required=True, help="new folder of images and true cameras")
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
    known = available_scenes(quick=False)
    scenes = parsed.scenes or ([*folders] if folders else available_scenes(quick=parsed.quick))
    if unknown := [s for s in scenes if s not in (*known, *folders)]:
        raise ValueError(f"no scene is called {unknown[0]}; choose from {', '.join(known)}")
    if parsed.resume is not None and parsed.resume.resolve() == parsed.out.resolve():
        raise ValueError("--resume names another folder than --out, whose earlier results are removed")
    if parsed.threads < 1 or parsed.time_limit <= 0:
        raise ValueError("--threads and --time-limit must be positive")
    if parsed.max_side and parsed.max_side < MIN_SIDE_PX:
        raise ValueError(f"--max-side must be at least {MIN_SIDE_PX} px")
    return ReportOptions(
        parsed.out.resolve(),
        tuple(dict.fromkeys([*scenes, *folders])),
        tuple(parsed.stages or STAGES),
        folders,
        parsed.quick,
        gates_only=parsed.command == "check",
        seed=parsed.seed,
        threads=min(parsed.threads, len(own_cores())),
        limit_s=parsed.time_limit,
        resume="" if parsed.resume is None else str(parsed.resume.resolve()),
        side_px=parsed.max_side,
    )


def _report_models(parsed: argparse.Namespace) -> int:
    """Report existing models; exit code 2 for a model that cannot be read or compared."""
    try:
        if not parsed.model or not parsed.reference:
            raise UsageError("a report of models needs --model NAME=PATH, once or more, and --reference PATH")
        models = [_named(word) for word in parsed.model]
        if len(dict(models)) < len(models):
            raise UsageError(f"two models are called {Counter(n for n, _ in models).most_common(1)[0][0]!r}")
        page = report_models(dict(models), _named(parsed.reference), parsed.out.resolve())
    except UsageError as error:
        print(f"validation: {error}", file=sys.stderr)
        return 2
    print(f"{counted(len(models), 'model')} compared; the page is {page}")
    return 0


def _move_limits(parsed: argparse.Namespace) -> int:
    """Show, and with --write change, the limits of gates; exit code 2 for a folder without results."""
    try:
        move_limits(read_runs(parsed.runs), write=parsed.write)
    except ValueError as error:
        print(f"validation: {error}", file=sys.stderr)
        return 2
    return 0


def _lay_out(parsed: argparse.Namespace) -> int:
    """Lay out a download; exit code 2 if it lacks a part."""
    try:
        scene = lay_out(parsed.name, parsed.folder, parsed.out)
    except (UsageError, ValueError) as error:
        print(f"validation: {error}", file=sys.stderr)
        return 2
    print(f"{counted(len(scene.image_paths), 'image')}, {int(scene.known.sum())} with a camera: {parsed.out}")
    return 0


def _named(word: str) -> tuple[str, Path]:
    """Name and path of NAME=PATH, or of a path with its own name."""
    name, equals, path = word.partition("=")
    return (name, Path(path)) if equals and name else (Path(word).name, Path(word))


def _print_gates(results: Results, gates: Mapping[str, Gate]) -> None:
    for row in results.rows:
        if row.limit is not None:
            sign = "<=" if row.direction == "at most" else ">="
            value = "none" if row.value is None else f"{row.value:.4g}"
            more = " (better than measured: show the change with --update)" * (row.verdict == "moved")
            print(f"{row.verdict:8} {row.key}: {value} {sign} {row.limit:g} {row.unit}{more}")
    for key in results.missing:
        why = [words for task, words in results.failures.items() if task.split("/")[:2] == key.split("/")[:2]]
        print(f"missed   {key}: no method reported this number{''.join(f' ({words})' for words in why[:1])}")
    for key in results.not_run:
        print(f"not run  {key}: --quick leaves its method out")
    judged = {*(row.key for row in results.rows), *results.missing, *results.not_run}
    left = Counter(key.rpartition("/")[0] for key in gates if key not in judged)
    here = available_scenes(quick=False)
    for place, count in left.items():
        scene = place.partition("/")[2]
        reason = "this run leaves it out" if scene in here else "its images are not on this machine"
        print(f"not run  {place}, {counted(count, 'gate')}: {reason}")


def _add_ablate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The command ``ablate`` among the others."""
    text = "Compare variants and parameters over scenes and seeds, with intervals."
    command = commands.add_parser("ablate", help=text, description=text)
    shipped = ", ".join(sorted(p.stem for p in STUDIES.glob("*.toml")))
    text = f"TOML file, or the name of a shipped study: {shipped}"
    command.add_argument("study", metavar="STUDY", help=text)
    text = "output folder; a rerun continues from its rows"
    command.add_argument("-o", "--out", type=Path, required=True, help=text)
    text = "local, processes (default) or dask://HOST:PORT, whose workers see OUT"
    command.add_argument("--executor", default="processes", help=text)
    command.add_argument("--time-limit", type=float, metavar="S", help="a row that takes longer fails")
    text = "number of parallel rows (default: number of processors)"
    command.add_argument("--threads", type=int, help=text)
    command.add_argument("--plan", action="store_true", help="print the plan only")
    command.add_argument("--read", action="store_true", help="only analyse the rows in OUT")
    text = "also compare with the rows of an earlier OUT, of whatever version; page in OUT/against-NAME"
    command.add_argument("--against", type=Path, metavar="OUT", help=text)


def run_ablation(parsed: argparse.Namespace) -> int:
    """Run a study; exit code 0: done, 2: wrong option, 3: every row failed, 130: interrupted."""
    try:
        study = read_study(_study_path(parsed.study))
        if parsed.plan:
            print(plan_summary(plan_study(study)))
            return 0
        if parsed.read:
            rows = read_rows(study, parsed.out)
            if not rows:
                raise UsageError(f"{parsed.out} has no rows of this study and this code; run without --read")
        else:
            how = {"executor": parsed.executor, "threads": parsed.threads, "limit_s": parsed.time_limit}
            with with_resume_advice(KEPT.format(parsed.out)):
                rows = ablate(study, parsed.out, **how, on_progress=progress_lines())
        page = write_analysis(analyse(rows), parsed.out)
        if parsed.against is not None:
            compared = compare_runs(read_earlier_rows(study, parsed.against), rows)
            folder = parsed.out / f"against-{parsed.against.resolve().name}"
            print(f"before and after: {write_analysis(compared, folder)}")
    except UsageError as error:
        print(f"ablate: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        print("; ".join(("ablate: interrupted", *map(str, stop.args))), file=sys.stderr)
        return CODES[SIGINT]
    print(_ablation_summary(rows, page))
    return 3 if rows and all(r.failure for r in rows) else 0


def _study_path(name: str) -> Path:
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


def _ablation_summary(rows: Rows, page: Path) -> str:
    failed = sum(bool(r.failure) for r in rows)
    found = [f"{variant} failed on {scene}: {why}" for variant, scene, why in failures_of(rows)]
    more = [f"... and {len(found) - SHOWN} more on the page"] if len(found) > SHOWN else []
    text = counted(len(rows), "row") + f", {failed} of them failed" * bool(failed)
    return "\n".join([*map(printable, found[:SHOWN]), *more, f"{text}; the page is {page}"])


def run_all(out: Path) -> int:
    """Make every table of the documentation, each in its own folder: all studies with the options of
    the pages, all ablations, and the report. One that ends with an error does not end the others; the exit
    code is the largest.
    """
    runs: dict[str, Callable[[], int]] = {}
    for name in MODULES:
        for number, options in enumerate(OF_PAGES.get(name, [[]])):
            folder = str(out / (f"{name}-{number + 1}" if number else name))
            words = f"study {name} {' '.join(options)}".rstrip()
            runs[words] = partial(run_study, name, ["-o", folder, *options])
    for path in sorted(STUDIES.glob("*.toml")):
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
