"""The run folder: cached results of stages, so that an interrupted run loses little.

Each result is one npz file with a JSON description, written atomically. It is reused only if it is unchanged
and its key, made from settings, code and all inputs, is the same.
"""

import dataclasses
import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon import records
from thesisrecon.errors import Notice, OutputError, UsageError, shortened
from thesisrecon.io import _files
from thesisrecon.io._outputs import LOCK_FILE, OutputFolder, claim_folder, claim_of, lock_file, lock_part
from thesisrecon.records import StageReport

FORMAT = 3
RUN_FILE, MANIFEST_FILE = "run.json", "manifest.json"
_DESCRIPTION = "description"
_MAX_BYTES = 2**40


class ChangedRecord(Exception):
    """The file of a record is damaged or was changed."""


def bytes_from_record(record: Any, key: str) -> bytes:
    """Content of an npz file; equal records give equal bytes."""
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    description = json.dumps({"key": key, "record": _describe(record, arrays)}, sort_keys=True)
    stream = io.BytesIO()
    named: dict[str, Any] = {_DESCRIPTION: np.frombuffer(description.encode(), dtype=np.uint8), **arrays}
    np.savez(stream, **named)
    return sealed(stream.getvalue())


def sealed(archive: bytes) -> bytes:
    """A zip archive with the digest of its bytes as comment, against accidents: kernels check no input."""
    return archive[:-2] + b"\x20\0" + hashlib.sha256(archive).digest()


def _require_sealed(content: bytes) -> None:
    if sealed(content[:-34] + b"\0\0") != content:
        raise ValueError("a record has the seal of its content")


def _describe(value: Any, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    """JSON of a value in which an array is ``{"array": name}``; arrays are collected in ``arrays``."""
    if isinstance(value, np.ndarray):
        arrays[f"array{len(arrays)}"] = value
        return {"array": f"array{len(arrays) - 1}"}
    if isinstance(value, np.generic):
        return value.item()
    if dataclasses.is_dataclass(value):
        fields = {f.name: _describe(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, "fields": fields}
    if isinstance(value, Mapping):
        return {"mapping": {str(k): _describe(v, arrays) for k, v in value.items()}}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return {"tuple": [_describe(v, arrays) for v in value]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a record contains arrays, numbers, text and records; got {type(value).__name__}")


def _rebuild(value: Any, arrays: Mapping[str, Any]) -> Any:
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]]
    if "tuple" in value:
        return tuple(_rebuild(v, arrays) for v in value["tuple"])
    if "mapping" in value:
        return {k: _rebuild(v, arrays) for k, v in value["mapping"].items()}
    kind = getattr(records, value["type"])
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise TypeError(f"{value['type']} is no record")
    return kind(**{name: _rebuild(v, arrays) for name, v in value["fields"].items()})


def read_record(path: Path, key: str) -> Any:
    """Read a record; None if the file is missing or has another key."""
    if not os.path.lexists(path):
        return None
    try:
        content = _files.read_bytes(path, largest=_MAX_BYTES)
        _require_sealed(content)
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            # A compressed one may be a zip bomb.
            if any(part.compress_type for part in file.zip.infolist()):
                raise ValueError("a record is not compressed")
            description = json.loads(bytes(file[_DESCRIPTION]).decode())
            if description["key"] != key:
                return None
            return _rebuild(description["record"], {name: file[name] for name in file.files})
    except Exception as error:
        # The readers raise many types for damaged files.
        raise ChangedRecord(f"{path}: {error}") from None


def _is_record(path: Path) -> bool:
    """Whether a file is a record, with any key."""
    try:
        _require_sealed(b"" if path.is_symlink() else _files.read_bytes(path, largest=_MAX_BYTES))
    except (OSError, ValueError):
        return False
    return True


def key_of(*parts: Any) -> str:
    """Digest (32 hexadecimal digits) of JSON-like parts and arrays, equal on every machine."""
    text = json.dumps(parts, sort_keys=True, default=_json_value, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _json_value(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [str(value.dtype), value.shape, hashlib.sha256(np.ascontiguousarray(value).data).hexdigest()]
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a key consists of plain values and arrays; got {type(value).__name__}")


@dataclass(frozen=True)
class StageFolder:
    """The folder of a stage: a file per item and a manifest; ``shared`` holds results of several runs."""

    path: Path
    shared: Path | None = None
    trial: bool = False  #: nothing is written
    kept: dict[str, Any] = field(default_factory=dict)  #: records by key that trial runs computed

    def load(self, item: str, key: str) -> Any:
        """The record of an item, from this run or the shared folder; None if it must be computed."""
        own, changed = self.path / f"{item}.npz", None
        for place in [own] if self.shared is None else [own, self.shared / f"{key}.npz"]:
            try:
                record = read_record(place, key)
            except ChangedRecord as error:
                changed = error
                continue
            if record is not None:
                if place != own and not self.trial:
                    _files.link(place, own)
                return record
        if changed is not None:
            raise changed
        if (record := self.kept.get(key)) is not None and not self.trial:
            self.save(item, key, record)
        return record

    def save(self, item: str, key: str, record: Any) -> None:
        """Write the record of an item."""
        if self.trial:
            self.kept[key] = record
            return
        own = self.path / f"{item}.npz"
        _files.write_atomically(own, bytes_from_record(record, key), cached=True)
        if self.shared is not None:
            _files.link(own, self.shared / f"{key}.npz")

    def finish(self, report: StageReport, settings: Mapping[str, Any], keys: Mapping[str, str]) -> None:
        """Write the manifest of a finished stage and remove stale records and partial files."""
        if self.trial:
            return
        try:
            # Nothing is removed through a link.
            there = [] if self.path.is_symlink() else self.path.iterdir()
            for stale in [path for path in there if ".npz" in path.suffixes]:
                if _files.is_partial(stale.name) or (stale.stem not in keys and _is_record(stale)):
                    stale.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(self.path, error) from None
        content = {"format": FORMAT, "settings": settings, "keys": keys, "report": dataclasses.asdict(report)}
        _files.write_json(self.path / MANIFEST_FILE, content, cached=True)

    def finished(self, keys: Mapping[str, str]) -> StageReport | None:
        """Return the report of the run that computed these items; None if the keys differ."""
        content = _files.read_json(self.path / MANIFEST_FILE)
        try:
            return _report(**content["report"]) if content["keys"] == dict(keys) else None
        except (TypeError, KeyError, AttributeError):
            return None

    def keys(self) -> dict[str, str]:
        """The keys of the records that the manifest lists, of those that are there."""
        content = _files.read_json(self.path / MANIFEST_FILE)
        try:
            return {
                item: key for item, key in content["keys"].items() if (self.path / f"{item}.npz").exists()
            }
        except (TypeError, KeyError, AttributeError):
            return {}


def _report(*, seconds: Any, counts: Any, metrics: Any, warnings: Any, stage: Any) -> StageReport:
    """A report from JSON values, checked."""
    numbers = [seconds, *counts.values(), *(value for value in metrics.values() if value is not None)]
    if not all(isinstance(number, int | float) for number in numbers):
        raise TypeError("counts and metrics must be numbers")
    if not all(isinstance(word, str) for word in (stage, *warnings)):
        raise TypeError("stage and warnings must be text")
    return StageReport(stage, seconds, counts, metrics, tuple(warnings))


@dataclass(frozen=True)
class RunDirectory:
    """The output folder of one run, and the folder of results shared with other runs, if any."""

    path: Path
    shared: Path | None = None
    part: bool = False  #: of a group, in the folder of the whole run
    trial: bool = False  #: nothing is written; the run in a folder that repeats it takes what is kept
    #: a run of more images takes the place of the one in the folder, whose files it keeps
    continues: bool = False
    kept: dict[str, Any] = field(default_factory=dict)  #: records by key that trial runs computed

    def stage(self, folder: str) -> StageFolder:
        """The folder of a stage, such as ``01-features``."""
        shared = None if self.shared is None else self.shared / folder
        return StageFolder(self.path / folder, shared, self.trial, self.kept)

    def mark(self, stage: StageFolder, item: str) -> None:
        """Set the time of a reused record to that of this run, so that only unused records are older."""
        if self.trial:
            return
        with suppress(OSError):
            path, start = stage.path / f"{item}.npz", (self.path / RUN_FILE).stat().st_mtime_ns
            if path.stat().st_mtime_ns < start:
                os.utime(path, ns=(start, start))

    @contextmanager
    def claim(
        self, identity: Mapping[str, Any], *, overwrite: bool, results: Sequence[str] = ()
    ) -> Iterator[None]:
        """Claim the folder for a run that writes ``results``; ``identity`` needs no image."""
        whole = claim_of(self.path) if self.part else None
        if whole is not None:
            self._check(identity, overwrite, whole)
            with lock_part(whole, self.path):
                yield
            return

        def check(outputs: OutputFolder) -> bool:
            return self._check(identity, overwrite, outputs)

        with claim_folder(self.path, overwrite=overwrite, names=results, check=check) as outputs:
            yield
            if outputs.kept:
                outputs.require_complete([RUN_FILE])

    @property
    def _outputs(self) -> OutputFolder:
        # A writer that is called alone has no claim; its folder belongs to the caller.
        return claim_of(self.path / RUN_FILE) or OutputFolder(self.path, overwrite=True)

    def adopt(self, identity: Mapping[str, Any], *, overwrite: bool, results: Sequence[str] = ()) -> None:
        """Resume the same run in the claimed folder, or replace another one and remove its ``results``."""
        if self._check(identity, overwrite, self._outputs) and not self.continues:
            self.remove(results)
        # A resumed run keeps its file and time: its records are not older.
        if _files.read_json(self.path / RUN_FILE) != _files.as_read(identity):
            _files.write_json(self.path / RUN_FILE, identity)
        self._outputs.kept = True

    def remove(self, names: Sequence[str]) -> None:
        """Remove own files and the folders that are empty afterwards (:meth:`OutputFolder.remove`)."""
        here = self._outputs.name_of(self.path)
        self._outputs.remove([f"{here}/{name}" for name in names])

    def _check(self, identity: Mapping[str, Any], overwrite: bool, outputs: OutputFolder) -> bool:
        """Whether the folder holds another run; UsageError if this one must not use the folder."""
        if not os.path.lexists(self.path / RUN_FILE):
            paths = sorted(self.path.iterdir()) if os.path.lexists(self.path) else []
            strange = [p.name for p in paths if p.is_symlink() or not outputs.lists(outputs.name_of(p))]
            if foreign := [name for name in strange if name != LOCK_FILE and not _files.is_partial(name)]:
                raise UsageError(Notice("foreign-file", self.path, foreign[0]))
            return False
        there, difference = None, ""
        try:
            there = json.loads(_files.read_bytes(self.path / RUN_FILE).decode("utf-8"))
        except OSError as error:
            difference = f"its {RUN_FILE} cannot be read: {error.strerror or error}"
        except (ValueError, RecursionError):
            difference = f"its {RUN_FILE} is damaged, or was not written by thesisrecon"
        if isinstance(there, dict):
            there = {name: value for name, value in there.items() if name in (*identity, "source")}
        difference = difference or next(_differences(there, _files.as_read(identity)), "")
        if difference and not overwrite and not self.continues:
            raise UsageError(Notice("another-run", self.path, difference))
        return bool(difference)


def _differences(there: Any, here: Any, place: str = "") -> Iterator[str]:
    """Differences of two JSON values in words."""
    if place == "source":
        # A source that was only moved is the same.
        sources = [source if isinstance(source, dict) else {} for source in (there, here)]
        digests = [str(source.get("digest", "")) for source in sources]
        if digests[0] != digests[1]:
            was, now = (
                f"{source.get('name')} (digest {digest[:12]})" if digest else "images"
                for source, digest in zip(sources, digests, strict=True)
            )
            yield f"it was made from {was}, this run starts from {now}"
    elif place == "images" and isinstance(there, dict) and isinstance(here, dict):
        changed = [n for n in here if n in there and there[n] != here[n]]
        missing, new = [n for n in there if n not in here], [n for n in here if n not in there]
        for what, names in (("without", missing), ("with a new", new), ("with a changed", changed)):
            if names:
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                yield f"other images: this run is {what} {names[0]!r}{more}"
    elif isinstance(there, dict) and isinstance(here, dict):
        # Another source mostly comes with other settings.
        for name in sorted(here | there, key=lambda name: name != "source"):
            yield from _differences(there.get(name), here.get(name), f"{place}.{name}" if place else name)
    elif there != here:
        yield f"{place.removeprefix('settings.')} was {_short(there)} and is now {_short(here)}"


def _short(value: Any) -> str:
    return "not set" if value is None else shortened(json.dumps(value, ensure_ascii=False))


def is_running(folder: Path) -> bool:
    """Whether a run is writing to an output folder."""
    try:
        with (folder / LOCK_FILE).open() as handle:
            lock_file(handle.fileno(), shared=True)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False
