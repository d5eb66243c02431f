"""Scenes that give few depths or none, through the whole pipeline, and a set of unusual images.

In the first ones cameras are given, depth and model are real. The result is a model or one sentence, no
warnings, and the cameras in any case.
"""

# ruff: noqa: ARG002 (a stage that knows the answer ignores most of what it is given)
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import trimesh

from tests.conftest import refuses
from tests.pipeline.fake_stages import FakeMetric, fake_config
from tests.stereo import hard_scenes as scenes
from tests.stereo.depth_scenes import photograph_scene
from tests.synthetic import texture
from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.cli.main import run_command
from thesisrecon.config import preset
from thesisrecon.errors import StageFailure

# The depth maps of more of them are tested with stereo; here they are empty, or there is no pair to match.
HOPELESS = {
    "no texture": lambda: photograph_scene(scenes.abreast(0.4), scenes.blank_wall(0.0)),
    "no points": scenes.without_points,
}
PARTLY = {
    "forward": scenes.ahead, "tiny baseline": lambda: scenes.fenced(0.05), "a fence": scenes.fenced,
    "a view of elsewhere": scenes.of_elsewhere, "a small photograph": lambda: scenes.far_smaller(0.5),
    "burnt out": lambda: scenes.burnt_out(scenes.fenced()),
}  # fmt: skip
MADE = {}


@dataclass(frozen=True)
class Given:
    """The cameras and points of a scene as they are, stage after stage."""

    scene: str

    @property
    def truth(self):
        return MADE[self.scene].reconstruction

    def build(self, prepared, pairs, *, map_all, rng):
        return self.truth.tracks

    def reconstruct(self, tracks, pairs, sizes, *, rng, attempt=0):
        return replace(self.truth, stratum="projective", K=None, distortion=None)

    def refine(self, reconstruction, calibration, *, prior, rng, threads):
        reported = FakeMetric().refine(reconstruction, calibration, prior=prior, rng=rng, threads=threads)
        return replace(reported, reconstruction=self.truth)


def photographs(name):
    if name not in MADE:
        MADE[name] = (HOPELESS | PARTLY)[name]()
    # The fake front end reads a number from the name.
    return [replace(image, name=f"{k:02d}.png") for k, image in enumerate(MADE[name].images)]


def config(name, base):
    chosen = preset(base)
    return fake_config(
        tracks=Given(name), projective=Given(name), metric=Given(name), dense=chosen.dense, model=chosen.model
    )


def run(name, out, base="default", **given):
    images = photographs(name)
    return reconstruct(images, out, config=config(name, base), threads=2, **given)


def summary(out):
    return json.loads((out / "summary.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", HOPELESS)
def test_no_depths_are_one_sentence_and_the_cameras_stay(name, tmp_path):
    result = run(name, tmp_path)
    assert result.mesh is None
    reported = [w for w in result.warnings if "No surface model was built" in w]
    assert len(reported) == 1
    assert "no depth was found" in reported[0]
    assert summary(tmp_path)["registered"] == len(MADE[name].images)
    assert not (tmp_path / "model.glb").exists()
    assert (tmp_path / "report.html").exists()


def test_a_requested_model_without_depths_is_a_failure(tmp_path):
    refuses(StageFailure, "no depth was found", run, "no texture", tmp_path, until="model")
    assert "no depth" in summary(tmp_path)["failure"]


@pytest.mark.parametrize(("name", "base"), [*((n, "default") for n in PARTLY), ("a fence", "thesis")])
def test_partly_visible_scenes_become_models(name, base, tmp_path):
    result = run(name, tmp_path, base)
    assert len(result.mesh.faces) > 100
    assert np.isfinite(result.mesh.vertices).all()
    scene = trimesh.load(tmp_path / "model.glb")
    assert len(scene.geometry) == 1
    without = {f"{m.view:02d}.png" for m in result.depth_maps if not np.isfinite(m.depth).any()}
    assert {w.split()[1] for w in result.warnings if w.endswith("has no depth values")} == without
    if name == "a view of elsewhere":
        assert without == {"03.png"}


COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "images"


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
    command = ["reconstruct", str(folder), "-o", str(out), "--max-size", "200", "--threads", "2"]
    assert run_command(command) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "5 of 6 images registered" in printed.out
    assert "not registered: elsewhere.png" in printed.out
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert [entry["name"] for entry in summary["refused"]] == ["elsewhere.png"]
    mesh = next(iter(trimesh.load(out / "model.glb").geometry.values()))
    assert len(mesh.faces) > 10_000
    assert np.isfinite(mesh.vertices).all()
