"""Docstrings are complete numpydoc, and the examples in them run."""

import doctest
import importlib
import io
import runpy
import sys
from contextlib import redirect_stdout
from pathlib import Path

import thesisrecon

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "thesisrecon"
CHECK = runpy.run_path(str(ROOT / "scripts" / "check_docstrings"))
CHAPTERS_WITH_EXAMPLES = ("geometry", "epipolar", "selfcalibration")


def test_most_public_functions_have_complete_docstrings(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["check_docstrings", "--summary"])
    assert CHECK["main"]() == 0, capsys.readouterr().out


def test_every_exported_function_has_a_complete_docstring():
    incomplete = {}
    for name in set(thesisrecon.__all__) - {"__version__"}:
        exported = getattr(thesisrecon, name)
        found = CHECK["problems"](Path(importlib.import_module(exported.__module__).__file__))
        own = {k: faults for k, faults in found.items() if k.split(".")[0] == exported.__name__}
        assert own or isinstance(exported, type), f"{name} is not a public function of {exported.__module__}"
        assert exported.__doc__, name
        incomplete |= {k: faults for k, faults in own.items() if faults}
    assert incomplete == {}


def test_the_examples_in_docstrings_run():
    """The front doors, the camera, and chapters 3, 5 and 7; every exported function has one."""
    paths = [PACKAGE / "api.py", PACKAGE / "camera.py"]
    paths += [p for chapter in CHAPTERS_WITH_EXAMPLES for p in sorted((PACKAGE / chapter).glob("*.py"))]
    names = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for p in paths}
    exported = [getattr(thesisrecon, name) for name in thesisrecon.__all__ if name != "__version__"]
    names |= {e.__module__ for e in exported}
    # Examples of chapter 7 continue that of self_calibrate, and others that of reconstruct_from_matches.
    shared = {}
    for function in (thesisrecon.self_calibrate, thesisrecon.reconstruct_from_matches):
        for example in doctest.DocTestParser().get_examples(function.__doc__):
            exec(example.source, shared)
    shared = {name: shared[name] for name in ("projective", "keypoints", "result")}
    finder, tried, output = doctest.DocTestFinder(), 0, io.StringIO()
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    with redirect_stdout(output):
        for name in sorted(names):
            for example in finder.find(importlib.import_module(name), name, extraglobs=shared):
                tried += len(example.examples)
                runner.run(example)
    assert runner.failures == 0, output.getvalue()
    assert tried > 50
    functions = [e for e in exported if not isinstance(e, type)]
    assert [f.__name__ for f in functions if ">>>" not in (f.__doc__ or "")] == []
