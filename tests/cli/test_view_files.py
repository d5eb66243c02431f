"""``thesisrecon render`` on a small run made by hand: the painted sphere and the cameras around it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from tests.conftest import without_progress
from tests.surface.sphere import SHAPE, photograph, ring_of
from thesisrecon.api.export import write_mesh
from thesisrecon.camera import Camera
from thesisrecon.cli.commands import run_command
from thesisrecon.io._exports import cameras_table
from thesisrecon.io._files import write_json
from thesisrecon.records import TexturedMesh
from thesisrecon.surface.fusion import VolumetricFusion
from thesisrecon.surface.model import texture_mesh

SIZE = SHAPE[::-1]
COUNT = 8


def write_cameras(out):
    """``cameras.json`` by the writer of runs."""
    views = [Camera.from_matrix(depth_map.P, SIZE) for depth_map in ring_of(COUNT)]
    cameras = {f"{k}.jpg": replace(view, distortion=np.zeros(3)) for k, view in enumerate(views) if k != 3}
    write_json(out / "cameras.json", cameras_table(cameras))


@pytest.fixture(scope="module")
def sphere(tmp_path_factory):
    """A folder as a run leaves it, and the model in it."""
    out = tmp_path_factory.mktemp("views") / "a rün"
    maps = ring_of(COUNT)
    mesh = texture_mesh(VolumetricFusion(voxel_px=3.0).fuse(maps), [photograph(m) for m in maps])
    write_mesh(out / "model.glb", mesh)
    write_cameras(out)
    write_json(out / "run.json", {})
    return out, mesh


@pytest.fixture
def run(sphere, tmp_path):
    """A copy of the run for one test."""
    return Path(shutil.copytree(sphere[0], tmp_path / sphere[0].name))


def pixels(path):
    with PIL.Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def difference_from_photograph(frame, view):
    """Median difference of colours from photograph ``view`` on the sphere, well inside it."""
    truth = photograph(ring_of(COUNT)[view]).rgb.astype(int)
    y, x = np.indices(SHAPE)
    inside = np.hypot(x - 79.5, y - 59.5) < 25
    return float(np.median(np.abs(pixels(frame) - truth)[inside]))


def test_interpolation_begins_and_ends_as_the_photographs(run, capsys):
    assert run_command(["render", str(run), "--path", "interpolate", "--frames", "5", "--threads", "2"]) == 0
    folder = run / "views" / "interpolate"
    said = capsys.readouterr()
    assert said.out == f"5 frames of 160 x 120 px and interpolate.webp written to {folder}\n"
    assert without_progress(said.err) == ""
    frames = [f"frame-000{k}.png" for k in range(1, 6)]
    names = [".lock", *frames, "frames.json", "interpolate.webp"]
    assert sorted(path.name for path in folder.iterdir()) == names
    assert difference_from_photograph(folder / "frame-0001.png", 0) < 6
    assert difference_from_photograph(folder / "frame-0005.png", COUNT - 1) < 6
    with PIL.Image.open(folder / "interpolate.webp") as film:
        assert film.n_frames == 5
    reported = json.loads((folder / "frames.json").read_text(encoding="utf-8"))
    cameras = json.loads((run / "cameras.json").read_text(encoding="utf-8"))["cameras"]
    assert len(cameras) == COUNT - 1
    np.testing.assert_allclose(reported["frames"][0]["centre"], cameras[0]["centre"], atol=1e-9)
    np.testing.assert_allclose(reported["frames"][-1]["R"], cameras[-1]["R"], atol=1e-9)


def test_an_orbit_shows_the_model_from_all_sides_and_threads_change_no_byte(run, tmp_path):
    wanted = ["render", str(run), "--path", "orbit", "--frames", "6", "--size", "120x80"]
    for threads in ("1", "2"):
        assert run_command([*wanted, "-o", str(tmp_path / threads), "--threads", threads]) == 0
    one, two = tmp_path / "1", tmp_path / "2"
    # The record lists the files in the order in which they were written.
    written = [{p.name: p.read_bytes() for p in out.iterdir() if p.name != ".lock"} for out in (one, two)]
    assert written[0] == written[1]
    frames = [pixels(one / f"frame-000{k}.png") for k in range(1, 7)]
    for frame in frames:
        assert frame.shape == (80, 120, 3)
        drawn = frame.any(axis=2)
        assert not drawn[0, 0]
        assert 0.1 < drawn.mean() < 0.9
        y, x = np.nonzero(drawn)
        assert abs(x.mean() - 59.5) < 3
        assert abs(y.mean() - 39.5) < 3
    assert np.abs(frames[0] - frames[3]).mean() > 4


def test_a_bare_model_is_lit(run, tmp_path):
    cube = TexturedMesh(
        np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)]) * 0.7,
        np.array([[0, 1, 2], [3, 2, 1], [4, 6, 5], [7, 5, 6], [0, 4, 1], [5, 1, 4]]),
    )
    write_mesh(run / "model.glb", cube)
    assert run_command(["render", str(run), "--frames", "2", "-o", str(tmp_path / "cube")]) == 0
    shown = pixels(tmp_path / "cube" / "frame-0001.png")[..., 0]
    assert len(np.unique(shown)) > 5


def test_a_shorter_command_removes_the_earlier_frames(run):
    small = ["render", str(run), "--size", "40x30", "-o", str(run / "film"), "--frames"]
    assert run_command([*small, "4"]) == 0
    assert run_command([*small, "2", "--path", "interpolate"]) == 0
    names = sorted(path.name for path in (run / "film").iterdir())
    assert names == [".lock", "frame-0001.png", "frame-0002.png", "frames.json", "interpolate.webp"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--frames", "0"], "'--frames'"),
        (["--frames", "many"], "--frames"),
        (["--size", "large"], "--size takes WIDTHxHEIGHT in pixels, as 1000x700; got 'large'"),
        (["--size", "100x0"], "sides of 1 to 8192 pixels; got 100x0"),
        (["--size", "100x9000"], "sides of 1 to 8192 pixels"),
        (["--size", "-5x7"], "--size takes WIDTHxHEIGHT"),
        (["--path", "spiral"], "--path"),
        (["-o", ""], "the folder has no name"),
    ],
)
def test_wrong_options_get_one_sentence(options, words, run, refused):
    assert words in refused(["render", run, *options])
    assert not (run / "views").exists()


def test_missing_arguments_are_named(run, tmp_path, refused):
    said = refused(["render", tmp_path / "nowhere"])
    assert "holds no run; create one with thesisrecon reconstruct" in said
    (tmp_path / "empty").mkdir()
    assert "holds no run" in refused(["render", tmp_path / "empty"])
    (run / "cameras.json").rename(run / "other.json")
    assert "there is no cameras.json" in refused(["render", run])
    (run / "model.glb").write_bytes(b"glTF")
    assert "model.glb cannot be read" in refused(["render", run])
    (run / "model.glb").unlink()
    assert "has no model yet (model.glb)" in (said := refused(["render", run]))
    assert "without --until" in said
    reason = "No surface model was built: no depth was found; none of 4 views agrees with another."
    (run / "summary.json").write_text(json.dumps({"warnings": ["something else", reason]}))
    assert f"has cameras but no model: {reason}" in refused(["render", run])


def test_a_folder_of_photographs_is_not_written_over(run, refused):
    photographs = run / "photographs"
    photographs.mkdir()
    (photographs / "frame-0001.png").write_bytes(b"dear")
    said = refused(["render", run, "-o", photographs])
    assert "contains 'frame-0001.png', which this command did not create" in said
    assert (photographs / "frame-0001.png").read_bytes() == b"dear"
    assert "move the file that is in the place of a folder" in refused(
        ["render", run, "-o", photographs / "frame-0001.png"]
    )
