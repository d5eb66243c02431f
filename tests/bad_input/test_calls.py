"""Bad input through the command line gets one sentence and exit code 2 or 3, and nothing is lost."""

import json
import shutil
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.conftest import without_progress
from tests.synthetic import texture
from thesisrecon.cli.commands import run_command

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "images"
SMALL = ["--max-size", "320", "--threads", "2", "--until", "metric"]


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    return folder


@pytest.fixture
def reconstruct(folder, tmp_path, capsys):
    """Run the command, require its exit code, and return its sentence (none if it succeeds) and summary."""

    def run(code=0):
        found = run_command(["reconstruct", str(folder), "-o", str(tmp_path / "out"), *SMALL])
        sentence = without_progress(capsys.readouterr().err)
        assert found == code, sentence
        assert "Traceback" not in sentence
        assert sentence.count("\n") == (code != 0)
        return sentence, json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))

    return run


def courtyard(n):
    return sorted(COURTYARD.iterdir())[:n]


def picture(k):
    with PIL.Image.open(courtyard(k + 1)[k]) as file:
        return file.convert("RGB")


TWO_REGISTERED = {"stratum": "projective", "registered": 2}


@pytest.mark.parametrize(
    ("copies", "words", "found"),
    [
        ({"a.jpg": 0}, "1 usable image; at least two different ones are needed", {"images": 1}),
        ({"a.jpg": 0, "b.jpg": 0}, "b.jpg has the same pixels as a.jpg", {}),
        ({"a.jpg": 0, "b.jpg": 1}, "self-calibration needs at least 3 registered images", TWO_REGISTERED),
    ],
)
def test_too_few_images(copies, words, found, folder, reconstruct):
    for name, k in copies.items():
        shutil.copy(courtyard(2)[k], folder / name)
    sentence, summary = reconstruct(3)
    assert words in sentence
    assert found.items() <= summary.items()


def test_images_without_common_corners(folder, reconstruct):
    """Noise, and a soft gradient that passes for a photograph but has no corner to match."""
    rng, ramp = np.random.default_rng(0), np.linspace(0, 255, 400)[None, :] * np.ones((300, 1))
    for k in range(2):
        PIL.Image.fromarray(rng.integers(0, 256, (300, 400, 3), dtype=np.uint8)).save(folder / f"{k}.png")
        PIL.Image.fromarray(np.roll(ramp, 40 * k, axis=0).astype(np.uint8) // (k + 1)).save(
            folder / f"r{k}.png"
        )
    sentence, summary = reconstruct(3)
    assert "no two images could be matched" in sentence
    assert summary["pairs"]["matched"] == 6


SIZE = (480, 360)
K = np.array([[480.0, 0.0, 239.5], [0.0, 480.0, 179.5], [0.0, 0.0, 1.0]])
K_PICTURE = np.array([[800.0, 0.0, 511.5], [0.0, 800.0, 383.5], [0.0, 0.0, 1.0]])


def rotation(x, y):
    """About the x axis after the y axis, in radians."""
    return Rotation.from_euler("yx", [y, x]).as_matrix()


def seen_through(H):
    """The first photograph of the courtyard where pixel x shows its pixel H x."""
    perspective, bicubic = PIL.Image.Transform.PERSPECTIVE, PIL.Image.Resampling.BICUBIC
    coefficients = tuple((H / H[2, 2]).ravel()[:8].tolist())
    return picture(0).transform(SIZE, perspective, coefficients, bicubic, fillcolor=(128, 128, 128))


def round_a_poster():
    """Four cameras walk round a plane, the poster z = 1: x ~ K R (X - C)."""
    for k, angle in enumerate((-0.4, -0.15, 0.15, 0.4)):
        R = rotation(0.1 * (-1) ** k, angle)
        C = np.array([-np.sin(angle), 0.1 * (-1) ** k, 1 - np.cos(angle)])
        yield K @ R @ np.column_stack([[1, 0, 0], [0, 1, 0], np.array([0, 0, 1]) - C])


def on_a_tripod():
    return [K @ rotation(x, y) for x, y in [(-0.05, -0.18), (0.04, -0.06), (0.0, 0.07), (-0.03, 0.19)]]


@pytest.mark.parametrize("cameras", [round_a_poster, on_a_tripod])
def test_a_flat_poster_and_a_camera_that_only_turns_have_no_parallax(cameras, folder, reconstruct):
    for k, image_from_plane in enumerate(cameras()):
        seen_through(K_PICTURE @ np.linalg.inv(image_from_plane)).save(folder / f"{k}.png")
    sentence, summary = reconstruct(3)
    assert "no parallax" in sentence
    assert summary["pairs"]["accepted"] >= 3


@pytest.fixture
def odd_images(folder):
    """One small, two partly burnt out and black, and one of elsewhere."""
    for k in range(5):
        rgb = np.array(picture(k).reduce(6) if k == 3 else picture(k))
        if k in (1, 2):
            rgb[: rgb.shape[0] // 3] = 255
            rgb[-60:, :200] = 0
        PIL.Image.fromarray(rgb).save(folder / f"{k}.png")
    other = np.repeat(texture(300, 400, 9).astype(np.uint8)[..., None], 3, axis=2)
    PIL.Image.fromarray(other).save(folder / "elsewhere.png")
    return folder


def test_the_others_become_a_model(odd_images, tmp_path, capsys):
    out = tmp_path / "out"
    command = ["reconstruct", str(odd_images), "-o", str(out), "--max-size", "200", "--threads", "2"]
    assert run_command(command) == 0
    printed = capsys.readouterr()
    assert without_progress(printed.err) == ""
    assert "5 of 6 images registered" in printed.out
    assert "not registered: elsewhere.png" in printed.out
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert [entry["name"] for entry in summary["refused"]] == ["elsewhere.png"]
    mesh = next(iter(trimesh.load(out / "model.glb").geometry.values()))
    assert len(mesh.faces) > 10_000
    assert np.isfinite(mesh.vertices).all()
