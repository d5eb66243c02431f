"""The run directory: what a stage computed, kept so that a kill at any point loses little.

Each result is one npz file with a JSON description inside, written whole or not at all. It carries the key
of what it was made from (settings, code and inputs, all the way up), and is used again only under that key
and as it was written.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.errors import OutputError, UsageError
from thesisrecon.io.files import as_read, is_partial, link, read_json, write_atomically, write_json
from thesisrecon.records import StageReport
from thesisrecon.runtime.record_files import ChangedRecord, bytes_from_record, read_record

try:
    import fcntl
except ImportError:  # pragma: no cover - only where there is no POSIX
    fcntl = None  # type: ignore[assignment]

FORMAT = 2
RUN_FILE, LOCK_FILE, MANIFEST_FILE = "run.json", ".lock", "manifest.json"
_CODE_OF_ALL_STAGES = ("arrays.py", "camera.py", "errors.py", "records.py", "geometry", "numerics")


def key_of(*parts: Any) -> str:
    """A short name for JSON-like parts: equal parts give equal keys, on every machine."""
    text = json.dumps(parts, sort_keys=True, default=_json_value, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _json_value(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [str(value.dtype), value.shape, hashlib.sha256(np.ascontiguousarray(value).data).hexdigest()]
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a key is made of plain values and arrays; got {type(value).__name__}")


@cache
def code_key(module: str) -> str:
    """A short name for the code a variant of ``module`` runs: its stage folder and what all stages share.

    Results of other code are thus never taken for results of this one. A module of the caller counts by its
    own file alone.
    """
    package = Path(__file__).parent.parent
    parts = module.split(".")
    own = [package / parts[1]] if parts[0] == package.name and len(parts) > 1 else _file_of(module)
    content = hashlib.sha256(f"{module} {FORMAT}".encode())
    for root in [*own, *(package / part for part in _CODE_OF_ALL_STAGES)]:
        for path in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
            content.update(path.read_bytes())
    return content.hexdigest()[:32]


def _file_of(module: str) -> list[Path]:
    """The file of a loaded module of the caller; none where it was typed into a prompt."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return [Path(file)] if file is not None and Path(file).is_file() else []


@dataclass(frozen=True)
class StageFolder:
    """The folder of one stage: a file per item, and a manifest that people can read.

    ``shared`` is a folder of results of several runs, each named by its key; None where a run stands alone.
    """

    path: Path
    shared: Path | None = None

    def load(self, item: str, key: str) -> Any:
        """The kept record of this item, from this run or another; None where it must be computed.

        Raises :class:`ChangedRecord` where it must be computed since a file of it is not as it was written.
        """
        own, changed = self.path / f"{item}.npz", None
        places = [own] if self.shared is None else [own, self.shared / f"{key}.npz"]
        for place in places:
            try:
                record = read_record(place, key)
            except ChangedRecord as error:
                changed = error
                continue
            if record is not None:
                if place != own:
                    link(place, own)
                return record
        if changed is not None:
            raise changed
        return None

    def save(self, item: str, key: str, record: Any) -> None:
        """Keep the record of this item."""
        own = self.path / f"{item}.npz"
        write_atomically(own, bytes_from_record(record, key))
        if self.shared is not None:
            link(own, self.shared / f"{key}.npz")

    def finish(self, report: StageReport, settings: Mapping[str, Any], keys: Mapping[str, str]) -> None:
        """Write the manifest of a stage that is done; files of items that are no longer part of it, and what
        a kill left of one that was being written, are removed.
        """
        try:
            for stale in [*self.path.glob("*.npz"), *self.path.glob(".*.partial")]:
                if is_partial(stale.name) or stale.stem not in keys:
                    stale.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(self.path, error) from None
        content = {"format": FORMAT, "settings": settings, "keys": keys, "report": dataclasses.asdict(report)}
        write_json(self.path / MANIFEST_FILE, content)

    def finished(self, keys: Mapping[str, str]) -> StageReport | None:
        """The report of the run that computed exactly these items, None where it did not end."""
        content = read_json(self.path / MANIFEST_FILE)
        try:
            if content["keys"] != dict(keys):
                return None
            return _report(**content["report"])
        except (TypeError, KeyError, AttributeError):
            return None


def _report(*, seconds: Any, counts: Any, metrics: Any, warnings: Any, stage: Any) -> StageReport:
    """A report of these values as JSON has them; ``TypeError`` where one is not what it should be."""
    numbers = [seconds, *counts.values(), *(value for value in metrics.values() if value is not None)]
    if not all(isinstance(number, int | float) for number in numbers):
        raise TypeError("a report counts in numbers")
    if not all(isinstance(word, str) for word in (stage, *warnings)):
        raise TypeError("a report warns in words")
    return StageReport(stage, seconds, counts, metrics, tuple(warnings))


@dataclass(frozen=True)
class RunDirectory:
    """The output folder of one run, and the folder of results it ``shared`` with others (None: it shares
    none)."""

    path: Path
    shared: Path | None = None

    def stage(self, folder: str) -> StageFolder:
        """The folder of one stage, as ``01-features``."""
        return StageFolder(self.path / folder, None if self.shared is None else self.shared / folder)

    @contextmanager
    def claimed(self, wishes: Mapping[str, Any], *, overwrite: bool) -> Iterator[None]:
        """Hold the folder for a run of these ``wishes``: as much of its identity as is known before its
        photographs are read.

        Raises :class:`UsageError` where the folder cannot be written, is in use, holds things of no run, or
        holds another run, unless ``overwrite``; nothing in it is changed then.
        """
        with _locked(self.path):
            self._check(wishes, overwrite)
            yield

    def adopt(self, identity: Mapping[str, Any], *, overwrite: bool, results: Sequence[str] = ()) -> None:
        """Make the claimed folder that of the run of this ``identity`` (settings, seed, photographs).

        A folder of the same run is resumed. Where another run is replaced, its ``results`` (paths in the
        folder) are removed: they must not stand beside those of this one. Raises as :meth:`claimed` does.
        """
        if self._check(identity, overwrite):
            self.remove(results)
        write_json(self.path / RUN_FILE, identity)

    def remove(self, names: Sequence[str]) -> None:
        """Remove these files of the folder, where they are there, and the folders that are empty then."""
        try:
            for path in (self.path / name for name in names):
                path.unlink(missing_ok=True)
                for parent in path.parents[: len(path.relative_to(self.path).parents) - 1]:
                    if parent.is_dir() and not any(parent.iterdir()):
                        parent.rmdir()
        except OSError as error:
            raise OutputError(
                f"the output folder {self.path}, of which old results must go,", error
            ) from None

    def _check(self, identity: Mapping[str, Any], overwrite: bool) -> bool:
        """Whether the folder holds a run that differs in what ``identity`` tells."""
        there = read_json(self.path / RUN_FILE)
        if there is None:
            strange = sorted(p.name for p in self.path.iterdir() if p.name != LOCK_FILE)
            if strange and RUN_FILE not in strange and not all(map(is_partial, strange)):
                raise UsageError(
                    f"the output folder {self.path} holds {strange[0]!r}, which is of no run; "
                    "choose an empty or a new folder"
                )
            # A damaged run file names no run, so whatever stands beside it is another one's.
            return bool(strange)
        if isinstance(there, dict):
            there = {name: value for name, value in there.items() if name in identity}
        difference = next(_differences(there, as_read(identity)), "")
        if difference and not overwrite:
            raise UsageError(
                f"the output folder {self.path} holds another run ({difference}); choose another folder, or "
                "--overwrite to replace what differs and keep the rest"
            )
        return bool(difference)


def _differences(there: Any, here: Any, place: str = "") -> Iterator[str]:
    """Where two JSON values differ, one sentence part each."""
    if isinstance(there, dict) and isinstance(here, dict):
        if place == "photographs":
            yield from _photograph_difference(there, here)
            return
        for name in [*here, *(k for k in there if k not in here)]:
            yield from _differences(there.get(name), here.get(name), f"{place}.{name}" if place else name)
    elif there != here:
        yield f"{place.removeprefix('settings.')} was {_short(there)} there and is {_short(here)} here"


def _photograph_difference(there: dict[str, str], here: dict[str, str]) -> Iterator[str]:
    missing, new = [n for n in there if n not in here], [n for n in here if n not in there]
    changed = [n for n in here if n in there and there[n] != here[n]]
    for what, names in (("without", missing), ("with a new", new), ("with a changed", changed)):
        if names:
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            yield f"its photographs are not these: this run is {what} {names[0]!r}{more}"


def _short(value: Any) -> str:
    text = "not set" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Make the folder, and hold it against a second run; the lock ends with the process, however that
    ends.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
    except OSError as error:
        raise OutputError(f"the output folder {folder}", error) from None
    try:
        _lock(handle, folder)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, folder: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise UsageError(
            f"another run is writing to the output folder {folder}; choose another one"
        ) from None
