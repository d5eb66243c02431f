"""Bad input through the command line: each item gets one clear sentence, exit code 2 or 3, and nothing is
lost.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from thesisrecon.cli import run_command

COURTYARD = Path(__file__).parent.parent / "fixtures" / "courtyard" / "images"
SMALL = ["--max-size", "480", "--threads", "2"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "photographs"
    folder.mkdir()
    return folder


class Answer:
    """Exit code, the one sentence, and the summary (None where no run began)."""

    def __init__(self, code: int, sentence: str, out: Path) -> None:
        self.code, self.sentence = code, sentence
        path = out / "summary.json"
        self.summary: Any = json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


@pytest.fixture
def reconstruct(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    def run(*options: str, out: Path | None = None) -> Answer:
        out = tmp_path / "out" if out is None else out
        code = run_command(["reconstruct", str(folder), "-o", str(out), *SMALL, *options])
        sentence = capsys.readouterr().err
        assert "Traceback" not in sentence
        assert sentence.count("\n") == (code != 0)
        return Answer(code, sentence, out)

    return run


def courtyard(n: int) -> list[Path]:
    return sorted(COURTYARD.iterdir())[:n]


def picture(k: int) -> PIL.Image.Image:
    with PIL.Image.open(courtyard(k + 1)[k]) as file:
        return file.convert("RGB")


def refused(answer: Answer) -> dict[str, str]:
    return {entry["name"]: entry["reason"] for entry in answer.summary["refused"]}


def test_an_empty_folder(reconstruct: Callable[..., Answer]) -> None:
    answer = reconstruct()
    assert answer.code == 2
    assert "there are no photographs in" in answer.sentence


def test_one_image(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    shutil.copy(courtyard(1)[0], folder)
    answer = reconstruct()
    assert answer.code == 3
    assert "1 usable photograph; at least 2 different ones are needed" in answer.sentence
    assert answer.summary["images"] == 1


def test_two_identical_images(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    for name in ("a.jpg", "b.jpg"):
        shutil.copy(courtyard(1)[0], folder / name)
    answer = reconstruct()
    assert answer.code == 3
    assert "b.jpg has the same pixels as a.jpg" in answer.sentence


def test_damaged_files_among_good_ones(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    """A text named .jpg and a truncated JPEG are refused with their reasons; the others go on to cameras."""
    for path in courtyard(5):
        shutil.copy(path, folder / f"good {path.name}")
    (folder / "letter.jpg").write_text("dear reader")
    whole = courtyard(6)[5].read_bytes()
    (folder / "cut off.jpg").write_bytes(whole[: len(whole) // 2])
    answer = reconstruct()
    assert answer.code == 0
    assert answer.summary["registered"] == 5
    assert "not an image" in refused(answer)["letter.jpg"]
    assert "truncated" in refused(answer)["cut off.jpg"]
    page = (folder.parent / "out" / "report.html").read_text(encoding="utf-8")
    assert "letter.jpg" in page


def test_every_kind_of_pixel_in_one_scene(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    """16-bit, grey, RGBA and CMYK images, an EXIF rotation, spaces and letters beyond ASCII: all become
    cameras.
    """
    grey = np.asarray(picture(0).convert("L")).astype(np.uint16) * 257
    PIL.Image.fromarray(grey).save(folder / "a sixteen bits.png")
    picture(1).convert("L").save(folder / "b größe.png")
    picture(2).convert("RGBA").save(folder / "c 写真.png")
    picture(3).convert("CMYK").save(folder / "d.tif")
    exif = PIL.Image.Exif()
    exif[0x0112] = 6
    picture(4).transpose(PIL.Image.Transpose.ROTATE_90).save(folder / "e.jpg", exif=exif, quality=95)
    answer = reconstruct()
    assert answer.code == 0
    cameras = {camera["name"]: camera for camera in answer.summary["cameras"]}
    assert list(cameras) == ["a sixteen bits.png", "b größe.png", "c 写真.png", "d.tif", "e.jpg"]
    assert all(camera["registered"] for camera in cameras.values())
    assert cameras["e.jpg"]["width_px"] == picture(4).size[0]
    assert {camera["camera"] for camera in cameras.values()} == {0}


def test_mixed_sizes_are_different_cameras(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    for k in range(6):
        scale = 0.75 if k % 2 else 1.0
        image = picture(k)
        image.resize((int(image.size[0] * scale), int(image.size[1] * scale))).save(folder / f"{k}.png")
    answer = reconstruct()
    assert answer.code == 0
    assert answer.summary["registered"] == 6
    focals = [c["focal_px"]["value"] / c["width_px"] for c in answer.summary["cameras"]]
    assert [c["camera"] for c in answer.summary["cameras"]] == [0, 1, 0, 1, 0, 1]
    assert np.ptp(focals) < 0.1 * np.mean(focals)


def test_blank_images(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    for k in range(3):
        PIL.Image.new("RGB", (400, 300), (200, 190, 60 * k)).save(folder / f"{k}.png")
    answer = reconstruct()
    assert answer.code == 3
    assert "no usable photographs" in answer.sentence
    assert "blank" in answer.sentence


def test_noise_images(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    rng = np.random.default_rng(0)
    for k in range(3):
        PIL.Image.fromarray(rng.integers(0, 256, (300, 400, 3), dtype=np.uint8)).save(folder / f"{k}.png")
    answer = reconstruct()
    assert answer.code == 3
    assert "no two photographs could be matched" in answer.sentence
    assert answer.summary["pairs"]["matched"] == 3


def test_almost_featureless_images(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    """A soft gradient passes for a photograph, but has no corner to match."""
    ramp = np.linspace(0, 255, 400)[None, :] * np.ones((300, 1))
    for k in range(2):
        PIL.Image.fromarray(np.roll(ramp, 40 * k, axis=0).astype(np.uint8) // (k + 1)).save(
            folder / f"{k}.png"
        )
    answer = reconstruct()
    assert answer.code == 3


def test_two_views_are_answered_with_a_result_or_a_reason(
    folder: Path, reconstruct: Callable[..., Answer]
) -> None:
    for path in courtyard(2):
        shutil.copy(path, folder)
    answer = reconstruct()
    assert answer.code in (0, 3)
    if answer.code == 0:
        assert not answer.summary["trusted"]
        assert answer.summary["warnings"]


def test_an_output_folder_that_cannot_be_written(
    folder: Path, tmp_path: Path, reconstruct: Callable[..., Answer]
) -> None:
    for path in courtyard(2):
        shutil.copy(path, folder)
    (tmp_path / "file").write_text("in the way")
    answer = reconstruct(out=tmp_path / "file" / "out")
    assert answer.code == 2
    assert "cannot be written" in answer.sentence


def test_an_output_folder_of_something_else(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    for path in courtyard(2):
        shutil.copy(path, folder)
    answer = reconstruct(out=folder)
    assert answer.code == 2
    assert "which is of no run" in answer.sentence


def test_an_output_folder_of_another_config(folder: Path, reconstruct: Callable[..., Answer]) -> None:
    for path in courtyard(2):
        shutil.copy(path, folder)
    assert reconstruct("--until", "features").code == 0
    answer = reconstruct("--until", "features", "--set", "features.levels=4")
    assert answer.code == 2
    assert "features.levels was 5 there and is 4 here" in answer.sentence
    assert reconstruct("--until", "features", "--seed", "1", "--overwrite").code == 0
    assert answer.summary["images"] == 2
