"""Docstrings of the public names are complete numpydoc, and the examples in docstrings run."""

import doctest
import importlib
import io
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from numpydoc.validate import validate

import thesisrecon

PACKAGE = Path(thesisrecon.__file__).parent
EXPORTED = [getattr(thesisrecon, name) for name in thesisrecon.__all__ if name != "__version__"]
CHAPTERS_WITH_EXAMPLES = ("geometry", "epipolar", "selfcalibration")
CHECKS = {"GL01", "GL08", "PR01", "PR02", "PR03", "PR07", "PR10", "RT01", "SS01", "SS05", "YD01"}
"""A summary, and all parameters and return values with types, in order."""


@pytest.mark.parametrize("exported", EXPORTED, ids=lambda exported: exported.__name__)
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
    names = {f"thesisrecon.{p.parent.name}.{p.stem}" for p in paths} | {e.__module__ for e in EXPORTED}
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
