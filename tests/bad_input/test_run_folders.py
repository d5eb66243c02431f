"""Run folders that are damaged, hostile or of another version."""

import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.bad_input import files
from tests.bad_input.files import FEATURES, links, pipe, sparse, writes

pytestmark = pytest.mark.usefixtures("bounded")

OTHER_SIZE = "reconstruct with a smaller --max-size or fewer --threads\n"
CHANGED = "01-features/00000.npz was damaged or changed by another program and was computed again"


def finished_run(tmp_path, run_cli):
    """A command that was carried out, and its folder."""
    out = tmp_path / "out"
    command = ["reconstruct", str(files.folder_of(tmp_path, "in")), "-o", str(out), *FEATURES]
    run_cli(command, 0)
    return command, out


def pickled(path):
    """An npz whose description runs a program when it is unpickled."""

    class Snare:
        def __reduce__(self):
            return os.system, (f"touch {path.parent / 'sprung'}",)

    np.savez(path, description=np.array([Snare()], dtype=object))


def packed_bomb(path):
    np.savez_compressed(path, description=np.zeros(2**27, np.uint8))


RECORDS = [
    ("pickle", pickled), ("packed", packed_bomb), ("empty", writes(b"")), ("text", writes("dear reader")),
    ("zip of nothing", writes(b"PK\x05\x06" + bytes(18))), ("pipe", pipe), ("device", links("/dev/zero")),
    ("round", links("{here}/00000.npz")), ("folder", lambda path: path.mkdir()),
    ("10 TiB", sparse(10**13, b"PK\x03\x04")),
]  # fmt: skip


@pytest.mark.parametrize("make", [make for _, make in RECORDS], ids=[name for name, _ in RECORDS])
def test_an_invalid_record_is_recomputed_or_rejected(make, tmp_path, run_cli):
    command, out = finished_run(tmp_path, run_cli)
    (record,) = (out / "01-features").glob("*.npz")
    whole = record.read_bytes()
    record.unlink()
    make(record)
    if record.is_dir():
        assert "cannot be written: Is a directory" in run_cli(command, 2)
        return
    assert CHANGED in run_cli(command, 0)
    assert CHANGED in json.loads((out / "summary.json").read_text(encoding="utf-8"))["warnings"]
    assert record.read_bytes() == whole
    assert not (out / "01-features" / "sprung").exists()
    assert CHANGED not in run_cli(command, 0)


def manifest(report):
    def make(path):
        content = json.loads(path.read_text(encoding="utf-8"))
        path.write_text(json.dumps({**content, "report": report}), encoding="utf-8")

    return make


GOOD_REPORT = {"stage": "features", "seconds": 1.0, "counts": {}, "metrics": {}, "warnings": []}


MANIFESTS = [
    writes(files.deep_json()), writes("[]"), manifest(None),
    manifest({**GOOD_REPORT, "counts": {"images": {}}}),
]  # fmt: skip


@pytest.mark.parametrize("make", MANIFESTS, ids=["deep", "list", "no report", "counts of tables"])
def test_an_invalid_manifest_is_rewritten(make, tmp_path, run_cli):
    command, out = finished_run(tmp_path, run_cli)
    make(out / "01-features" / "manifest.json")
    run_cli(command, 0)
    report = json.loads((out / "01-features" / "manifest.json").read_text(encoding="utf-8"))["report"]
    assert report["counts"]
    assert isinstance(report["seconds"], float)


RUN_FILES = [
    ("another version", writes('{"version": 2, "seed": 0}'), "version was 2 and is now 1"),
    ("wrong types", writes('{"version": 1, "seed": {}, "settings": []}'), "seed was {} and is now 0"),
    ("wrong photographs", writes('{"version": 1, "photographs": [3]}'), "holds another run"),
    *((name, make, "holds another run (its run.json ") for name, make in (
        ("pipe", pipe), ("device", links("/dev/zero")), ("deep", writes(files.deep_json())),
        ("10 TiB", sparse(10**13)),
    )),
]  # fmt: skip


@pytest.mark.parametrize(("make", "words"), [r[1:] for r in RUN_FILES], ids=[r[0] for r in RUN_FILES])
def test_a_run_file_that_is_invalid_or_of_another_version(make, words, tmp_path, run_cli):
    folder, out = files.folder_of(tmp_path, "in"), tmp_path / "out"
    out.mkdir()
    make(out / "run.json")
    command = ["reconstruct", str(folder), "-o", str(out), *FEATURES]
    said = run_cli(command, 2)
    assert words in said
    assert "choose another folder, or use --overwrite" in said
    assert [path.name for path in out.iterdir()] == ["run.json"]
    run_cli([*command, "--overwrite"], 0)
    assert json.loads((out / "run.json").read_text(encoding="utf-8"))["seed"] == 0


def test_nothing_is_written_through_the_links_of_a_folder(tmp_path, run_cli):
    """A foreign folder may hold links at the names of temporary and final files."""
    command, out = finished_run(tmp_path, run_cli)
    victim = tmp_path / "letter.txt"
    victim.write_text("dear", encoding="utf-8")
    for name in ("run.json", "summary.json", "report.html", "config.toml"):
        (out / f".{name}.partial").symlink_to(victim)
        (out / name).unlink()
        (out / name).symlink_to(victim)
    (out / "01-features" / ".manifest.json.partial").symlink_to(tmp_path / "new.txt")
    (out / "01-features" / "manifest.json").unlink()
    assert "holds another run (its run.json is damaged" in run_cli(command, 2)
    assert (out / "report.html").is_symlink()
    run_cli([*command, "--overwrite"], 0)
    assert victim.read_text(encoding="utf-8") == "dear"
    assert not (tmp_path / "new.txt").exists()
    assert not any(path.is_symlink() for path in out.rglob("*.*"))


def summary_of_run(**changes):
    return json.dumps(files.SUMMARY | changes)


SUMMARIES = [
    ("absent", lambda _: None, "holds no summary.json"),
    ("device", links("/dev/zero"), "holds no summary.json"),
    ("10 TiB", sparse(10**13), "holds no summary.json"),
    ("bytes", writes(b"\xff\xfe"), "holds no summary.json"),
    ("digits", writes("9" * 9000), "holds no summary.json"),
    ("another program's", writes('{"a": 1}'), "is not a summary written by thesisrecon"),
    ("beyond numbers", writes(summary_of_run(reprojection_rms_px=10**400)), "is not a summary"),
    ("a camera of nothing", writes(summary_of_run(cameras=[{"focal_px": None}])), "is not a summary"),
]


@pytest.mark.parametrize(("make", "words"), [s[1:] for s in SUMMARIES], ids=[s[0] for s in SUMMARIES])
def test_inspect_rejects_invalid_summaries(make, words, tmp_path, run_cli):
    make(tmp_path / "summary.json")
    assert words in run_cli(["inspect", str(tmp_path)], 2)


def test_inspect_lets_nothing_through_to_the_terminal(tmp_path, run_cli):
    warnings = ["\x1b]0;title\x07", "two\nlines", "\ud800", "\u202eturned"]
    (tmp_path / "summary.json").write_text(summary_of_run(warnings=warnings), encoding="utf-8")
    said = run_cli(["inspect", str(tmp_path)], 0).splitlines()
    shown = ["\\x1b]0;title\\x07", "two\\x0alines", "\\ud800", "\\u202eturned"]
    assert said[2:6] == [f"warning: {text}" for text in shown]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [("reconstruct in -o out --until features", 3), ("inspect in", 2)],
)
def test_programs_of_their_own_end_so_too(arguments, code, tmp_path):
    """With an address space of 6 GiB, and another alphabet on the terminal."""
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "böm\u5199.png").write_bytes(files.png(30_000, 30_000))
    pipe(folder / "pipe\x1b[31m.jpg")
    packed = files.encoded("TIFF", compression="tiff_lzw")
    (folder / "packed.tif").write_bytes(packed[:200] + b"\xff" * 200 + packed[400:])
    for name in ("summary.json", "model.glb", "cameras.json", "run.json"):
        (folder / name).symlink_to("/dev/zero")
    done = subprocess.run(
        [sys.executable, "-m", "thesisrecon", *arguments.split()], cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": "latin-1", "PYTHONPATH": str(Path(__file__).parents[2])},
        capture_output=True, timeout=120, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (6 * 2**30, 6 * 2**30)),
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    assert done.stdout == b""
    files.require_sentence(done.stderr.decode("latin-1"))
    assert done.stderr.count(b"thesisrecon: ") == 1


def limited(folder, limit, most, *before):
    """The command on an image with a limit of the system."""
    images, out = files.folder_of(folder, "in"), folder / "out"
    options = ["--until", "features", "--threads", "2"]
    return subprocess.run(
        [*before, sys.executable, "-m", "thesisrecon", "reconstruct", str(images), "-o", str(out), *options],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}, capture_output=True, timeout=120,
        check=False, preexec_fn=lambda: resource.setrlimit(limit, (most, most)),
    )  # fmt: skip


@pytest.mark.parametrize("megabytes", [150, 250])
def test_too_little_memory_for_the_libraries_is_one_sentence(megabytes, tmp_path):
    done = limited(tmp_path, resource.RLIMIT_AS, megabytes * 2**20)
    assert done.returncode == 3
    assert done.stderr.decode() == "thesisrecon: out of memory; " + OTHER_SIZE


def test_a_run_goes_on_with_the_only_process_that_is_allowed(tmp_path):
    """The limit holds for users other than root, who keeps no right here but that to the files."""
    rights = "-all,+dac_override,+dac_read_search"
    other = ["setpriv", "--reuid=54321", "--clear-groups", f"--inh-caps={rights}", f"--ambient-caps={rights}"]
    if os.getuid() == 0 and shutil.which(other[0]) is None:
        pytest.skip("setpriv is not on this machine")
    done = limited(tmp_path, resource.RLIMIT_NPROC, 1, *(other if os.getuid() == 0 else ()))
    assert done.returncode == 0, done.stderr
    assert b"corners in 1 image" in done.stdout
