"""What a run returns: cameras, points and observations in original pixels, saved and read back."""

import shutil

import numpy as np
import pytest

import thesisrecon
from tests.conftest import refuses, same_pairs
from tests.pipeline.given_scene import SIZE, given_scene
from thesisrecon.api.models import read_cameras
from thesisrecon.errors import UsageError


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    scene = given_scene()
    out = tmp_path_factory.mktemp("results") / "out"
    return scene, thesisrecon.reconstruct_from_matches(scene.keypoints, scene.matches, scene.sizes, out)


def test_points_project_to_their_observations_in_original_pixels(run):
    scene, result = run
    for name, camera in result.cameras.items():
        seen = result.observations(name)
        distance = np.linalg.norm(camera.project(result.points[seen.point]) - seen.xy, axis=1)
        assert len(seen.xy) > 150
        assert np.median(distance) < 1.5 * scene.noise_px
        assert camera.size == SIZE


def test_a_camera_is_found_by_name_and_by_number_and_has_standard_deviations(run):
    scene, result = run
    camera = result.cameras["image-3"]
    assert np.array_equal(camera.P, result.cameras[3].P)
    assert np.array_equal(camera.P, result.cameras[-2].P)
    assert abs(camera.K[0, 0] - scene.cameras[3].K[0, 0]) < 4 * camera.std["focal_px"]
    assert 0 < camera.std["focal_px"] < 50
    for key, words in (("other", "there is no image 'other'"), (9, "there is no image 9; 5 were read")):
        refuses(KeyError, words, result.cameras.__getitem__, key)
    refuses(KeyError, "there is no image 7", result.observations, 7)
    # Notebooks show the value of a cell.
    assert repr(result).startswith("RunResult(out='")
    assert repr(result).endswith("images=5, registered=5, points=200, failure='')")
    assert repr(result.cameras).startswith("Cameras(['image-0', ")


def test_results_are_read_back_and_saved_with_or_without_their_folder(run, tmp_path):
    result = run[1]
    loaded = thesisrecon.load(result.out)
    assert loaded.summary == result.summary
    assert list(loaded.cameras) == list(result.cameras)
    assert np.array_equal(loaded.points, result.points)
    assert np.array_equal(loaded.cameras[1].K, result.cameras[1].K)
    assert same_pairs(loaded, result)
    assert loaded.tracks.n_points == result.tracks.n_points
    thesisrecon.save(loaded, tmp_path / "copy")
    for name in ("cameras.json", "points.ply", "summary.json", "sparse/0/images.bin"):
        assert (tmp_path / "copy" / name).read_bytes() == (result.out / name).read_bytes()
    scene, kept = run
    result = thesisrecon.reconstruct_from_matches(scene.keypoints, scene.matches, scene.sizes)
    assert result.out is None
    thesisrecon.save(result, str(tmp_path / "saved"))
    saved = read_cameras(tmp_path / "saved" / "cameras.json")
    assert np.allclose(saved["image-2"].K, kept.cameras[2].K)
    assert (tmp_path / "saved" / "points.ply").read_bytes() == (kept.out / "points.ply").read_bytes()


def test_results_of_one_folder_stay_apart_and_outlive_it(run, tmp_path):
    scene, kept = run
    out = tmp_path / "out"

    def again(**options):
        given = (scene.keypoints, scene.matches, scene.sizes, out)
        return thesisrecon.reconstruct_from_matches(*given, overwrite=True, **options)

    first, second = again(), again(set={"intrinsics.focal_px": 1000.0, "intrinsics.focal": "known"})
    assert abs(second.cameras[0].K[0, 0] / first.cameras[0].K[0, 0] - 1.1) < 0.05
    for _ in ("replaced", "removed"):
        assert thesisrecon.compare_models(first, second).summary["focal_error_rel"]["max"] > 1e-6
        assert thesisrecon.compare_models(first, kept).summary["focal_error_rel"]["max"] == 0.0
        thesisrecon.save(first, tmp_path / "copy")
        for name in ("cameras.json", "points.ply", "sparse/0/images.bin", "sparse/0/points3D.bin"):
            assert (tmp_path / "copy" / name).read_bytes() == (kept.out / name).read_bytes()
        shutil.rmtree(out, ignore_errors=True)


def test_pairs_given_the_other_way_round_are_read_back_and_cameras_are_refused_with_the_reason(run, tmp_path):
    scene, out = run[0], tmp_path / "early"
    refuses(UsageError, "no run has finished in this folder", thesisrecon.load, tmp_path)
    matches = {(j, i): rows[:, ::-1] for (i, j), rows in scene.matches.items()}
    given = scene.keypoints, matches, scene.sizes
    result = thesisrecon.reconstruct_from_matches(*given, out, until="matches")
    assert [(p.i, p.j) for p in result.pairs][:3] == [(0, 1), (0, 2), (1, 2)]
    assert same_pairs(thesisrecon.load(out), result)
    with pytest.raises(AttributeError, match="the run ended before the metric stage"):
        result.cameras  # noqa: B018


def test_the_reconstruction_in_original_pixels_has_the_cameras_and_observations(run):
    result = run[1]
    r = result.reconstruction
    assert np.allclose(r.P[3], result.cameras[3].P)
    assert np.allclose(r.K[3], result.cameras[3].K)
    here = r.inlier & (r.tracks.view_index == 3)
    assert np.array_equal(r.tracks.xy[here], result.observations(3).xy)
