"""Lists of pairs as text files."""

import pytest

from thesisrecon.errors import UsageError
from thesisrecon.io.pair_list import read_pairs


def test_names_with_and_without_blanks(tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_text(
        '# a list\n\na.jpg b.jpg\n"my a.jpg"  "my b.jpg"\nc d.jpg\te.jpg\n"f.jpg"\t"g.jpg"\n',
        encoding="utf-8",
    )
    assert read_pairs(path) == [
        ("a.jpg", "b.jpg"),
        ("my a.jpg", "my b.jpg"),
        ("c d.jpg", "e.jpg"),
        ("f.jpg", "g.jpg"),
    ]


def test_the_mark_and_the_line_ends_of_other_systems_belong_to_no_name(tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_bytes(b"\xef\xbb\xbfa.jpg b.jpg\r\nc.jpg\td.jpg\r\n")
    assert read_pairs(path) == [("a.jpg", "b.jpg"), ("c.jpg", "d.jpg")]


@pytest.mark.parametrize("line", ["a.jpg", "a.jpg b.jpg c.jpg", 'a.jpg "b.jpg', "a\tb\tc"])
def test_a_line_that_is_no_pair_is_named(tmp_path, line):
    path = tmp_path / "pairs.txt"
    path.write_text(f"a.jpg b.jpg\n{line}\n", encoding="utf-8")
    with pytest.raises(UsageError, match=r"line 2 of .* takes two file names"):
        read_pairs(path)


def test_a_file_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="not a UTF-8 text"):
        read_pairs(path)
