"""A set as people have them, from the command line to the model: burnt-out skies, one photograph far smaller
than the others, one of something else."""

import json
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import trimesh

from tests.synthetic import texture
from thesisrecon.cli.main import run_command

COURTYARD = Path(__file__).parent.parent / "fixtures" / "courtyard" / "images"


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    for k, path in enumerate(sorted(COURTYARD.iterdir())[:5]):
        with PIL.Image.open(path) as file:
            picture = file.convert("RGB")
        if k == 3:
            picture = picture.resize((picture.width // 6, picture.height // 6), PIL.Image.Resampling.LANCZOS)
        if k in (1, 2):
            rgb = np.array(picture)
            rgb[: rgb.shape[0] // 3] = 255
            rgb[-60:, :200] = 0
            picture = PIL.Image.fromarray(rgb)
        picture.save(folder / f"{k}.png")
    other = np.repeat(texture(300, 400, 9).astype(np.uint8)[..., None], 3, axis=2)
    PIL.Image.fromarray(other).save(folder / "elsewhere.png")
    return folder


def test_the_others_become_a_model(folder, tmp_path, capsys):
    out = tmp_path / "out"
    command = ["reconstruct", str(folder), "-o", str(out), "--max-size", "240", "--threads", "2"]
    assert run_command(command) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "5 of 6 photographs registered" in printed.out
    assert "refused: elsewhere.png" in printed.out
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert [entry["name"] for entry in summary["refused"]] == ["elsewhere.png"]
    mesh = next(iter(trimesh.load(out / "model.glb").geometry.values()))
    assert len(mesh.faces) > 10_000
    assert np.isfinite(mesh.vertices).all()
