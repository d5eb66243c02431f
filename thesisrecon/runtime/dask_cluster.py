"""A Dask cluster as workers: the extra ``distributed``, imported only when an address is given."""

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
"""How long a scheduler may take to answer, and a cluster to show a worker."""
WORKERLESS_S = 60.0
"""How long a cluster may have no worker in the middle of a run: one that died is started again meanwhile."""
_ADDRESS = re.compile(r"(?P<host>[^\s:/@?#\[\]]+|\[[0-9A-Fa-f:.]+\]):(?P<port>\d{1,5})")


def is_address(executor: object) -> bool:
    """Whether the name of an executor is meant as that of a Dask scheduler."""
    return isinstance(executor, str) and executor.partition(":")[0].lower() == "dask"


def address_of(executor: str) -> str:
    """``tcp://HOST:PORT`` of ``dask://HOST:PORT``; :class:`UsageError` for anything else."""
    found = _ADDRESS.fullmatch(executor.removeprefix(SCHEME)) if executor.startswith(SCHEME) else None
    if found is None or not 0 < int(found["port"]) < 65536:
        raise UsageError(
            "a Dask scheduler is given as dask://HOST:PORT, for instance dask://localhost:8786; "
            f"got {executor!r}"
        )
    return f"tcp://{found[0]}"


@dataclass
class Cluster:
    """A connection to a scheduler, and its executor."""

    address: str
    client: Any
    executor: futures.Executor
    _alone_since: float | None = field(default=None, repr=False)

    def parallel(self) -> int:
        """How many tasks its workers do at a time; at least 1, for a worker may come back."""
        return max(1, sum(self._threads().values()))

    def check(self) -> None:
        """:class:`WorkersLost` where the scheduler is gone, or has had no worker for long."""
        if self._threads():
            self._alone_since = None
            return
        now = time.monotonic()
        self._alone_since = self._alone_since or now
        if now - self._alone_since > WORKERLESS_S:
            raise WorkersLost(
                f"the Dask scheduler at {self.address} has had no worker for {WORKERLESS_S:.0f} s"
            )

    def lost(self) -> WorkersLost:
        """What is to be said when tasks come back undone."""
        return WorkersLost(f"the Dask scheduler at {self.address} is gone")

    def _threads(self) -> dict[str, int]:
        try:
            found: dict[str, int] = self.client.nthreads()
        except Exception:
            # Whatever a broken connection makes the client raise.
            raise self.lost() from None
        return found


@contextmanager
def connected(executor: str) -> Iterator[Cluster]:
    """The cluster of ``dask://HOST:PORT`` while the block lasts.

    Raises :class:`UsageError` where the extra is not installed, nobody answers, or there is no worker.
    """
    address = address_of(executor)
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise UsageError(
            f"--executor {executor} needs the package distributed, which is not installed; install "
            "thesisrecon[distributed]"
        ) from None
    # Its messages are told as sentences of our own; tasks are large by intent.
    settings = {"distributed.admin.large-graph-warning-threshold": "1TiB"}
    with _quiet("distributed"), dask.config.set(settings):
        try:
            client = Client(address, timeout=ANSWER_S, set_as_default=False)
        except (OSError, futures.TimeoutError):
            raise UsageError(
                f"no Dask scheduler answers at {address.removeprefix('tcp://')} within {ANSWER_S:.0f} s; "
                "start one there (dask scheduler) and its workers (dask worker), or mend the address"
            ) from None
        try:
            _wait_for_worker(client, address)
            # Tasks are told apart by what they are, not by a hash of all their bytes.
            yield Cluster(address.removeprefix("tcp://"), client, client.get_executor(pure=False))
        finally:
            with suppress(Exception):
                client.close(timeout=1.0)


def _wait_for_worker(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=ANSWER_S)
    except (OSError, futures.TimeoutError):
        raise UsageError(
            f"the Dask scheduler at {address.removeprefix('tcp://')} has no workers; start some with: "
            f"dask worker {address}"
        ) from None


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """No messages of these loggers below the worst."""
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
