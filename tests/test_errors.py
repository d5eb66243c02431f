"""The words of failures."""

from thesisrecon.errors import counted


def test_one_is_told_as_one():
    assert [counted(n, "photograph") for n in (0, 1, 2)] == ["0 photographs", "1 photograph", "2 photographs"]
    assert [counted(n, "verified match") for n in (1, 7)] == ["1 verified match", "7 verified matches"]
    assert counted(1200, "face", "1 200") == "1 200 faces"
