"""Shared fixtures; files with slow tests start first, so that workers finish together."""

import gc
import logging
import os
import re
import sys

import pytest
from hypothesis import settings

from thesisrecon.cli.commands import run_command
from thesisrecon.errors import STRICT_VARIABLE, made
from thesisrecon.runtime._run_folder import bytes_from_record
from validation.scenes.real import data_root

# The same examples on every machine: whether a test passes is no matter of chance.
settings.register_profile("same", derandomize=True, database=None)
settings.load_profile("same")

LOCAL = {
    "threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": ":0", "worker_dashboard_address": None,
    "silence_logs": logging.ERROR,
}  # fmt: skip
"""Options of a Dask cluster on loopback."""


@pytest.fixture(scope="session", autouse=True)
def _not_flushed():
    """Leave the flushing of files to the system: no test loses its power, and thousands of waits add up."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _strict():
    """A figure, page or file that cannot be made is an error: nothing hides behind its warning."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(STRICT_VARIABLE, "1")
        yield


@pytest.fixture(scope="module")
def dask_cluster():
    """A scheduler and two worker processes on loopback."""
    distributed = pytest.importorskip("distributed", reason="the extra distributed is not installed")
    with distributed.LocalCluster(n_workers=2, **LOCAL) as running:
        yield running


def address(running):
    """What the command line calls it."""
    return str(running.scheduler_address).replace("tcp://", "dask://")


def without_progress(text):
    """What a command says on standard error beside the lines of its stages."""
    return re.sub(r"^[^:\n]+: \d+ of \d+, \d+ s\n", "", text, flags=re.MULTILINE)


def refuses(error, words, call, *arguments, **options):
    """Require that a call raises the error with these words."""
    with pytest.raises(error, match=words):
        call(*arguments, **options)


def real_data(name):
    """A file or folder of the real images; a test that needs it is skipped without it."""
    root = data_root()
    if root is None or not (root / name).exists():
        pytest.skip(f"the real data are not on this machine ({name})")
    return root / name


def before_each_output(monkeypatch, call):
    """Call ``call(what)`` before each figure, page or file is made, in all modules."""

    def tried(what, make, *rest):
        return made(what, lambda: (call(what), make())[1], *rest)

    for module in list(sys.modules.values()):
        if getattr(module, "made", None) is made and module.__name__.startswith(
            ("thesisrecon.", "validation.")
        ):
            monkeypatch.setattr(module, "made", tried)


def failing(what, error):
    """A function for :func:`before_each_output` that raises the error before this output."""

    def call(name):
        if name == what:
            raise error

    return call


def same_pairs(one, other):
    """Whether the matched pairs of two results are equal in all fields."""
    return [bytes_from_record(p, "") for p in one.pairs] == [bytes_from_record(p, "") for p in other.pairs]


@pytest.fixture
def refused(capsys):
    """Run a command line that must end with this exit code and one line of explanation; return the line."""

    def run(arguments, code=2):
        capsys.readouterr()
        assert run_command([str(argument) for argument in arguments]) == code
        said = capsys.readouterr().err
        assert said.startswith("thesisrecon: ")
        assert said.count("\n") == 1
        assert "Traceback" not in said
        return said

    return run


def pytest_collection_finish():
    """Keep the objects that all tests have in common out of each search for garbage."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items):
    """Move files with a slow test to the front."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
