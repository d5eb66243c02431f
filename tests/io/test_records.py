"""Records as files: only those of ours are made, and nothing that is larger unpacked is unpacked."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np

from thesisrecon.io.records import read_record


def saved(path: Path, record: object, *, packed: bool = False, **arrays: np.ndarray) -> Path:
    told = json.dumps({"key": "k", "record": record}).encode()
    save = np.savez_compressed if packed else np.savez
    save(path, description=np.frombuffer(told, dtype=np.uint8), **arrays)
    return path


REPORT = {"type": "StageReport", "fields": {"stage": "x", "seconds": 1.0}}


def test_only_records_are_made(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    assert read_record(saved(path, REPORT), "k").stage == "x"
    assert read_record(path, "other") is None
    for kind in ("Path", "annotations", "__builtins__", "field", "soup", "F64"):
        assert read_record(saved(path, {"type": kind, "fields": {}}), "k") is None
    assert read_record(saved(path, {"array": "array0"}), "k") is None
    assert read_record(saved(path, {"array": "array0"}, array0=np.arange(3)), "k").tolist() == [0, 1, 2]


def test_nothing_is_unpacked(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.npz", REPORT, packed=True)
    assert read_record(path, "k") is None
    with zipfile.ZipFile(path, "w") as archive:
        # An array that claims to be larger than the machine.
        head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117) + b"\n"
        archive.writestr("description.npy", b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head)
    assert read_record(path, "k") is None
