"""Images added to a run, localised in it, and cameras that are known before."""

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import refuses
from thesisrecon import (
    Camera,
    StageFailure,
    UsageError,
    add_images,
    compare_models,
    export,
    load,
    localize,
    read_cameras,
    reconstruct,
    reconstruct_with_cameras,
)
from thesisrecon.cli.commands import run_command
from thesisrecon.pipeline import stages

HOME = Path(__file__).parents[2] / "fixtures" / "courtyard"
FILES = sorted((HOME / "images").glob("*.jpg"))[:8]
SMALL = {"max_size": 480, "until": "metric", "threads": 1}


@pytest.fixture(scope="module")
def truth():
    return read_cameras(HOME / "cameras.json")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "out"
    reconstruct(FILES[:6], out, **SMALL)
    return out


@pytest.fixture
def run(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "out")
    return tmp_path / "out"


def content(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def poses(cameras):
    return {name: np.column_stack([camera.R, camera.t]) for name, camera in cameras.items()}


def same_poses(a, b):
    return all(np.allclose(a[name], b[name], atol=1e-9) for name in a)


def test_an_image_is_localised_and_the_run_stays_as_it_is(finished, truth):
    before = content(finished)
    camera = localize(finished, FILES[6], threads=1)
    assert content(finished) == before
    cameras = dict(load(finished).cameras) | {"0006.jpg": camera}
    found = compare_models(cameras, truth)
    place = found.names.index("0006.jpg")
    move, off = found.similarity, found.centre_error[place]
    std = [move.scale * camera.std[f"centre_{axis}"] for axis in "xyz"]
    assert off < 4.0 * np.linalg.norm(std)
    assert np.linalg.norm(std) < 0.02
    assert np.allclose(camera.K, cameras["0000.jpg"].K)


def test_added_images_are_in_the_frame_of_the_run_and_its_cameras_do_not_move(run, truth):
    old = load(run)
    found = old.add(FILES[5:8], threads=1)
    assert list(found.cameras) == [path.name for path in FILES]
    assert found.metric.trusted
    assert same_poses(poses(old.cameras), poses(found.cameras))
    assert compare_models(found, truth).centre_error.max() < 0.02
    again = load(run)
    assert same_poses(poses(found.cameras), poses(again.cameras))
    assert again.cameras["0000.jpg"].std == pytest.approx(old.cameras["0000.jpg"].std)
    assert "Lengths have no absolute scale" in (run / "report.html").read_text("utf-8")
    # A second time nothing is new, and the files of the images are known.
    assert same_poses(poses(found.cameras), poses(add_images(run, FILES[7:8], threads=1).cameras))


def test_depth_maps_of_cameras_that_do_not_move_are_kept(tmp_path):
    options = {**SMALL, "max_size": 320, "until": "dense"}
    old = reconstruct(FILES[:6], tmp_path / "out", **options)
    before = content(tmp_path / "out" / "07-dense")
    found = old.add(FILES[6:7], threads=1)
    after = content(tmp_path / "out" / "07-dense")
    records = [path for path in before if path.suffix == ".npz"]
    assert len(records) == 12
    assert all(after[path] == before[path] for path in records)
    assert [m.view for m in found.depth_maps] == list(range(7))
    assert np.isfinite(found.depth_maps[6].depth).mean() > 0.3
    # Cameras that moved have other depths.
    load(tmp_path / "out").add(FILES[7:8], refine=True, threads=1)
    assert all(content(tmp_path / "out" / "07-dense")[path] != before[path] for path in records)


def test_all_cameras_may_be_refined_in_the_old_frame(run, truth):
    old = load(run)
    found = add_images(run, FILES[6:8], refine=True, threads=1)
    assert len(found.cameras) == 8
    assert not same_poses(poses(old.cameras), poses(found.cameras))
    for name, camera in old.cameras.items():
        std = [camera.std[f"centre_{axis}"] for axis in "xyz"]
        assert np.all(np.abs(found.cameras[name].centre - camera.centre) < 2.0 * np.array(std))
    assert compare_models(found, truth).centre_error.max() < 0.02


def test_an_addition_that_was_interrupted_loses_nothing_and_goes_on(run, monkeypatch):
    old = load(run)

    def stop(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stages, "metric_from_given", stop)
        with pytest.raises(KeyboardInterrupt):
            add_images(run, FILES[6:7], threads=1)
    assert same_poses(poses(old.cameras), poses(read_cameras(run)))
    found = add_images(run, FILES[6:7], threads=1)
    assert len(found.cameras) == 7
    assert same_poses(poses(old.cameras), poses(found.cameras))


def test_images_of_another_folder_are_found_again_for_an_export(run, tmp_path):
    (tmp_path / "new").mkdir()
    shutil.copy(FILES[6], tmp_path / "new" / "walk.jpg")
    assert run_command(["reconstruct", str(tmp_path / "new"), "--into", str(run), "--threads", "1"]) == 0
    assert run_command(["export", str(run), "-o", str(tmp_path / "e"), "--to", "nerfstudio"]) == 0
    assert len(list((tmp_path / "e" / "images").iterdir())) == 7
    assert export(load(run), tmp_path / "again", to="nerfstudio").notes == ()


def test_wrong_additions_are_refused(run, tmp_path):
    (tmp_path / "new").mkdir()
    shutil.copy(FILES[6], tmp_path / "new" / "0000.jpg")
    refuses(UsageError, "0000.jpg is the name of another image", add_images, run, tmp_path / "new")
    noise = np.random.default_rng(0).integers(0, 256, (360, 480, 3), dtype=np.uint8)
    refuses(StageFailure, "cannot be localised", localize, run, noise, threads=1)


@pytest.mark.parametrize(
    "words", [["-o", "a", "--into", "b"], [], ["--into", "b", "--seed", "3"], ["-o", "a", "--refine"]]
)
def test_contradicting_options_are_refused(words, capsys):
    assert run_command(["reconstruct", str(HOME / "images"), *words]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_known_cameras_keep_their_frame_and_another_image_is_registered(tmp_path, truth):
    known = {name: truth[name] for name in [path.name for path in FILES[:5]]}
    found = reconstruct_with_cameras(FILES[:6], known, tmp_path / "out", **SMALL)
    assert found.metric.trusted
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "Lengths and axes are those of the cameras that were given." in page
    assert same_poses(poses(known), poses(found.cameras))
    new = found.cameras["0005.jpg"]
    std = np.array([new.std[f"centre_{axis}"] for axis in "xyz"])
    assert np.all(np.abs(new.centre - truth["0005.jpg"].centre) < 4.0 * std)
    assert np.linalg.norm(std) < 0.02
    assert len(found.points) > 1000


def test_inexact_cameras_are_not_trusted_until_they_are_refined(tmp_path, truth):
    rng, known = np.random.default_rng(1), {}
    for name in [path.name for path in FILES[:5]]:
        one = truth[name]
        known[name] = Camera(one.K, one.R, one.t + rng.normal(0.0, 0.01, 3), one.size, one.distortion)
    rough = reconstruct_with_cameras(FILES[:5], known, tmp_path / "a", **SMALL)
    assert not rough.metric.trusted
    assert any("inexact" in text for text in rough.metric.failed_checks)
    exact = reconstruct_with_cameras(FILES[:5], known, tmp_path / "b", refine=True, **SMALL)
    assert exact.metric.trusted, exact.metric.failed_checks
    assert compare_models(exact, truth).centre_error.max() < 0.01
    off = [np.linalg.norm(exact.cameras[name].centre - truth[name].centre) for name in known]
    assert max(off) < 0.03


def test_cameras_of_another_convention_are_named(tmp_path, truth):
    wrong = {n: Camera(c.K, c.R.T, -c.R.T @ c.t, c.size) for n, c in list(truth.items())[:5]}
    arguments = (FILES[:5], wrong, tmp_path / "out")
    refuses(StageFailure, "convention", reconstruct_with_cameras, *arguments, **SMALL)
    named = {f"x{name}": camera for name, camera in truth.items()}
    arguments = (FILES[:5], named, tmp_path / "other")
    refuses(UsageError, "no image has a known camera", reconstruct_with_cameras, *arguments, **SMALL)
