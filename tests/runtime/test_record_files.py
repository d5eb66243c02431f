"""Records as files: only those of ours are made, as they were written, and nothing is unpacked."""

import json
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from thesisrecon.records import Tracks
from thesisrecon.runtime.record_files import ChangedRecord, _seal, bytes_from_record, read_record


def saved(path, record, *, packed=False, **arrays):
    """A file that is sealed, whatever it holds."""
    told = json.dumps({"key": "k", "record": record}).encode()
    save = np.savez_compressed if packed else np.savez
    save(path, description=np.frombuffer(told, dtype=np.uint8), **arrays)
    with zipfile.ZipFile(path, "a") as archive:
        archive.comment = _seal(archive)
    return path


def refused(path, words="npz: "):
    with pytest.raises(ChangedRecord, match=words):
        read_record(path, "k")
    return True


REPORT = {"type": "StageReport", "fields": {"stage": "x", "seconds": 1.0}}


def test_only_records_are_made(tmp_path):
    path = tmp_path / "a.npz"
    assert read_record(saved(path, REPORT), "k").stage == "x"
    assert read_record(path, "other") is None
    for kind in ("Path", "annotations", "__builtins__", "field", "soup", "F64"):
        assert refused(saved(path, {"type": kind, "fields": {}}))
    assert refused(saved(path, {"array": "array0"}), "array0")
    assert read_record(saved(path, {"array": "array0"}, array0=np.arange(3)), "k").tolist() == [0, 1, 2]


def test_nothing_is_unpacked(tmp_path):
    path = saved(tmp_path / "a.npz", REPORT, packed=True)
    assert refused(path, "not compressed")
    with zipfile.ZipFile(path, "w") as archive:
        # An array that claims to be larger than the machine.
        head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117) + b"\n"
        archive.writestr("description.npy", b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head)
    assert refused(path)


TRACKS = Tracks(np.zeros(3, np.int64), np.arange(3), np.ones((3, 2)), 1, 3)
Change = Callable[[dict[str, Any]], object]
CHANGES = [
    ("beyond the views", lambda parts: parts["array0"].__setitem__(1, 10**9)),
    ("below zero", lambda parts: parts["array1"].__setitem__(1, -1)),
    ("NaN", lambda parts: parts["array2"].__setitem__((0, 0), np.nan)),
    ("one bit less", lambda parts: parts["array2"].__setitem__((0, 0), np.nextafter(1.0, 0.0))),
    ("another type", lambda parts: parts.update(array0=parts["array0"].astype(np.int32))),
    ("another shape", lambda parts: parts.update(array2=parts["array2"].T)),
    ("fewer", lambda parts: parts.update(array1=parts["array1"][:2])),
    ("missing", lambda parts: parts.pop("array1")),
    ("more", lambda parts: parts.update(array3=np.zeros(3))),
    ("exchanged", lambda parts: parts.update(array0=parts["array1"], array1=parts["array0"])),
    ("a number of the description", lambda parts: parts.update(description=told_otherwise(parts))),
]


def told_otherwise(parts):
    told = parts["description"].tobytes().replace(b'"n_views": 1', b'"n_views": 2')
    assert told != parts["description"].tobytes()
    return np.frombuffer(told, dtype=np.uint8)


@pytest.mark.parametrize("change", [change for _, change in CHANGES], ids=[name for name, _ in CHANGES])
def test_what_another_program_has_written_anew_is_told(change, tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(bytes_from_record(TRACKS, "k"))
    assert read_record(path, "k").n_points == 3
    with np.load(path) as file:
        parts = {name: file[name].copy() for name in file.files}
        seal = file.zip.comment
    change(parts)
    np.savez(path, **parts)
    assert refused(path, "seal")
    with zipfile.ZipFile(path, "a") as archive:
        archive.comment = seal
    assert refused(path, "seal")
    assert read_record(path, "another") is None
