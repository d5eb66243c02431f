"""A Dask cluster as workers; needs the extra ``distributed``, imported only when an address is given."""

from __future__ import annotations

import concurrent.futures as futures
import logging
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from thesisrecon.errors import UsageError, WorkersLost

SCHEME = "dask://"
ANSWER_S = 10.0
"""Timeout of the scheduler, and of the first worker."""
WORKERLESS_S = 60.0
"""Time a cluster may be without workers during a run, so that they can be restarted."""
_ADDRESS = re.compile(r"(?P<host>[^\s:/@?#\[\]]+|\[[0-9A-Fa-f:.]+\]):(?P<port>\d{1,5})")


def is_dask_address(executor: object) -> bool:
    """Whether an executor is given as a Dask address."""
    return isinstance(executor, str) and executor.partition(":")[0].lower() == "dask"


def tcp_address(executor: str) -> str:
    """Convert ``dask://HOST:PORT`` to ``tcp://HOST:PORT``."""
    found = _ADDRESS.fullmatch(executor.removeprefix(SCHEME)) if executor.startswith(SCHEME) else None
    if found is None or not 0 < int(found["port"]) < 65536:
        form = "dask://HOST:PORT, for example dask://localhost:8786"
        raise UsageError(f"a Dask scheduler must be given as {form}; got {executor!r}")
    return f"tcp://{found[0]}"


@dataclass
class Cluster:
    """A connection to a scheduler (HOST:PORT), and its executor."""

    address: str
    client: Any
    executor: futures.Executor
    _alone_since: float | None = field(default=None, repr=False)

    def parallel(self) -> int:
        """Number of worker threads, at least 1: a worker may come back."""
        return max(1, sum(self._threads().values()))

    def check(self) -> None:
        """Raise ``WorkersLost`` if the scheduler is gone or has had no worker for ``WORKERLESS_S``."""
        if self._threads():
            self._alone_since = None
            return
        now = time.monotonic()
        self._alone_since = self._alone_since or now
        if now - self._alone_since > WORKERLESS_S:
            alone = f"has had no worker for {WORKERLESS_S:.0f} s"
            raise WorkersLost(f"the Dask scheduler at {self.address} {alone}")

    def lost(self) -> WorkersLost:
        """The error for tasks that were cancelled."""
        return WorkersLost(f"the Dask scheduler at {self.address} is gone")

    def _threads(self) -> dict[str, int]:
        try:
            found: dict[str, int] = self.client.nthreads()
        except Exception:
            # A broken connection raises many types.
            raise self.lost() from None
        return found


@contextmanager
def connect_dask(executor: str) -> Iterator[Cluster]:
    """Connect to a Dask scheduler for the duration of a block."""
    address = tcp_address(executor)
    try:
        import dask
        from distributed import Client
    except ImportError:
        missing = "needs the package distributed, which is not installed; install thesisrecon[distributed]"
        raise UsageError(f"--executor {executor} {missing}") from None
    # Errors are reported by this module; large tasks are intended.
    settings = {"distributed.admin.large-graph-warning-threshold": "1TiB"}
    place = address.removeprefix("tcp://")
    with _quiet("distributed"), dask.config.set(settings):
        try:
            client = Client(address, timeout=ANSWER_S, set_as_default=False)
        except (OSError, futures.TimeoutError):
            raise UsageError(
                f"no Dask scheduler answers at {place} within {ANSWER_S:.0f} s; "
                "start one there (dask scheduler) and its workers (dask worker), or correct the address"
            ) from None
        try:
            try:
                client.wait_for_workers(1, timeout=ANSWER_S)
            except (OSError, futures.TimeoutError):
                advice = f"start some with: dask worker {address}"
                raise UsageError(f"the Dask scheduler at {place} has no workers; {advice}") from None
            # pure=False: do not hash all bytes of the tasks.
            yield Cluster(place, client, client.get_executor(pure=False))
        finally:
            with suppress(Exception):
                client.close(timeout=1.0)


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Silence a logger and its children."""
    loggers = [logging.getLogger(name)]
    loggers += [logging.getLogger(n) for n in logging.root.manager.loggerDict if n.startswith(f"{name}.")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
