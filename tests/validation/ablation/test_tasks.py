"""What the rows of our studies run: known answers, and the same as calling the stages."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import thesisrecon
from tests.conftest import refuses
from thesisrecon.config import PipelineConfig, preset
from thesisrecon.epipolar.ransac import ThesisRansac
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.errors import StageFailure, UsageError
from validation.ablation import Place, Study, ablate
from validation.ablation.plan import plan_study, study_from_table
from validation.ablation.tasks import Reconstruction, images
from validation.ablation.tasks.searches import ESTIMATORS, RobustSearch
from validation.ablation.tasks.synthetic import FundamentalOfCube, TriangulationOverNoise
from validation.metrics.searches import traced
from validation.scenes import stereo as stereo_scenes
from validation.scenes.real import ROOT, write_png
from validation.scenes.two_views import make_two_views

CONFIG = PipelineConfig()
NOWHERE = Place(Path(), Path())


@pytest.fixture(scope="module")
def yard(tmp_path_factory):
    """Three photographs of the courtyard, with their cameras."""
    folder, source = tmp_path_factory.mktemp("yard"), ROOT / "fixtures" / "courtyard"
    (folder / "images").mkdir()
    reported = json.loads((source / "cameras.json").read_text(encoding="utf-8"))
    cameras = {"cameras": reported["cameras"][4:7]}
    for camera in cameras["cameras"]:
        shutil.copy(source / "images" / camera["name"], folder / "images" / camera["name"])
    (folder / "cameras.json").write_text(json.dumps(cameras), encoding="utf-8")
    return folder


def test_exact_points_have_an_exact_fundamental_matrix():
    for method in ("eight-point, normalised", "epipolar of the configuration"):
        task = FundamentalOfCube(method=method, noise_px=0.0, pairs=3)
        found = task.run(CONFIG, "cube", 0, NOWHERE)
        assert found["distance_px"] < 1e-6
        assert found["epipole_deg"] < 1e-4
        assert found["within_pct"] == 100.0
        assert "over_bound" not in found, "without noise there is no bound"


def test_the_polynomial_method_does_not_depend_on_the_frame():
    found = [
        TriangulationOverNoise(frame=frame, points=60).run(CONFIG, "two views beside each other", 3, NOWHERE)
        for frame in ("metric", "projective")
    ]
    assert found[0] == pytest.approx(found[1], rel=1e-6)
    with pytest.raises(ValueError, match="one of two views"):
        TriangulationOverNoise().run(CONFIG, "five views", 0, NOWHERE)


@pytest.mark.parametrize(
    ("task", "scene", "words"),
    [
        (FundamentalOfCube(), "cub", "unknown scene 'cub'; did you mean cube"),
        (images.ImagePairs(), "courtyard/13", "there is no pair courtyard/13"),
        (images.RectifiedPairs(), "Teddy#3/2", "with k from 1 to n"),
        (Reconstruction(), str(ROOT / "scripts"), "there are no images in"),
    ],
)
def test_a_missing_scene_is_reported(task, scene, words):
    with pytest.raises(UsageError, match=words):
        task.check(scene)


def test_a_yard_is_matched_whole_and_in_windows_of_its_rows(tmp_path, monkeypatch):
    texture = np.random.default_rng(0).integers(0, 256, (30, 80, 3), dtype=np.uint8)
    # The lower half of the scene is nearer; the left image sees the right one's column x at x + d.
    disparity = np.repeat([[8.0], [12.0]], 30, axis=0) * np.ones(160)
    right = texture.repeat(2, axis=0).repeat(2, axis=1)
    left = np.stack([np.roll(row, int(d), axis=0) for row, d in zip(right, disparity[:, 0], strict=True)])
    for name, image in (("left", left), ("right", right)):
        write_png(tmp_path / f"{name}.png", image)
    np.save(tmp_path / "disparity.npy", np.stack([disparity, disparity]).astype(np.float32))
    monkeypatch.setattr(stereo_scenes, "stereo_yard_folder", {9: tmp_path}.get)
    task = images.RectifiedPairs()
    assert task.subsets("yard-9", 2) == ["yard-9#1/2", "yard-9#2/2"]
    for scene, rows in (("yard-9", 60), ("yard-9#1/2", 40), ("yard-9#2/2", 40)):
        assert task.scene_of(scene) == "yard-9"
        pair = images.matched_pair(scene)
        assert pair.left.shape == pair.right.shape == (rows, 160, 3)
        assert pair.disparities >= 13
        assert task.run(CONFIG, scene, 0, NOWHERE)["bad1_pct"] < 5.0
    np.testing.assert_array_equal(images.matched_pair("yard-9#2/2").left, left[20:])


def test_pairs_of_a_scene_are_one_value_and_a_wrong_F_is_a_failure():
    task = images.ImagePairs(gap=2)
    assert {task.scene_of(f"courtyard/{i}") for i in (0, 4)} == {"courtyard"}
    pair = images.read_pair("courtyard/4", 2)
    views = [CONFIG.matching.prepare(image, CONFIG.features.detect(image)) for image in pair.images]
    found = images.numbers_of_pair(CONFIG, views, pair, 0)
    assert [image.name for image in pair.images] == ["0004.jpg", "0006.jpg"]
    assert found["verified"] > 500
    assert found["error_px"] < 0.1
    assert found["precision_pct"] > 95.0
    fewest = min(len(v.features.xy) for v in views)
    right = found["precision_pct"] * found["verified"]
    assert found["matching_score_pct"] == pytest.approx(right / fewest)
    assert found["auc5_pct"] > 95.0
    spoiled = pair._replace(truth=pair.truth[:, [0, 1, 2, 0]])
    refuses(StageFailure, "F is wrong", images.numbers_of_pair, CONFIG, views, spoiled, 0)
    # Without F: the pose counts as wrong, the distance as the largest.
    few = replace(CONFIG, epipolar=replace(CONFIG.epipolar, threshold_px=1e-9))
    none = images.numbers_of_pair(few, views, pair, 0, strict=False)
    assert (none["error_px"], none["auc20_pct"], none["precision_pct"]) == (99.0, 0.0, 0.0)


def test_pairs_of_a_folder_are_listed_and_judged_at_any_size(yard, tmp_path):
    (yard / "pairs.txt").write_text("0004.jpg 0006.jpg\n0005.jpg 0004.jpg\n", encoding="utf-8")
    task = images.ImagePairs(gap=1)
    assert task.expand(f"{yard}/*") == [f"{yard}/0", f"{yard}/1"]
    study = Study({}, [f"{yard}/pairs.txt", f"{yard}/0"], task=task)
    scenes = [row.scene for row in plan_study(study).rows]
    assert scenes == [f"{yard}/0004.jpg+0006.jpg", f"{yard}/0005.jpg+0004.jpg", f"{yard}/0"]
    whole, half = (images.read_pair(scenes[0], 1, size) for size in (1536, 300))
    assert half.images[0].size[0] == 300
    scale = half.images[0].scale / whole.images[0].scale
    np.testing.assert_allclose(half.truth + 0.5, scale * (whole.truth + 0.5), rtol=1e-12)
    found = replace(task, max_size_px=300).run(CONFIG, scenes[0], 0, NOWHERE)
    assert found["error_px"] < 0.3
    before = task.scene_key(scenes[0])
    moved = json.loads((yard / "cameras.json").read_text(encoding="utf-8"))
    other = tmp_path / "moved"
    shutil.copytree(yard, other)
    moved["cameras"][0]["t"][0] += 0.01
    (other / "cameras.json").write_text(json.dumps(moved), encoding="utf-8")
    assert task.scene_key(f"{other}/0004.jpg+0006.jpg") != before, "the truth is part of the content"
    refuses(UsageError, "unknown image of .* '0004.png'", task.check, f"{yard}/0004.png+0006.jpg")
    refuses(UsageError, "or a list of pairs", task.check, f"{yard}/none.txt")


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_search_is_judged_by_samples_and_by_time(estimator):
    """The trace ends at the estimator's result, and its cost falls."""
    task = RobustSearch(estimator=estimator, outliers=0.5, matches=300)
    end = task.run(CONFIG, "two views", 0, NOWHERE)
    assert end["error_px"] < 1.0
    costs = []
    for samples in (70, 10**9):
        found = replace(task, after_samples=samples).run(CONFIG, "two views", 0, NOWHERE)
        assert found["samples"] <= samples
        costs.append(found["cost"])
    assert costs[0] >= costs[1] == end["cost"]
    assert found["error_px"] == end["error_px"]
    late = replace(task, after_ms=1e6).run(CONFIG, "two views", 0, NOWHERE)
    assert late["error_px"] == end["error_px"]
    refuses(StageFailure, "no model yet", replace(task, after_samples=1).run, CONFIG, "two views", 0, NOWHERE)


def test_the_trace_of_the_thesis_falls_and_nothing_is_watched_outside():
    rng = np.random.default_rng(0)
    views = make_two_views(Configuration.GENERAL, 100, rng)
    method = ThesisRansac(samples=50)
    with traced() as trace:
        method.estimate(views.xy1, views.xy2, np.random.default_rng(1))
    assert [s.samples for s in trace.steps] == sorted(s.samples for s in trace.steps)
    costs = [s.cost for s in trace.steps]
    assert costs
    assert costs == sorted(costs, reverse=True)
    method.estimate(views.xy1, views.xy2, np.random.default_rng(1))
    assert len(trace.steps) == len(costs)


def test_without_noise_the_cost_of_the_right_model_is_the_share_of_wrong_matches():
    rng = np.random.default_rng(0)
    views = make_two_views(Configuration.GENERAL, 100, rng)
    xy2 = np.concatenate([views.xy2[:70], rng.uniform(0.0, 640.0, (30, 2))])
    with traced() as trace:
        thesisrecon.estimate_fundamental(views.xy1, xy2)
    costs = np.array([s.cost - (1.0 - s.share) for s in trace.steps if s.share >= 0.7])
    assert len(costs) > 1
    assert np.abs(costs).max() < 0.05


def test_metrics_a_scene_cannot_give_are_rejected_only_on_request(yard, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(yard / "images", bare / "images")
    study = Study({"epipolar": ["thesis-ransac"]}, [str(bare)], seeds=1)
    assert {m.name for m in plan_study(study).measures} >= {"points", "verified", "trusted"}
    assert "focal_error_pct" not in [m.name for m in plan_study(study).measures]
    with pytest.raises(UsageError, match="no scene of this study has the metric focal_error_pct"):
        plan_study(replace(study, metrics=["points", "focal_error_pct"]))
    early = replace(study, task=Reconstruction(until="matches"), scenes=[str(yard)])
    assert [m.name for m in plan_study(early).measures] == ["verified", "sigma_px"]
    mixed = plan_study(replace(study, scenes=[str(yard), str(bare)], metrics=["focal_error_pct", "points"]))
    assert {r.scene: mixed.wanted(r) for r in mixed.rows} == {
        str(yard): ["focal_error_pct", "points"],
        str(bare): ["points"],
    }


def test_sizes_and_lists_of_pairs_of_a_reconstruction_are_settings(yard):
    listed = {"kind": "listed-pairs", "listed": [["0004.jpg", "0005.jpg"]]}
    axes = {"images.max_size_px": [300], "pairs": ["all-pairs", listed]}
    rows = plan_study(study_from_table({"scenes": [str(yard)], "axes": axes})).rows
    assert rows[1].setting.config.images.max_size_px == 300
    assert rows[3].setting.config.pairs.listed == (("0004.jpg", "0005.jpg"),)


def test_a_reconstruction_in_a_study_is_the_one_outside(yard, tmp_path):
    config = replace(preset("thesis"), images=replace(CONFIG.images, max_size_px=400))
    given = {"seeds": [3], "config": config, "metrics": ["focal_error_pct", "points", "verified"]}
    study = Study({"selfcalibration": ["nonlinear-quadric"]}, [str(yard)], **given)
    rows = ablate(study, tmp_path / "study", executor="local", threads=1)
    assert [r.variant for r in rows] == ["unchanged", "nonlinear-quadric"]
    assert not any(r.failure for r in rows)
    result = thesisrecon.reconstruct(
        yard / "images", tmp_path / "run", config=config, seed=3, until="metric", threads=1
    )
    assert result.metric is not None
    assert result.metric.reconstruction.K is not None
    assert rows[0].metrics["points"] == result.metric.reconstruction.valid.sum()
    assert rows[0].metrics["verified"] == sum(pair.inliers for pair in result.pairs if pair.accepted)
    # The truth is brought to the size at which the photographs were read.
    f = float(np.sqrt(np.prod(np.diag(result.metric.reconstruction.K[0])[:2]))) / result.images[0].scale
    truth = json.loads((yard / "cameras.json").read_text())["cameras"]
    f_true = np.sqrt(np.prod(np.diag(truth[0]["K"])[:2]))
    assert rows[0].metrics["focal_error_pct"] == pytest.approx(100.0 * abs(f / f_true - 1.0), rel=1e-6)
