"""Hostile and unusual images through the command line: rejected in one sentence, or read."""

import json
import os
import resource
import subprocess
import sys
import unicodedata

import numpy as np
import PIL.Image
import PIL.ImageCms
import pytest

from tests.bad_input import files
from tests.bad_input.files import FEATURES, links, picture, pipe, sparse, writes

pytestmark = pytest.mark.usefixtures("bounded")

# Files that are not images: name, maker, part of the reason.
NO_PHOTOGRAPHS = [
    ("gone.png", links("{here}/nowhere.png"), "cannot be read: No such file"),
    ("round.png", links("{here}/round.png"), "cannot be read: Too many levels of symbolic links"),
    ("pipe.jpg", pipe, "is a pipe, a device or a socket"),
    ("socket.jpg", files.listens, "is a pipe, a device or a socket"),
    ("zero.png", links("/dev/zero"), "is a pipe, a device or a socket"),
    ("random.jpg", links("/dev/urandom"), "is a pipe, a device or a socket"),
    ("null.png", links("/dev/null"), "is a pipe, a device or a socket"),
    ("unreadable.png", files.unreadable, "cannot be decoded: "),
    ("empty.jpg", writes(b""), "is not an image of a known format"),
    ("letter.jpg", writes("dear reader"), "is not an image of a known format"),
    ("page.png", writes("<html><script>alert(1)</script>"), "is not an image of a known format"),
    ("program.jpg", writes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 99 99\n"), "is not an image"),
    ("cut.jpg", writes(files.encoded("JPEG")[:900]), "cannot be decoded: image file is truncated"),
    ("cut.png", writes(files.encoded("PNG")[:900]), "cannot be decoded"),
    ("cut.gif", writes(files.encoded("GIF")[:300]), "is not an image of a known format"),
    ("cut.tif", writes(files.encoded("TIFF")[:600]), "cannot be decoded"),
    ("cut.webp", writes(files.encoded("WEBP")[:200]), "cannot be decoded"),
    ("doubtful.png", writes(files.png(12_000, 12_000)), "cannot be decoded: "),
    ("broken.png", writes(files.encoded("PNG").replace(b"IDAT", b"IDOT", 1)), "is not an image"),
    ("bomb.png", writes(files.bomb()), "claims more than 178 megapixels"),
    ("claim.png", writes(files.png(2**31 - 1, 2**31 - 1)), "claims more than 178 megapixels"),
    ("note.png", writes(files.text_bomb()), "cannot be decoded: Decompressed "),
    ("one.png", writes(files.encoded("PNG", picture(size=(1, 1)))), "has only 1 x 1 pixels"),
    ("thin.png", writes(files.encoded("PNG", picture(size=(2, 10_000)))), "has 2 x 10000 pixels: too narrow"),
    ("flat.bmp", writes(files.encoded("BMP", picture(size=(1, 30)))), "has only 1 x 30 pixels"),
    ("large.jpg", sparse(2**33, files.encoded("JPEG")), "is a file of 8.0 GiB"),
    ("blank.png", writes(files.encoded("PNG", PIL.Image.new("RGB", (99, 99)))), "is blank"),
]


@pytest.mark.parametrize(("name", "make", "words"), NO_PHOTOGRAPHS, ids=[name for name, *_ in NO_PHOTOGRAPHS])
def test_files_that_are_not_images_are_rejected(name, make, words, tmp_path, run_cli):
    (tmp_path / "in").mkdir()
    make(tmp_path / "in" / name)
    said = run_cli(["reconstruct", str(tmp_path / "in"), "-o", str(tmp_path / "out"), *FEATURES], 3)
    assert "no usable images; at least one is needed; " in said
    assert f"{name} {words}" in said
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert [entry["name"] for entry in summary["refused"]] == [name]


def test_a_picture_below_the_limit_is_held_once(tmp_path, run_cli):
    """80 megapixels of one byte each; as colours with alpha they would take 320 MB, several times over."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "large.png").write_bytes(files.large_palette())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    said = run_cli(["reconstruct", str(tmp_path / "in"), "-o", str(tmp_path / "out"), *FEATURES], 3)
    assert "large.png is blank" in said
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 250 * 2**10


def test_images_of_noise_are_matched_in_memory_in_proportion_to_their_pixels(tmp_path):
    """A process of its own, whose peak is that of the run."""
    rng = np.random.default_rng(0)
    for k in range(2):
        tiles = np.indices((1200, 1600)).sum(axis=0) // 4 % 2 * 200 + rng.integers(0, 55, (1200, 1600))
        PIL.Image.fromarray(tiles.astype(np.uint8)).save(tmp_path / f"{k}.png")
    script = "import re, sys; from thesisrecon.cli.commands import run_command; run_command(sys.argv[1:])\n"
    # The peak of getrusage is at least that of the process that started this one.
    script += "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])"
    words = ["reconstruct", tmp_path, "-o", tmp_path / "out", "--until", "matches", "--threads", "1"]
    run = [sys.executable, "-c", script, *map(str, words)]
    done = subprocess.run(run, capture_output=True, text=True, check=True)
    # 230 MB, and 92 MB per megapixel, were measured from 0.75 to 6.75 megapixels.
    assert int(done.stdout.split()[-1]) / 1024.0 < 1.3 * (230.0 + 92.0 * 1.92)


def with_exif(data):
    return files.encoded("JPEG", exif=b"Exif\0\0" + data)


def animated():
    return files.encoded("GIF", save_all=True, append_images=[picture(k) for k in range(1, 5)])


def with_nan():
    values = np.asarray(picture().convert("L")).astype(np.float32)
    values[::7] = np.nan
    values[3, 3], values[4, 4] = np.inf, -np.inf
    return files.encoded("TIFF", PIL.Image.fromarray(values))


def sixteen_bits():
    grey = np.asarray(picture().convert("L")).astype(np.uint16) * 257
    return files.encoded("PNG", PIL.Image.fromarray(grey))


def wrong_focal(value):
    exif = PIL.Image.Exif()
    exif[0x8769] = {0xA405: value}
    return files.encoded("JPEG", exif=exif)


PROFILE = PIL.ImageCms.ImageCmsProfile(PIL.ImageCms.createProfile("LAB")).tobytes()
# Unusual images that are valid.
PHOTOGRAPHS = [
    ("sixteen bits.png", sixteen_bits()), ("cmyk.jpg", files.encoded("JPEG", picture().convert("CMYK"))),
    ("palette.png", files.encoded("PNG", picture().convert("P"))),
    ("alpha.png", files.encoded("PNG", picture().convert("RGBA"))),
    ("grey and alpha.png", files.encoded("PNG", picture().convert("LA"))),
    ("one bit.png", files.encoded("PNG", picture().convert("1"))), ("animated.gif", animated()),
    ("nan.tif", with_nan()), ("packed.tif", files.encoded("TIFF", compression="tiff_lzw")),
    ("exif of noise.jpg", with_exif(bytes(range(256)) * 4)),
    ("exif cut.jpg", with_exif(b"II*\0\x08\0\0\0\xff\xff")),
    ("exif in a circle.jpg", with_exif(b"MM\0*\0\0\0\x08\0\x01\x87\x69\0\x04\0\0\0\x01\0\0\0\x08\0\0\0\x08")),
    ("focal of words.jpg", wrong_focal("wide")), ("focal below zero.jpg", wrong_focal(0)),
    ("profile of another space.jpg", files.encoded("JPEG", icc_profile=PROFILE)),
    ("profile of noise.png", files.encoded("PNG", icc_profile=bytes(range(256)) * 9)),
    ("profile of noise.jpg", files.encoded("JPEG", icc_profile=os.urandom(70_000))),
    ("jpeg called.png", files.encoded("JPEG")),
    ("more after its end.jpg", files.encoded("JPEG") + os.urandom(5000)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content"), PHOTOGRAPHS, ids=[name for name, _ in PHOTOGRAPHS])
def test_odd_photographs_are_read(name, content, tmp_path, run_cli):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / name).write_bytes(content)
    knowledge = ["--set", "intrinsics.exif=true", "--set", "intrinsics.focal_std_rel=0.1"]
    said = run_cli(
        ["reconstruct", str(tmp_path / "in"), "-o", str(tmp_path / "out"), *FEATURES, *knowledge], 0
    )
    assert "corners in 1 image" in said or "1 of 1 image read" in said


def test_links_lead_outside_and_folders_in_a_loop_are_not_entered(tmp_path, run_cli):
    folder = files.folder_of(tmp_path, "in")
    (tmp_path / "outside.png").write_bytes(files.encoded("PNG", picture(1)))
    (folder / "b.png").symlink_to(tmp_path / "outside.png")
    (folder / "loop.png").symlink_to(folder)
    (folder / "sub").mkdir()
    (folder / "sub" / "a.png").write_bytes(files.encoded("PNG", picture(2)))
    (folder / "sub" / "up").symlink_to(folder)
    said = run_cli(["reconstruct", str(folder), "-o", str(tmp_path / "out"), *FEATURES], 0)
    assert "3 images" in said
    assert "images of several folders are used: . (2), sub (1)" in said
    only = tmp_path / "folders only"
    (only / "empty" / ".hidden").mkdir(parents=True)
    (only / "empty" / ".hidden" / "a.png").write_bytes(files.encoded("PNG", picture(2)))
    said = run_cli(["reconstruct", str(only), "-o", str(tmp_path / "other"), *FEATURES], 2)
    assert "no images in" in said
    assert "and its subfolders" in said


def test_images_of_subfolders_have_relative_names_and_a_camera_for_each_folder(tmp_path, run_cli):
    home, out = tmp_path / "in", tmp_path / "in" / "out"
    for n, name in enumerate(("left/2.png", "left/10.png", "right/2.png", "masks/left/2.png")):
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = np.array(picture(n))
        pixels[:20] = 0
        (home / name).write_bytes(files.encoded("PNG", PIL.Image.fromarray(pixels)))
    given = ["reconstruct", str(home), "-o", str(out), "--masks", str(home / "masks"), *FEATURES]
    assert "left (2), right (1)" in run_cli(given, 0)
    summary = json.loads((out / "summary.json").read_text())
    assert [view["name"] for view in summary["cameras"]] == ["left/2.png", "left/10.png", "right/2.png"]
    assert [view["camera"] for view in summary["cameras"]] == [0, 0, 1]
    assert "masked_fraction" in summary["cameras"][0]
    # The output folder is no folder of images, also when the run is repeated.
    run_cli(given, 0)
    run_cli([*given, "--cameras", "per-size", "--overwrite"], 0)
    summary = json.loads((out / "summary.json").read_text())
    assert [view["camera"] for view in summary["cameras"]] == [0, 0, 0]


def test_a_file_that_vanishes_while_others_are_read(tmp_path, run_cli, monkeypatch):
    folder = files.folder_of(tmp_path, "in")
    for k in range(3):
        (folder / f"b{k}.png").write_bytes(files.encoded("PNG", picture(k + 1)))
    opened = PIL.Image.open

    def open_and_take_away(file, **options):
        (folder / "b1.png").unlink(missing_ok=True)
        return opened(file, **options)

    monkeypatch.setattr(PIL.Image, "open", open_and_take_away)
    said = run_cli(["reconstruct", str(folder), "-o", str(tmp_path / "out"), *FEATURES], 0)
    assert "not registered: b1.png: cannot be read: No such file or directory" in said
    assert "in 3 images" in said


NAMES = [
    "<img src=x onerror=alert(1)>.png", "\"'><script>alert(2)<\u2215script>.png",
    "{{ 7 * 7 }} %s %n $(id) `id` ;&|.png", "line\nend\r\t\x1b[31m.png", "\u202egnp.exe turned.png",
    "a" * 251 + ".png", "\U0001f4f7 写真 größe e\u0301.png", "-o.png", "--help.png", "a\\x0ab.png",
    "a\nb.png", os.fsdecode(b"latin \xff.png"), os.fsdecode(b"latin \xfe.png"), "latin \\xff.png",
    "NaN.png", "null.png",
]  # fmt: skip


def test_names_are_distinguished_and_shown_in_one_line(tmp_path, run_cli):
    (tmp_path / "in").mkdir()
    for k, name in enumerate(NAMES):
        (tmp_path / "in" / name).write_bytes(files.encoded("PNG", picture(k)))
    out = tmp_path / os.fsdecode(b"o\xff\n<b>ut")
    run_cli(["reconstruct", str(tmp_path / "in"), "-o", str(out), *FEATURES], 0)
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    names = [camera["name"] for camera in summary["cameras"]]
    assert len(set(names)) == len(NAMES)
    assert {"latin \\xff.png", "latin \\xff.png (2)", "latin \\xfe.png", "a\\x0ab.png (2)"} <= set(names)
    assert not any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for name in names for c in name)
    assert not any("\u202e" in name for name in names)
    said = run_cli(["inspect", str(out)], 0)
    assert "\\xff\\x0a<b>ut/report.html" in said
