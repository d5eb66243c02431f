"""The synthetic walks and the adapter to Ceres."""

import numpy as np
import pytest

pytest.importorskip("pycolmap")

from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from validation.references.ceres import CeresOptions, refine_with_ceres
from validation.scenes.walks import SIZE, make_walk
from validation.stages.bundle import FOCAL_K1


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


@pytest.mark.parametrize("loss_px", [np.inf, 0.7])
def test_ours_and_ceres_end_at_one_cost(loss_px):
    rng = np.random.default_rng(1)
    walk = make_walk(12, "street", rng)
    cameras, X = walk.start(rng)
    theirs = refine_with_ceres(cameras, X, walk.seen, SIZE, CeresOptions(loss_px, function_tolerance=0.0))

    def ours(steps):
        options = BundleOptions(loss_px=loss_px, max_iterations=steps)
        return refine_metric_bundle(cameras, X, walk.seen, free=FOCAL_K1, options=options)

    mine = ours(200)
    assert ours(0).cost == pytest.approx(theirs.initial_cost, rel=1e-9)
    assert mine.cost == pytest.approx(theirs.cost, rel=1e-4)
    assert mine.cameras.intrinsics[0, 0] == pytest.approx(theirs.cameras.intrinsics[0, 0], rel=1e-3)
