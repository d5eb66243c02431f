"""Which files may be replaced, what a refused command leaves, and folders removed during a command."""

import errno
import json
import os
import shutil
from pathlib import Path

import pytest

from tests.conftest import refuses
from tests.pipeline.fake_stages import fake_config, photographs
from thesisrecon import load, reconstruct
from thesisrecon.errors import OutputError, StageFailure, UsageError
from thesisrecon.io._files import write_atomically, write_new
from thesisrecon.io._outputs import LOCK_FILE, claim_folder, claim_of, clear_folder

CHANGED = (
    "was not written by thesisrecon, or was changed since; move it, choose another place, or use --overwri"
)


def write(folder, content=b"ours", name="a/x.txt", **options):
    with claim_folder(folder, names=[name], **options):
        write_atomically(folder / name, content)


def content(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_own_files_are_replaced_and_changed_ones_are_not(tmp_path):
    out = tmp_path / "new" / "out"
    write(out)
    write(out, b"again")
    write(out, b"ours")
    for changed in (b"of the user", b"ours, edited", b""):
        (out / "a" / "x.txt").write_bytes(changed)
        before = content(out)
        refuses(UsageError, CHANGED, write, out, b"third")
        assert content(out) == before
    write(out, b"third", overwrite=True)
    assert (out / "a" / "x.txt").read_bytes() == b"third"
    write(out, b"fourth")


@pytest.mark.parametrize("overwrite", [False, True])
def test_nothing_is_written_or_removed_through_a_link(tmp_path, overwrite):
    out, theirs = tmp_path / "out", tmp_path / "theirs"
    write(out)
    theirs.mkdir()
    shutil.copy(out / "a" / "x.txt", theirs)
    shutil.rmtree(out / "a")
    (out / "a").symlink_to(theirs)
    for name in ("a/x.txt", "a/new.txt"):
        words = "is not written, because .*a is a link; replace the link by a folder"
        refuses(UsageError, words, write, out, b"b", name, overwrite=overwrite)
    with claim_folder(out, overwrite=overwrite) as outputs:
        outputs.remove(["a/x.txt", "a/*"])
    assert content(theirs) == {"x.txt": b"ours"}


def test_the_record_of_a_killed_command_may_end_anywhere(tmp_path):
    write(tmp_path)
    write(tmp_path, name="y.txt")
    whole = (tmp_path / LOCK_FILE).read_bytes()
    for length in range(len(whole) + 1):
        (tmp_path / LOCK_FILE).write_bytes(whole[:length])
        with claim_folder(tmp_path) as outputs:
            assert outputs.owns(tmp_path / "y.txt") == (length == len(whole))
    (tmp_path / LOCK_FILE).write_bytes(whole[:-5])
    for text in (b"one", b"two"):
        write(tmp_path, text, name="z.txt")


@pytest.mark.parametrize("theirs", [b"12345\n", b"\xff\xfe", b'{"pid": 3}', b'["a", "b"]\nx'])
def test_a_lock_file_of_another_program(tmp_path, theirs):
    (tmp_path / LOCK_FILE).write_bytes(theirs)
    refuses(UsageError, r"\.lock was not written by thesisrecon; move it", write, tmp_path)
    assert content(tmp_path) == {LOCK_FILE: theirs}


@pytest.mark.parametrize("error", [UsageError("no"), StageFailure("no"), KeyboardInterrupt(), None])
def test_a_command_that_writes_nothing_leaves_nothing(tmp_path, error):
    try:
        with claim_folder(tmp_path / "deep" / "out"):
            assert (tmp_path / "deep" / "out" / LOCK_FILE).is_file()
            if error is not None:
                raise error
    except (UsageError, StageFailure, KeyboardInterrupt):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_refused_command_takes_its_files_back(tmp_path):
    """But a command that is interrupted, or finds no room, keeps them for the next one."""

    def half(out, error):
        def command():
            with claim_folder(out):
                write_atomically(out / "a" / "x.txt", b"ours")
                raise error

        refuses(type(error), None, command)

    half(tmp_path / "1", UsageError("no"))
    assert list(tmp_path.iterdir()) == []
    for n, error in enumerate((KeyboardInterrupt(), OutputError("x", OSError(errno.ENOSPC, "full")))):
        half(tmp_path / str(n), error)
        write(tmp_path / str(n), b"more")
        assert (tmp_path / str(n) / "a" / "x.txt").read_bytes() == b"more"


def test_a_file_that_appears_while_another_is_written(tmp_path, monkeypatch):
    def appear(_):
        (tmp_path / "a" / "x.txt").write_bytes(b"of the user")

    monkeypatch.setattr(os, "fsync", appear)
    refuses(UsageError, CHANGED, write, tmp_path)
    assert content(tmp_path) == {"a/x.txt": b"of the user"}


def test_a_folder_is_locked_and_claims_end(tmp_path):
    with claim_folder(tmp_path / "out") as outer:
        assert claim_of(tmp_path / "out" / "a") is outer
        assert claim_of(tmp_path / "out") is None
        assert claim_of(tmp_path / "outer" / "a") is None
        refuses(UsageError, "another run is writing", write, tmp_path / "out")
        with claim_folder(tmp_path / "out" / "inner") as inner:
            assert claim_of(tmp_path / "out" / "inner" / "a") is inner
    assert claim_of(tmp_path / "out" / "a") is None


def test_a_folder_is_cleared_only_if_a_command_made_it(tmp_path):
    work, photos = tmp_path / "work", tmp_path / "photos"
    clear_folder(work)
    work.mkdir()
    (work / "x").write_bytes(b"ours")
    clear_folder(work)
    assert not work.exists()
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"of the user")
    refuses(UsageError, "photos was not written by thesisrecon.*; move it, or choose", clear_folder, photos)
    work.symlink_to(photos)
    refuses(UsageError, "work was not written by thesisrecon", clear_folder, work)
    assert content(photos) == {"a.jpg": b"of the user"}


def test_a_single_file_of_another_is_not_replaced(tmp_path):
    path = tmp_path / "1.json"
    path.write_text("of the user", encoding="utf-8")
    refuses(UsageError, CHANGED, write_new, path, "{}", overwrite=False)
    assert content(tmp_path) == {"1.json": b"of the user"}
    write_new(path, "{}", overwrite=True)
    write_new(path, "{}", overwrite=False)
    assert content(tmp_path) == {"1.json": b"{}"}


def at(stage, action):
    """A listener that acts once when a part of the stage is done."""
    left = [action]

    def listen(name, done, _):
        if name == stage and done >= 1 and left:
            left.pop()()

    return listen


def run(out, **options):
    return reconstruct(photographs(3), out, config=fake_config(), threads=1, **options)


WAYS = [
    (way, stage) for way in ("moved", "removed", "replaced") for stage in ("features", "matches", "dense")
]
WAYS += [(files, "matches") for files in ("run.json", "01-features", "*")]


@pytest.mark.parametrize(("way", "stage"), WAYS)
def test_an_output_folder_or_files_that_go_while_a_run_goes_on(tmp_path, stage, way):
    """Files in it may go, as by ``rm -r OUT/*``: it would not be a folder of a run."""
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"

    def go():
        if way == "moved":
            out.rename(elsewhere)
        elif way in ("removed", "replaced"):
            shutil.rmtree(out)
        else:
            for path in out.glob(way):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        if way == "replaced":
            out.mkdir()
            (out / "of the user.txt").write_bytes(b"x")

    refuses(UsageError, "removed while the command was writing to", run, out, progress=at(stage, go))
    if way in ("moved", "removed", "replaced"):
        assert out.exists() == (way == "replaced")
    if way == "replaced":
        assert content(out) == {"of the user.txt": b"x"}
    if way == "moved":
        elsewhere.rename(out)
        assert ("features" in run(out).summary["resumed"]) == (stage != "features")
    if way == "01-features":
        run(out)
        assert load(out).mesh is not None


def test_an_own_result_that_was_changed_is_named_before_the_run_begins(tmp_path):
    run(tmp_path)
    seen = []
    (tmp_path / "points.ply").write_bytes(b"edited")
    shutil.rmtree(tmp_path / "06-metric")
    given = {"progress": lambda *step: seen.append(step)}
    refuses(UsageError, f"points.ply {CHANGED}", run, tmp_path, **given)
    assert seen == []
    assert (tmp_path / "points.ply").read_bytes() == b"edited"
    run(tmp_path, overwrite=True)
    assert (tmp_path / "points.ply").read_bytes().startswith(b"ply")


def test_a_refused_command_leaves_no_trace_among_photographs(tmp_path, refused):
    (tmp_path / "a.jpg").write_bytes(b"x")
    os.utime(tmp_path, (1e9, 1e9))
    before = content(tmp_path)
    for _ in range(2):
        assert "holds 'a.jpg'" in refused(["reconstruct", tmp_path, "-o", tmp_path])
        assert "holds 'a.jpg'" in refused(["demo", "-o", tmp_path])
    assert content(tmp_path) == before
    assert tmp_path.stat().st_mtime == 1e9


def test_the_record_lists_the_files_of_a_run(tmp_path):
    run(tmp_path)
    lines = (tmp_path / LOCK_FILE).read_text(encoding="utf-8").splitlines()
    names = {json.loads(line)[0] for line in lines if line}
    results = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert names == {name for name in results if not name.startswith("0")} - {LOCK_FILE}
    assert Path("sparse/0/images.bin").as_posix() in names


def test_only_own_files_and_clear_folders_are_removed(tmp_path):
    write(tmp_path, name="a/b/x.txt")
    write(tmp_path, name="a/y.txt")
    (tmp_path / "a" / "b" / "z.txt").write_bytes(b"of the user")
    (tmp_path / "a" / "y.txt").write_bytes(b"of the user")
    (tmp_path / "empty").mkdir()
    with claim_folder(tmp_path) as outputs:
        outputs.remove(["a/b/*.txt", "a/y.txt", "empty/none.txt"])
    assert sorted(content(tmp_path)) == [LOCK_FILE, "a/b/z.txt", "a/y.txt"]
    assert (tmp_path / "empty").is_dir()
    with claim_folder(tmp_path, overwrite=True) as outputs:
        outputs.remove(["a/y.txt"])
    assert sorted(content(tmp_path)) == [LOCK_FILE, "a/b/z.txt"]
