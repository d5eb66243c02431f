"""What studies compute: scenes, bounds, coverage, schedules."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from tests.pipeline.fake_stages import fake_config, kept_bytes, photographs
from tests.synthetic import texture
from thesisrecon.api.reconstruct import reconstruct
from validation.metrics import focal_bound
from validation.metrics.cameras import holding_std
from validation.scenes.dinosaur import load_dinosaur
from validation.scenes.rigs import cube_rig, make_cloud, noisy_tracks, projective_from_truth
from validation.scenes.stereo import StereoPair, seen_by_both
from validation.studies import cluster_efficiency, subsets
from validation.studies.cluster_efficiency import TaskMeter, efficiency_table
from validation.studies.dinosaur import compare, to_metrics


def small_pair():
    """A textured plane at disparity 5, a nearer square at 9."""
    colors = [[texture(60, 120, 3 * kind + k) for k in range(3)] for kind in range(2)]
    base, square = (np.stack(channels, axis=2).astype(np.uint8) for channels in colors)
    left, right = base[:, 20:110].copy(), base[:, 25:115].copy()
    truth = np.full((60, 90), 5.0, np.float32)
    left[20:40, 40:60], right[20:40, 31:51] = square[:20, :20], square[:20, :20]
    truth[20:40, 40:60] = 9.0
    return StereoPair("small", left, right, truth, seen_by_both(truth, None), 16)


def test_pixels_hidden_by_the_square_or_beyond_the_image_are_not_judged():
    judged = small_pair().judged
    assert not judged[:, :5].any()
    # At the left of the square lie the four columns of the plane that it covers in the right image.
    assert not judged[20:40, 36:40].any()
    assert judged[20:40, 40:60].all()
    assert judged[:20, 5:].all()


def test_cameras_of_one_face_are_left_out_of_the_projective_stage():
    rng, rig = np.random.default_rng(0), cube_rig()
    rec = projective_from_truth(rig, noisy_tracks(rig, 1.0, rng), rng)
    assert rig.flat is not None
    assert rig.flat.sum() == 6
    np.testing.assert_array_equal(rec.registered, ~rig.flat)
    assert rec.sigma_px == pytest.approx(0.9, abs=0.1)


def test_the_bound_grows_with_noise_and_shrinks_with_cameras_and_priors():
    rig = make_cloud(9, np.random.default_rng(1), points=80)
    std = focal_bound(rig, 1.0, zooming=False, principal_std_px=15.0)
    np.testing.assert_allclose(std, std[0])
    # With what is known of the principal point scaled along, twice the noise is twice the deviation.
    np.testing.assert_allclose(
        focal_bound(rig, 2.0, zooming=False, principal_std_px=30.0), 2.0 * std, rtol=1e-4
    )
    assert focal_bound(rig.subset(np.arange(4)), 1.0, zooming=False, principal_std_px=15.0)[0] > 1.2 * std[0]
    assert (focal_bound(rig, 1.0, zooming=True, principal_std_px=15.0) > std[0]).all()
    assert focal_bound(rig, 1.0, zooming=False, principal_std_px=0.1)[0] <= std[0]
    scaled = replace(rig, X=3.0 * rig.X, C=3.0 * rig.C)
    np.testing.assert_allclose(focal_bound(scaled, 1.0, zooming=False, principal_std_px=15.0), std, rtol=1e-4)


def test_without_a_trusted_result_no_coverage_is_reached(monkeypatch):
    monkeypatch.setattr(subsets, "run_synthetic", lambda *_: None)
    assert "missed" in [row.verdict for row in subsets.check_coverage("shared", range(3))]


def test_cameras_that_err_together_make_a_share_as_unsure_as_scenes_do():
    alone = [np.full((1, 1), 5.0 if n % 10 == 0 else 0.0) for n in range(100)]
    assert holding_std(alone) == pytest.approx(np.sqrt(0.1 * 0.9 / 99))
    assert holding_std([np.tile(z, (8, 1)) for z in alone]) == pytest.approx(holding_std(alone))


@pytest.fixture(scope="module")
def comparison():
    dinosaur = load_dinosaur()
    if dinosaur is None:
        pytest.skip("the dinosaur's tracks are not on this machine")
    return compare(dinosaur)


@pytest.mark.real
def test_all_cameras_are_found_and_explain_the_tracks_as_well_as_the_published_ones(comparison):
    missed = [row for row in to_metrics(comparison) if row.verdict == "missed"]
    assert not missed, missed


def test_a_toy_run_is_measured_task_by_task_and_its_result_is_the_same(tmp_path):
    meter, given = TaskMeter(), {"config": fake_config(), "threads": 1}
    reconstruct(photographs(5), tmp_path / "a", executor=meter, **given)
    plain = reconstruct(photographs(5), tmp_path / "b", **given)
    assert kept_bytes(tmp_path / "a") == kept_bytes(tmp_path / "b")
    found = meter.tasks(1)
    counts = {stage: len(tasks) for stage, tasks in found.items()}
    assert counts == {"features": 5, "depth maps": 5, "matches": 10}
    image = photographs(1)[0].rgb.nbytes
    assert all(task.sent > image and task.received > 500 for task in found["features"])
    # Of ten pairs each is a batch, with two images.
    assert all(2 * image < task.sent < 3 * image for task in found["matches"])
    received = sum(task.received for task in found["matches"])
    assert received == pytest.approx(sum(len(pickle.dumps([p], 5)) for p in plain.pairs), rel=0.02)
    table = efficiency_table(1.0, {workers: meter.tasks(workers) for workers in (1, 2)})
    assert table.count("| whole run |") == 2


def test_the_cluster_study_counts_the_first_matches_of_many_images(tmp_path, monkeypatch):
    for path in sorted((Path(__file__).parents[2] / "fixtures" / "courtyard" / "images").iterdir())[4:7]:
        PIL.Image.open(path).resize((160, 120)).save(tmp_path / f"{path.stem}.png")
    monkeypatch.setattr(cluster_efficiency, "write_scene", lambda *_, **__: str(tmp_path))
    study = cluster_efficiency.cluster_efficiency_study
    (table,) = study(tmp_path, sizes=[3], until="matches", set_=["matching.many_images=2"])
    assert table.startswith("3 images")
    assert [table.count(f"\n| {stage} | ") for stage in ("first matches", "whole run")] == [5, 5]
