"""The ten tasks of docs/recipes/tasks.md are short and run as they stand, three on fewer images."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

import thesisrecon
from thesisrecon.io._images import demo_images

PAGE = Path(__file__).parents[2] / "docs" / "recipes" / "tasks.md"
BLOCKS = dict(re.findall(r"^## (.+?)\n.*?```python\n(.*?)```", PAGE.read_text("utf-8"), re.M | re.S))
FOCAL_PX = 908.6
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with images, a finished run, and a COLMAP model and database of the same images."""
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "images").mkdir()
    for path in demo_images():
        shutil.copy(path, folder / "images")
    return folder


def run(title, place, monkeypatch, size=""):
    """The names of a block after it ran, with another ``size`` where it has one."""
    monkeypatch.chdir(place)
    names = {"__name__": "task"}
    code, changed = re.subn(r"max_size=\d+", size, BLOCKS[title]) if size else (BLOCKS[title], True)
    assert changed
    exec(compile(code, f"{PAGE.name}: {title}", "exec"), names)
    return names


@pytest.fixture(scope="module")
def finished(place):
    """What other blocks read from "out" and "sparse/0"."""
    with pytest.MonkeyPatch.context() as patch:
        names = run("Images to cameras, and a projected point", place, patch)
    shutil.copytree(place / "out" / "sparse", place / "sparse", dirs_exist_ok=True)
    return names


def test_images_give_cameras_and_a_projected_point(finished):
    assert abs(finished["camera"].K[0, 0] - FOCAL_PX) < 3 * finished["camera"].std["focal_px"]
    assert np.median(np.linalg.norm(finished["distance"], axis=1)) < 0.2


@pytest.mark.references
def test_own_matches_give_the_focal_length(place, monkeypatch):
    camera = run("Own matches to a metric model", place, monkeypatch)["result"].cameras[0]
    assert camera.K[0, 0] == pytest.approx(FOCAL_PX, rel=2e-3)
    assert abs(camera.K[0, 0] - FOCAL_PX) < 2 * camera.std["focal_px"]


@pytest.mark.references
@pytest.mark.usefixtures("finished")
def test_colmap_s_database_and_model_are_calibrated_again(place, monkeypatch, capsys):
    import pycolmap

    database, mode = place / "database.db", pycolmap.CameraMode.SINGLE
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.sift.max_num_features = 640, 2000
    pycolmap.extract_features(database, place / "images", camera_mode=mode, extraction_options=options)
    pycolmap.match_exhaustive(database)
    run("New calibrations for COLMAP", place, monkeypatch)
    found = {
        line.split()[0]: float(line.split()[1])
        for line in capsys.readouterr().out.splitlines()
        if "+-" in line
    }
    assert found == pytest.approx({"database.db": FOCAL_PX, "sparse/0": FOCAL_PX}, rel=2e-3)


def test_an_own_matcher_runs_in_the_pipeline(place, monkeypatch, tmp_path):
    (tmp_path / "images").mkdir()
    for path in sorted((place / "images").iterdir())[:4]:
        shutil.copy(path, tmp_path / "images")
    result = run("Own matcher in the pipeline", tmp_path, monkeypatch)["result"]
    assert len(result.cameras) == 4
    assert result.cameras[0].K[0, 0] == pytest.approx(FOCAL_PX, rel=1e-2)


def test_every_method_gives_f_and_lines_are_drawn(place, monkeypatch, capsys):
    names = run("F by every method, with covariance and drawn lines", place, monkeypatch)
    assert capsys.readouterr().out.count("(9, 9)") == 4
    assert [image.dtype for image in names["drawn"]] == [np.uint8, np.uint8]


@pytest.mark.usefixtures("finished")
def test_chapters_3_and_7_agree_with_the_cameras(place, monkeypatch):
    names = run("Chapters 3 and 7 from camera matrices", place, monkeypatch)
    K = names["cameras"][0].K
    assert names["quadric"].K[0][0, 0] == pytest.approx(K[0, 0], rel=0.05)
    assert np.allclose(np.abs(names["plane"]), [0, 0, 0, 1], atol=1e-6)
    assert names["K"][0, 0] == pytest.approx(K[0, 0], rel=0.05)
    assert names["tensor"].T.shape == (3, 3, 3)
    assert names["in_front"].mean() > 0.99


@pytest.mark.usefixtures("finished")
def test_bundle_adjustment_gives_covariances(place, monkeypatch):
    names = run("Bundle adjustment with covariance", place, monkeypatch)
    assert names["adjusted"].cameras[0].K[0, 0] == pytest.approx(FOCAL_PX, rel=2e-3)
    assert np.isfinite(names["adjusted"].point_covariance).all()


@pytest.mark.usefixtures("finished")
def test_known_cameras_give_a_model_and_two_exports(place, monkeypatch):
    names = run("Depth to GLB from known cameras, and two exports", place, monkeypatch, "max_size=200")
    assert len(names["mesh"].faces) > 2000
    assert (place / "model.glb").stat().st_size > 50_000
    written = {path.relative_to(place / "exported").parts[0] for path in (place / "exported").rglob("*.*")}
    assert written == {"colmap-undistorted", "nerfstudio"}


def test_an_own_variant_is_compared_by_a_script(place):
    script = place / "ablation_of_mine.py"
    script.write_text(BLOCKS["An ablation with an own variant"], encoding="utf-8")
    command = [sys.executable, script.name]
    paths = {"PYTHONPATH": str(PAGE.parent.parent)}
    said = subprocess.run(
        command, cwd=place, env=os.environ | paths, capture_output=True, text=True, check=True
    ).stdout
    assert "| threshold_px = 0.5" in said or "0.5" in said
    assert re.search(r"\], p \S+, 6 draws", said)


@pytest.mark.usefixtures("finished")
def test_a_run_and_its_sparse_model_are_the_same(place, monkeypatch):
    comparison = run("Comparison of two models", place, monkeypatch)["comparison"]
    assert len(comparison.names) == 6
    assert comparison.centre_error.max() < 1e-6


def blocks_of(page):
    return re.findall(r"```python\n(.*?)```", (PAGE.parent / page).read_text("utf-8"), re.S)


@pytest.mark.usefixtures("finished")
def test_the_blocks_of_the_page_of_comparisons_run(place, monkeypatch):
    monkeypatch.chdir(place)
    names = {}
    exec(compile(blocks_of("compare.md")[0], "compare.md", "exec"), names)
    assert names["comparison"].points is not None


def test_the_blocks_of_the_page_of_exports_run(place, monkeypatch, finished):
    monkeypatch.chdir(place)
    first, second, third = blocks_of("export.md")
    names = {}
    exec(compile(first, "export.md", "exec"), names)
    assert names["report"].file.is_file()
    exec(compile(second, "export.md", "exec"), names)
    assert np.abs(names["undistorted"] - names["xy"]).max() < 20.0
    # The page has positions of its own: here those of the cameras, in other units.
    cameras = finished["result"].cameras
    names["measured"] = {name: 3.0 * cameras[name].centre + 1.0 for name in cameras}
    exec(compile(re.sub(r"positions = \{.*?\}", "positions = measured", third), "export.md", "exec"), names)
    assert (place / "metres" / "sparse" / "0").is_dir()
    written = thesisrecon.read_cameras(place / "metres" / "sparse" / "0")
    assert np.linalg.norm(written["0001.jpg"].centre - written["0002.jpg"].centre) == pytest.approx(1.5)


ANSWERS = (PAGE.parent / "you-asked.md").read_text("utf-8").split("\n## ")[1:]
ASKED = {part.split("\n")[0]: re.findall(r"```python\n(.*?)```", part, re.S) for part in ANSWERS}
ASKED = {question: code for question, code in ASKED.items() if code}


@pytest.fixture(scope="module")
def asked(place, request):
    """The folder with what the answers read: five images in a run, one more, and the ends of a ruler."""
    request.getfixturevalue("finished")
    home = place / "asked"
    shutil.copytree(place / "images", home / "images")
    (home / "more").mkdir()
    (home / "images" / "0005.jpg").rename(home / "more" / "0005.jpg")
    shutil.copy(home / "more" / "0005.jpg", home / "query.jpg")
    shutil.copy(PAGE.parents[2] / "fixtures" / "courtyard" / "cameras.json", home)
    thesisrecon.reconstruct(home / "images", home / "out", until="metric", max_size=400)
    shutil.copytree(place / "sparse", home / "sparse")
    for k, image in enumerate(sorted((home / "images").iterdir())):
        folder = home / "cameras" / ("left", "right")[k % 2]
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(image, folder)
        (home / "masks").mkdir(exist_ok=True)
        mask = np.where(np.arange(768) < 600, 255, 0).astype(np.uint8)
        PIL.Image.fromarray(np.tile(mask[:, None], 1024)).save(home / "masks" / f"{image.stem}.png")
    return home


@pytest.mark.parametrize("question", ASKED)
def test_the_answers_on_the_page_run_and_are_short(question, asked, tmp_path, monkeypatch):
    home = tmp_path / "here"
    shutil.copytree(asked, home)
    monkeypatch.chdir(home)
    (code,) = ASKED[question]
    assert len(code.splitlines()) <= 10
    cameras = thesisrecon.load("out").cameras
    ends = thesisrecon.load("out").points[[0, 50]]
    names = {"__name__": "answer"}
    for image, letters in (("0001.jpg", "xy"), ("0003.jpg", "uv")):
        for k, pixel in enumerate(cameras[image].project(ends), start=1):
            names |= {f"{letter}{k}": value for letter, value in zip(letters, pixel.tolist(), strict=True)}
    exec(compile(code, f"you-asked.md: {question}", "exec"), names)
    if "more" in question:
        assert "0005.jpg" in names["result"].cameras
    if "camera" in names and "Where" in question:
        assert max(names["camera"].std[f"centre_{axis}"] for axis in "xyz") < 0.05
    if "result" in names:
        assert names["result"].metric.trusted
    if "model" in names:
        assert np.linalg.norm(np.diff(names["model"].X[[0, 50]], axis=0)) == pytest.approx(0.3, rel=0.01)
