"""Text that is safe to show, and files that are read within bounds."""

import os
from pathlib import Path

import pytest

from thesisrecon.errors import UsageError
from thesisrecon.io.files import printable, read_bytes, read_text, shorten_middle, shortened


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("größe 写真 \U0001f4f7 e\u0301.jpg", "größe 写真 \U0001f4f7 e\u0301.jpg"),
        ("a\nb\t\x1b[31m\x7f\x85", "a\\x0ab\\x09\\x1b[31m\\x7f\\x85"),
        ("a\u2028b\u2029c", "a\\u2028b\\u2029c"),
        ("\u202egpj.exe\u2066", "\\u202egpj.exe\\u2066"),
        (os.fsdecode(b"gr\xfc\xdfe"), "gr\\xfc\\xdfe"),
        ("half \ud800", "half \\ud800"),
        ("both \ud800\udcff", "both \\ud800\\udcff"),
        ("<b>&\"'", "<b>&\"'"),
    ],
)
def test_names_are_shown_in_one_line_and_in_their_order(name, shown):
    assert printable(name) == shown
    shown.encode("utf-8")


def test_long_text_is_begun():
    assert shortened("x" * 60) == "x" * 60
    assert shortened("x" * 61) == "x" * 57 + "..."


def test_a_long_sentence_keeps_its_beginning_and_its_end():
    said = f"'--seed': '{'9' * 50}' is no integer"
    assert shorten_middle(said, len(said)) == said
    assert shorten_middle(said, 60) == f"'--seed': '{'9' * 29} ... ' is no integer"
    assert len(shorten_middle(said, 60)) == 60


def test_only_regular_files_of_a_size_are_read(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"\xef\xbb\xbfgr\xc3\xb6\xc3\x9fe")
    assert read_text(path) == "größe"
    assert len(read_bytes(path, largest=11)) == 10
    with pytest.raises(OSError, match=r"larger than 0 MiB"):
        read_bytes(path, largest=9)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UsageError, match="pipe cannot be read: it is a pipe, a device or a socket"):
        read_text(tmp_path / "pipe")
    with pytest.raises(UsageError, match="cannot be read: No such file"):
        read_text(tmp_path / "nowhere")
    # Files of the system say that they are empty.
    if Path("/proc/self/status").exists():
        assert b"Pid:" in read_bytes(Path("/proc/self/status"))
