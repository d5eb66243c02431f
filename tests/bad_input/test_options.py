"""Options that must be rejected: paths, settings, lists of pairs."""

import pytest

from tests.bad_input import files
from tests.bad_input.files import links, picture, pipe, sparse, writes

pytestmark = pytest.mark.usefixtures("bounded")


def nothing(_):
    """No preparation."""


def locked_by_link(place):
    (place / "out").mkdir()
    (place / "out" / ".lock").symlink_to(place / "elsewhere")


# Name, arguments (in a folder with images in ``in``), preparation, part of the message.
OPTIONS = [
    ("images too long", [files.TOO_LONG, "-o", "out"], nothing, "File name too long"),
    ("images round", ["round", "-o", "out"], lambda p: links("{here}/round")(p / "round"), "round"),
    ("images a pipe", ["pipe", "-o", "out"], lambda p: pipe(p / "pipe"), "is not a folder"),
    ("images a device", ["/dev/zero", "-o", "out"], nothing, "is not a folder"),
    ("out too long", ["in", "-o", files.TOO_LONG], nothing, "File name too long"),
    ("out a device", ["in", "-o", "/dev/null"], nothing, "cannot be written"),
    ("out of the system", ["in", "-o", "/proc/thesisrecon"], nothing, "cannot be written"),
    ("out round", ["in", "-o", "round"], lambda p: links("{here}/round")(p / "round"), "cannot be written"),
    ("lock a link", ["in", "-o", "out"], locked_by_link, "cannot be written: Too many levels"),
    ("lock a folder", ["in", "-o", "out"], lambda p: (p / "out" / ".lock").mkdir(parents=True), "written"),
    ("threads", ["in", "-o", "out", "--threads", "9" * 400], nothing, "--threads"),
    ("seed", ["in", "-o", "out", "--seed", "-1"], nothing, "--seed"),
    ("seed of digits", ["in", "-o", "out", "--seed", "9" * 5000], nothing, "--seed"),
    ("size of words", ["in", "-o", "out", "--max-size", "9 " * 5000], nothing, "--max-size"),
    ("executor", ["in", "-o", "out", "--executor", "dask://[::1"], nothing, "dask"),
    ("pairs too long", ["in", "-o", "out", "--pairs", files.TOO_LONG], nothing, "File name too long"),
    ("pairs a device", ["in", "-o", "out", "--pairs", "/dev/zero"], nothing, "there is no file"),
    ("pairs a pipe", ["in", "-o", "out", "--pairs", "p"], lambda p: pipe(p / "p"), "there is no file"),
    ("config too long", ["in", "-o", "out", "--config", files.TOO_LONG], nothing, "File name too long"),
    ("config a device", ["in", "-o", "out", "--config", "/dev/zero"], nothing, "a device"),
    ("config a pipe", ["in", "-o", "out", "--config", "p"], lambda p: pipe(p / "p"), "a pipe"),
    ("config a folder", ["in", "-o", "out", "--config", "in"], nothing, "Is a directory"),
    ("config of 10 TiB", ["in", "-o", "out", "--config", "c"], lambda p: sparse(10**13)(p / "c"), "larger"),
    ("set deep", ["in", "-o", "out", "--set", "a." * 9000 + "b=1"], nothing, "--set takes"),
    ("set a nest", ["in", "-o", "out", "--set", f"images.max_size_px={'[' * 9000}"], nothing, "takes"),
    ("set digits", ["in", "-o", "out", "--set", f"images.max_size_px={'9' * 4000}"], nothing, "takes"),
]


@pytest.mark.parametrize(
    ("arguments", "make", "words"), [w[1:] for w in OPTIONS], ids=[w[0] for w in OPTIONS]
)
def test_impossible_options_are_rejected(arguments, make, words, tmp_path, run_cli, monkeypatch):
    files.folder_of(tmp_path, "in")
    make(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert words in run_cli(["reconstruct", *arguments], 2)
    assert not (tmp_path / "out" / "run.json").exists()
    assert not (tmp_path / "elsewhere").exists()


CONFIGS = [
    ("[[features]]\nlevels = 1", "takes a table"),
    (f"[features]\nlevels = 0x{'f' * 9000}", "takes a whole number; got int too large"),
    (f"[features]\nlevels = {'9' * 9000}", "is not TOML"),
    (f"[features]\nlevels.{'a.' * 5000}b = 1", "takes a whole number"),
    ("[intrinsics]\nfocal_px = 1" + "0" * 400, "takes a number; got 1000"),
    ("[dense.pairs]\nmatcher = {kind = []}", "unknown kind of dense.pairs.matcher []"),
    (f"a = {'[' * 50_000}", "too deep"), (b"\xff\xfe\0a", "is not a UTF-8 text"), ("\0", "is not TOML"),
    ("x" * 100_000 + " = 1", "unknown stage"),
]  # fmt: skip
"""Values of other types are tried at random."""


@pytest.mark.parametrize(("text", "words"), CONFIGS, ids=[str(k) for k in range(len(CONFIGS))])
def test_settings_of_wrong_types(text, words, tmp_path, run_cli):
    folder = files.folder_of(tmp_path, "in")
    writes(text)(tmp_path / "c.toml")
    out = tmp_path / "out"
    said = run_cli(["reconstruct", str(folder), "-o", str(out), "--config", str(tmp_path / "c.toml")], 2)
    assert words in said
    assert not out.exists()


PAIRS = [
    ("line 1 of", "a.png " * 100_000), ("line 2 of", 'a.png b.png\n"a.png\n'),
    ("names 'c\\x1b[31m.png'", "a.png c\x1b[31m.png"),
    ("names '<b>.png'", "a.png <b>.png"), ("leaves no pair", "# nothing\n"),
    ("pairs 'a.png' with itself", "a.png a.png\n"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "text"), PAIRS, ids=[str(k) for k in range(len(PAIRS))])
def test_invalid_lists_of_pairs_are_rejected(words, text, tmp_path, run_cli):
    folder = files.folder_of(tmp_path, "in")
    (folder / "b.png").write_bytes(files.encoded("PNG", picture(1)))
    writes(text)(tmp_path / "pairs.txt")
    arguments = ["reconstruct", str(folder), "-o", str(tmp_path / "out"), "--until", "matches"]
    assert words in run_cli([*arguments, "--pairs", str(tmp_path / "pairs.txt")], 2)
