"""Compilation of the listed kernels before a run."""

import subprocess
import sys

import pytest
from numba import types

from thesisrecon import _numba
from thesisrecon._numba import Kernel, copy_to, kernel
from thesisrecon.runtime import _precompilation
from thesisrecon.runtime._precompilation import kernel_and_types, listed_kernels, precompile

COPY = "_numba.copy_to(float64[::1], float64[::1],)"


@pytest.fixture
def listed(tmp_path, monkeypatch):
    """Let the list hold some lines; returns the calls of progress of a precompilation."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(_precompilation, "LIST", tmp_path / "kernels.txt")

    def compiled(*lines, until="model", workers=2):
        (tmp_path / "kernels.txt").write_text("\n".join(lines), encoding="utf-8")
        calls = []
        precompile(until, workers, lambda *call: calls.append(call))
        return calls

    return compiled


def test_the_list_names_kernels_with_the_types_of_their_arguments():
    lines = listed_kernels("model")
    assert len(lines) > 50
    assert len(listed_kernels("features")) < len(listed_kernels("metric")) < len(lines)
    for line in lines:
        kernel, arguments = kernel_and_types(line)
        assert isinstance(kernel, Kernel), line
        assert arguments, line
        assert all(isinstance(kind, types.Type) for kind in arguments), line


def test_kernels_are_compiled_once_and_up_to_the_last_stage(listed, tmp_path):
    lines = ("[features]", COPY, "[matches]", COPY.replace("64", "32"))
    first = listed(*lines, until="features")
    assert (first[0], first[-1]) == (("kernels", 0, 1), ("kernels", 1, 1))
    assert len(list((tmp_path / "cache").rglob("_numba.copy_to-*"))) == 1
    kernel(copy_to.py_func).compile(kernel_and_types(COPY)[1])  # finds the entry of the worker's
    assert len(list((tmp_path / "cache").rglob("_numba.copy_to-*"))) == 1
    assert listed(*lines, until="features") == []
    assert listed(*lines)[-1] == ("kernels", 2, 2)
    assert len(list((tmp_path / "cache").rglob("_numba.copy_to-*"))) == 2


def test_a_kernel_that_cannot_be_compiled_stops_nothing(listed):
    lines = ("[features]", "kernels.unknown(float64,)", COPY)
    assert listed(*lines)[-1] == ("kernels", 1, 2)
    assert listed(*lines)[-1] == ("kernels", 1, 2)  # tried again: a repaired one would be found


RUN = """
import sys
from thesisrecon import reconstruct
from thesisrecon.io._images import demo_images
from thesisrecon._numba import KernelCache
from thesisrecon.runtime._precompilation import kernel_and_types, listed_kernels

load, asked = KernelCache.load_overload, []

def listen(cache, signature, context):
    asked.append((cache._dispatcher, tuple(signature)))
    return load(cache, signature, context)

KernelCache.load_overload = listen
reconstruct(demo_images(), sys.argv[1], until="metric", threads=2)
assert asked
listed = {kernel_and_types(line) for line in listed_kernels("metric")}
missing = {kernel.py_func.__qualname__ + str(kinds) for kernel, kinds in set(asked) - listed}
print(sorted(missing))
"""


@pytest.mark.slow
def test_a_run_calls_no_kernel_that_is_not_listed(tmp_path):
    # All are compiled before the first stage: each that is asked for is one that a stage calls.
    run = subprocess.run(
        [sys.executable, "-c", RUN, str(tmp_path / "out")], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("executable", ["/nonexistent/python", ""])
def test_without_workers_this_process_compiles(monkeypatch, executable):
    monkeypatch.setattr("thesisrecon.runtime._precompilation.sys.executable", executable)
    monkeypatch.setenv("PATH", "")
    assert _precompilation._compile_in_processes(["a.b()"], 2, lambda *_: None) == 0


def test_without_a_home_the_cache_is_an_own_folder(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    for name in (_numba.CACHE_VARIABLE, "HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(_numba, "PACKAGE", tmp_path / "file")

    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(_numba.Path, "home", no_home)
    monkeypatch.setattr(_numba.tempfile, "gettempdir", lambda: str(tmp_path))
    own = _numba.cache_folder()
    assert own.parent == tmp_path
    assert own.stat().st_mode & 0o777 == 0o700
    own.chmod(0o777)  # anybody may have put machine code there
    assert _numba.cache_folder() == tmp_path / "file" / "__pycache__" / "kernels"
