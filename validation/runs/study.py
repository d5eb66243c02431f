"""Run the studies: ``python -m validation study NAME [--option ...]``, ``python -m validation study --list``.
``python -m validation study all -o OUT`` runs them all, the ablations and the report, which takes hours.

A study is a generator function ``NAME_study`` in ``validation/studies``. Its keyword parameters with their
defaults and annotations are the options of the command, which ``studies.toml`` explains. It yields parts: a
list of :class:`Metric` rows (one table under the scene of the first row) or a string. A parameter ``out`` is
a folder that keeps what the study makes. The exit code is 1 if a bound is missed, 2 for missing data or
options.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
import tempfile
import time
import tomllib
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io._files import write_text
from thesisrecon.io._outputs import join_claim
from validation.runs.tables import Metric, markdown_table, stamp, write_metrics

FOLDER = Path(__file__).parents[1] / "studies"
FOUND = [
    (name.replace("_", "-"), path.stem)
    for path in FOLDER.glob("[a-z]*.py")
    for name in re.findall(r"^def (\w+)_study\(", path.read_text(encoding="utf-8"), re.M)
]
MODULES = dict(sorted(FOUND))
"""Name of a study -> the module of ``validation/studies`` that holds its function."""
_OPTIONS = tomllib.loads(FOLDER.with_suffix(".toml").read_text(encoding="utf-8"))
HELP: dict[str, str] = _OPTIONS["help"]
OF_PAGES: dict[str, list[list[str]]] = _OPTIONS["pages"]
"""Options of each run of a study for the documentation, where they are not the defaults."""
Part = Sequence[Metric] | str
StudyFunction = Callable[..., Iterable[Part]]


def run_studies(arguments: Sequence[str]) -> int:
    """Run the study that the command line names and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m validation study", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("name", nargs="?", choices=list(MODULES), metavar="NAME", help="name of the study")
    parser.add_argument("--list", action="store_true", help="list the studies and exit")
    names = [name.replace("_", "-") for name in arguments[:1]]
    options = parser.parse_args(names)
    if options.list:
        for name in MODULES:
            print(f"{name:22} {_summary(load_study(name))}")
        return 0
    if options.name is None:
        parser.error("name a study; --list shows them")
    return run_study(options.name, arguments[1:])


def run_study(name: str, arguments: Sequence[str] = ()) -> int:
    """Run one study with its options: print its parts, write them if asked, return the exit code."""
    function = load_study(name)
    options = vars(study_parser(name, function).parse_args(list(arguments)))
    out, texts, metrics = options.pop("out"), list[str](), list[Metric]()
    try:
        with output_folder(out, [f"{name}.md", f"{name}.json"]) as folder:
            if "out" in inspect.signature(function).parameters:
                options["out"] = folder
            for part in function(**options):
                if not part:
                    continue
                metrics += [] if isinstance(part, str) else part
                text = part if isinstance(part, str) else f"## {part[0].scene}\n\n{markdown_table(part)}"
                texts.append(text)
                print(texts[-1], end="\n\n", flush=True)
                # Written after each part, so that an interrupted study keeps what it has.
                if out is not None:
                    write_text(folder / f"{name}.md", "\n\n".join((stamp(), *texts)) + "\n")
                    write_metrics(folder / f"{name}.json", metrics)
    except (UsageError, StageFailure) as error:
        print(f"study {name}: {error}", file=sys.stderr)
        return 2
    if not texts:
        print(f"study {name}: the images are not on this machine (THESISRECON_DATA)", file=sys.stderr)
        return 2
    return int(any(row.verdict == "missed" for row in metrics))


def load_study(name: str) -> StudyFunction:
    """Import the function of a study."""
    module = import_module(f"validation.studies.{MODULES[name]}")
    function: StudyFunction = getattr(module, f"{name.replace('-', '_')}_study")
    return function


def study_parser(name: str, function: StudyFunction) -> argparse.ArgumentParser:
    """Make the command-line parser from the signature and the docstring of a study."""
    module = sys.modules[function.__module__]
    text = f"{_summary(function)}\n\n{inspect.getdoc(module) or ''}"
    parser = argparse.ArgumentParser(
        prog=f"python -m validation study {name}",
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-o", "--out", type=Path, help="folder for the tables and for what the study makes")
    hints = typing.get_type_hints(function)
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name != "out":
            flag = f"--{parameter.name.replace('_', '-').strip('-')}"
            given = _argument(hints[parameter.name], parameter.default)
            parser.add_argument(flag, dest=parameter.name, help=HELP.get(parameter.name), **given)
    return parser


def _argument(hint: Any, default: Any) -> dict[str, Any]:
    """Return the keywords of ``add_argument`` for an annotation and its default."""
    given: dict[str, Any] = {"default": default}
    if default is inspect.Parameter.empty:
        given = {"required": True}
    if isinstance(hint, types.UnionType):
        hint = next(one for one in typing.get_args(hint) if one is not type(None))
    if hint is bool:
        return {"action": "store_true"}
    if typing.get_origin(hint) in (Sequence, tuple):
        given["nargs"] = "*"
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) is typing.Literal:
        return given | {"choices": typing.get_args(hint)}
    return given | {"type": hint, "metavar": hint.__name__.upper()}


def _summary(function: StudyFunction) -> str:
    return (inspect.getdoc(function) or "").partition("\n")[0]


@contextmanager
def output_folder(folder: Path | None, names: Sequence[str]) -> Iterator[Path]:
    """The folder of a study that writes these tables, else a temporary one."""
    if folder is None:
        with tempfile.TemporaryDirectory() as temporary:
            yield Path(temporary)
    else:
        with join_claim(folder.resolve()) as outputs:
            outputs.require(names)
            yield folder.resolve()


# ---------------------------------------------------------------- helpers of the studies


def report_progress(text: object) -> None:
    """Print a line on the error stream at once."""
    print(text, file=sys.stderr, flush=True)


LOG_EVERY_S = 30.0


def progress_lines() -> Callable[[str], None]:
    """The same at a terminal; in a log one line in half a minute from now."""
    last = time.monotonic()

    def report(text: str) -> None:
        nonlocal last
        if sys.stderr.isatty() or time.monotonic() - last >= LOG_EVERY_S:
            last = time.monotonic()
            report_progress(text)

    return report


def pick(names: Sequence[str] | None, known: Iterable[str]) -> list[str]:
    """Return the names asked for, all known ones by default; ``UsageError`` for an unknown name."""
    known = list(known)
    for name in names or ():
        if name not in known:
            raise UsageError(f"{name!r} does not exist; choose from {', '.join(known)}")
    return known if names is None else list(names)
