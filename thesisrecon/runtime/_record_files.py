"""Records of :mod:`thesisrecon.records` as npz files with a JSON description, without pickles.

A record is used only if it is unchanged, since kernels do not check their input. A seal in the comment of the
archive is a digest of the checksums of its parts: damaged parts fail their checksum, rewritten parts the
seal. The seal detects accidents, not forgery.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from thesisrecon import records

_DESCRIPTION = "description"


class ChangedRecord(Exception):
    """The file of a record is damaged or was changed."""


def bytes_from_record(record: Any, key: str) -> bytes:
    """Content of an npz file; equal records give equal bytes."""
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    description = json.dumps({"key": key, "record": _describe(record, arrays)}, sort_keys=True)
    stream = io.BytesIO()
    named: dict[str, Any] = {_DESCRIPTION: np.frombuffer(description.encode(), dtype=np.uint8), **arrays}
    np.savez(stream, **named)
    with zipfile.ZipFile(stream, "a") as archive:
        archive.comment = _seal(archive)
    return stream.getvalue()


def _seal(archive: zipfile.ZipFile) -> bytes:
    """Digest of the checksums of all parts."""
    parts = [(part.filename, part.CRC, part.file_size) for part in archive.infolist()]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32].encode()


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
        # Opening a pipe would block.
        _require(path.is_file(), "a record is a file")
        # np.load leaves an unreadable file open.
        with path.open("rb") as stream:
            seal = _seal_of_plain(stream)
            with np.load(stream, allow_pickle=False) as file:
                description = json.loads(bytes(file[_DESCRIPTION]).decode())
                if description["key"] != key:
                    return None
                _require(file.zip.comment == seal, "a record has the seal of its content")
                return _rebuild(description["record"], {name: file[name] for name in file.files})
    except Exception as error:
        # The readers raise many types for damaged files.
        raise ChangedRecord(f"{path}: {error}") from None


def _require(holds: bool, rule: str) -> None:
    if not holds:
        raise ValueError(rule)


def _seal_of_plain(stream: BinaryIO) -> bytes:
    """Expected seal of an archive; compressed ones, which may be bombs, are refused."""
    with zipfile.ZipFile(stream) as archive:
        packed = [entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()]
        size = sum(entry.file_size for entry in archive.infolist())
        seal = _seal(archive)
    _require(not any(packed) and size <= stream.seek(0, os.SEEK_END), "a record is not compressed")
    stream.seek(0)
    return seal
