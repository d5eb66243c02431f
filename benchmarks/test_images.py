"""Corners, matching, rectification, disparities and rendering beside OpenCV."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.conftest import Bench
from benchmarks.references import nearest_two, opencv_uncalibrated, warp_perspective
from thesisrecon.config import preset
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.matching._seeds import _scan_correlations as scan_correlations
from thesisrecon.pipeline.matching import match_views
from thesisrecon.records import Image
from thesisrecon.stereo._epipolar_pair import pair_of_fundamental
from thesisrecon.stereo.rectification import PlanarRectification, hartley, rectify
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline
from thesisrecon.stereo.semi_global import SemiGlobalMatching
from validation.references.opencv import OpenCVSemiGlobal, harris_corners
from validation.references.sift import compute_sift, grey_of, sift_front_end
from validation.scenes.two_views import make_two_views

DISPARITIES = 64
MATCHERS: dict[str, SemiGlobalMatching | MaximumLikelihoodScanline] = {
    "ours": SemiGlobalMatching(),
    "ours (thesis)": MaximumLikelihoodScanline(),
}


@pytest.mark.parametrize("method", ["ours", "OpenCV", "SIFT"])
def test_corners(bench: Bench, method: str, photographs: tuple[Image, ...]) -> None:
    image, corners = photographs[0], HarrisCorners()
    grey = grey_of(image)

    calls = {
        "ours": lambda: corners.detect(image),
        "OpenCV": lambda: harris_corners(image, 2000),
        "SIFT": lambda: compute_sift(grey),
    }
    bench("corners of a photograph, 1024 x 768", method, calls[method])


@pytest.mark.parametrize("method", ["ours", "SIFT"])
def test_matches_of_a_pair(bench: Bench, method: str, photographs: tuple[Image, ...]) -> None:
    config = preset("default") if method == "ours" else sift_front_end(preset("default"))
    one, two = (config.matching.prepare(image, config.features.detect(image)) for image in photographs)
    bench("matches and F of a pair, features known", method, lambda: match_views(config, one, two, (0, 1), 0))


@pytest.mark.parametrize("method", ["ours", "OpenCV"])
def test_correlation(bench: Bench, method: str, rng: np.random.Generator) -> None:
    one, two = rng.normal(size=(2, 2000, 121)).astype(np.float32)
    one, two = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (one, two))
    places, apart = np.zeros((2000, 2), np.float32), np.full(2000, -1.0, np.float32)
    calls: dict[str, Callable[[], object]] = {
        "ours": lambda: scan_correlations(one @ two.T, places, apart),
        "OpenCV": lambda: nearest_two(one, two),
    }
    bench("best two of 2000 patches for each of 2000", method, calls[method])


@pytest.mark.parametrize("method", ["ours", "ours (least distorted)", "OpenCV"])
def test_rectification(bench: Bench, method: str) -> None:
    scene = make_two_views(Configuration.GENERAL, 500, np.random.default_rng(1))
    F, size = fundamental_from_cameras(scene.P1, scene.P2), (1280, 960)
    calls: dict[str, Callable[[], object]] = {
        "ours": lambda: hartley(pair_of_fundamental(F, scene.xy1, scene.xy2, size, size)),
        "ours (least distorted)": lambda: rectify(pair_of_fundamental(F, scene.xy1, scene.xy2, size, size)),
        "OpenCV": lambda: opencv_uncalibrated(F, scene.xy1, scene.xy2, size),
    }
    bench("rectification of F by Hartley's method, 500 matches", method, calls[method])


@pytest.mark.parametrize("method", ["ours", "OpenCV"])
def test_rectifying_warp(bench: Bench, method: str, photographs: tuple[Image, ...]) -> None:
    rgb = photographs[0].rgb.astype(np.float32)
    size = (rgb.shape[1], rgb.shape[0])
    H = np.array([[1.02, 0.03, -8.0], [-0.02, 1.01, 5.0], [1e-5, 2e-5, 1.0]])
    rectified = PlanarRectification(np.stack([H, np.eye(3)]), size)
    calls = {"ours": lambda: rectified.warp(rgb, 0), "OpenCV": lambda: warp_perspective(rgb, H, size)}
    bench("rectifying warp, 1024 x 768", method, calls[method])


@pytest.mark.parametrize("method", [*MATCHERS, "SGBM HH", "SGBM 3-way"])
def test_disparities(bench: Bench, method: str, photographs: tuple[Image, ...]) -> None:
    left = photographs[0].rgb[::2, ::2].copy()
    right = np.roll(left, -20, axis=1)

    def ours() -> object:
        return MATCHERS[method].match(left, right, disparity_range=(0, DISPARITIES - 1))

    def theirs() -> object:
        return OpenCVSemiGlobal(method, widened=False).match(left, right, DISPARITIES)

    bench("disparities, 512 x 384, 64 levels", method, ours if method in MATCHERS else theirs)
