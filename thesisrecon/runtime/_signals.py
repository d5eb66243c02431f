"""Prompt termination by Ctrl-C and SIGTERM.

Python handles signals in the main thread between two bytecodes, not during a kernel, an image decoder or a
wait for a thread pool. The signal therefore writes its number to a pipe, and a watching thread prints a
message, kills the child processes and exits. Nothing is lost: files are written atomically
(:mod:`thesisrecon.io._files`), and a run resumes from its cache.
"""

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
"""Exit codes: 128 plus the number of the signal, as in shells."""
REASONS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
START_S = 0.5  # Time to wait for a starting process, so that it can be killed

_stderr = [2]
_advice: list[str] = []
_kills: list[Callable[[], object]] = []
_leaving: list[signal.Signals] = []
_starting = threading.RLock()


def install_signal_handlers(program: str, advice: str = "repeat the command to resume") -> None:
    """Let SIGINT and SIGTERM, unless ignored, end this program at once with an exit code of :data:`CODES`."""
    _advice.append(advice)
    pipe, written = os.pipe()
    # A signal handler must not block.
    if hasattr(os, "set_blocking"):  # Python 3.11 on Windows
        os.set_blocking(written, False)
    signal.set_wakeup_fd(written, warn_on_full_buffer=False)
    for number in CODES:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
    # The resource tracker of multiprocessing would warn about what it cleans up afterwards.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_forget)
    try:
        threading.Thread(target=_watch, args=(program, pipe), daemon=True).start()
    except RuntimeError:
        # Without a thread that watches, the signals end the program as usual.
        _forget()


def set_error_stream(descriptor: int) -> None:
    """Set the file descriptor for messages."""
    _stderr.append(descriptor)


@contextmanager
def with_resume_advice(advice: str) -> Iterator[None]:
    """Set the advice printed if the program is ended in the block; a ``KeyboardInterrupt`` carries it too."""
    _advice.append(advice)
    try:
        yield
    except KeyboardInterrupt as stop:
        stop.args = stop.args or (advice,)
        raise
    finally:
        _advice.pop()


@contextmanager
def kill_on_exit(kill: Callable[[], object]) -> Iterator[None]:
    """Kill processes other than those of :mod:`multiprocessing` if the program is ended in the block."""
    _kills.append(kill)
    try:
        yield
    finally:
        _kills.remove(kill)


@contextmanager
def starting_processes() -> Iterator[None]:
    """Block both signals in processes started in this block, and delay the end until they can be killed."""
    while _leaving:
        time.sleep(START_S)
    with _starting:
        if not hasattr(signal, "pthread_sigmask"):  # Windows
            yield
            return
        before = signal.pthread_sigmask(signal.SIG_BLOCK, CODES)
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _forget() -> None:
    signal.set_wakeup_fd(-1)
    for number in CODES:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


def _watch(program: str, pipe: int) -> None:
    number = 0
    while number not in CODES:
        # Other handlers of the program also write to the pipe.
        number = os.read(pipe, 1)[0]
    received = signal.Signals(number)
    # No process is started from here on; wait for the one being started.
    _leaving.append(received)
    _starting.acquire(timeout=START_S)
    _say(f"{program}: {REASONS[received]}; {_advice[-1]}")
    for kill in [*_kills, _kill_children]:
        with suppress(Exception):
            kill()
    os._exit(CODES[received])


def _say(sentence: str) -> None:
    """Write to the descriptor: the main thread may hold the lock of ``sys.stderr``, the reader may hang."""
    with suppress(OSError, ValueError):
        # A progress bar hides the cursor and leaves it in the middle of a line.
        start = "\x1b[?25h\n" if os.isatty(_stderr[-1]) else ""
        line = f"{start}{' '.join(sentence.split())}\n"
        # On Windows select takes sockets only.
        if os.name == "nt" or select.select([], [_stderr[-1]], [], START_S)[1]:
            os.write(_stderr[-1], line.encode("utf-8", "backslashreplace"))


def _kill_children() -> None:
    if "multiprocessing.process" in sys.modules:
        for child in sys.modules["multiprocessing.process"].active_children():
            child.kill()
