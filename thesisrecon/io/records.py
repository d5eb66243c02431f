"""Records of :mod:`thesisrecon.types` as npz files with a JSON description inside: plain arrays and plain
text, nothing that a reader would have to run."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from thesisrecon import types as records

_DESCRIPTION = "description"


def bytes_from_record(record: Any, key: str) -> bytes:
    """A record of :mod:`thesisrecon.types` as the bytes of an npz file; equal records give equal bytes."""
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    description = json.dumps({"key": key, "record": _describe(record, arrays)}, sort_keys=True)
    stream = io.BytesIO()
    named: dict[str, Any] = {_DESCRIPTION: np.frombuffer(description.encode(), dtype=np.uint8), **arrays}
    np.savez(stream, **named)
    return stream.getvalue()


def _describe(value: Any, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    """``value`` as JSON in which an array is ``{"array": name}``; the arrays themselves go to ``arrays``."""
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
    raise TypeError(f"a record holds arrays, numbers, text and records; got {type(value).__name__}")


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
    """The record kept in ``path`` under ``key``; None where it is absent, damaged or made from something
    else.
    """
    try:
        if not path.is_file():
            return None
        # np.load would leave a file it cannot understand open.
        with path.open("rb") as stream:
            _require_plain(stream)
            with np.load(stream, allow_pickle=False) as file:
                description = json.loads(bytes(file[_DESCRIPTION]).decode())
                if description["key"] != key:
                    return None
                return _rebuild(description["record"], {name: file[name] for name in file.files})
    except Exception:
        # Whatever a half-written or edited file makes the readers raise: it is computed again.
        return None


def _require_plain(stream: BinaryIO) -> None:
    """Refuse an archive that is larger unpacked than packed: ours are not compressed."""
    with zipfile.ZipFile(stream) as archive:
        packed = [entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()]
        size = sum(entry.file_size for entry in archive.infolist())
    if any(packed) or size > stream.seek(0, os.SEEK_END):
        raise ValueError("a record is not compressed")
    stream.seek(0)
