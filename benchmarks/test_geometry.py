"""F, triangulation and bundle adjustment beside OpenCV, PoseLib, COLMAP and Ceres."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from benchmarks.conftest import Bench
from thesisrecon.api.cameras import triangulate
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.geometry.polynomial_triangulation import triangulate_polynomial
from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from validation.references.ceres import CeresOptions, bundle_adjuster, colmap_model
from validation.references.fundamental import SOLVERS, colmap_points, opencv_linear, opencv_polynomial
from validation.scenes.two_views import make_two_views
from validation.scenes.walks import SIZE, make_walk
from validation.stages.bundle import FOCAL_K1

MATCHES, SIGMA_PX, FRAME = 1000, 0.5, (1280.0, 960.0)
POINTS = 2000


@pytest.mark.parametrize("outliers", [0.1, 0.3, 0.5, 0.7])
@pytest.mark.parametrize("method", ["ours", "USAC_ACCURATE", "USAC_MAGSAC", "FM_RANSAC", "COLMAP", "PoseLib"])
def test_fundamental(bench: Bench, method: str, outliers: float) -> None:
    rng = np.random.default_rng(1)
    scene = make_two_views(Configuration.GENERAL, MATCHES, rng)
    xy1, xy2 = (xy + rng.normal(0.0, SIGMA_PX, xy.shape) for xy in (scene.xy1, scene.xy2))
    wrong = rng.random(MATCHES) < outliers
    xy2[wrong] = rng.uniform((0.0, 0.0), FRAME, (int(wrong.sum()), 2))
    group = f"F of 1000 matches, {100 * outliers:.0f} % wrong"
    bench(group, method, lambda: SOLVERS[method](xy1, xy2, 1.0, 0))


@pytest.mark.parametrize(
    ("group", "method", "solve"),
    [
        ("linear triangulation, two views", "ours", partial(triangulate, method="linear")),
        ("linear triangulation, two views", "OpenCV", opencv_linear),
        ("linear triangulation, two views", "COLMAP", colmap_points),
        ("optimal triangulation, two views", "ours", triangulate_polynomial),
        ("optimal triangulation, two views", "ours (iterative)", partial(triangulate, method="optimal")),
        ("optimal triangulation, two views", "OpenCV", opencv_polynomial),
    ],
)
def test_triangulation(bench: Bench, group: str, method: str, solve: object) -> None:
    assert callable(solve)
    rng = np.random.default_rng(2)
    scene = make_two_views(Configuration.GENERAL, POINTS, rng)
    xy = np.stack([scene.xy1, scene.xy2])
    xy += rng.normal(0.0, SIGMA_PX, xy.shape)
    P = np.stack([scene.P1, scene.P2])
    bench(group, method, lambda: solve(P, xy))


@pytest.mark.parametrize("views", [10, 30])
@pytest.mark.parametrize("method", ["ours", "Ceres"])
def test_bundle_adjustment(bench: Bench, method: str, views: int) -> None:
    rng = np.random.default_rng(3)
    walk = make_walk(views, rng)
    cameras, X = walk.start(rng)
    options = BundleOptions(loss_px=1.0, max_iterations=100)

    def ours() -> object:
        return refine_metric_bundle(cameras, X, walk.seen, free=FOCAL_K1, options=options)

    group = f"bundle adjustment, a street of {views} photographs"
    if method == "ours":
        bench(group, method, ours)
        return
    # The model in memory is COLMAP's own way to hold the problem: it is no part of the work.
    bench(
        group,
        method,
        lambda model: bundle_adjuster(model, CeresOptions(1.0)).solve(),
        setup=lambda: colmap_model(cameras, X, walk.seen, SIZE),
    )
