"""Command lines whose answers are one sentence, within bounds of time and memory."""

import resource
import signal

import pytest

from tests.hostile import files
from thesisrecon.cli.main import run_command
from validation.command import main as run_validation

GROWTH_MB = 600
"""What one case may add to the peak of the memory: a photograph of 89 megapixels takes 360."""


@pytest.fixture(autouse=True)
def bounded():
    """Ends what waits for ever, and finds what took more memory than it may."""

    def stop(*_):
        raise TimeoutError("it waits for something")

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    old = signal.signal(signal.SIGALRM, stop)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, old)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < GROWTH_MB * 2**10


@pytest.fixture
def told(capsys):
    """Runs a command line, holds its code and the form of its sentence, and returns that."""

    def run(arguments, code):
        capsys.readouterr()
        found = run_command(arguments)
        said = capsys.readouterr()
        assert found == code, said.err
        if code == 0:
            assert said.err == ""
            return said.out
        files.require_sentence(said.err.replace(files.TOO_LONG, "..."))
        assert said.err.startswith("thesisrecon: ")
        return said.err

    return run


@pytest.fixture
def validated(capsys):
    """Runs a command of the validation that has to end with exit code 2 before it begins."""

    def run(arguments):
        assert run_validation(arguments) == 2
        said = capsys.readouterr()
        assert said.out == ""
        files.require_sentence(said.err)
        return said.err

    return run
