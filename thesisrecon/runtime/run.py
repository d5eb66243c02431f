"""One run while it goes on: its settings, workers and folder, and the clock, cache and reports of its
stages.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypedDict, get_args

import numpy as np

from thesisrecon.config import PipelineConfig, kind_of, tables_from_config
from thesisrecon.errors import OutputError, UsageError, WorkersLost
from thesisrecon.records import StageReport
from thesisrecon.runtime.executors import Workers, available_threads
from thesisrecon.runtime.record_files import ChangedRecord
from thesisrecon.runtime.run_folder import RunDirectory, code_key, key_of
from thesisrecon.settings import table_from_dataclass, unknown_word

Progress = Callable[[str, int, int], None]
"""Hears (stage, done, total) whenever a part of a stage is done; called from the thread of the caller."""

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
    """How a run is carried out, none of which changes what it finds.

    ``until`` : the last stage. None = "model", and a run that finds cameras and points but no surface ends
    well, with a warning. ``threads`` : workers (all processors). ``executor`` : who works on photographs,
    pairs and depth maps: "local" threads, "processes", a Dask cluster ("dask://HOST:PORT", which needs the
    extra ``distributed``), or any :class:`concurrent.futures.Executor`; see :class:`Workers`. ``overwrite`` :
    take over a folder that holds another run (False). ``shared`` : a folder where results of stages are kept
    for other runs, and taken from where another run has found the same.
    """

    until: Until | None
    threads: int | None
    executor: str | Executor
    overwrite: bool
    shared: str | Path | None


Batch = tuple[Sequence[int], tuple[Any, ...]]
"""The numbers of some items, and the arguments of the function that computes their records."""


def stream(seed: int, stage: str, *ids: int) -> np.random.Generator:
    """The random numbers of one task: they depend on (seed, stage, ids) and on nothing that ran before."""
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(stage.encode()), *ids]))


@dataclass
class StageLog:
    """What is known of a stage so far."""

    seconds: float = 0.0
    keys: dict[str, str] = field(default_factory=dict)
    computed: int = 0


@dataclass
class Run:
    """The settings and the state of one run; the only thing here that changes."""

    config: PipelineConfig
    seed: int
    workers: Workers
    directory: RunDirectory
    progress: Progress
    title: str
    logs: dict[str, StageLog] = field(default_factory=dict)
    reports: dict[str, StageReport] = field(default_factory=dict)
    resumed: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)

    @property
    def elapsed_s(self) -> float:
        """Wall time (s) since the run was started; the clocks of kept stages tell of older ones."""
        return time.perf_counter() - self.started

    @contextmanager
    def clock(self, stage: str) -> Iterator[StageLog]:
        """Count the time of the block to the stage."""
        log = self.logs.setdefault(stage, StageLog())
        start = time.perf_counter()
        try:
            yield log
        finally:
            log.seconds += time.perf_counter() - start

    def variant_key(self, stage: str) -> list[Any]:
        """What names the variant of a stage in a key: its kind, its parameters and its code."""
        variant = getattr(self.config, stage)
        module = type(variant).__module__
        return [module, type(variant).__qualname__, table_from_dataclass(variant), code_key(module)]

    def kept(self, stage: str, item: str, key: str, compute: Callable[[], Any]) -> Any:
        """The record of one item of a stage: read where it was kept under this key, else computed and
        kept.
        """
        with self.clock(stage) as log:
            log.keys[item] = key
            (record,) = self._loaded(stage, {item: key})
            if record is None:
                record = compute()
                log.computed += 1
                self.directory.stage(FOLDERS[stage]).save(item, key, record)
            return record

    def _loaded(self, stage: str, keys: Mapping[str, str]) -> list[Any]:
        """What was kept of these items, None where nothing was; of records that were changed is told."""
        folder = self.directory.stage(FOLDERS[stage])
        records: list[Any] = []
        changed: list[str] = []
        for item, key in keys.items():
            try:
                records.append(folder.load(item, key))
            except ChangedRecord:
                records.append(None)
                changed.append(f"{FOLDERS[stage]}/{item}.npz")
        if changed:
            more = f" and {len(changed) - 1} more were" if len(changed) > 1 else " was"
            again = "are computed again" if len(changed) > 1 else "is computed again"
            self.warnings.append(f"{changed[0]}{more} damaged or changed by another program, and {again}")
        return records

    def kept_all(
        self,
        stage: str,
        keys: Mapping[str, str],
        function: Callable[..., Sequence[Any]],
        batches: Callable[[Sequence[int]], Iterable[Batch]],
    ) -> list[Any]:
        """The records of all items of a stage, in order; those that were not kept are computed by the
        workers.

        ``batches`` is given the numbers of the missing items and deals them out: the numbers of some, and
        what ``function`` takes to make their records.
        """
        with self.clock(stage) as log:
            log.keys.update(keys)
            folder = self.directory.stage(FOLDERS[stage])
            names = list(keys)
            records = self._loaded(stage, keys)
            missing = [n for n, record in enumerate(records) if record is None]
            done = len(names) - len(missing)
            self.progress(stage, done, len(names))
            dealt: list[Sequence[int]] = []

            def tasks() -> Iterator[tuple[Any, ...]]:
                for numbers, given in batches(missing) if missing else ():
                    dealt.append(numbers)
                    yield given

            def finished(k: int, found: Sequence[Any]) -> None:
                nonlocal done
                for n, record in zip(dealt[k], found, strict=True):
                    records[n] = record
                    folder.save(names[n], keys[names[n]], record)
                done, log.computed = done + len(found), log.computed + len(found)
                self.progress(stage, done, len(names))

            with self.resumable(stage):
                self.workers.run(function, tasks(), finished)
            return records

    @contextmanager
    def resumable(self, stage: str) -> Iterator[None]:
        """Whoever loses the workers in this block is told how the run goes on."""
        try:
            yield
        except WorkersLost as lost:
            raise WorkersLost(
                f"{lost} (in the stage {stage}); what was done is kept in {self.directory.path}, and the "
                "same command goes on from there, with this executor or another"
            ) from None

    @contextmanager
    def kept_in_folder(self) -> Iterator[None]:
        """Whoever cannot write in this block is told how the run goes on."""
        try:
            yield
        except OutputError as refused:
            raise OutputError(refused.place, refused.error, self.directory.path) from None

    def finish(
        self,
        stage: str,
        *,
        counts: Mapping[str, int],
        metrics: Mapping[str, float] | None = None,
        warnings: Sequence[str] = (),
    ) -> None:
        """End a stage: its report, and in its folder the manifest. A stage that was only read keeps its old
        report.
        """
        log = self.logs.setdefault(stage, StageLog())
        report = StageReport(stage, log.seconds, dict(counts), dict(metrics or {}), tuple(warnings))
        if stage in FOLDERS:
            folder = self.directory.stage(FOLDERS[stage])
            old = None if log.computed else folder.finished(log.keys)
            if old is not None:
                self.resumed.append(stage)
                report = old
            else:
                folder.finish(report, self._settings_of(stage), log.keys)
        self.reports[stage] = report
        self.warnings.extend(w for w in warnings if w not in self.warnings)

    def _settings_of(self, stage: str) -> dict[str, Any]:
        """The tables a stage runs by."""
        stages = ("matching", "epipolar", "verification") if stage == "matches" else (stage,)
        tables = tables_from_config(self.config)
        return {s: {"kind": kind_of(s, getattr(self.config, s))} | tables[s] for s in stages}

    def key(self, stage: str, *parts: Any) -> str:
        """The key of an item of this stage made from these parts."""
        return key_of(FOLDERS[stage], *parts)


def start_run(
    out: str | Path, config: PipelineConfig, seed: int, progress: Progress | None, options: Mapping[str, Any]
) -> tuple[Until, Run, bool]:
    """The checked wishes of a call as (last stage, run, overwrite); :class:`UsageError` names a wrong
    one.
    """
    unknown = sorted(set(options) - set(RunOptions.__annotations__))
    if unknown:
        raise TypeError(unknown_word("option of reconstruct", unknown[0], RunOptions.__annotations__))
    until: Until = options.get("until") or "model"
    if until not in get_args(Until):
        raise UsageError(unknown_word("stage", str(until), get_args(Until)))
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise UsageError(f"the seed must be a whole number of at least 0; got {seed!r}")
    threads = options.get("threads") or available_threads()
    workers = Workers(threads, options.get("executor", "local"))
    if not str(out).strip():
        raise UsageError("the output folder has no name; write . for the current one")
    shared = options.get("shared")
    directory = RunDirectory(Path(out), None if shared is None else Path(shared))
    hear = progress or (lambda *_: None)
    run = Run(config, seed, workers, directory, hear, directory.path.absolute().name)
    return until, run, bool(options.get("overwrite", False))
