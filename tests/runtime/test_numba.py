"""Compiled kernels: a cache that is keyed by all their code, and no effect on what else numba compiles."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from thesisrecon._numba import kernel

CALLEE = """
from thesisrecon._numba import kernel

OFFSET = 1.0

@kernel(fastmath={"reassoc", "contract", "nsz"})  # the order of a set changes with PYTHONHASHSEED
def inner(x):
    '''Add an offset.'''
    return x + OFFSET
"""
CALLER = """
from callee import inner
from thesisrecon._numba import kernel

@kernel
def outer(x):
    return 2.0 * inner(x)
"""
RUN = """
import sys, caller
value = caller.outer(3.0)
print(value, sum(caller.outer.stats.cache_hits.values()))
"""


def run_in(folder, code=RUN, **variables):
    """What code prints in a new interpreter."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), **variables}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"  # Python misses an edit of the same second and size
    environment["PYTHONPATH"] = os.pathsep.join([str(folder), str(Path(__file__).parents[2])])
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.fixture
def package(tmp_path):
    (tmp_path / "callee.py").write_text(CALLEE, encoding="utf-8")
    (tmp_path / "caller.py").write_text(CALLER, encoding="utf-8")
    return tmp_path


def edit(file, old, new):
    text = file.read_text(encoding="utf-8")
    assert text.count(old) == 1
    file.write_text(text.replace(old, new), encoding="utf-8")


FOREIGN = """
import numba, numpy as np

def foreign(x, n):
    y, z = np.zeros(n), np.empty((n, 2), np.float32)
    for k in range(int(n)):
        y[k] = max(x[k], 0) + min(k, 3, 2.5) * x[-1] - 2 * np.int32(k)
        z[k, 0], z[k, 1] = int(y[k]), max(k - 1, 2) + 0.5
    return np.full(2, 3.0), y.sum() + z.max()

def compiled():
    function = numba.njit(foreign)
    value = function(np.arange(4.0), 4)[1]
    (result,) = function.overloads.values()
    calls = [str(kinds) for kinds in result.fndesc.calltypes.values()]
    return value, calls, str(result.signature), dict(vars(numba.config))

before = compiled()
import caller
from thesisrecon.matching import growth
from thesisrecon.epipolar._sampling import sampson_distances
from thesisrecon._numba import zeros
caller.outer(3.0), sampson_distances(np.ones(9), np.ones((5, 4))), zeros((2, 3))
print(len(before[1]) > 20, *(a == b for a, b in zip(before, compiled())))
"""
"""A function of another program is compiled alike before and after kernels are used."""


def test_a_kernel_is_compiled_once_for_its_code_and_that_of_called_functions(package):
    callee, caller = package / "callee.py", package / "caller.py"
    assert run_in(package) == ["8.0", "0"]
    assert run_in(package, PYTHONHASHSEED="7") == ["8.0", "1"]
    assert run_in(package, FOREIGN) == ["True"] * 5
    for entry in (package / "cache" / "thesisrecon").iterdir():
        entry.write_bytes(entry.read_bytes()[:-7])
    assert run_in(package) == ["8.0", "0"]
    # Neither a comment nor another place in the file matters.
    edit(callee, "Add an offset.", "Add a constant.")
    edit(caller, "\n@kernel", "\n# further down\n\n@kernel")
    assert run_in(package) == ["8.0", "1"]
    for old, new, value in (("x + OFFSET", "x - OFFSET", "4.0"), ("= 1.0", "= 2.0", "2.0")):
        edit(callee, old, new)
        assert run_in(package) == [value, "0"]
    for processor in ({"NUMBA_CPU_NAME": "generic"}, {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""}):
        assert run_in(package, **processor) == ["2.0", "0"]
        assert run_in(package, **processor) == ["2.0", "1"]


def test_a_folder_that_cannot_be_written_costs_only_the_cache(package):
    (package / "cache").write_text("a file in the place of the folder", encoding="utf-8")
    warned = "import logging, sys; logging.basicConfig(format='%(message)s', stream=sys.stdout)" + RUN
    words = run_in(package, warned)
    assert words[-2:] == ["8.0", "0"]
    assert " ".join(words).count("set the variable NUMBA_CACHE_DIR to a writable folder") == 1


def test_an_entry_of_a_record_that_has_moved_is_compiled_again(package):
    record = "from typing import NamedTuple\n\n\nclass Pair(NamedTuple):\n    x: float\n    y: float\n"
    (package / "records_here.py").write_text(record, encoding="utf-8")
    edit(package / "caller.py", "return 2.0 * inner(x)", "return inner(x.x)")
    code = RUN.replace("caller.outer(3.0)", "caller.outer(records.Pair(3.0, 1.0))")
    assert run_in(package, code.replace("sys,", "sys, records_here as records,")) == ["4.0", "0"]
    (package / "records_here.py").rename(package / "records_there.py")
    assert run_in(package, code.replace("sys,", "sys, records_there as records,")) == ["4.0", "0"]


@kernel
def running_sums(x, steps):
    out = np.zeros(len(x))
    for _ in range(steps):
        for k in range(len(x)):
            out[k] = 0.5 * out[k] + x[k]
    return out, out + 1.0


def test_a_signal_during_a_kernel_arrives_as_itself():
    x = np.ones(1000)
    running_sums(x, 1)

    def interrupt(*_):
        raise KeyboardInterrupt("once")

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        with pytest.raises(KeyboardInterrupt, match="once"):
            running_sums(x, 3_000_000)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
