"""Files that appear whole or not at all, on disks that fill and in places that cannot be written."""

import errno
import os
import pickle
import resource
import subprocess
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from thesisrecon.errors import DISK, MEND, OutputError, UsageError
from thesisrecon.io.colmap_files import write_colmap_model
from thesisrecon.io.colmap_model import ColmapModel, ColmapPoints
from thesisrecon.io.exports import write_point_cloud
from thesisrecon.io.files import is_partial, link, read_json, write_atomically, write_json, write_text
from validation.studies.full_disk import disk_ends, remount, small_disk

MANY = np.zeros((20_000, 3))


def entries(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@contextmanager
def no_larger_than(size):
    """No file may grow beyond that size: what a full disk does to one, for whoever may not mount any."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def read_only(folder):
    """Nothing can be made in this folder. Permissions are nothing to root, who may mark it instead."""
    if os.geteuid():
        folder.chmod(0o500)
        yield
        folder.chmod(0o700)
        return
    try:
        subprocess.run(["chattr", "+i", str(folder)], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("root may write everywhere, and folders cannot be marked as immutable here")
    try:
        yield
    finally:
        subprocess.run(["chattr", "-i", str(folder)], check=True)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_what_cannot_be_written_leaves_the_file_before_it(tmp_path, number):
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    before = entries(tmp_path)
    with disk_ends(1, number), pytest.raises(OutputError) as refused:
        write_json(path, {"a": 2})
    assert entries(tmp_path) == before
    assert str(refused.value) == f"{path} cannot be written: {os.strerror(number)}; {MEND[number]}"
    assert isinstance(refused.value, UsageError)


def test_a_file_that_grows_too_large_leaves_nothing_of_itself(tmp_path):
    """The system itself cuts it off in the middle."""
    (tmp_path / "points.ply").write_bytes(b"before")
    with no_larger_than(100_000):
        with pytest.raises(OutputError, match=r"File too large; .*ulimit"):
            write_point_cloud(tmp_path / "points.ply", MANY, np.ones(MANY.shape, np.uint8))
        with pytest.raises(OutputError, match="File too large"):
            write_text(tmp_path / "new.txt", "x" * 200_000)
    assert entries(tmp_path) == {"points.ply": b"before"}


def test_each_file_of_a_model_is_whole_or_absent(tmp_path):
    none, no_ids = np.zeros((0, 3)), np.zeros(0, np.int64)
    points = ColmapPoints(
        no_ids, none, none.astype(np.uint8), none[:, 0], np.zeros(1, np.int64), no_ids, no_ids
    )
    with disk_ends(3, errno.ENOSPC), pytest.raises(OutputError, match=r"frames\.bin cannot be written"):
        write_colmap_model(tmp_path / "0", ColmapModel((), (), points))
    assert sorted(entries(tmp_path / "0")) == ["cameras.bin", "rigs.bin"]


def test_a_disk_that_is_full_or_read_only(tmp_path):
    try:
        with small_disk(tmp_path / "disk", "64k") as disk:
            write_json(disk / "a.json", [1])
            for name in ("a.json", "b.json"):
                with pytest.raises(OutputError, match="No space left on device; make room there"):
                    write_text(disk / name, "x" * 100_000)
            assert list(entries(disk)) == ["a.json"]
            assert read_json(disk / "a.json") == [1]
            remount(disk, "size=1m")
            write_text(disk / "b.json", "x" * 100_000)
            remount(disk, "ro")
            with pytest.raises(OutputError, match="Read-only file system; make the place writable"):
                write_text(disk / "c.json", "")
            with pytest.raises(OutputError, match="Read-only file system"):
                link(disk / "a.json", disk / "deep" / "a.json")
    except PermissionError as error:
        pytest.skip(str(error))


def test_a_folder_where_nothing_can_be_made(tmp_path):
    write_text(tmp_path / "a.txt", "before")
    with read_only(tmp_path):
        for write in (write_text, write_json):
            with pytest.raises(OutputError, match=r"not permitted|denied"):
                write(tmp_path / "a.txt", "after")
        with pytest.raises(OutputError, match="make the place writable, or choose another one"):
            link(tmp_path / "a.txt", tmp_path / "b.txt")
    assert entries(tmp_path) == {"a.txt": b"before"}


def test_a_file_stands_where_a_folder_belongs(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "x", tmp_path / "file" / "deep" / "x"):
        with pytest.raises(OutputError, match="move away the file that stands where a folder belongs"):
            write_atomically(path, b"")
    with pytest.raises(OutputError, match="move away the folder that stands where a file belongs"):
        write_atomically(tmp_path / "folder", b"")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder"]


def test_the_sentence_survives_the_way_from_a_worker():
    refused = OutputError(Path("a"), OSError(errno.ENOSPC, "No space left on device"), kept="out")
    again = pickle.loads(pickle.dumps(refused))
    assert str(again) == str(refused)
    assert str(refused).endswith("make room there, then the same command goes on from what is kept in out")
    assert set(DISK) <= set(MEND)


def test_json_has_no_nan(tmp_path):
    write_json(
        tmp_path / "a.json",
        {"a": float("nan"), "b": [np.float64(1.5), np.int64(2)], "c": np.array([np.inf, 1])},
    )
    assert read_json(tmp_path / "a.json") == {"a": None, "b": [1.5, 2], "c": [None, 1.0]}
    assert read_json(tmp_path / "b.json") is None


def test_names_of_what_a_kill_leaves():
    assert is_partial(".points.ply.partial")
    assert not is_partial("points.ply.partial")
    assert not is_partial(".lock")
