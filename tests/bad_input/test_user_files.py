"""Files of the user survive every command without --overwrite, whatever the output folder holds."""

# ruff: noqa: ARG001 (a stub takes what the real function takes)

import contextlib
import os
import shutil
import signal
from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest

import thesisrecon
from tests.bad_input import files
from tests.pipeline.fake_stages import fake_config, interrupt_at, photographs
from thesisrecon import load, reconstruct
from thesisrecon.cli.commands import run_command
from thesisrecon.errors import UsageError
from thesisrecon.io import _frames
from thesisrecon.pipeline.outputs import RESULT_FILES

pytestmark = pytest.mark.usefixtures("bounded")

QUICK, MANY = 120, 1000


@pytest.fixture(scope="module")
def stock(tmp_path_factory):
    """Images, and folders that commands left behind: runs, a killed one, an export, frames."""
    place = tmp_path_factory.mktemp("stock")
    (place / "images").mkdir()
    for image in photographs(3):
        PIL.Image.fromarray(image.rgb).save(place / "images" / image.name)
    (place / "00.mp4").write_bytes(b"a video")
    with patched():
        for name, options in (("same", {}), ("other", {"seed": 1}), ("early", {"until": "matches"})):
            reconstruct_images(place, place / name, **options)
        with contextlib.suppress(KeyboardInterrupt):
            reconstruct_images(place, place / "killed", progress=interrupt_at("matches", 2))
        reconstruct_video(place, place / "video")
        with contextlib.suppress(KeyboardInterrupt):
            reconstruct_video(place, place / "cut video", progress=interrupt_at("frames", 4))
        for name in ("nerfstudio", "colmap", "save"):
            assert COMMANDS[name](place, place / name) in (0, None)
    return place


def reconstruct_images(place, out, **options):
    reconstruct(place / "images", out, config=fake_config(), threads=1, **options)


def reconstruct_video(place, out, **options):
    given = {"until": "features", "config": fake_config(), "threads": 1, "every": 2}
    reconstruct(place / "00.mp4", out, **given, **options)


def export(kind):
    def command(place, out, *more):
        return cli("export", place / "same", "--to", kind, "-o", out, *more)

    return command


def cli(*arguments):
    return run_command([str(argument) for argument in arguments])


def save(place, out, *more):
    thesisrecon.save(load(place / "same"), out, overwrite=bool(more))


def python(function):
    return lambda place, out, *more: function(place, out, overwrite=bool(more))


COMMANDS = {
    "reconstruct": python(reconstruct_images),
    "video": python(reconstruct_video),
    "real": lambda place, out, *more: reconstruct(
        place / "images", out, until="features", threads=1, overwrite=bool(more)
    ) and 0,
    "demo": lambda _, out, *more: cli("demo", "-o", out, *more),
    "save": save,
    **{kind: export(kind) for kind in ("colmap", "colmap-undistorted", "nerfstudio")},
    "compare": lambda place, out, *more: cli(
        "compare", place / "same", place / "other", "--json", out / "summary.json", *more
    ),
}  # fmt: skip


@contextlib.contextmanager
def patched():
    """Frames of a video, and views between images, that cost nothing."""

    def decoded(path, threads, warnings):
        for n in range(6):
            image = files.picture(n)
            yield SimpleNamespace(rotation=0, to_image=lambda image=image: image), 6

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_frames, "_decoded", decoded)
        patch.setattr(
            "thesisrecon.cli.commands._run",
            lambda _, __, out, options: reconstruct(
                photographs(2), out, config=fake_config(), threads=1, overwrite=options["overwrite"]
            ),
        )
        yield


KNOWN = (
    *(name for name in RESULT_FILES if "*" not in name), "config.toml", "run.json",
    "00-frames/00-000000.png", "00-frames/frames.json", "group-2/summary.json", "group-2/cameras.json",
    "transforms.json", "images/00.png", "images/01.png", "scene.mvs",
)  # fmt: skip
"""Files that --overwrite may replace; the following survive it, too."""
UNKNOWN = (
    "holiday.jpg", "a/b.txt", "tiles/mine.glb", "00-frames/mine.png", "01-features/mine.npz",
    "01-features/notes.txt", "06-metric/x.npz", "group-x/summary.json", "frame-x.png", "frame-0009.png",
    "images/mine.jpg", ".lock", ".hidden", "sparse/0/images.txt", "sparse/1/images.bin", "model.GLB",
    "Summary.json",
)  # fmt: skip
FOLDERS = ("sparse", "sparse/0", "tiles", "00-frames", "images", "group-2", "views", "06-metric")
STATES = (
    "same", "other", "early", "killed", "video", "cut video", "nerfstudio", "colmap", "save",
    "nothing", "nothing", "empty",
)  # fmt: skip
RUN_FILES = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[:40] if path.is_file() else b'{"vers'),
    "empty": lambda path: path.write_bytes(b""),
    "foreign": lambda path: path.write_text('{"program": "another"}', encoding="utf-8"),
    "unreadable": lambda path: (path.unlink(missing_ok=True), files.unreadable(path)),
    "folder": lambda path: (path.unlink(missing_ok=True), path.mkdir()),
    "absent": lambda path: path.unlink(missing_ok=True),
}


def make_state(rng, stock, place):
    """A random output folder; returns it and the files of the user in it."""
    out, outside = place / "out", place / "outside"
    outside.mkdir()
    for n in range(2):
        (outside / f"{n}.jpg").write_bytes(rng.bytes(20))
    (outside / "00-000000.png").write_bytes(rng.bytes(20))
    state = STATES[rng.integers(len(STATES))]
    if state not in ("nothing", "empty"):
        shutil.copytree(stock / state, out)
    elif state == "empty" or rng.random() < 0.8:
        out.mkdir()
    own = {}
    if out.is_dir():
        if rng.random() < 0.35:
            kind = [*RUN_FILES][rng.integers(len(RUN_FILES))]
            RUN_FILES[kind](out / "run.json")
        for name in rng.choice(KNOWN + UNKNOWN, rng.integers(0, 4), replace=False).tolist():
            add_file(rng, out / name, outside, own)
        for name in rng.choice(FOLDERS, int(rng.random() < 0.25)).tolist():
            if not os.path.lexists(out / name) and (out / name).parent.is_dir():
                (out / name).symlink_to(outside)
                own[out / name] = ("link", str(outside))
    return out, own | {path: ("file", path.read_bytes()) for path in outside.iterdir()}


def add_file(rng, path, outside, own):
    """A file, folder or link of the user, perhaps in the place of one of a command."""
    if any(parent.is_symlink() or parent.is_file() for parent in path.parents):
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        return
    path.unlink(missing_ok=True)
    kind = rng.choice(["file", "file", "file", "link", "folder", "hard link"])
    if kind == "link":
        path.symlink_to(outside / "0.jpg")
        own[path] = ("link", str(outside / "0.jpg"))
        return
    if kind == "folder":
        path.mkdir()
        path = path / "inner.txt"
    if kind == "hard link":
        os.link(outside / "1.jpg", path)
    else:
        path.write_bytes(rng.bytes(30))
    own[path] = ("file", path.read_bytes())


def lost(own):
    """The files of the user that changed and are not kept beside their place either."""
    beside = {path: path.with_name(f"{path.name}.other") for path in own}
    return [str(path) for path, what in own.items() if what not in (of(path), of(beside[path]))]


def of(path):
    if path.is_symlink():
        return "link", str(path.readlink())
    return ("file", path.read_bytes()) if path.is_file() else None


def tree(place):
    """All files, links and folders; the content of an unreadable one is not read."""
    unread = [path for path in place.rglob("*") if not path.is_symlink() and not path.is_dir()]
    found = {path: of(path) for path in unread if os.access(path, os.R_OK)}
    return found | {p: of(p) for p in place.rglob("*") if p.is_symlink()} | {
        p: "folder" for p in place.rglob("*") if p.is_dir() and not p.is_symlink()
    }  # fmt: skip


def try_one(seed, stock, place, *, overwrite):
    """One random state and command; returns its words and what was lost or left."""
    rng = np.random.default_rng([43, seed])
    name = [*COMMANDS][rng.integers(len(COMMANDS))]
    out, own = make_state(rng, stock, place)
    before, code, said = tree(place), 0, ""
    try:
        code = COMMANDS[name](stock, out, *["--overwrite"][: int(overwrite)]) or 0
    except UsageError as refusal:
        code, said = 2, str(refusal)
    words = f"{seed}: {name}, {code} {said}"
    if overwrite:
        names = {path: path.relative_to(place).as_posix().removeprefix("out/") for path in own}
        own = {path: what for path, what in own.items() if names[path] not in KNOWN}
    faults = [f"{words}: lost {path}" for path in lost(own)]
    if code == 2 and "resume from" not in said:
        after = tree(place)
        changed = sorted(str(p) for p in before.keys() | after.keys() if before.get(p) != after.get(p))
        faults += [f"{words}: left or changed {path}" for path in changed]
    if code not in (0, 2):
        faults.append(f"{words}: {code}")
    return words, faults


def search(seeds, stock, tmp_path, *, overwrite=False):
    done, faults = [], []
    with patched():
        for seed in seeds:
            place = tmp_path / str(seed)
            place.mkdir()
            words, found = try_one(seed, stock, place, overwrite=overwrite)
            done.append(words)
            faults += found
            shutil.rmtree(place)
    assert faults == []
    # Both kinds of end occur: otherwise nothing would have been tried.
    share = sum(", 0 " in words for words in done) / len(done)
    assert 0.2 < share < 0.8, share


def test_overwrite_replaces_only_files_that_a_command_writes(stock, tmp_path):
    search(range(QUICK), stock, tmp_path, overwrite=True)


def test_files_of_the_user_survive_without_overwrite(stock, tmp_path):
    search(range(QUICK), stock, tmp_path)


@pytest.mark.slow
def test_files_of_the_user_survive_in_a_thousand_folders(stock, tmp_path):
    # They take longer than the limit of the tests of this folder.
    for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
        signal.setitimer(timer, 0)
    search(range(QUICK, QUICK + MANY), stock, tmp_path)
