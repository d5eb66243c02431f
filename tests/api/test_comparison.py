"""Comparison of models: known changes are found, and pycolmap finds the same."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.io.test_colmap import SIZE
from thesisrecon import Camera, RunResult, UsageError, compare_models
from thesisrecon.io._models import read_model
from thesisrecon.records import Similarity
from thesisrecon.results import SparseModel, SparseView

TRUTH = Path(__file__).parents[2] / "fixtures" / "courtyard" / "cameras.json"
WORLD = Similarity(0.3, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([5.0, -3.0, 8.0]))


@pytest.fixture
def truth():
    """The cameras of the courtyard and 300 points."""
    X = np.random.default_rng(0).normal(0, 1.5, (300, 3))
    return replace(read_model(TRUTH), X=X)


def changed(model, change, world=WORLD):
    return replace(model, views=[change(view) for view in model.views]).transformed(world)


def noisy(view):
    rng = np.random.default_rng(list(view.name.encode()))
    R = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix() @ view.R
    K = view.K + rng.normal(0, 3, (3, 3)) * [[1, 0, 1], [0, 1, 1], [0, 0, 0]]
    return replace(view, R=R, t=-R @ (view.centre + rng.normal(0, 0.02, 3)), K=K)


def test_another_world_has_no_errors_and_known_changes_are_found(truth):
    found = compare_models(changed(truth, lambda view: view), TRUTH)
    assert found.names == found.names_b == tuple(truth.names)
    assert max(summary["max"] for summary in found.summary.values()) < 1e-9
    assert found.similarity.scale == pytest.approx(1 / 0.3)
    np.testing.assert_allclose(found.similarity.matrix @ WORLD.matrix, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(found.a.X, truth.X, atol=1e-12)
    assert found.notes == found.only_a == found.only_b == ()
    assert found.points is None

    def change(view):
        K = np.diag([1.02, 1 / 1.01, 1.0]) @ view.K
        K[:2, 2] = view.K[:2, 2] + [3.0, -4.0]
        turn = np.eye(3)
        if view.name == "0003.jpg":
            turn = Rotation.from_rotvec([0, 0, np.radians(2.0)]).as_matrix()
        return replace(view, K=K, R=turn @ view.R, t=turn @ view.t)

    found = compare_models(changed(truth, change), truth)
    np.testing.assert_allclose(found.focal_error_rel, np.sqrt(1.02 / 1.01) - 1.0, atol=1e-12)
    np.testing.assert_allclose(found.principal_point_error_px, 5.0, atol=1e-9)
    # The mean rotation takes over a part of it, as the other cameras are many.
    assert found.rotation_error_deg.argmax() == 3
    assert 1.7 < found.rotation_error_deg[3] < 2.0
    assert found.centre_error.max() < 1e-12
    assert found.summary["rotation_error_deg"]["max"] == found.rotation_error_deg[3]


@pytest.mark.references
def test_pycolmap_aligns_in_the_same_way(truth):
    import pycolmap

    model = changed(truth, noisy)
    found = compare_models(model, truth)
    source, target = (np.array([view.centre for view in m.views]) for m in (model, truth))
    theirs = pycolmap.estimate_sim3d(source, target)
    np.testing.assert_allclose(found.similarity.matrix[:3], theirs.matrix(), atol=1e-6)
    moved = np.array([theirs * x for x in source])
    np.testing.assert_allclose(found.centre_error, np.linalg.norm(moved - target, axis=1), atol=1e-6)
    assert found.summary["centre_error"]["rms"] > 0.01


def test_distances_of_points_count_both_ways(truth):
    """Every second point is missing in a, and the others are 5 mm off."""
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    b = replace(truth, X=grid)
    a = replace(truth, X=grid[::2] + np.array([0.005, 0, 0])).transformed(WORLD)
    points = compare_models(a, b).points
    assert points.a_to_b == pytest.approx(0.005)
    assert points.b_to_a == pytest.approx((0.005 + 0.995) / 2, abs=0.01)
    size = np.median(np.linalg.norm(grid - np.median(grid, axis=0), axis=1))
    np.testing.assert_allclose(points.thresholds, size * np.array([0.001, 0.003, 0.01, 0.03, 0.1]))
    np.testing.assert_array_equal(points.a_within, points.thresholds > 0.005)
    np.testing.assert_array_equal(points.b_within, 0.5 * (points.thresholds > 0.005))


def test_results_folders_and_cameras_by_name_are_models(tmp_path, truth):
    cameras = {v.name: Camera(v.K, v.R, v.t, v.size) for v in truth.views[::-1]}
    (tmp_path / "cameras.json").write_text(TRUTH.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "summary.json").write_text('{"trusted": true}', encoding="utf-8")
    result = RunResult(tmp_path, (), {}, (), (), np.zeros(0, np.int64), {}, summary={"trusted": True})
    found = compare_models(result, cameras)
    other = replace(result, summary={"trusted": False})
    refuses(UsageError, "the result has no cameras", compare_models, other, cameras)
    assert found.names == tuple(truth.names)
    assert found.summary["centre_error"]["max"] < 1e-9
    refuses(UsageError, "the second model of a comparison must be a path", compare_models, cameras, 3)
    refuses(UsageError, "the first model of a comparison must be a path", compare_models, {}, cameras)


def renamed(model, names, **fields):
    return replace(
        model, views=[replace(v, name=n, **fields) for v, n in zip(model.views, names, strict=False)]
    )


def test_cameras_are_paired_by_name_stem_and_order(truth):
    some = renamed(truth, ["x.jpg", *truth.names[1:]])
    found = compare_models(some, truth)
    assert found.names == tuple(truth.names[1:])
    assert (found.only_a, found.only_b) == (("x.jpg",), ("0000.jpg",))
    # Two images of one stem are not paired, and a time is no suffix.
    folders = [f"cam/{name[:-4]}.png" for name in truth.names[1:]] + ["other/0005.png"]
    found = compare_models(renamed(truth, folders), truth)
    assert found.names == tuple(name for name in folders if "0005" not in name)
    assert found.names_b == tuple(name for name in truth.names[1:] if name != "0005.jpg")
    times = [f"{k}.25" for k in range(14)]
    trajectory = renamed(truth, times, K=None, size=None)
    in_folder = renamed(truth, [f"rgb/{name}.png" for name in times])
    assert compare_models(in_folder, trajectory).names_b == tuple(times)
    found = compare_models(trajectory, truth)
    assert found.names_b == tuple(truth.names)
    assert np.isnan(found.focal_error_rel).all()
    assert "focal_error_rel" not in found.summary
    assert found.notes[0] == "no name is common; the 14 cameras were paired by their order alone"
    words = "no common camera: '0.25', '1.25', '2.25' and 11 more in the first and '0000.jpg'"
    refuses(UsageError, words, compare_models, trajectory, SparseModel(truth.views[:2]))


def test_trajectories_are_paired_by_time_and_have_errors_by_distance(truth):
    times = 1e9 + np.arange(14) * 0.1
    drift = [replace(view, t=view.t - view.R @ [0.01 * k, 0, 0]) for k, view in enumerate(truth.views)]
    fields = {"K": None, "size": None}
    fast = renamed(truth, [f"{time:.6f}" for time in times], **fields)
    # Every second one in another order, late, as images named by nanoseconds, and one without a partner.
    slow = replace(truth, views=drift[::-2])
    late = renamed(slow, [f"cam0/{round((time + 2.003) * 1e9)}.png" for time in times[::-2]])
    late = replace(late, views=[*late.views, replace(late.views[0], name="cam0/1000000500000000000.png")])
    refuses(UsageError, "nearest times of the models are 0.803 s apart", compare_models, fast, late)
    found = compare_models(fast, late, time_offset=-2.0)
    assert found.names_b == tuple(view.name for view in late.views[6::-1])
    assert found.names == tuple(fast.names[1::2])
    said = "7 of 14 and 8 cameras were paired by time, at most 0.003 s apart (tolerance 0.01 s, offset -2 s)"
    assert found.notes[0] == said
    wide = compare_models(fast, fast, max_time_difference=np.inf, time_offset=0.06)
    assert wide.names_b[0] == fast.names[0]
    errors = found.relative_errors(2.0)
    assert (errors.pairs[1:, 0] == errors.pairs[:-1, 1]).all()
    refuses(ValueError, "shorter than the distance 1e", found.relative_errors, 1e6)
    refuses(ValueError, "finite distance above 0", found.relative_errors, 0.0)


def test_relative_errors_and_pairs_by_time_are_those_of_evo(truth):
    """By the definition of Grupp's evo (matching_time_indices; pairs by path; E of Kuemmerle et al.)."""
    rng, fields = np.random.default_rng(3), {"K": None, "size": None}
    times = 1e9 + np.arange(14) * 0.1
    reference = renamed(truth, [f"{time:.6f}" for time in times], **fields)
    late = [f"{time + 0.5:.6f}" for time in times + rng.uniform(-0.02, 0.02, 14)]
    given = renamed(changed(truth, noisy), late, **fields)
    found = compare_models(given, reference, time_offset=0.5, max_time_difference=0.015)
    expected = []
    for name in late:
        differences = [abs(time + 0.5 - float(name)) for time in times]
        j = int(np.argmin(differences))
        if differences[j] <= 0.015:
            expected.append((name, reference.names[j]))
    assert list(zip(found.names, found.names_b, strict=True)) == expected
    assert 4 < len(expected) < 14

    def camera_to_world(model, names):
        views = {view.name: view for view in model.views}
        return [
            np.linalg.inv(np.vstack([np.column_stack([v.R, v.t]), [0, 0, 0, 1]]))
            for v in map(views.get, names)
        ]

    P, Q = camera_to_world(found.a, found.names), camera_to_world(reference, found.names_b)
    for distance in (0.5, 1.5, 3.0):
        ends, path = [], 0.0
        for k in range(1, len(Q)):
            path += np.linalg.norm(Q[k][:3, 3] - Q[k - 1][:3, 3])
            if path >= distance:
                ends.append(k)
                path = 0.0
        # The program begins with the end of the first motion, which counts here too.
        pairs = list(zip([0, *ends], ends, strict=False))
        errors = found.relative_errors(distance)
        assert errors.pairs.tolist() == [list(pair) for pair in pairs]
        E = [np.linalg.inv(np.linalg.inv(Q[i]) @ Q[j]) @ np.linalg.inv(P[i]) @ P[j] for i, j in pairs]
        np.testing.assert_allclose(errors.translation, [np.linalg.norm(e[:3, 3]) for e in E], rtol=1e-9)
        angles = [np.degrees(np.linalg.norm(Rotation.from_matrix(e[:3, :3]).as_rotvec())) for e in E]
        np.testing.assert_allclose(errors.rotation_deg, angles, rtol=1e-6)
        assert max(angles) > 0.1


def test_too_few_cameras_and_cameras_on_a_line_are_compared_as_far_as_possible(truth):
    two = compare_models(truth, SparseModel(truth.views[:2]))
    assert two.notes[0].startswith("2 common cameras cannot be aligned, at least 3 are needed")
    assert two.similarity is None
    assert list(two.summary) == ["rotation_error_deg", "focal_error_rel", "principal_point_error_px"]
    one = compare_models(truth, SparseModel(truth.views[:1]))
    assert list(one.summary) == ["focal_error_rel", "principal_point_error_px"]

    def on_line(view, bend=0.0):
        x = float(view.name[:4])
        return replace(view, t=-view.R @ np.array([x, bend * x**2, 0.0]))

    line = compare_models(truth, changed(truth, on_line))
    assert "lie on one line" in line.notes[0]
    assert line.points is None
    almost = compare_models(truth, changed(truth, lambda view: on_line(view, 1e-4)))
    assert "almost on one line" in almost.notes[0]
    assert almost.similarity is not None


def test_intrinsics_are_compared_at_the_size_of_the_second_model():
    K, half = np.array([[500.0, 0, 300], [0, 500, 200], [0, 0, 1]]), np.diag([0.5, 0.5, 1.0])
    half[:2, 2] = -0.25
    sizes = ((half @ K, (SIZE[0] // 2, SIZE[1] // 2)), (K, SIZE))
    models = [SparseModel([SparseView("a", np.eye(3), np.zeros(3), *one)]) for one in sizes]
    found = compare_models(*models)
    assert (abs(found.focal_error_rel[0]), found.principal_point_error_px[0]) < (1e-12, 1e-9)
