"""The synthetic walks, the adapter to Ceres and the measurements of the study of bundle adjustment."""

import itertools

import numpy as np
import pytest

pytest.importorskip("pycolmap")

from tests.numerics.bundle_scenes import make_block
from thesisrecon.numerics.metric_bundle import BundleOptions, refine_metric_bundle
from thesisrecon.records import Reconstruction, Tracks
from validation.references.ceres_bundle import CeresOptions, refine_with_ceres
from validation.scenes.streets import SIZE, make_walk
from validation.studies.bundle import (
    FOCAL_K1,
    Case,
    check_covariance,
    check_same_problem,
    measure_walk,
    perturbed_model,
    timed_often,
    walk_rows,
)


@pytest.mark.parametrize("kind", ["street", "loop"])
def test_walks_have_short_tracks_among_neighbours(kind):
    walk = make_walk(40, kind, np.random.default_rng(0))
    counts = np.bincount(walk.seen.point_index)
    assert counts.min() >= 3
    assert counts.max() <= 10
    assert (np.bincount(walk.seen.view_index, minlength=40) > 50).all()
    assert (np.abs(walk.seen.xy - np.array(SIZE) / 2.0) < np.array(SIZE)).all()
    first, last = (set(walk.seen.point_index[walk.seen.view_index == v]) for v in (0, 39))
    assert bool(first & last) is (kind == "loop")


@pytest.mark.parametrize("loss", ["squared", "huber"])
def test_ours_and_ceres_end_at_one_cost(loss):
    rng = np.random.default_rng(1)
    walk = make_walk(12, "street", rng)
    cameras, X = walk.start(rng)
    theirs = refine_with_ceres(cameras, X, walk.seen, SIZE, CeresOptions(loss, 0.7, function_tolerance=0.0))
    options = BundleOptions(loss=loss, loss_px=0.7, max_iterations=200)
    mine = refine_metric_bundle(cameras, X, walk.seen, free=FOCAL_K1, options=options)
    assert mine.initial_cost == pytest.approx(theirs.initial_cost, rel=1e-9)
    assert mine.cost == pytest.approx(theirs.cost, rel=1e-4)
    assert mine.cameras.intrinsics[0, 0] == pytest.approx(theirs.cameras.intrinsics[0, 0], rel=1e-3)


def _model(block, sigma_px):
    """The block as a run would have ended with it."""
    c, V, N = block.cameras, len(block.cameras.R), len(block.X)
    xy = block.xy + sigma_px * np.random.default_rng(0).normal(size=block.xy.shape)
    tracks = Tracks(block.view, block.point, xy, V, N)
    sizes = np.tile([1030, 760], (V, 1))
    ones = np.ones(V, bool), np.ones(N, bool), np.ones(len(xy), bool)
    distortion = np.tile([c.intrinsics[0, 5], 0.0, 0.0], (V, 1))
    return Reconstruction(
        "metric", c.P, block.Xh, *ones, tracks, sizes, sigma_px, ("",) * V, K=c.K, distortion=distortion
    )


def test_a_model_is_perturbed_and_taken_several_times():
    block = make_block(k1=0.02)
    cameras, X, seen = perturbed_model(_model(block, 0.1), np.random.default_rng(0), copies=2)
    K, N = len(block.xy), len(block.X)
    assert cameras.intrinsics[0, 0] == pytest.approx(1.02 * 1200.0)
    assert len(X) == 2 * N
    np.testing.assert_array_equal(seen.point_index[K:], block.point + N)
    again = seen.xy[K:] - seen.xy[:K]
    assert np.std(again) == pytest.approx(0.1, rel=0.1)
    assert 0.0 < np.abs(X[:N] - block.X).max() < 0.1


@pytest.mark.parametrize("shared", [True, False])
def test_one_problem_is_reported_with_cost_time_and_steps(shared):
    block = make_block(k1=0.02, points=150)
    rows = check_same_problem(_model(block, 0.3), Case(1, "squared", True, shared), repeats=2)
    named = {row.name: row for row in rows}
    assert named["cost over Ceres' - 1"].verdict == "reached"
    assert named["final cost"].values["Ceres"] == pytest.approx(named["final cost"].values["ours"], rel=1e-4)
    assert min(named["wall time"].values.values()) > 0.0
    assert f"{2 * len(block.xy)} residuals" in rows[0].scene


def test_covariances_are_those_of_colmap():
    rows = {row.name: row for row in check_covariance(3)}
    assert rows["poses: largest difference to COLMAP's"].verdict == "reached"
    assert rows["f, c, k1: largest difference to COLMAP's"].verdict == "reached"


def test_short_work_is_repeated_and_the_first_result_kept():
    count = itertools.count()
    answer, wall, cpu = timed_often(lambda: (next(count), 1e-3, 2e-3))
    assert (answer, wall, cpu, next(count)) == (0, 1e-3, 2e-3, 25)
    assert timed_often(lambda: (next(count), 5.0, 4.0)) == (26, 5.0, 4.0)
    assert next(count) == 27


def test_a_walk_is_measured_by_either_and_judged_by_processor_time():
    told = {method: measure_walk("loop", 10, method) for method in ("ours", "sparse")}
    assert told["ours"]["cost"] == pytest.approx(told["sparse"]["cost"], rel=1e-3)
    assert told["ours"]["observations"] == told["sparse"]["observations"] > 0
    rows = walk_rows("loop", {"ours": {**told["ours"], "cpu": 2.0}, "sparse": {**told["sparse"], "cpu": 1.0}})
    assert [row.verdict for row in rows if row.name == "processor time"] == ["missed"]
