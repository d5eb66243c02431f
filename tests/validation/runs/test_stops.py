"""A stopped report leaves no task behind."""

import os
import signal
import sys
import threading
import time
from dataclasses import replace

import pytest

from tests.runtime.test_signals import is_alive
from tests.validation.runs.test_report import toy_options
from tests.validation.runs.toy_stages import ToyStage
from validation.runs.report import run_tasks
from validation.scenes.real import ROOT
from validation.studies.robustness import stopped

PROGRAM = """
import sys
from pathlib import Path
from tests.validation.runs.test_report import toy_options
from tests.validation.runs.test_stops import hanging_stages
from thesisrecon.runtime._signals import with_resume_advice, install_signal_handlers
from validation.runs.report import run_tasks
install_signal_handlers("toy")
with with_resume_advice("begin again"):
    run_tasks(toy_options(Path(sys.argv[1]), quick=False), hanging_stages(), print)
"""


class HangingStage(ToyStage):
    """All its methods hang."""

    def methods(self, scene, options):
        return ("hanging",)


def hanging_stages():
    return {"toy": HangingStage()}


def process_of(out):
    """The process of the task that hangs, 0 where it is not there yet."""
    reported = list(out.rglob("hanging/process"))
    return int(reported[0].read_text() or 0) if reported else 0


def is_gone(number):
    """Say whether the process ends soon, as its parent has ended."""
    end = time.monotonic() + 10.0
    while is_alive(number) and time.monotonic() < end:
        time.sleep(0.02)
    return not is_alive(number)


@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGKILL])
def test_a_report_that_is_ended_takes_its_tasks_along(asked, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    program = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    stop = stopped(program, lambda: process_of(tmp_path) > 0, asked, environment=environment)
    assert is_gone(process_of(tmp_path))
    if asked == signal.SIGINT:
        assert (stop.code, stop.message, stop.left) == (130, "toy: interrupted; begin again\n", 0)


def test_an_interrupt_in_a_program_ends_the_tasks(tmp_path):
    options = replace(toy_options(tmp_path, quick=False), limit_s=120.0)

    def interrupt():
        while not process_of(tmp_path):
            time.sleep(0.02)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    # What a shell starts in the background ignores the signal, and so would this test.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt):
            run_tasks(options, hanging_stages(), print)
    finally:
        signal.signal(signal.SIGINT, before)
    assert is_gone(process_of(tmp_path))
