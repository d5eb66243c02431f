"""Reading and writing text, lists of pairs and cameras; files are written atomically."""

import errno
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import refuses
from thesisrecon.errors import WRITE_ERRNOS, OutputError, UsageError, remedies, shortened
from thesisrecon.io import _files as files
from validation.studies.robustness import disk_ends


def entries(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_a_failed_write_leaves_the_old_file(tmp_path, number):
    path = tmp_path / "a.json"
    files.write_json(path, {"a": 1})
    before = entries(tmp_path)
    with disk_ends(1, number), pytest.raises(OutputError) as refused:
        files.write_json(path, {"a": 2})
    assert entries(tmp_path) == before
    assert str(refused.value) == f"{path} cannot be written: {os.strerror(number)}; {remedies()[number]}"
    assert isinstance(refused.value, UsageError)


def test_a_file_stands_where_a_folder_belongs(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "x", tmp_path / "file" / "deep" / "x"):
        with pytest.raises(OutputError, match="move the file that is in the place of a folder"):
            files.write_atomically(path, b"")
    with pytest.raises(OutputError, match="move the folder that is in the place of a file"):
        files.write_atomically(tmp_path / "folder", b"")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder"]


def test_the_sentence_survives_the_way_from_a_worker():
    refused = OutputError(Path("a"), OSError(errno.ENOSPC, "No space left on device"), kept="out")
    again = pickle.loads(pickle.dumps(refused))
    assert str(again) == str(refused)
    assert str(refused).endswith("free space there, then repeat the command to resume from out")
    assert set(WRITE_ERRNOS) <= set(remedies())


def test_json_has_no_nan(tmp_path):
    values = {"a": float("nan"), "b": [np.float64(1.5), np.int64(2)], "c": np.array([np.inf, 1])}
    files.write_json(tmp_path / "a.json", values)
    assert files.read_json(tmp_path / "a.json") == {"a": None, "b": [1.5, 2], "c": [None, 1.0]}
    assert files.read_json(tmp_path / "b.json") is None
    partial = [files.is_partial(name) for name in (".points.ply.partial", "points.ply.partial", ".lock")]
    assert partial == [True, False, False]


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("größe 写真 \U0001f4f7 e\u0301 <b>&\"'", "größe 写真 \U0001f4f7 e\u0301 <b>&\"'"),
        ("a\nb\t\x1b[31m\x7f\x85", "a\\x0ab\\x09\\x1b[31m\\x7f\\x85"),
        ("a\u2028b\u2029c\u202egpj.exe\u2066", "a\\u2028b\\u2029c\\u202egpj.exe\\u2066"),
        (os.fsdecode(b"gr\xfc\xdfe"), "gr\\xfc\\xdfe"), ("half \ud800", "half \\ud800"),
        ("both \ud800\udcff", "both \\ud800\\udcff"),
    ],
)  # fmt: skip
def test_names_are_shown_in_one_line_and_in_their_order(name, shown):
    assert files.printable(name) == shown
    shown.encode("utf-8")


def test_a_long_sentence_keeps_its_beginning_and_its_end():
    said = f"'--seed': '{'9' * 50}' is no integer"
    assert files.shorten_middle(said, len(said)) == said
    assert files.shorten_middle(said, 60) == f"'--seed': '{'9' * 29} ... ' is no integer"
    assert shortened("x" * 60) == "x" * 60
    assert shortened("x" * 61) == "x" * 57 + "..."


def test_only_regular_files_of_a_size_are_read(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"\xef\xbb\xbfgr\xc3\xb6\xc3\x9fe")
    assert files.read_text(path) == "größe"
    assert len(files.read_bytes(path, largest=11)) == 10
    refuses(OSError, r"larger than 0 MiB", files.read_bytes, path, largest=9)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UsageError, match="pipe cannot be read: it is a pipe, a device or a socket"):
        files.read_text(tmp_path / "pipe")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    refuses(UsageError, "not a UTF-8 text", files.read_pairs, tmp_path / "binary")
    refuses(UsageError, "cannot be read: No such file", files.read_text, tmp_path / "nowhere")
    # Files of the system say that they are empty.
    if Path("/proc/self/status").exists():
        assert b"Pid:" in files.read_bytes(Path("/proc/self/status"))


def test_names_with_and_without_blanks(tmp_path):
    path = tmp_path / "pairs.txt"
    # The byte order mark and the line ends of other systems belong to no name.
    path.write_bytes(
        b'\xef\xbb\xbf# a list\n\na.jpg b.jpg\r\n"my a.jpg"  "my b.jpg"\nc d.jpg\te.jpg\r\n"f.jpg"\t"g.jpg"\n'
    )
    pairs = [("a.jpg", "b.jpg"), ("my a.jpg", "my b.jpg"), ("c d.jpg", "e.jpg"), ("f.jpg", "g.jpg")]
    assert files.read_pairs(path) == pairs


@pytest.mark.parametrize("line", ["a.jpg", "a.jpg b.jpg c.jpg", 'a.jpg "b.jpg', "a\tb\tc"])
def test_a_line_that_is_not_a_pair_is_named(tmp_path, line):
    path = tmp_path / "pairs.txt"
    path.write_text(f"a.jpg b.jpg\n{line}\n", encoding="utf-8")
    refuses(UsageError, r"line 2 of .* must hold two file names", files.read_pairs, path)
