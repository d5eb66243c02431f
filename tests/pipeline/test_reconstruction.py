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
from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.api.views import render
from thesisrecon.camera import Camera
from thesisrecon.cli.commands import summary_text
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io._meshes import read_mesh
from thesisrecon.matching.pair_selection import SequenceWindow
from thesisrecon.pipeline import algorithm1, matching, stages
from thesisrecon.pipeline import run as pipeline_run
from thesisrecon.pipeline.run import name_images, stream
from thesisrecon.records import Image
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
    knowledge = IntrinsicsOptions(skew="constant", skew_std_px=5.0, focal_px=100.0, focal_std_rel=0.1)
    config = fake_config(intrinsics=knowledge, selfcalibration=fakes.FakeCalibrator(skew_px=2.0))
    result = run(tmp_path, config=config, overwrite=True)
    assert [c for c in CALLS if c.startswith("calibrate")] == [
        "calibrate prior=False",
        "calibrate prior=True",
    ]
    (sentence,) = (w for w in result.summary["warnings"] if "sparse/0" in w)
    assert "COLMAP has no camera model with skew" in sentence
    assert sentence in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert not (tmp_path / "sparse").exists()
    assert (tmp_path / "points.ply").is_file()
    assert [view["K"][0][1] for view in read(tmp_path / "cameras.json")["cameras"]] == [2.0] * 4


def test_a_run_of_other_library_versions_is_not_resumed_in_silence(tmp_path, monkeypatch):
    run(tmp_path / "out", shared=tmp_path / "shared")
    other = algorithm1.library_versions() | {"numpy": "1.0"}
    for module in (algorithm1, pipeline_run):
        monkeypatch.setattr(module, "library_versions", lambda: other)
    words = rf'holds another run \(versions.numpy was "{np.__version__}" and is now "1.0"\); choose another'
    refuses(UsageError, words, run, tmp_path / "out")
    for given in ({"out": tmp_path / "out", "overwrite": True}, {"out": tmp_path / "b"}):
        CALLS.clear()
        run(shared=tmp_path / "shared", **given)
        assert ("detect 00.png" in CALLS) == ("overwrite" in given), "results of the same versions are shared"


def test_a_second_run_computes_only_what_is_damaged_or_new(tmp_path):
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
    for name in ("00001-00002", "00000-00001"):
        (tmp_path / "02-matches" / f"{name}.npz").write_bytes(b"damaged")
    (tmp_path / "01-features" / "00003.npz").unlink()
    third = run(tmp_path)
    called = sorted(c for c in CALLS if not c.startswith("prepare"))
    assert called == ["detect 03.png", "match (0, 1)", "match (1, 2)"]
    assert kept_bytes(tmp_path) == before
    reported = "02-matches/00000-00001.npz and 1 more were damaged or changed by another program"
    assert f"{reported} and were computed again" in third.warnings
    CALLS.clear()
    run(tmp_path, 5, overwrite=True)
    assert [c for c in CALLS if c.startswith("detect")] == ["detect 04.png"]
    assert sorted(c for c in CALLS if c.startswith("match")) == [f"match ({k}, 4)" for k in range(4)]


STOPS = [
    ("features", 2), ("matches", 0), ("matches", 3), ("projective", 0), ("projective", 1), ("metric", 0),
    ("dense", 2),
]  # fmt: skip


@pytest.mark.parametrize(("stage", "done"), STOPS)
def test_a_run_stopped_anywhere_goes_on_and_ends_the_same(tmp_path, stage, done):
    def computed():
        return sorted(call for call in CALLS if not call.startswith(("prepare", "metric")))

    run(tmp_path / "whole", threads=1, until="model")
    whole = computed()
    CALLS.clear()
    cut = {"out": tmp_path / "cut", "threads": 1, "until": "model"}
    refuses(KeyboardInterrupt, None, run, progress=interrupt_at(stage, done), **cut)
    run(**cut)
    assert kept_bytes(tmp_path / "cut") == kept_bytes(tmp_path / "whole")
    assert computed() == whole


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


@pytest.fixture
def small_limit(monkeypatch):
    """The configuration of a model of all faces, which is larger than its limit."""
    config = fake_config(model=SurfaceModel(fusion=VolumetricFusion(tolerance=0.0)))
    object.__setattr__(config.model, "max_glb_mb", 0.03)
    monkeypatch.setattr(SurfaceModel, "max_glb_mb", 0.03)
    return config


def test_a_model_above_the_size_limit_is_reduced_and_whole_beside_it(tmp_path, small_limit):
    result = run(tmp_path, until="model", threads=1, config=small_limit)
    mesh = result.mesh
    assert sum(text.endswith("model-full.glb holds all") for text in result.warnings) == 1
    assert (tmp_path / "model.glb").stat().st_size <= 30_000
    reduced = read_mesh(tmp_path / "model.glb")
    assert len(reduced.faces) < len(mesh.faces) == len(read_mesh(tmp_path / "model-full.glb").faces)
    np.testing.assert_allclose(reduced.vertices[:, 2], 8.0, atol=0.05)
    refuses(ValueError, "max_glb_mb must be at least 5; got 1", SurfaceModel, max_glb_mb=1)


def test_a_smaller_run_in_the_same_folder_leaves_no_whole_model(tmp_path, small_limit, monkeypatch):
    out = tmp_path / "out"
    result = run(out, until="model", config=small_limit)
    thesisrecon.save(result, tmp_path / "copy")
    assert (tmp_path / "copy" / "model-full.glb").is_file()
    assert "all triangles are in" in summary_text(result.summary, out)
    object.__setattr__(small_limit.model, "max_glb_mb", 50.0)
    monkeypatch.setattr(SurfaceModel, "max_glb_mb", 50.0)
    run(out, 3, until="model", config=small_limit, overwrite=True)
    assert (out / "model.glb").is_file()
    assert not (out / "model-full.glb").exists()
    assert "all triangles" not in summary_text(read(out / "summary.json"), out)


def test_no_depths_are_one_sentence_and_the_cameras_stay(tmp_path):
    config = fake_config(dense=fakes.FakeDense(unknown=(0, 1, 2, 3)))
    refuses(StageFailure, "no depth was found", run, tmp_path / "model", until="model", config=config)
    assert "no depth" in read(tmp_path / "model" / "summary.json")["failure"]
    result = run(tmp_path / "any", until=None, config=config)
    (sentence,) = (w for w in result.warnings if "No surface model was built" in w)
    assert "no depth was found" in sentence
    assert result.mesh is None
    for out in (tmp_path / "model", tmp_path / "any"):
        assert read(out / "summary.json")["registered"] == 4
        assert (out / "report.html").exists()
        assert not (out / "model.glb").exists()
    some = run(tmp_path / "some", until=None, config=fake_config(dense=fakes.FakeDense(unknown=(3,))))
    assert len(some.mesh.faces) > 50
    assert [w for w in some.warnings if "no depth values" in w] == ["Image 03.png has no depth values"]


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
    assert early.mesh is None
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    assert early.summary["until"] == "features"
    assert any("up to metric: its summary and report are kept" in warning for warning in early.warnings)


@pytest.mark.parametrize("images", [3, 4])
def test_nothing_of_a_replaced_run_is_left_or_read_back(tmp_path, images):
    """Records of the old one stay for reuse, with their manifests."""
    run(tmp_path, until="model")
    assert all((tmp_path / name).exists() for name in MODEL)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, seed=1, overwrite=True, threads=1, progress=interrupt_at("matches", 1))
    assert not any((tmp_path / name).exists() for name in (*MODEL, "summary.json", "report.html"))
    run(tmp_path, until="model", overwrite=True)
    run(tmp_path, images, until="matches", seed=1, overwrite=True)
    assert not any((tmp_path / name).exists() for name in MODEL)
    loaded = load(tmp_path)
    assert [report.stage for report in loaded.reports] == ["features", "pairs", "matches"]
    assert len(loaded.images) == len(loaded.features) == images
    assert loaded.tracks is loaded.best_reconstruction is loaded.calibration is loaded.mesh is None
    failing = fake_config(projective=fakes.FakeProjective(fail_below=9))
    refuses(StageFailure, "the initial pair is bad", run, tmp_path, images, config=failing, overwrite=True)
    assert "the initial pair is bad" in (tmp_path / "report.html").read_text(encoding="utf-8")
    loaded = load(tmp_path)
    assert loaded.tracks.n_views == images
    assert loaded.best_reconstruction is loaded.calibration is None
    assert "the initial pair is bad" in loaded.failure


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


@pytest.mark.parametrize(
    ("changes", "tries"),
    [
        ({"metric": fakes.FakeMetric(trusted_from=1)}, 2),
        ({"projective": fakes.FakeProjective(fail_below=2)}, 3),
    ],
)
def test_a_distrusted_or_failed_attempt_is_followed_by_another(tmp_path, changes, tries):
    result = run(tmp_path, config=fake_config(**changes))
    assert [c for c in CALLS if c.startswith("projective")] == [f"projective {k}" for k in range(tries)]
    assert result.metric.trusted
    assert result.warnings == (f"{tries} initial pairs were tried; the best result is used",)


def test_an_untrusted_result_is_written_with_each_failed_check_once(tmp_path):
    doubted = fake_config(
        metric=fakes.FakeMetric(trusted_from=9, failed_checks=("odd focal", "the camera only rotates")),
        selfcalibration=fakes.FakeCalibrator(identifiable=False),
    )
    warnings = run(tmp_path, config=doubted).warnings
    assert sum(c.startswith("projective") for c in CALLS) == 3
    assert any("cannot be trusted: odd focal" in warning for warning in warnings)
    for words in ("only rotates", "odd focal"):
        assert sum(warning.count(words) for warning in warnings) == 1
    assert read(tmp_path / "summary.json")["trusted"] is False
    assert (tmp_path / "sparse" / "0" / "images.bin").exists()
    assert "odd focal" in (tmp_path / "report.html").read_text(encoding="utf-8")


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


def test_a_pair_that_fails_is_refused_and_without_an_accepted_pair_the_best_is_named(tmp_path):
    result = run(tmp_path / "a", config=fake_config(matching=fakes.FakeMatcher(fail_pair=(0, 2))))
    refused = [pair for pair in result.pairs if not pair.accepted]
    assert [(pair.i, pair.j) for pair in refused] == [(0, 2)]
    assert refused[0].reason.startswith("only 3 matches")
    none, words = (
        fake_config(verification=fakes.FakeVerifier(accept=False)),
        "has 30 verified matches: too few",
    )
    refuses(StageFailure, f"best of 6 pairs {words}", run, tmp_path / "b", config=none)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"until": "surface"}, "unknown stage"), ({"until": "metrik"}, "did you mean metric"),
        ({"threads": -1}, "at least 0 as threads; got -1"), ({"executor": "dask://there"}, "dask://HOST:PORT"),
        ({"executor": "proceses"}, "did you mean processes"), ({"seed": -1}, "at least 0"),
    ],
)  # fmt: skip
def test_wrong_options_are_rejected_before_any_output(tmp_path, options, words):
    refuses(ValueError, words, run, tmp_path / "out", **options)
    refuses(TypeError, "did you mean threads", run, tmp_path / "out", thread=3)
    assert not (tmp_path / "out").exists()


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


def test_sentences_name_images_by_file():
    names = ["a.jpg", "b #0.jpg"]
    assert name_images("Images #0 and #1: few inliers (image #0).", names) == (
        "Images a.jpg and b #0.jpg: few inliers (image a.jpg)."
    )
    for kept in ("b #0.jpg is left out", "no image #7", "x#0", "#0b"):
        assert name_images(kept, names) == kept
