"""Options, stages and random streams of a run."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np

from thesisrecon.errors import UsageError

Progress = Callable[[str, int, int], None]
"""Called with (stage, done, total) in the caller's thread when a part of a stage is done."""

FOLDERS: Mapping[str, str] = {
    "features": "01-features",
    "pairs": "02-pairs",
    "matches": "02-matches",
    "tracks": "03-tracks",
    "projective": "04-projective",
    "selfcalibration": "05-selfcalibration",
    "metric": "06-metric",
    "dense": "07-dense",
    "model": "08-model",
}

Until = Literal["features", "matches", "projective", "metric", "dense", "model"]


class RunOptions(TypedDict, total=False):
    """Options of :func:`thesisrecon.reconstruct`: ``until`` selects the last stage; none changes a result.

    Attributes
    ----------
    until : {"features", "matches", "projective", "metric", "dense", "model"}, optional
        Last stage. None: "model", where a surface that fails is only a warning.
    threads : int, optional
        Number of workers; None: all processors.
    executor : str or concurrent.futures.Executor
        "local" (threads), "processes", "dask://HOST:PORT" (needs the extra ``distributed``) or an executor;
        see :class:`~thesisrecon.runtime.executors.Workers`.
    overwrite : bool
        Replace another run in the output folder.
    shared : path, optional
        Folder in which runs share cached results of stages.
    """

    until: Until | None
    threads: int | None
    executor: str | Executor
    overwrite: bool
    shared: str | Path | None


def stream(seed: int, stage: str, *ids: int) -> np.random.Generator:
    """Return the random generator of one task, which depends only on the arguments.

    Parameters
    ----------
    seed : int
        Seed of the run; ``ValueError`` if it is not a whole number of at least 0.
    stage : str
        Name of the stage.
    *ids : int
        Numbers of the task, such as view or pair.

    Returns
    -------
    numpy.random.Generator
    """
    entropy = [checked_seed(seed), zlib.crc32(stage.encode()), *ids]
    return np.random.default_rng(np.random.SeedSequence(entropy))


def checked_seed(seed: Any) -> int:
    """Return the seed as an int.

    Parameters
    ----------
    seed : int
        Seed of a run; ``UsageError`` if it is not a whole number of at least 0.

    Returns
    -------
    int
    """
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise UsageError(f"the seed must be a whole number of at least 0; got {seed!r}")
    return int(seed)
