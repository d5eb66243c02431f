"""The documentation: exported names, commands, settings and messages have a page, and examples run.

Docstrings of the public names are complete numpydoc. Every equation has code with a test.
"""

import ast
import doctest
import importlib
import inspect
import io
import re
import shlex
import sys
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path

import pytest
from numpydoc.validate import validate

import thesisrecon
from docs._ext import theory
from thesisrecon.config import KINDS

DOCS = Path(__file__).parents[2] / "docs"
THEORY, README = DOCS / "theory", DOCS.parent / "README.md"
PACKAGE = Path(thesisrecon.__file__).parent
EXPORTED = sorted(set(thesisrecon.__all__) - {"__version__"})
OBJECTS = [getattr(thesisrecon, name) for name in EXPORTED]


@pytest.fixture(scope="module")
def site():
    """The modules that make pages; those that need Sphinx are imported where it is installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        yield lambda name: importlib.import_module(f"_ext.{name}")
    for name in [name for name in sys.modules if name.split(".")[0] == "_ext"]:
        del sys.modules[name]


def test_every_exported_name_has_a_page_with_an_example(site):
    borrowed = site("examples").RETURNED_BY
    own = {name for name in EXPORTED if ">>>" in (getattr(thesisrecon, name).__doc__ or "")}
    assert own | set(borrowed) == set(EXPORTED)
    assert not own & set(borrowed)
    assert set(borrowed.values()) <= own


def test_the_pages_of_commands_and_settings_name_all_of_them(site):
    interface = site("interface")
    commands, settings = interface.command_page(), interface.settings_page()
    for command, option in (("reconstruct", "--from"), ("export", "--to"), ("compare", "--json")):
        assert re.search(rf"^## {command}$.*?`{option}`", commands, re.M | re.S)
    for stage, kinds in KINDS.items():
        assert f"## {stage}\n" in settings
        assert all(f"`{stage}.kind={word}`" in settings for word in kinds)
    rows = re.findall(r"^\| (`.*)", settings, re.M)
    assert len(rows) > 75
    assert [row for row in rows if row.rstrip().endswith("|  |")] == []


def test_the_page_of_ablations_names_tasks_metrics_and_what_can_be_imported(site):
    pytest.importorskip("validation.ablation.tasks")
    from validation import metrics, scenes
    from validation.ablation.tasks import TASKS

    page = site("ablations").page()
    for word, task in TASKS.items():
        assert f"## {word}\n" in page
        assert all(f"| `{m.name}`" in page and m.definition for m in task.measures)
        assert all(f"`task.{name}`" in page for name in vars(task()))
    names = re.findall(r"^\| `(\w+)[`(].*?\| (.*) \|$", page.split("## validation.scenes")[1], re.M)
    assert {name for name, _ in names} == {*scenes.__all__, *metrics.__all__}
    assert all(meaning for _, meaning in names)


def test_every_message_of_the_code_has_a_remedy_on_the_page_of_failures(site):
    failures = site("failures")
    known = {code: message for table in failures.TABLES.values() for code, message in table.items()}
    source = "".join(path.read_text("utf-8") for path in failures.PACKAGE.rglob("*.py"))
    motions = failures.TABLES["Critical motions"]
    assert {*re.findall(r'Notice\(\s*"([^"]+)"', source), *motions} == {*known, *failures.CALLS}
    assert all(text and remedy for text, remedy in known.values())
    # Messages are sorted by heading: a remedy cannot refer to the one above it.
    assert not re.search("as above", " ".join(remedy for _, remedy in known.values()), re.I)
    advised = failures.ADVISED
    assert {*re.findall(r'StageFailure\.of\(\s*"([^"]+)"', source), "no-images"} == {*advised}
    assert all(reason and advice for reason, _, advice in advised.values())
    page = failures.page()
    assert all(f"| `{code}` | {failures.shown(reason)} |" in page for code, (reason, *_) in advised.items())


CODE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.M | re.S)
PAGES = sorted(path for path in DOCS.rglob("*.md") if not {"_build", "modules", "generated"} & {*path.parts})


def test_the_calls_of_the_readme_fit_the_functions():
    """Its names stand for data of the reader, so it cannot run."""
    tree = ast.parse(block("../README.md", 1))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    calls = [call for call in calls if ast.unparse(call.func).startswith("thesisrecon.")]
    for call in calls:
        function = getattr(thesisrecon, call.func.attr)
        inspect.signature(function).bind(*call.args, **{keyword.arg: None for keyword in call.keywords})
    assert len(calls) >= 15


def commands_of(text):
    """Command lines of a page in backticks or in blocks, without what stands for something else."""
    code = [line for _, block in CODE.findall(text) for line in block.replace("\\\n", " ").splitlines()]
    code += re.findall(r"`([^`\n]+)`", re.sub(CODE, "", text))
    for line in code:
        words = shlex.split(re.sub(r"[\[\]|]", " ", line), comments=True)
        if words[:1] == ["thesisrecon"] or "validation" in words[:3]:
            yield words[words.index("validation" if "validation" in words else "thesisrecon") :]


def test_commands_of_the_pages_exist(site):
    """Names of commands, studies and ablations, and all options."""
    pytest.importorskip("validation.runs.study")
    from validation.ablation.plan import STUDIES
    from validation.command import _parser
    from validation.runs.study import MODULES, load_study, study_parser

    sections = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", site("interface").command_page(), re.M | re.S))
    shipped, tried = {file.stem for file in STUDIES.glob("*.toml")}, 0
    for path in [*PAGES, README]:
        for program, *words in commands_of(path.read_text("utf-8")):
            where = f"{path.name}: {' '.join([program, *words])}"
            options = [word.split("=")[0] for word in words if re.match("--?[a-z]", word)]
            tried += 1
            if program == "thesisrecon":
                if words and words[0].islower() and not words[0].startswith("-"):
                    assert words[0] in sections, where
                    known = f"{sections[words[0]]} `--help`"
                    assert [o for o in options if f"`{o}`" not in known] == [], where
            elif words[:1] == ["study"]:
                if words[1:2] and words[1] in MODULES:
                    if "--help" not in words:
                        study_parser(words[1], load_study(words[1])).parse_args(words[2:])
                else:
                    assert words[1:2] in ([], ["all"], ["NAME"], ["--list"]), where
            elif words:
                complete = words[0] == "limits" or {"-o", "--out"} & {*words}
                parsed = _parser().parse_args(words if complete else [*words, "-o", "OUT"])
                if parsed.command == "ablate":
                    assert parsed.study in ("NAME", "STUDY.toml", *shipped), where
    assert tried > 60
    named = {name for path in PAGES for name in re.findall(r"`study ([a-z-]+)", path.read_text("utf-8"))}
    assert named - {*MODULES, "all"} == set()


def block(page, number=0):
    """One Python block of a page."""
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text("utf-8"), re.S)[number]


def test_the_example_of_the_conventions_runs():
    exec(compile(block("reference/conventions.md"), "conventions.md", "exec"), {})


@pytest.mark.slow
@pytest.mark.parametrize(("page", "images"), [("../README.md", 14), ("start/first-reconstruction.md", 6)])
def test_the_first_lines_of_the_readme_and_the_first_reconstruction_run(page, images, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fixtures").symlink_to(DOCS.parent / "fixtures")
    names = {}
    exec(compile(block(page), page, "exec"), names)
    assert len(names["result"].cameras) == images
    assert names["result"].summary["trusted"]
    assert names["camera"].K[0, 0] == pytest.approx(908.6, rel=2e-3)
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"report.html", "cameras.json", "sparse"}


CHAPTERS_WITH_EXAMPLES = ("geometry", "epipolar", "selfcalibration")
CHECKS = {"GL01", "GL08", "PR01", "PR02", "PR03", "PR07", "PR10", "RT01", "SS01", "SS05", "YD01"}
"""A summary, and all parameters and return values with types, in order."""


@pytest.mark.parametrize("exported", OBJECTS, ids=lambda exported: exported.__name__)
def test_exported_functions_and_methods_have_complete_docstrings(exported):
    assert exported.__doc__
    name = f"{exported.__module__}.{exported.__name__}"
    names = [name]
    if isinstance(exported, type):
        public = [key for key in vars(exported) if not key.startswith("_")]
        names = [f"{name}.{key}" for key in public if callable(getattr(exported, key))]
    else:
        assert ">>>" in exported.__doc__
    faults = {name: [fault for fault in validate(name)["errors"] if fault[0] in CHECKS] for name in names}
    assert not any(faults.values()), faults


def test_the_examples_in_docstrings_run():
    """The public names, and chapters 3, 5 and 7."""
    paths = [p for chapter in CHAPTERS_WITH_EXAMPLES for p in (PACKAGE / chapter).glob("[a-z]*.py")]
    names = {f"thesisrecon.{p.parent.name}.{p.stem}" for p in paths} | {e.__module__ for e in OBJECTS}
    # Examples of chapter 7 continue that of self_calibrate, and others that of reconstruct_from_matches.
    shared = {}
    for function in (thesisrecon.self_calibrate, thesisrecon.reconstruct_from_matches):
        for example in doctest.DocTestParser().get_examples(function.__doc__):
            exec(example.source, shared)
    shared = {name: shared[name] for name in ("projective", "keypoints", "result")}
    finder, output = doctest.DocTestFinder(), io.StringIO()
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    with redirect_stdout(output):
        for name in sorted(names):
            for example in finder.find(importlib.import_module(name), name, extraglobs=shared):
                runner.run(example)
    assert runner.failures == 0, output.getvalue()
    assert runner.tries > 50


SECTIONS = {
    "views": ["1.2", "1.3"], "stereo": ["2.5"], "surfaces": ["2.6"],
    "geometry": ["3.2", "3.4.2", "3.4.3", "3.4.4", "3.5", "3.6", "3.6.3", "3.6.4"],
    "features": ["4.2.1", "4.2.2"], "fundamental-matrix": ["5.2", "5.3", "5.4", "5.5"],
    "bundle-adjustment": ["6.7"], "self-calibration": ["7.3"],
    "projective": ["6.2", "6.3", "6.3.1", "6.3.2", "6.3.3", "6.4", "6.5", "6.6"],
}  # fmt: skip
"""Sections of the thesis that a page must cover."""


@cache
def exists(name):
    """Say whether a dotted name is a module of thesisrecon or an attribute of one."""
    parts = ["thesisrecon", *name.split(".")]
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[cut:]:
            if not hasattr(found, attribute):
                return False
            found = getattr(found, attribute)
        return True
    return False


def test_every_numbered_equation_and_section_has_code_and_tests_that_exist():
    covered = {r.number for row in theory.rows() if row.tests for r in row.references if r.kind == "equation"}
    wanted = {f"3.{k}" for k in range(1, 43)} | {"4.1"} | {f"5.{k}" for k in range(1, 7)}
    assert wanted - covered == set()
    for page, sections in SECTIONS.items():
        numbers = {r.number for row in theory.table(page) for r in row.references}
        assert [s for s in sections if s not in numbers] == []
    assert theory.chapters_of("geometry.strata.dual") == ["geometry"]
    assert theory.chapters_of("load") == []
    rows = theory.rows()
    assert len(rows) > 150
    assert [row.name for row in rows if not exists(row.name)] == []
    assert [row.name for row in rows if not row.tests and "_" not in row.name] == []
    for file, test in {test for row in rows for test in row.tests}:
        assert re.search(rf"^def {test}\(", (Path(__file__).parents[1] / file).read_text("utf-8"), re.M)


@pytest.mark.parametrize("page", sorted(theory.PAGES))
def test_a_page_has_its_table_and_names_what_exists(page):
    text = (THEORY / f"{page}.md").read_text("utf-8")
    assert f"```{{theory-table}} {page}\n" in text
    assert len(theory.table(page)) >= 5
    named = re.findall(r"\{py:(?:func|class)\}`thesisrecon\.([\w.]+)`", text)
    assert [name for name in named if not exists(name)] == []
    assert all(page in theory.chapters_of(name) for name in named)  # they link back
