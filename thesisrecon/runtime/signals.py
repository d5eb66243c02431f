"""Ctrl-C, and being told to end (SIGTERM), obeyed at any moment of a command.

Python hears of a signal on its main thread, between two steps of the interpreter: not while a kernel, a
decoder or a wait for other threads goes on there, and the end of a pool of threads is such a wait. So the
signal writes its number into a pipe, which it does whatever the main thread is at, and a thread that only
reads from that pipe ends the program: it says one sentence, kills the processes the program has started, and
leaves at once. Nothing is lost by leaving in the middle of anything: a file appears under its name when it is
whole (:mod:`thesisrecon.io.files`), so what a run has kept is what it goes on from.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
"""Exit codes, 128 and the number of the signal, as shells have them."""
REASONS = {signal.SIGINT: "interrupted", signal.SIGTERM: "told to end"}
START_S = 0.5
"""How long a process that is just being started is waited for, so that it can be killed."""
STDERR = 2
_SHOW_CURSOR = "\x1b[?25h\n"

_stderr = [STDERR]
_advice: list[str] = []
_kills: list[Callable[[], object]] = []
_leaving: list[signal.Signals] = []
_starting = threading.RLock()


def obey_signals(program: str, advice: str = "give the same command again") -> None:
    """From now on SIGINT and SIGTERM end this process, with what :func:`advised` says and an exit code of
    :data:`CODES`.

    To be called once, by a program and not by a library, from the main thread; ``advice`` is said where
    nothing else is to be. A signal that this process was started to ignore (``nohup``, a command in the
    background of a script) stays ignored.
    """
    _advice.append(advice)
    heard, written = os.pipe()
    # The handler of the signal may not wait.
    os.set_blocking(written, False)
    signal.set_wakeup_fd(written, warn_on_full_buffer=False)
    for number in CODES:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
    # The helper of multiprocessing would tell of what it clears away behind a program that has left.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")
    os.register_at_fork(after_in_child=_forget)
    threading.Thread(target=_obey, args=(program, heard), daemon=True).start()


def speak_through(descriptor: int) -> None:
    """The error stream of the program is from now on this descriptor."""
    _stderr.append(descriptor)


@contextmanager
def advised(advice: str) -> Iterator[None]:
    """Whoever ends the program in this block is told this; a ``KeyboardInterrupt`` carries it."""
    _advice.append(advice)
    try:
        yield
    except KeyboardInterrupt as stop:
        stop.args = stop.args or (advice,)
        raise
    finally:
        _advice.pop()


@contextmanager
def killed_by(kill: Callable[[], object]) -> Iterator[None]:
    """Call ``kill`` when the program is ended in this block; processes of :mod:`multiprocessing` are killed
    anyway."""
    _kills.append(kill)
    try:
        yield
    finally:
        _kills.remove(kill)


@contextmanager
def starting_processes() -> Iterator[None]:
    """Processes started in this block leave both signals waiting from their first moment on, for a terminal
    sends them to all of a program; and the program does not end before they can be killed."""
    while _leaving:
        time.sleep(START_S)
    with _starting:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, CODES)
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _forget() -> None:
    """In a fork: its signals are not those of the program."""
    signal.set_wakeup_fd(-1)
    for number in CODES:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


def _obey(program: str, heard: int) -> None:
    number = 0
    while number not in CODES:
        # Other handlers of the program write here too.
        number = os.read(heard, 1)[0]
    asked = signal.Signals(number)
    # Nothing more is started from here on; what is being started is waited for.
    _leaving.append(asked)
    _starting.acquire(timeout=START_S)
    _say(f"{program}: {REASONS[asked]}; {_advice[-1]}")
    for kill in [*_kills, _kill_children]:
        with suppress(Exception):
            kill()
    os._exit(CODES[asked])


def _say(sentence: str) -> None:
    """To the error stream itself: the main thread may hold the lock of Python's. Nobody is waited for who
    does not read."""
    with suppress(OSError, ValueError):
        # A bar of progress has hidden the cursor and stands in the middle of a line.
        start = _SHOW_CURSOR if os.isatty(_stderr[-1]) else ""
        if select.select([], [_stderr[-1]], [], START_S)[1]:
            os.write(
                _stderr[-1], f"{start}{' '.join(sentence.split())}\n".encode("utf-8", "backslashreplace")
            )


def _kill_children() -> None:
    if "multiprocessing.process" in sys.modules:
        for child in sys.modules["multiprocessing.process"].active_children():
            child.kill()
