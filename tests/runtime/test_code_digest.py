"""The digest changes with all code that is reached, and with nothing else."""

import importlib
import pickle
import re
import subprocess
import sys
import threading
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from thesisrecon._numba import code_digest, kernel
from thesisrecon.config import PipelineConfig


def defined(text, name="chosen"):
    """What a prompt or a notebook cell defines: code without a file."""
    scope = {"__name__": "__main__"}
    exec(text, scope)
    return scope[name]


PROMPT = """
def half(x):
    return x * 0.5

class chosen:
    {comment}
    ratio: float = 0.8
    def select(self, x):
        return half(x) < self.ratio{end}
"""


def test_a_class_from_a_prompt_counts_with_its_helpers_and_not_with_comments():
    first = code_digest(defined(PROMPT.format(comment="", end="")))
    assert code_digest(defined(PROMPT.format(comment="# as in the paper", end=""))) == first
    changes = [("0.8", "0.5"), ("* 0.5", "* 0.25"), ("< self", "<= self"), ("float = 0.8", "float")]
    texts = [PROMPT.format(comment="", end="").replace(*change) for change in changes]
    assert len({first, *(code_digest(defined(text)) for text in texts)}) == 5


# What differs between two codes stands in brackets.
CHANGES = {
    "lambda": "chosen = lambda x: x + [1|2]",
    "closure": "def make(k): return lambda x: x + k\nchosen = make([1|2])",
    "default": "def chosen(x, k=[1|2]): return x + k",
    "keyword default": "def chosen(x, *, k=[1|2]): return x + k",
    "table": "TABLE = {'a': [1|2]}\ndef chosen(x): return TABLE[x]",
    "inner function": "def chosen(x):\n    def inner(y): return y [+|-] 1\n    return inner(x)",
    "base class": "class A:\n    @property\n    def p(self): return [1|2]\nclass chosen(A): pass",
    "static method": "class chosen:\n    @staticmethod\n    def f(): return [1|2]",
    "relative import": "def chosen(x):\n    from . import other\n    return x + [1|2]",
    "module function": "import math\ndef chosen(x): return math.[sin|cos](x)",
}


@pytest.mark.parametrize("text", CHANGES.values(), ids=CHANGES)
def test_what_changes_a_result_changes_the_digest(text):
    one, two = (re.sub(r"\[(.*)\|(.*)\]", rf"\{n}", text) for n in (1, 2))
    assert code_digest(defined(one)) == code_digest(defined(one)) != code_digest(defined(two))


def test_an_edited_module_counts_for_those_that_import_it(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # two edits within a second
    at_the_top = "import digest_helper\nclass Chosen:\n    def f(self, x): return digest_helper.g(x)\n"
    inside = "class Chosen:\n    def f(self, x):\n        from digest_helper import g\n        return g(x)\n"
    for text in (at_the_top, inside):
        found = []
        for value in (1, 2, 1):
            helper = f"def g(x): return x + {value:d}\n# edit {len(found)}"
            (tmp_path / "digest_main.py").write_text(text, encoding="utf-8")
            (tmp_path / "digest_helper.py").write_text(helper, encoding="utf-8")
            for name in ("digest_main", "digest_helper"):
                monkeypatch.delitem(sys.modules, name, raising=False)
            importlib.invalidate_caches()
            found.append(code_digest(importlib.import_module("digest_main").Chosen))
        assert found[0] == found[2] != found[1]


@dataclass(frozen=True)
class Inner:
    step: float = 1.0

    def apply(self, x):
        return x * self.step


@dataclass(frozen=True)
class Outer:
    inner: object


def doubled(x):
    return 2.0 * x


def test_fields_count_with_their_classes_kernels_with_their_options_and_use_changes_nothing():
    kernels = kernel(doubled), kernel(fastmath=True)(doubled)
    values = (None, Inner(), Inner(2.0), doubled, partial(doubled, 3), *kernels)
    before = [code_digest(Outer(value)) for value in values]
    assert len({*before}) == len(values)
    assert code_digest(Outer(Inner())) == code_digest(Outer(Inner(1.0)))
    assert code_digest(np.linalg.svd) == code_digest(np.linalg.svd)
    matching = code_digest(PipelineConfig().matching)
    pickle.loads(pickle.dumps((Inner(), PipelineConfig())))  # notes names in the classes
    assert [code_digest(Outer(value)) for value in values] == before
    assert code_digest(PipelineConfig().matching) == matching


def test_every_process_computes_the_same_digest():
    config = PipelineConfig()
    program = (
        "from thesisrecon._numba import code_digest\nfrom thesisrecon.config import PipelineConfig\n"
        "c = PipelineConfig()\nprint(code_digest(c.matching), code_digest(c.metric), code_digest(c.model))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.split() == [code_digest(v) for v in (config.matching, config.metric, config.model)]


class State:
    """An object that is no dataclass."""

    def __init__(self, ratio, function=None):
        self.ratio, self.function = ratio, function


def test_an_object_counts_with_its_state_and_one_that_cannot_be_pickled_never_twice():
    values = (
        State(0.8), State(0.5), State(0.8, doubled), State(0.8, lambda x: x), np.add, np.maximum, len, abs,
    )  # fmt: skip
    assert len({code_digest(Outer(value)) for value in values}) == len(values)
    assert code_digest(Outer(State(0.8, doubled))) == code_digest(Outer(State(0.8, doubled)))
    texts = ("lambda x: x + 1", "lambda x: x + 2")
    one, two = (code_digest(State(0.8, defined(f"chosen = {text}"))) for text in texts)
    assert one != two
    lock = threading.Lock()
    assert code_digest(Outer(lock)) != code_digest(Outer(lock))


def test_a_package_of_another_environment_counts_by_its_name(tmp_path, monkeypatch):
    home = tmp_path / "site-packages"
    home.mkdir()
    monkeypatch.syspath_prepend(home)
    text = "def chosen(x):\n    import installed_elsewhere\n    return installed_elsewhere.{}(x)"
    digests = set()
    for offset in (1, 2):
        (home / "installed_elsewhere.py").write_text(f"def shift(x): return x + {offset}\n", encoding="utf-8")
        sys.modules.pop("installed_elsewhere", None)
        importlib.invalidate_caches()
        digests.add(code_digest(defined(text.format("shift"))))
    assert len(digests) == 1
