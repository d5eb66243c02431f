"""Programs that receive a stop signal end at once with one message and their exit code."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import without_progress
from thesisrecon.cli.commands import run_command
from thesisrecon.runtime._signals import CODES
from validation.studies.robustness import different, outputs, stopped

ROOT = Path(__file__).parents[2]
COURTYARD = ROOT / "fixtures" / "courtyard" / "images"
ENDLESS = 'hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)'
"""Compiled code that lets go of the interpreter and does not end."""
PROGRAM = """
import hashlib, sys, time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from thesisrecon.runtime._signals import with_resume_advice, install_signal_handlers
from thesisrecon.runtime._executors import ProcessPool
if __name__ == "__main__":
    install_signal_handlers("toy")
    with with_resume_advice("it goes on\\nlater"):
        {work}
"""
IGNORING = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
os.execv(sys.argv[1], sys.argv[1:])
"""
LOADING = """
import runpy, sys, time
from pathlib import Path
ready, name, slow = sys.argv[1:]
class Slow:
    def find_spec(self, wanted, *_):
        if wanted == slow:
            Path(ready).touch()
            time.sleep(600)
sys.meta_path.insert(0, Slow())
runpy.run_module(name, run_name="__main__", alter_sys=True)
"""
"""A command, one of whose modules is never loaded."""
AT_WORK = {
    "in compiled code": "Path(sys.argv[1]).touch(); " + ENDLESS,
    "at the end of a pool of threads": f"""
        with ThreadPoolExecutor(2) as pool:
            for _ in range(5):
                pool.submit(lambda: {ENDLESS})
            Path(sys.argv[1]).touch()""",
    "in processes": """
        pool = ProcessPool(2)
        tasks = [pool.submit(time.sleep, 600) for _ in range(5)]
        while not tasks[1].running():
            time.sleep(0.01)
        Path(sys.argv[1]).touch()
        tasks[0].result()""",
    "while it starts processes": """
        Path(sys.argv[1]).touch()
        while True:
            ProcessPool(2).submit(time.sleep, 600)""",
}


def program(folder, work):
    file = folder / "toy.py"
    file.write_text(PROGRAM.format(work=work))
    return [sys.executable, str(file), str(folder / "ready")]


def is_alive(number):
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.parametrize("what", AT_WORK)
@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGTERM])
def test_a_program_stops_at_any_time(what, asked, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ready = tmp_path / "ready"
    stop = stopped(program(tmp_path, AT_WORK[what]), ready.exists, asked, environment=environment)
    word = "interrupted" if asked == signal.SIGINT else "terminated"
    assert (stop.code, stop.message, stop.left) == (CODES[asked], f"toy: {word}; it goes on later\n", 0)


@pytest.mark.parametrize(("name", "slow"), [("thesisrecon", "cli"), ("validation", "command")])
@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGTERM])
def test_a_command_is_ended_while_it_is_loaded(name, slow, asked, tmp_path):
    ready = tmp_path / "ready"
    program = [sys.executable, "-c", LOADING, str(ready), name, f"{name}.{slow}"]
    stop = stopped(program, ready.exists, asked, environment={**os.environ, "PYTHONPATH": str(ROOT)})
    word = "interrupted" if asked == signal.SIGINT else "terminated"
    assert stop.code == CODES[asked]
    assert stop.message == f"{name}: {word}; repeat the command to resume\n"


def test_signals_ignored_at_start_stay_ignored(tmp_path):
    ready = tmp_path / "ready"
    work = "Path(sys.argv[1]).touch(); time.sleep(0.5)"
    process = subprocess.Popen(
        [sys.executable, "-c", IGNORING, *program(tmp_path, work)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    while not ready.exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 0


def test_a_run_that_was_stopped_goes_on_to_the_same_bytes(tmp_path):
    images, out = tmp_path / "images", tmp_path / "out"
    images.mkdir()
    for path in sorted(COURTYARD.iterdir())[:4]:
        (images / path.name).symlink_to(path)
    arguments = ["reconstruct", str(images), "--max-size", "200", "--until", "matches", "--threads", "2"]
    stop = stopped(
        [sys.executable, "-m", "thesisrecon", *arguments, "-o", str(out), "--executor", "processes"],
        lambda: any(out.glob("01-features/*.npz")),
        signal.SIGINT,
        environment={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert (stop.code, stop.left) == (130, 0)
    advice = f"repeat the command to resume from {out}"
    assert without_progress(stop.message) == f"thesisrecon: interrupted; {advice}\n"
    assert run_command([*arguments, "-o", str(out)]) == 0
    assert run_command([*arguments, "-o", str(tmp_path / "whole")]) == 0
    assert different(outputs(out), outputs(tmp_path / "whole")) == ()
