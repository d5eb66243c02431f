"""Compiled kernels: a cache that is keyed by all their code, and no effect on what else numba compiles."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

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


FORKS = """
import json, os, sys, traceback
import thesisrecon._numba
sys.dont_write_bytecode = True  # Python misses an edit of the same second and size
for line in sys.stdin:
    folder, code = json.loads(line)
    child = os.fork()
    if child == 0:
        log = os.open(os.path.join(folder, "log"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1), os.dup2(log, 2)
        os.environ["NUMBA_CACHE_DIR"] = os.path.join(folder, "cache")
        sys.path.insert(0, folder)
        try:
            exec(code, {"__name__": "__main__"})
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        sys.stdout.flush()
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def forks():
    """Runs code in a process of its own, a fork of one that has imported numba and compiled nothing."""
    pipe = subprocess.PIPE
    path = {"PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(
        [sys.executable, "-c", FORKS], stdin=pipe, stdout=pipe, text=True, env=os.environ | path
    ) as template:

        def run(folder, code=RUN):
            print(json.dumps([str(folder), code]), file=template.stdin, flush=True)
            ended, said = template.stdout.readline().strip(), (folder / "log").read_text(encoding="utf-8")
            assert ended == "0", said
            return said.split()

        yield run


def run_in(folder, code=RUN, **variables):
    """The same in a new interpreter."""
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


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory, forks):
    """The cache of a process that has compiled the caller."""
    folder = tmp_path_factory.mktemp("compiled")
    (folder / "callee.py").write_text(CALLEE, encoding="utf-8")
    (folder / "caller.py").write_text(CALLER, encoding="utf-8")
    assert forks(folder) == ["8.0", "0"]
    return folder / "cache"


@pytest.fixture
def compiled(package, compiled_once):
    """The package after a first process."""
    shutil.copytree(compiled_once, package / "cache")
    return package


def edit(file, old, new):
    text = file.read_text(encoding="utf-8")
    assert text.count(old) == 1
    file.write_text(text.replace(old, new), encoding="utf-8")


def test_a_second_process_compiles_nothing(compiled):
    assert run_in(compiled, PYTHONHASHSEED="7") == ["8.0", "1"]


def test_a_kernel_is_compiled_for_each_processor(compiled):
    for processor in ({"NUMBA_CPU_NAME": "generic"}, {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""}):
        assert run_in(compiled, **processor) == ["8.0", "0"]
        assert run_in(compiled, **processor) == ["8.0", "1"]


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


def test_other_functions_are_compiled_as_without_kernels(compiled, forks):
    assert forks(compiled, FOREIGN) == ["True"] * 5


@pytest.mark.parametrize(
    ("old", "new", "value"), [("x + OFFSET", "x - OFFSET", "4.0"), ("= 1.0", "= 2.0", "10.0")]
)
def test_an_edit_of_a_called_function_or_its_constant_recompiles_the_caller(compiled, old, new, value, forks):
    edit(compiled / "callee.py", old, new)
    assert forks(compiled) == [value, "0"]


def test_an_edit_of_a_comment_or_a_moved_function_recompiles_nothing(compiled, forks):
    edit(compiled / "callee.py", "Add an offset.", "Add a constant.")
    edit(compiled / "caller.py", "\n@kernel", "\n# further down\n\n@kernel")
    assert forks(compiled) == ["8.0", "1"]


def test_a_damaged_entry_is_compiled_again(compiled, forks):
    for entry in (compiled / "cache" / "thesisrecon").iterdir():
        entry.write_bytes(entry.read_bytes()[:-7])
    assert forks(compiled) == ["8.0", "0"]
    assert forks(compiled) == ["8.0", "1"]


def test_a_folder_that_cannot_be_written_costs_only_the_cache(package, forks):
    (package / "cache").write_text("a file in the place of the folder", encoding="utf-8")
    warned = "import logging, sys; logging.basicConfig(format='%(message)s', stream=sys.stdout)" + RUN
    words = forks(package, warned)
    assert words[-2:] == ["8.0", "0"]
    assert " ".join(words).count("set the variable NUMBA_CACHE_DIR to a writable folder") == 1


def test_an_entry_of_a_record_that_has_moved_is_compiled_again(package, forks):
    record = "from typing import NamedTuple\n\n\nclass Pair(NamedTuple):\n    x: float\n    y: float\n"
    (package / "records_here.py").write_text(record, encoding="utf-8")
    edit(package / "caller.py", "return 2.0 * inner(x)", "return inner(x.x)")
    code = RUN.replace("caller.outer(3.0)", "caller.outer(records.Pair(3.0, 1.0))")
    assert forks(package, code.replace("sys,", "sys, records_here as records,")) == ["4.0", "0"]
    (package / "records_here.py").rename(package / "records_there.py")
    assert forks(package, code.replace("sys,", "sys, records_there as records,")) == ["4.0", "0"]
