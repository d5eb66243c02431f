"""The pipeline with fake stages: resuming, determinism, second attempts, and the files of a run."""

import json
import struct
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest
import trimesh

import thesisrecon
from tests.conftest import refuses, same_pairs
from tests.pipeline import fake_stages as fakes
from tests.pipeline.fake_stages import CALLS, fake_config, interrupt_at, kept_bytes, photographs, read
from thesisrecon import load
from thesisrecon.api.reconstruct import _exif_warnings, reconstruct
from thesisrecon.api.views import render
from thesisrecon.camera import Camera
from thesisrecon.cli.runs import summary_text
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io._meshes import read_mesh
from thesisrecon.matching.pair_selection import ListedPairs, SequenceWindow
from thesisrecon.pipeline import algorithm1, matching, outputs, stages
from thesisrecon.pipeline.job import name_images
from thesisrecon.records import Image
from thesisrecon.runtime._executors import Workers
from thesisrecon.runtime._run import stream
from thesisrecon.runtime._run_folder import RunDirectory
from thesisrecon.surface import fusion
from thesisrecon.surface.fusion import VolumetricFusion
from thesisrecon.surface.model import SurfaceModel


@pytest.fixture(autouse=True)
def _forget_calls():
    CALLS.clear()


def run(out, n=4, **given):
    given.setdefault("config", fake_config())
    given.setdefault("threads", 2)
    given.setdefault("until", "metric")
    return reconstruct(photographs(n), out, **given)


def test_a_run_writes_all_documented_files(tmp_path):
    result = run(tmp_path / "out")
    out = tmp_path / "out"
    assert result.metric.trusted
    names = {p.name for p in out.iterdir()}
    stages = {"01-features", "02-matches", "03-tracks", "04-projective", "05-selfcalibration", "06-metric"}
    assert (
        stages | {"sparse", "points.ply", "cameras.json", "report.html", "summary.json", "config.toml"}
        <= names
    )
    assert {p.name for p in (out / "sparse" / "0").iterdir()} >= {"cameras.bin", "images.bin", "points3D.bin"}
    assert struct.unpack("<Q", (out / "sparse" / "0" / "images.bin").read_bytes()[:8]) == (4,)
    summary = read(out / "summary.json")
    assert summary == json.loads(json.dumps(result.summary))
    assert (summary["images"], summary["registered"], summary["points"]) == (4, 4, fakes.POINTS)
    assert summary["reprojection_rms_px"] < 0.1
    assert summary["cameras"][0]["focal_px"] == {"value": 100.0, "std": 1.0, "source": "fake"}
    assert summary["failure"] is None
    assert set(summary["seconds"]) >= {
        "images", "features", "matches", "tracks", "metric", "outputs", "total",
    }  # fmt: skip
    manifest = read(out / "02-matches" / "manifest.json")
    assert set(manifest["keys"]) == {f"{i:05d}-{j:05d}" for i in range(4) for j in range(i + 1, 4)}
    assert manifest["report"]["counts"]["accepted"] == 6


def test_summary_and_cameras_are_in_original_pixels(tmp_path):
    """Photographs at half size: (x + 0.5) / s - 0.5, focal and residuals by 1 / s."""
    images = [Image(i.name, i.rgb, (2 * fakes.WIDTH, 2 * fakes.HEIGHT)) for i in photographs(3)]
    result = reconstruct(images, tmp_path, config=fake_config(), until="metric")
    camera = result.summary["cameras"][0]
    assert camera["focal_px"]["value"] == pytest.approx(200.0)
    assert camera["focal_px"]["std"] == pytest.approx(2.0)
    assert camera["principal_x_px"]["value"] == pytest.approx(94.5)
    assert result.summary["reprojection_median_px"] == pytest.approx(
        2 * result.summary["reprojection_median_working_px"]
    )
    table = read(tmp_path / "cameras.json")["cameras"][1]
    np.testing.assert_allclose(table["K"], [[200, 0, 94.5], [0, 200, 80.5], [0, 0, 1]])
    np.testing.assert_allclose(table["centre"], [0.5, 0.02, 0.0], atol=1e-12)


def test_cameras_with_skew_are_written_where_they_can_be(tmp_path):
    """COLMAP has no camera with skew; everything else is there, and nothing of an older model stays."""
    assert (run(tmp_path).out / "sparse" / "0" / "cameras.bin").is_file()
    knowledge = IntrinsicsOptions(skew="constant", skew_std_px=5.0)
    config = fake_config(intrinsics=knowledge, selfcalibration=fakes.FakeCalibrator(skew_px=2.0))
    result = run(tmp_path, config=config, overwrite=True)
    (sentence,) = (w for w in result.summary["warnings"] if "sparse/0" in w)
    assert "COLMAP has no camera model with skew" in sentence
    assert sentence in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert not (tmp_path / "sparse").exists()
    assert (tmp_path / "points.ply").is_file()
    assert [view["K"][0][1] for view in read(tmp_path / "cameras.json")["cameras"]] == [2.0] * 4


def test_a_second_run_computes_nothing(tmp_path):
    first = run(tmp_path)
    before = kept_bytes(tmp_path)
    CALLS.clear()
    second = run(tmp_path)
    assert CALLS == []
    assert kept_bytes(tmp_path) == before
    assert second.summary["resumed"] == list(read(tmp_path / "summary.json")["resumed"])
    assert set(second.summary["resumed"]) == set(first.summary["seconds"]) - {"images", "outputs", "total"}
    assert second.summary["elapsed_seconds"] > 0.0
    assert second.summary["seconds"]["matches"] == first.summary["seconds"]["matches"]


@pytest.mark.parametrize(
    ("stage", "done"),
    [("features", 2), ("matches", 0), ("matches", 3), ("projective", 0), ("projective", 1), ("metric", 0)],
)
def test_a_run_stopped_anywhere_goes_on_and_ends_the_same(tmp_path, stage, done):
    run(tmp_path / "whole", threads=1)
    whole = list(CALLS)
    CALLS.clear()
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "cut", threads=1, progress=interrupt_at(stage, done))
    run(tmp_path / "cut", threads=1)
    assert kept_bytes(tmp_path / "cut") == kept_bytes(tmp_path / "whole")
    computed = [call for call in CALLS if not call.startswith(("prepare", "metric"))]
    assert sorted(computed) == sorted(call for call in whole if not call.startswith(("prepare", "metric")))


def test_a_run_to_its_end_leaves_a_textured_model(tmp_path):
    result = run(tmp_path / "a", until="model", threads=1)
    np.testing.assert_allclose(result.mesh.vertices[:, 2], 8.0, atol=0.02)
    assert [m.view for m in result.depth_maps] == [0, 1, 2, 3]
    model = trimesh.load(tmp_path / "a" / "model.glb", force="mesh", process=False)
    assert len(model.faces) == len(result.mesh.faces)
    assert model.visual.kind == "texture"
    seen = render(result.mesh, Camera.from_matrix(result.views[1].P, (fakes.WIDTH, fakes.HEIGHT)))
    assert seen.valid[8:-8, 8:-8].mean() > 0.9
    assert {"dense", "model"} <= set(result.summary["seconds"])
    for options in ({"threads": 3}, {"threads": 2, "executor": "processes"}):
        other = tmp_path / f"{options}"
        run(other, until="model", **options)
        assert (other / "model.glb").read_bytes() == (tmp_path / "a" / "model.glb").read_bytes()


def test_depth_maps_that_do_not_fit_in_memory_give_the_same_model(tmp_path, monkeypatch):
    run(tmp_path / "a", until="model", threads=1)
    monkeypatch.setattr(stages, "MAP_BYTES", 0)
    monkeypatch.setattr(fusion, "GROUP_BYTES", 1)
    result = run(tmp_path / "b", until="model", threads=2)
    assert (tmp_path / "a" / "model.glb").read_bytes() == (tmp_path / "b" / "model.glb").read_bytes()
    assert [m.view for m in result.depth_maps[1:]] == [1, 2, 3]
    (tmp_path / "b" / "07-dense" / "confirmed-00002.npz").unlink()
    refuses(UsageError, "confirmed-00002.npz was removed or changed", result.depth_maps.__getitem__, 2)


def test_a_model_above_the_size_limit_is_written_whole_and_reduced(tmp_path):
    result = run(tmp_path / "a", until="model", threads=1)
    whole = (tmp_path / "a" / "model.glb").read_bytes()
    directory, limit_mb = RunDirectory(tmp_path / "b"), 0.6e-6 * len(whole)
    directory.path.mkdir()
    (sentence,) = outputs._write_surface(directory, result, limit_mb, 1)
    assert "1 tile (tiles/tiles.json) hold" in sentence
    assert sentence.endswith("model-full.glb holds all")
    assert (tmp_path / "b" / "model-full.glb").read_bytes() == whole
    assert (tmp_path / "b" / "model.glb").stat().st_size <= 1e6 * limit_mb
    reduced = read_mesh(tmp_path / "b" / "model.glb")
    assert len(reduced.faces) < len(result.mesh.faces)
    np.testing.assert_allclose(reduced.vertices[:, 2], 8.0, atol=0.05)
    assert outputs._write_surface(directory, result, 50.0, 1) == []
    assert not (tmp_path / "b" / "model-full.glb").exists()
    assert not (tmp_path / "b" / "tiles").exists()
    refuses(ValueError, "max_glb_mb must be at least 5; got 1", SurfaceModel, max_glb_mb=1)


def of_all_faces():
    return fake_config(model=SurfaceModel(fusion=VolumetricFusion(tolerance=0.0)))


def test_the_tiles_hold_each_face_once_in_files_of_bounded_size(tmp_path, monkeypatch):
    result = run(tmp_path / "a", until="model", threads=1, config=of_all_faces())
    directory, mesh = RunDirectory(tmp_path / "b"), result.mesh
    whole = (tmp_path / "a" / "model.glb").stat().st_size
    monkeypatch.setattr(outputs, "TILE_FACES", len(mesh.faces) // 2)
    monkeypatch.setattr(outputs, "TILE_MB", 0.2e-6 * whole)
    count = outputs.write_tiles(directory, mesh, mesh)
    coarse, *tiles = read(tmp_path / "b" / "tiles" / "tiles.json")["tiles"]
    assert (coarse["file"], coarse["level"], coarse["faces"]) == ("../model.glb", 0, len(mesh.faces))
    assert len(tiles) == count > 4
    assert {path.name for path in (tmp_path / "b" / "tiles").iterdir()} == {
        "tiles.json", *(tile["file"] for tile in tiles),
    }  # fmt: skip
    found = []
    for tile in tiles:
        path = tmp_path / "b" / "tiles" / tile["file"]
        assert path.stat().st_size <= 0.2 * whole
        there = read_mesh(path)
        assert (tile["level"], tile["faces"]) == (1, len(there.faces))
        loaded = trimesh.load(path, force="mesh", process=False)
        np.testing.assert_array_equal(tile["box"], loaded.bounds)
        found.append(there.vertices[there.faces].reshape(-1, 9))
    wanted = mesh.vertices[mesh.faces].reshape(-1, 9).astype(np.float32)
    np.testing.assert_array_equal(*(np.unique(rows, axis=0) for rows in (np.concatenate(found), wanted)))
    assert sum(map(len, found)) == len(mesh.faces)


def test_a_run_with_fewer_images_in_the_same_folder_leaves_no_old_tiles(tmp_path, monkeypatch):
    out, largest = tmp_path / "out", SurfaceModel.max_glb_mb
    config = of_all_faces()
    object.__setattr__(config.model, "max_glb_mb", 0.03)
    monkeypatch.setattr(SurfaceModel, "max_glb_mb", 0.03)
    monkeypatch.setattr(outputs, "TILE_FACES", 500)
    result = run(out, until="model", config=config)
    tiles = {path.name for path in (out / "tiles").iterdir()}
    assert len(tiles) > 3
    assert (out / "model.glb").stat().st_size <= 30_000
    thesisrecon.save(result, tmp_path / "copy")
    assert {path.name for path in (tmp_path / "copy" / "tiles").iterdir()} == tiles
    assert "all triangles are in the tiles of" in summary_text(result.summary, out)
    object.__setattr__(config.model, "max_glb_mb", largest)
    monkeypatch.setattr(SurfaceModel, "max_glb_mb", largest)
    run(out, 3, until="model", config=config, overwrite=True)
    assert (out / "model.glb").is_file()
    assert not (out / "tiles").exists()
    assert "tiles" not in summary_text(read(out / "summary.json"), out)


def test_a_run_stopped_between_depth_maps_goes_on(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, until="model", threads=1, progress=interrupt_at("dense", 2))
    CALLS.clear()
    run(tmp_path, until="model", threads=1)
    assert [call for call in CALLS if call.startswith("depth")] == ["depth 2", "depth 3"]
    CALLS.clear()
    assert run(tmp_path).mesh is None
    assert (tmp_path / "model.glb").exists()
    assert run(tmp_path, until="model").mesh is not None
    assert not [call for call in CALLS if call.startswith("depth")]


def test_no_depths_are_a_refusal_that_keeps_the_cameras(tmp_path):
    config = fake_config(dense=fakes.FakeDense(confirmed=False))
    refuses(StageFailure, "no depth was found", run, tmp_path, until="model", config=config)
    assert (tmp_path / "cameras.json").exists()
    assert "no depth" in read(tmp_path / "summary.json")["failure"]


def test_a_run_ends_with_a_model_by_default(tmp_path):
    result = run(tmp_path, until=None)
    summary = read(tmp_path / "summary.json")
    assert summary["until"] == "model"
    assert summary["model"]["faces"] == len(result.mesh.faces)
    assert summary["model"]["held_out"]["name"] == f"{result.held_out.view:02d}.png"
    # Photographs of noise on a plane have nothing in common: only the numbers are at stake.
    assert 0.5 < result.held_out.share <= 1.0
    assert summary["model"]["held_out"]["psnr_db"] == pytest.approx(result.held_out.psnr_db)
    assert 'id="held-out"' in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert [m["known_fraction"] for m in summary["depth_maps"]] == [
        pytest.approx(np.isfinite(m.depth).mean()) for m in result.depth_maps
    ]


def test_a_damaged_result_is_computed_again(tmp_path):
    run(tmp_path)
    before = kept_bytes(tmp_path)
    CALLS.clear()
    for name in ("00001-00002", "00000-00001"):
        (tmp_path / "02-matches" / f"{name}.npz").write_bytes(b"damaged")
    (tmp_path / "01-features" / "00003.npz").unlink()
    result = run(tmp_path)
    called = sorted(c for c in CALLS if not c.startswith("prepare"))
    assert called == ["detect 03.png", "match (0, 1)", "match (1, 2)"]
    assert kept_bytes(tmp_path) == before
    reported = "02-matches/00000-00001.npz and 1 more were damaged or changed by another program"
    assert f"{reported} and were computed again" in result.warnings


def test_the_seed_matters_and_streams_are_apart(tmp_path):
    run(tmp_path / "a")
    run(tmp_path / "b", seed=1)
    a, b = kept_bytes(tmp_path / "a"), kept_bytes(tmp_path / "b")
    assert a["02-matches/00000-00001.npz"] != b["02-matches/00000-00001.npz"]
    assert a["01-features/00000.npz"] == b["01-features/00000.npz"]
    draws = {
        stream(s, name, *ids).random() for s in (0, 1) for name in ("a", "b") for ids in ((), (0, 1), (1, 0))
    }
    assert len(draws) == 12


def test_another_run_is_rejected_and_overwrite_keeps_equal_records(tmp_path):
    run(tmp_path)
    CALLS.clear()
    changed = fake_config(
        projective=fakes.FakeProjective(), selfcalibration=fakes.FakeCalibrator(identifiable=False)
    )
    with pytest.raises(UsageError, match=r"selfcalibration\.identifiable was true and is now false"):
        run(tmp_path, config=changed)
    assert CALLS == []
    result = run(tmp_path, config=changed, overwrite=True)
    assert CALLS == ["calibrate prior=False", "metric 0"]
    assert any("only rotates" in warning for warning in result.warnings)


def test_the_folder_is_judged_before_any_photograph_is_read(tmp_path, monkeypatch):
    run(tmp_path / "out")
    (tmp_path / "file").write_text("in the way")

    def read_nothing(*_, **__):
        raise AssertionError("photographs were read")

    monkeypatch.setattr("thesisrecon.io._images.read_images", read_nothing)
    refuses(UsageError, "seed was 0 and is now 1", run, tmp_path / "out", seed=1)
    refuses(UsageError, "cannot be written", run, tmp_path / "file" / "out")


def test_a_new_photograph_under_overwrite_computes_only_what_it_touches(tmp_path):
    run(tmp_path, 3)
    CALLS.clear()
    run(tmp_path, 4, overwrite=True)
    assert [c for c in CALLS if c.startswith("detect")] == ["detect 03.png"]
    assert sorted(c for c in CALLS if c.startswith("match")) == [f"match ({k}, 3)" for k in range(3)]


def test_the_page_is_called_after_the_photographs(tmp_path):
    (tmp_path / "castle").mkdir()
    for image in photographs(2):
        PIL.Image.fromarray(image.rgb).save(tmp_path / "castle" / image.name)
    for images, title in ((tmp_path / "castle", "castle"), (photographs(2), "out")):
        reconstruct(images, tmp_path / "out", config=fake_config(), until="features")
        assert f"<h1>{title}</h1>" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


MODEL = ("points.ply", "cameras.json", "sparse")


def test_an_earlier_end_leaves_the_finished_result(tmp_path):
    run(tmp_path)
    before = {name: (tmp_path / name).read_bytes() for name in ("summary.json", "report.html", "points.ply")}
    early = run(tmp_path, until="features")
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    assert early.summary["until"] == "features"
    assert any("up to metric: its summary and report are kept" in warning for warning in early.warnings)


def test_an_earlier_end_of_another_run_replaces_the_finished_result(tmp_path):
    run(tmp_path)
    run(tmp_path, until="features", seed=1, overwrite=True)
    assert read(tmp_path / "summary.json")["until"] == "features"
    assert not any((tmp_path / name).exists() for name in MODEL)


def test_a_failure_leaves_no_model_of_the_run_before(tmp_path):
    run(tmp_path)
    assert all((tmp_path / name).exists() for name in MODEL)
    with pytest.raises(StageFailure):
        run(tmp_path, config=fake_config(projective=fakes.FakeProjective(fail_below=9)), overwrite=True)
    assert not any((tmp_path / name).exists() for name in MODEL)
    summary = read(tmp_path / "summary.json")
    assert "the initial pair is bad" in summary["failure"]
    assert summary["pairs"]["accepted"] == 6
    assert "the initial pair is bad" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("images", [3, 4])
def test_a_replaced_run_is_not_read_back_with_the_new_one(tmp_path, images):
    """Records of the old one stay for reuse, with their manifests."""
    run(tmp_path, until="model")
    run(tmp_path, images, until="matches", seed=1, overwrite=True)
    loaded = load(tmp_path)
    assert [report.stage for report in loaded.reports] == ["features", "pairs", "matches"]
    assert len(loaded.images) == len(loaded.features) == images
    assert loaded.tracks is loaded.best_reconstruction is loaded.calibration is loaded.mesh is None
    failing = fake_config(projective=fakes.FakeProjective(fail_below=9))
    refuses(StageFailure, "the initial pair is bad", run, tmp_path, images, config=failing, overwrite=True)
    loaded = load(tmp_path)
    assert loaded.tracks.n_views == images
    assert loaded.best_reconstruction is loaded.calibration is None
    assert "the initial pair is bad" in loaded.failure


def test_a_replaced_run_leaves_no_result_even_if_the_new_one_is_interrupted(tmp_path):
    run(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, seed=1, overwrite=True, threads=1, progress=interrupt_at("matches", 1))
    assert not any((tmp_path / name).exists() for name in (*MODEL, "summary.json", "report.html"))


def test_until_ends_early_and_a_longer_run_goes_on(tmp_path):
    assert run(tmp_path, until="features").pairs == ()
    assert run(tmp_path, until="matches").tracks is None
    projective = run(tmp_path, until="projective")
    assert projective.projective is not None
    assert projective.calibration is None
    assert (tmp_path / "report.html").exists()
    CALLS.clear()
    assert run(tmp_path).metric is not None
    assert CALLS == ["calibrate prior=False", "metric 0"]


def test_a_distrusted_result_is_tried_from_other_pairs(tmp_path):
    result = run(tmp_path, config=fake_config(metric=fakes.FakeMetric(trusted_from=1)))
    assert [c for c in CALLS if c.startswith("projective")] == ["projective 0", "projective 1"]
    assert result.metric.trusted
    assert any("2 initial pairs" in warning for warning in result.warnings)


def test_an_untrusted_result_is_written_with_its_warning(tmp_path):
    result = run(tmp_path, config=fake_config(metric=fakes.FakeMetric(trusted_from=9)))
    assert sum(c.startswith("projective") for c in CALLS) == 3
    assert any("cannot be trusted: odd focal" in warning for warning in result.warnings)
    assert read(tmp_path / "summary.json")["trusted"] is False
    assert (tmp_path / "sparse" / "0" / "images.bin").exists()
    assert "odd focal" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_every_failed_check_is_reported_once(tmp_path):
    doubted = fake_config(
        metric=fakes.FakeMetric(trusted_from=9, failed_checks=("odd focal", "the camera only rotates")),
        selfcalibration=fakes.FakeCalibrator(identifiable=False),
    )
    warnings = run(tmp_path, config=doubted).warnings
    assert sum(warning.count("only rotates") for warning in warnings) == 1
    assert sum(warning.count("odd focal") for warning in warnings) == 1


def test_a_failed_attempt_is_followed_by_another(tmp_path):
    result = run(tmp_path, config=fake_config(projective=fakes.FakeProjective(fail_below=2)))
    assert [c for c in CALLS if c.startswith("projective")] == [f"projective {k}" for k in range(3)]
    assert result.metric.trusted
    assert result.warnings == ("3 initial pairs were tried; the best result is used",)


@pytest.mark.parametrize(("first", "chosen"), [(0, 0), (1, 1)])
def test_stages_report_the_chosen_attempt(tmp_path, first, chosen):
    config = fake_config(
        projective=fakes.FakeProjective(fail_below=first), metric=fakes.FakeMetric(trusted_from=9)
    )
    for result in (run(tmp_path, config=config), run(tmp_path, config=config)):
        (report,) = [report for report in result.reports if report.stage == "projective"]
        assert report.metrics["sigma_px"] == 1.0 + chosen


@pytest.mark.parametrize("failed", [0, 1, 2])
def test_a_large_set_is_divided_once_whichever_attempt_is_the_first_to_be_calibrated(
    tmp_path, monkeypatch, failed
):
    divided = []
    monkeypatch.setattr(algorithm1, "cameras_from_parts", lambda *_: (divided.append(len(CALLS)), []))
    untrusted = fakes.FakeMetric(trusted_from=9)
    run(tmp_path, config=fake_config(projective=fakes.FakeProjective(fail_below=failed), metric=untrusted))
    assert len(divided) == 1


def test_a_pair_that_fails_is_a_refused_pair(tmp_path):
    result = run(tmp_path, config=fake_config(matching=fakes.FakeMatcher(fail_pair=(0, 2))))
    refused = [pair for pair in result.pairs if not pair.accepted]
    assert [(pair.i, pair.j) for pair in refused] == [(0, 2)]
    assert refused[0].reason.startswith("only 3 matches")


def test_no_accepted_pair_is_a_failure_with_the_best_pair_named(tmp_path):
    with pytest.raises(StageFailure, match=r"best of 6 pairs has 30 verified matches: too few verified"):
        run(tmp_path, config=fake_config(verification=fakes.FakeVerifier(accept=False)))


def test_a_focal_prior_reaches_the_stages_only_on_demand(tmp_path):
    knowledge = IntrinsicsOptions(focal_px=100.0, focal_std_rel=0.1)
    run(tmp_path, config=fake_config(intrinsics=knowledge))
    assert "calibrate prior=True" in CALLS


@pytest.mark.parametrize(
    ("knowledge", "focal_px", "words"),
    [
        (IntrinsicsOptions(exif=True, focal_std_rel=0.1), [800.0, np.nan], "1 of the 2 images"),
        (IntrinsicsOptions(exif=True, focal_std_rel=0.1), [800.0, 900.0], None),
        (IntrinsicsOptions(exif=True, focal_px=9.0, focal_std_rel=0.1), [np.nan, np.nan], None),
        (IntrinsicsOptions(), [np.nan, np.nan], None),
    ],
)
def test_only_an_ignored_option_gives_a_warning(knowledge, focal_px, words):
    warnings = _exif_warnings(knowledge, np.array(focal_px))
    assert [words in warning for warning in warnings] == ([True] if words else [])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"until": "surface"}, "unknown stage"), ({"until": "metrik"}, "did you mean metric"),
        ({"threads": -1}, "at least 1"), ({"executor": "dask://there"}, "dask://HOST:PORT"),
        ({"executor": "proceses"}, "did you mean processes"), ({"seed": -1}, "at least 0"),
    ],
)  # fmt: skip
def test_wrong_options_are_rejected_before_any_output(tmp_path, options, words):
    refuses(UsageError, words, run, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_an_unknown_option_is_a_wrong_call(tmp_path):
    refuses(TypeError, "did you mean threads", run, tmp_path / "out", thread=3)


def test_the_first_error_of_a_worker_ends_the_rest():
    def fail(n):
        if n == 3:
            raise StageFailure("three")
        return n

    heard = []
    with pytest.raises(StageFailure, match="three"):
        Workers(2).run(fail, [(n,) for n in range(1000)], lambda n, _: heard.append(n))
    assert len(heard) < 1000


def test_the_chosen_pairs_are_matched_and_the_choice_is_kept(tmp_path):
    config = fake_config(pairs=SequenceWindow(1))
    result = run(tmp_path, config=config, until="matches")
    assert [(pair.i, pair.j) for pair in result.pairs] == [(0, 1), (1, 2), (2, 3)]
    assert result.pair_choice is not None
    assert read(tmp_path / "summary.json")["pairs"]["possible"] == 6
    CALLS.clear()
    more = run(tmp_path, config=fake_config(), until="matches", overwrite=True)
    matched = ["match (0, 2)", "match (0, 3)", "match (1, 3)"]
    assert sorted(c for c in CALLS if c.startswith("match")) == matched
    assert "pairs" not in more.summary["resumed"]


def test_the_final_pairs_are_read_back(tmp_path, monkeypatch):
    """One is matched again from oblique views, and one is rejected because of the others."""

    def oblique(_config, _image, features):
        return replace(features, xy=features.xy + 1.0)

    def reject(pairs, _):
        return [*pairs[:-1], replace(pairs[-1], accepted=False, reason="repeated structure")]

    with monkeypatch.context() as patch:
        patch.setattr(matching, "pairs_to_connect", lambda *_: [1])
        patch.setattr(matching, "prepare_oblique", oblique)
        patch.setattr(matching, "reject_repeated_structure", reject)
        result = run(tmp_path, until="matches", threads=1)
    np.testing.assert_allclose(result.pairs[1].xy2, result.features[2].xy + 1.0)
    assert [pair.accepted for pair in result.pairs] == [True] * 5 + [False]
    assert same_pairs(load(tmp_path), result)
    assert same_pairs(run(tmp_path, until="matches"), load(tmp_path))
    assert all(pair.accepted for pair in load(tmp_path).pairs)


def test_oblique_views_are_tried_while_they_help(tmp_path, monkeypatch):
    """Thousands of images that do not overlap would each be tried with several others."""
    tried = []

    def matched(job, views, pairs, kind, original=matching._matched):
        tried.append((kind, len(pairs)))
        pairs = original(job, views, pairs, kind)
        helps = kind and len(tried) < 4
        return [replace(pair, accepted=bool(helps)) for pair in pairs]

    monkeypatch.setattr(matching, "pairs_to_connect", lambda *_: list(range(6)))
    monkeypatch.setattr(matching, "prepare_oblique", lambda _config, _image, features: features)
    monkeypatch.setattr(matching, "OBLIQUE_PAIRS", 1)
    monkeypatch.setattr(matching, "_matched", matched)
    run(tmp_path, until="matches", threads=1)
    assert tried == [("", 6), ("-oblique", 1), ("-oblique", 1), ("-oblique", 1)]


def test_a_list_that_names_no_photograph_is_refused_before_anything_is_computed(tmp_path):
    with pytest.raises(UsageError, match=r"'9\.png', which is not among the 4 images"):
        run(tmp_path, config=fake_config(pairs=ListedPairs((("00.png", "9.png"),))))
    assert CALLS == []


def test_sentences_name_images_by_file():
    names = ["a.jpg", "b #0.jpg"]
    assert name_images("Images #0 and #1: few inliers (image #0).", names) == (
        "Images a.jpg and b #0.jpg: few inliers (image a.jpg)."
    )
    for kept in ("b #0.jpg is left out", "no image #7", "x#0", "#0b"):
        assert name_images(kept, names) == kept
