"""Fixtures that run a command line within bounds of time and memory."""

import resource
import signal

import pytest

from tests.bad_input import files
from tests.conftest import without_progress
from thesisrecon.cli.commands import run_command
from validation.command import main as run_validation

GROWTH_MB = 600
"""Largest growth of peak memory; an image of 89 megapixels takes 360."""


@pytest.fixture
def bounded():
    """Limit the processor time, the wall time and the memory growth of each test."""

    def stop(*_):
        raise TimeoutError("it hangs")

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # On a busy machine 60 s of work take many minutes.
    limits = {signal.ITIMER_PROF: (signal.SIGPROF, 60), signal.ITIMER_REAL: (signal.SIGALRM, 900)}
    for timer, (number, seconds) in limits.items():
        signal.signal(number, stop)
        signal.setitimer(timer, seconds)
    yield
    for timer, (number, _) in limits.items():
        signal.setitimer(timer, 0)
        signal.signal(number, signal.SIG_DFL)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < GROWTH_MB * 2**10


@pytest.fixture
def run_cli(capsys):
    """Run a command line, check its exit code and message, and return the message."""

    def run(arguments, code):
        capsys.readouterr()
        found = run_command(arguments)
        said = capsys.readouterr()
        assert found == code, said.err
        sentence = without_progress(said.err)
        if code == 0:
            assert sentence == ""
            return said.out
        files.require_sentence(sentence.replace(files.TOO_LONG, "..."))
        assert sentence.startswith("thesisrecon: ")
        return sentence

    return run


@pytest.fixture
def validated(capsys):
    """Run a validation command that must end with exit code 2, and return its message."""

    def run(arguments):
        assert run_validation(arguments) == 2
        said = capsys.readouterr()
        assert said.out == ""
        files.require_sentence(said.err)
        return said.err

    return run
