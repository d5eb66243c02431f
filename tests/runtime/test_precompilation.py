"""Compilation of the listed kernels before a run."""

import os
import subprocess
import sys

import pytest
from numba.core import types
from numba.core.dispatcher import Dispatcher

from thesisrecon.runtime import _precompilation
from thesisrecon.runtime._precompilation import kernel_and_types, listed_kernels, precompile

COPY = "kernels.copy_to(float64[::1], float64[::1],)"


@pytest.fixture
def listed(tmp_path, monkeypatch):
    """Let the list hold some lines; returns the calls of progress of a precompilation."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(_precompilation, "LIST", tmp_path / "kernels.txt")

    def compiled(*lines, until="model"):
        (tmp_path / "kernels.txt").write_text("\n".join(lines), encoding="utf-8")
        calls = []
        precompile(until, 2, lambda *call: calls.append(call))
        return calls

    return compiled


def test_the_list_names_kernels_with_the_types_of_their_arguments():
    lines = listed_kernels("model")
    assert len(lines) > 50
    assert len(listed_kernels("features")) < len(listed_kernels("metric")) < len(lines)
    for line in lines:
        kernel, arguments = kernel_and_types(line)
        assert isinstance(kernel, Dispatcher), line
        assert arguments, line
        assert all(isinstance(kind, types.Type) for kind in arguments), line


def test_kernels_are_compiled_once_and_up_to_the_last_stage(listed, tmp_path):
    lines = ("[features]", COPY, "[matches]", COPY.replace("64", "32"))
    first = listed(*lines, until="features")
    assert (first[0], first[-1]) == (("kernels", 0, 1), ("kernels", 1, 1))
    assert len(list((tmp_path / "cache").rglob("kernels.copy_to-*"))) == 1
    assert listed(*lines, until="features") == []
    assert listed(*lines)[-1] == ("kernels", 2, 2)
    assert len(list((tmp_path / "cache").rglob("kernels.copy_to-*"))) == 2


def test_a_kernel_that_cannot_be_compiled_stops_nothing(listed):
    lines = ("[features]", "kernels.unknown(float64,)", COPY)
    assert listed(*lines)[-1] == ("kernels", 1, 2)
    assert listed(*lines)[-1] == ("kernels", 1, 2)  # tried again: a repaired one would be found


RUN = """
import sys
from pathlib import Path
from thesisrecon import reconstruct
from thesisrecon.io._images import demo_images
from thesisrecon.kernels import cache_folder
from thesisrecon.runtime._precompilation import precompile

precompile("metric", 2, lambda *_: None)
before = set(cache_folder().iterdir())
reconstruct(demo_images(), sys.argv[1], until="metric", threads=2)
print(sorted(file.name for file in set(cache_folder().iterdir()) - before))
"""


@pytest.mark.slow
def test_a_run_compiles_nothing_that_is_not_listed(tmp_path):
    run = subprocess.run(
        [sys.executable, "-c", RUN, str(tmp_path / "out")], capture_output=True, text=True, check=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
    )  # fmt: skip
    assert run.stdout.strip() == "[]"
