"""One run: options, random streams, workers, folder and progress, and the cache and reports of its stages."""

from __future__ import annotations

import re
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol, TypedDict, get_args

import numpy as np

from thesisrecon import errors
from thesisrecon._numba import code_digest
from thesisrecon.arrays import F64, I64, flag, whole_number
from thesisrecon.config import PipelineConfig
from thesisrecon.config.intrinsics import prior_from_options
from thesisrecon.config.text import table_from_dataclass, tables_from_config
from thesisrecon.imaging.on_demand import OnDemand
from thesisrecon.io._files import as_path, read_json
from thesisrecon.io._images import ImageSet
from thesisrecon.metric.given_cameras import GivenCameras
from thesisrecon.records import Features, Image, IntrinsicsPrior, PairChoice, StageReport, Tracks, TwoView
from thesisrecon.runtime import _run_folder
from thesisrecon.runtime._executors import Workers, available_threads, library_versions
from thesisrecon.runtime._progress import default_progress

Progress = Callable[[str, int, int], None]
"""Called with (stage, done, total) in the caller's thread when a part of a stage is done."""
Batch = tuple[Sequence[int], tuple[Any, ...]]
"""Numbers of some items, and the arguments of the function that computes their records."""
Until = Literal["features", "matches", "projective", "metric", "dense", "model"]

FOLDERS: Mapping[str, str] = {
    "features": "01-features", "pairs": "02-pairs", "matches": "02-matches", "tracks": "03-tracks",
    "projective": "04-projective", "selfcalibration": "05-selfcalibration", "metric": "06-metric",
    "dense": "07-dense", "model": "08-model",
}  # fmt: skip


class RunOptions(TypedDict, total=False):
    """Options of :func:`thesisrecon.reconstruct` that change no result."""

    until: Until | None
    threads: int | None
    executor: str | Executor
    overwrite: bool
    shared: str | Path | None


def stream(seed: int, stage: str, *ids: int) -> np.random.Generator:
    """The random generator of one task (view or pair numbers), which depends only on the arguments."""
    return np.random.default_rng([_checked_seed(seed), zlib.crc32(stage.encode()), *ids])


def _checked_seed(seed: Any) -> int:
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise errors.UsageError(f"the seed must be a whole number of at least 0; got {seed!r}")
    return int(seed)


@dataclass
class _StageLog:
    """Time, keys and number of computed items of a stage."""

    seconds: float = 0.0
    keys: dict[str, str] = field(default_factory=dict)
    computed: int = 0


@dataclass
class Run:
    """Settings and state of one run."""

    config: PipelineConfig
    seed: int
    workers: Workers
    directory: _run_folder.RunDirectory
    progress: Progress
    title: str  #: title of the report
    images_folder: Path | None = None  #: folder of all images; None: several folders, or images in memory
    masks_folder: Path | None = None
    images_elsewhere: dict[str, str] = field(default_factory=dict)  #: files by name outside of that folder
    as_stored: bool = False  #: pixels are those of the files without EXIF rotation, as in COLMAP
    logs: dict[str, _StageLog] = field(default_factory=dict, init=False)
    reports: dict[str, StageReport] = field(default_factory=dict, init=False)
    resumed: list[str] = field(default_factory=list, init=False)  #: stages read from the cache
    warnings: list[str] = field(default_factory=list, init=False)
    world: dict[str, Any] = field(default_factory=dict, init=False)  #: frame of the model by GPS
    groups: list[dict[str, Any]] = field(default_factory=list, init=False)  #: results of runs inside this one
    cameras: IntrinsicsPrior | None = field(default=None, init=False)  #: known before models are joined
    lens: F64 | None = field(default=None, init=False)
    """Lenses (V, 3) of the images in half diagonals, if pairs of images show that they bend lines."""
    started: float = field(default_factory=time.perf_counter, init=False)
    _stage: str = field(default="", init=False)  # the one being computed

    def inside(self, directory: _run_folder.RunDirectory) -> Run:
        """A run of a part of the images in a folder of its own, by the same workers."""
        return replace(self, directory=directory, title=f"{self.title}, {directory.path.name}")

    @contextmanager
    def clock(self, stage: str) -> Iterator[_StageLog]:
        """Add the time of the block to a stage; yields the log of the stage."""
        log, self._stage = self.logs.setdefault(stage, _StageLog()), stage
        start = time.perf_counter()
        try:
            yield log
        finally:
            log.seconds += time.perf_counter() - start

    def variant_key(self, stage: str) -> list[Any]:
        """The part of a key that identifies the method of a stage: class, parameters and code."""
        variant = getattr(self.config, stage)
        kind = type(variant)
        return [kind.__module__, kind.__qualname__, table_from_dataclass(variant), code_digest(variant)]

    def cached(self, stage: str, item: str, key: str, compute: Callable[[], Any]) -> Any:
        """Return the record of one item, from the cache or computed."""
        with self.clock(stage) as log:
            log.keys[item] = key
            (record,) = self._loaded(stage, {item: key})
            if record is None:
                record = compute()
                log.computed += 1
                self.directory.stage(FOLDERS[stage]).save(item, key, record)
            return record

    def stored(self, stage: str, item: str, key: str) -> Any:
        """The record of one item from the cache, None if it is not there."""
        return next(iter(self._loaded(stage, {item: key})))

    def _loaded(self, stage: str, keys: Mapping[str, str]) -> Iterator[Any]:
        """Cached records of items, None if missing; warns of changed ones."""
        folder = self.directory.stage(FOLDERS[stage])
        changed: list[str] = []
        for item, key in keys.items():
            try:
                record = folder.load(item, key)
            except _run_folder.ChangedRecord:
                record = None
                changed.append(f"{FOLDERS[stage]}/{item}.npz")
            if record is not None:
                self.directory.mark(folder, item)
            yield record
        if changed:
            more, were = (f" and {len(changed) - 1} more", "were") if len(changed) > 1 else ("", "was")
            self.warnings.append(errors.Notice("changed-files", changed[0], more, were, were))

    def map_cached(
        self, stage: str, keys: Mapping[str, str], function: Callable[..., Sequence[Any]],
        batches: Callable[[Sequence[int]], Iterable[Batch]], *, max_bytes: float = np.inf,
        silent: bool = False, here: bool = False,
    ) -> Sequence[Any]:  # fmt: skip
        """The records of all items (item -> key) of a stage, missing ones computed by the workers.

        Records beyond ``max_bytes`` are read when used; ``here``: in threads, for tasks with large arguments.
        """
        progress = (lambda *_: None) if silent else self.progress
        with self.clock(stage) as log:
            log.keys.update(keys)
            folder, names, missing = self.directory.stage(FOLDERS[stage]), list(keys), list[int]()

            def stored(n: int) -> Any:
                if (record := folder.load(names[n], keys[names[n]])) is None:
                    raise errors.UsageError(errors.Notice("record-lost", folder.path / f"{names[n]}.npz"))
                return record

            records = OnDemand(len(names), stored, max_bytes)
            for n, record in enumerate(self._loaded(stage, keys)):
                if record is None:
                    missing.append(n)
                else:
                    records.keep(n, record)
            done = len(names) - len(missing)
            progress(stage, done, len(names))
            submitted: list[Sequence[int]] = []

            def tasks() -> Iterator[tuple[Any, ...]]:
                for numbers, given in batches(missing) if missing else ():
                    submitted.append(numbers)
                    yield given

            def finished(k: int, found: Sequence[Any]) -> None:
                nonlocal done
                for n, record in zip(submitted[k], found, strict=True):
                    records.keep(n, record)
                    folder.save(names[n], keys[names[n]], record)
                done, log.computed = done + len(found), log.computed + len(found)
                progress(stage, done, len(names))

            local = self.workers if self.workers.in_process or not here else Workers(self.workers.threads)
            try:
                local.run(function, tasks(), finished)
            except errors.WorkersLost as lost:
                if lost.task is None:
                    raise
                items = [names[n] for n in submitted[lost.task]]
                images = dict.fromkeys(f"#{int(n)}" for item in items for n in re.findall(r"\d{5}", item))
                shown = ", ".join(list(images or items)[:4])
                more = f" and {len(images) - 4} more" if len(images) > 4 else ""
                raise errors.WorkersLost(f"{lost}; it was for {shown}{more}") from None
            return records

    @contextmanager
    def resumable(self) -> Iterator[None]:
        """Add resume advice to the error if workers are lost or a file cannot be written in the block."""
        try:
            yield
        except errors.WorkersLost as lost:
            raise errors.WorkersLost(
                errors.Notice("workers-lost", lost, self._stage, self.directory.path)
            ) from None
        except errors.OutputError as refused:
            raise errors.OutputError(refused.place, refused.error, self.directory.path) from None

    def finish(
        self, stage: str, *, counts: Mapping[str, int], metrics: Mapping[str, float] | None = None,
        warnings: Sequence[str] = (),
    ) -> None:  # fmt: skip
        """End a stage: write its manifest and report; a cached stage keeps its old report."""
        log = self.logs.setdefault(stage, _StageLog())
        report = StageReport(stage, log.seconds, dict(counts), dict(metrics or {}), tuple(warnings))
        if stage in FOLDERS:
            folder = self.directory.stage(FOLDERS[stage])
            old = None if log.computed else folder.finished(log.keys)
            if old is not None:
                self.resumed.append(stage)
                report = old
            else:
                tables = tables_from_config(self.config)
                stages = ("matching", "epipolar", "verification") if stage == "matches" else (stage,)
                folder.finish(report, {s: tables[s] for s in stages}, log.keys)
        self.reports[stage] = report
        self.warnings.extend(w for w in warnings if w not in self.warnings)

    def key(self, stage: str, *parts: Any) -> str:
        """Cache key of an item; ``parts`` are everything it depends on, but the versions of libraries."""
        return _run_folder.key_of(FOLDERS[stage], library_versions(), *parts)


class FrontEnd(Protocol):
    """The first stages of Algorithm 1: computed from images, or taken from other programs or another run."""

    @property
    def divides(self) -> bool:
        """Whether groups of images that do not overlap are reconstructed one by one."""

    def detect(self, job: Job) -> Sequence[Features]:
        """Features of each image (4.2.1)."""

    def prepare(self, job: Job, features: Sequence[Features]) -> Sequence[Any]:
        """The views as matching and tracks take them, made when they are used."""

    def select(self, job: Job, features: Sequence[Features]) -> PairChoice | None:
        """The pairs of images to match."""

    def lens(self, job: Job) -> F64 | None:
        """Lenses (V, 3) of images in half diagonals: k1, k2 and the base; None: none bends lines much."""

    def match(self, job: Job, views: Sequence[Any], choice: PairChoice | None) -> Sequence[TwoView]:
        """Matches and epipolar geometry of the pairs (4.2.2, chapter 5), F in straight pixels."""

    def track(
        self, job: Job, views: Sequence[Any], pairs: Sequence[TwoView], among: Sequence[int] | None = None
    ) -> Tracks:
        """Tracks through the accepted pairs; ``among``: images of this front end that the job consists of."""


@dataclass(frozen=True)
class Job:
    """What Algorithm 1 works on, and the last stage that is wanted."""

    run: Run
    inputs: ImageSet
    front: FrontEnd
    until: Until
    surface_required: bool = False  # whether a surface that fails is a failure; otherwise it is a warning
    known: IntrinsicsPrior | None = None
    """Prior of the intrinsics, if another model determined them."""
    given: GivenCameras | None = None
    """Cameras that are known before, in whose frame the model is."""

    @property
    def config(self) -> PipelineConfig:
        """The settings of the run."""
        return self.run.config

    @cached_property
    def images(self) -> Sequence[Image]:
        """The images at working size."""
        return self.inputs.images

    @property
    def names(self) -> list[str]:
        """File names of the images."""
        return [image.name for image in self.images]

    @cached_property
    def sizes(self) -> I64:
        """Working sizes (V, 2) of the images."""
        return np.array([image.size for image in self.images], dtype=np.int64)

    @property
    def prior(self) -> IntrinsicsPrior:
        """Prior of the intrinsics at working size, with the lenses that were found."""
        lens = self.run.lens
        return self._given_prior if lens is None else replace(self._given_prior, lens=lens)

    @cached_property
    def _given_prior(self) -> IntrinsicsPrior:
        if self.known is not None:
            return self.known
        scales = np.array([image.scale for image in self.images])
        sizes = [image.original_size for image in self.images]
        exif, options = self.inputs.exif_focal_px, self.config.intrinsics
        return prior_from_options(options, sizes, exif, scales, self.names)

    def require_images(self) -> None:
        """Raise ``StageFailure`` if there are fewer than two images (one, if only features are detected)."""
        found, needed = len(self.images), 1 if self.until == "features" else 2
        if found < needed:
            unread = [f"{name} {reason}" for name, reason in self.inputs.refused.items()]
            more = [f"and {len(unread) - 3} more"] if len(unread) > 3 else []
            wanted = f"at least {'two different ones are' if needed == 2 else 'one is'} needed"
            evidence = "; ".join([wanted, *unread[:3], *more])
            raise errors.StageFailure.of("one-image" if found else "no-images", evidence)


def name_images(text: str, names: Sequence[str]) -> str:
    """Replace the image numbers (``#number``) in a sentence of a stage by file names."""
    # A file name such as "a #1.jpg" in the sentence is left alone.
    named = re.sub(
        r"(?<![^\s(])#(\d+)(?!\.?\w)", lambda m: names[int(m[1])] if int(m[1]) < len(names) else m[0], text
    )
    return errors.Notice.of(text.code, named) if isinstance(text, errors.Notice) else named


def start_run(
    out: str | Path, config: PipelineConfig, seed: int, progress: Progress | None, options: Mapping[str, Any]
) -> tuple[Until, Run, bool]:
    """Check the options of a call; return the last stage, the run and whether to overwrite another."""
    unknown = sorted(set(options) - set(RunOptions.__annotations__))
    if unknown:
        others = ("config", "preset", "max_size", "cameras", "pairs", "set", "masks", "every", "seed")
        known = (*RunOptions.__annotations__, *others)
        raise TypeError(errors.unknown_word("option of reconstruct", unknown[0], known))
    until: Until = options.get("until") or "model"
    if until not in get_args(Until):
        raise errors.UsageError(errors.unknown_word("stage", str(until), get_args(Until)))
    folder, threads = as_path("a run", "out", out), options.get("threads")
    if not str(out).strip():
        raise errors.UsageError("the output folder has no name; write . for the current one")
    seed = _checked_seed(seed)
    threads = 0 if threads is None else whole_number("a run", "threads", threads, 0)
    workers = Workers(threads or available_threads(), options.get("executor", "local"))
    shared = options.get("shared")
    directory = _run_folder.RunDirectory(folder, None if shared is None else Path(shared))
    report = progress or default_progress()
    run = Run(config, seed, workers, directory, report, directory.path.absolute().name)
    return until, run, flag("a run", "overwrite", options.get("overwrite", False))


def run_position(folder: Path) -> str:
    """One sentence: running or interrupted, the stage and the items done; empty without a run."""
    content = read_json(folder / _run_folder.RUN_FILE)
    if not isinstance(content, dict):
        return ""
    # The last stage that was written to; older records belong to a replaced run and were not reused.
    started, (stage, done) = (folder / _run_folder.RUN_FILE).stat().st_mtime, ("images", 0)
    for one, name in FOLDERS.items():
        if items := sum(path.stat().st_mtime >= started for path in (folder / name).glob("*.npz")):
            stage, done = one, items
    total = len(content.get("images", ())) if stage == "features" else 0
    if stage == "matches":
        pairs = _run_folder.StageFolder(folder / FOLDERS["pairs"])
        choice = _run_folder.read_record(pairs.path / "choice.npz", pairs.keys().get("choice", ""))
        total = 0 if choice is None else len(choice.pairs)
    where = f"{stage}, {errors.counted(done, 'item')} done" if done else f"{stage} begins"
    if done and total:
        where = f"{stage}, {done} of {total} done" if done < total else f"{stage} is done"
    running = _run_folder.is_running(folder)
    return f"running: {where}" if running else f"interrupted: {where}; repeat the command to resume"
