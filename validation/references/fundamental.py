"""F and triangulation by OpenCV, COLMAP, PoseLib and other estimators and by ours, each with one signature.

Every method gets the matches in an order that the seed draws: OpenCV's generators start from a fixed state.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.api.pairs import estimate_fundamental
from thesisrecon.arrays import F64
from thesisrecon.epipolar.ransac import ThesisRansac, estimate_eight_point, estimate_seven_point
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals
from validation.references.libraries import INSTALLED, cv2, load, poselib, pycolmap

BoolArray = NDArray[np.bool_]
Answer = tuple[Any, Any]
OURS, THESIS = "ours", "ours (thesis)"
LINEAR, MINIMAL = "ours (eight points)", "ours (seven points)"
CONFIDENCE, ITERATIONS = 0.9999, 20000  # Settings of OpenCV instead of its defaults (0.99 and 1000)
Solver = Callable[[F64, F64, float, int], Answer]


def _own(xy1: F64, xy2: F64, threshold_px: float, seed: int, *, thesis: bool) -> Answer:
    try:
        if thesis:
            fit = ThesisRansac(threshold_px=threshold_px).estimate(xy1, xy2, np.random.default_rng(seed))
        else:
            fit = estimate_fundamental(xy1, xy2, threshold_px=threshold_px, seed=seed)
    except StageFailure:
        return None, None
    return fit.F, fit.inliers


_ours, _thesis = partial(_own, thesis=False), partial(_own, thesis=True)


def _eight_points(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> Answer:
    """Estimate from the inliers of the library function, as the method has no outlier test."""
    _, right = _ours(xy1, xy2, threshold_px, seed)
    return (None, None) if right is None else (estimate_eight_point(xy1[right], xy2[right]), right)


def _seven_points(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> Answer:
    """Return the first of up to three matrices through seven inliers of the library function."""
    _, right = _ours(xy1, xy2, threshold_px, seed)
    if right is None:
        return None, None
    some = np.random.default_rng(seed).choice(np.flatnonzero(right), 7, replace=False)
    found = estimate_seven_point(xy1[some], xy2[some])
    return (found[0], right) if len(found) else (None, None)


def _opencv(method: str) -> Solver:
    def solve(xy1: F64, xy2: F64, threshold_px: float, _: int) -> Answer:
        kind = getattr(cv2, method)
        return cv2.findFundamentalMat(xy1, xy2, kind, threshold_px, CONFIDENCE, ITERATIONS)

    return solve


def opencv_eight_point(xy1: F64, xy2: F64) -> F64 | None:
    """``cv2.findFundamentalMat`` by its normalised eight-point method, of all matches (N, 2) px."""
    F = cv2.findFundamentalMat(xy1, xy2, cv2.FM_8POINT)[0]
    return None if F is None else np.asarray(F, dtype=np.float64)


def _colmap(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> Answer:
    settings = pycolmap.RANSACOptions(max_error=threshold_px, random_seed=seed)
    found = pycolmap.estimate_fundamental_matrix(xy1, xy2, settings)
    return (None, None) if found is None else (found["F"], found["inlier_mask"])


def _poselib(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> Answer:
    F, mask = poselib.estimate_fundamental(xy1, xy2, {"max_epipolar_error": threshold_px, "seed": seed}, {})
    return F, mask["inliers"]


def _degensac(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> Answer:
    find = load("pydegensac").findFundamentalMatrix
    F, mask = find(xy1, xy2, threshold_px, CONFIDENCE, ITERATIONS, seed=seed)
    return F, mask


def _of_both_images(library: str, xy1: F64, xy2: F64, **settings: Any) -> Answer:
    """F by a library that takes the matches (N, 4) and the sizes of the images, here those of the matches."""
    (width1, height1), (width2, height2) = np.ceil(xy1.max(axis=0)) + 1.0, np.ceil(xy2.max(axis=0)) + 1.0
    sizes = (width1, height1, width2, height2)
    if library == "pygcransac":
        sizes = (int(height1), int(width1), int(height2), int(width2))
    given = {"probabilities": np.empty(0), "conf": CONFIDENCE, "max_iters": ITERATIONS, "sampler": 0}
    F, mask = load(library).findFundamentalMatrix(np.hstack([xy1, xy2]), *sizes, **given, **settings)
    return F, mask


def _magsac(xy1: F64, xy2: F64, threshold_px: float, _: int) -> Answer:
    return _of_both_images("pymagsac", xy1, xy2, sigma_th=threshold_px)


def _gcransac(xy1: F64, xy2: F64, threshold_px: float, _: int) -> Answer:
    F = _of_both_images("pygcransac", xy1, xy2, threshold=threshold_px)[0]  # its mask holds all matches
    return F, None if F is None else np.abs(sampson_residuals(F, xy1, xy2)) < threshold_px


def _superansac(xy1: F64, xy2: F64, threshold_px: float, _: int) -> Answer:
    library = load("pysuperansac")
    settings = library.RANSACSettings()
    settings.inlier_threshold, settings.confidence = threshold_px, CONFIDENCE
    settings.max_iterations = ITERATIONS
    # The order that a seed draws says nothing of the quality of the matches.
    settings.sampler = library.SamplerType.Uniform
    sizes = [*(xy1.max(axis=0) + 1.0), *(xy2.max(axis=0) + 1.0)]
    F, right, _, _ = library.estimateFundamentalMatrix(np.hstack([xy1, xy2]), sizes, config=settings)
    mask = np.zeros(len(xy1), dtype=bool)
    mask[right] = True
    return F, mask


SOLVERS: dict[str, Solver] = {
    OURS: _ours,
    THESIS: _thesis,
    LINEAR: _eight_points,
    MINIMAL: _seven_points,
    **{name: _opencv(name) for name in ("USAC_ACCURATE", "USAC_MAGSAC", "FM_RANSAC", "FM_LMEDS")},
    "COLMAP": _colmap,
    "PoseLib": _poselib,
}  # All methods by name: with ``CONFIDENCE`` and ``ITERATIONS``, COLMAP and PoseLib as they come
_MORE = {"DEGENSAC": _degensac, "MAGSAC++": _magsac, "GC-RANSAC": _gcransac, "SupeRANSAC": _superansac}
SOLVERS |= {name: _MORE[name] for name in INSTALLED}


def estimate_with(
    method: str, xy1: F64, xy2: F64, *, threshold_px: float, seed: int
) -> tuple[F64 | None, BoolArray]:
    """F (3, 3), None if the method gave none, and inliers (N,) as the method reports them, of matches (N, 2)
    px by one of ``SOLVERS``; never raises for hard data.
    """
    order = np.random.default_rng(seed).permutation(len(xy1))
    some1, some2 = np.ascontiguousarray(xy1[order]), np.ascontiguousarray(xy2[order])
    F, mask = SOLVERS[method](some1, some2, threshold_px, seed)
    inliers = np.zeros(len(xy1), dtype=bool)
    F = None if F is None else np.asarray(F, dtype=np.float64)
    # OpenCV returns nothing, zeros or three stacked matrices on failure.
    if F is None or F.shape != (3, 3) or not np.isfinite(F).all() or not F.any():
        return None, inliers
    inliers[order] = np.asarray(mask).ravel() > 0
    return F, inliers


def opencv_linear(P: F64, xy: F64) -> F64:
    """``cv2.triangulatePoints``: the linear method of two views, its rows as they come."""
    found = cv2.triangulatePoints(P[0], P[1], xy[0].T.copy(), xy[1].T.copy())
    return np.asarray(found.T, dtype=np.float64)


def opencv_polynomial(P: F64, xy: F64) -> F64:
    """``cv2.correctMatches`` (Hartley and Sturm's polynomial), then ``cv2.triangulatePoints``."""
    F = fundamental_from_cameras(P[0], P[1])
    x1, x2 = cv2.correctMatches(F, xy[0][None], xy[1][None])
    return opencv_linear(P, np.stack([np.asarray(x1)[0], np.asarray(x2)[0]]).astype(np.float64))


def colmap_points(P: F64, xy: F64) -> F64:
    """``pycolmap.triangulate_point`` of two views, ``triangulate_multi_view_point`` of more, point by point.
    COLMAP needs normalised image points, so pixels and cameras are normalised together. Points that it
    refuses come out as zeros.
    """
    scale, middle = 1e-3, xy.mean(axis=1)
    T = np.zeros((len(P), 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2], T[:, 2, 2] = -scale * middle, 1.0
    cameras, moved = T @ P, (xy - middle[:, None]) * scale
    rays = np.concatenate([moved, np.ones((*moved.shape[:2], 1))], axis=2)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    X = np.zeros((xy.shape[1], 4))
    of_two, of_many = pycolmap.triangulate_point, pycolmap.triangulate_multi_view_point
    for n in range(xy.shape[1]):
        if len(P) == 2:
            found = of_two(cameras[0], cameras[1], moved[0, n], moved[1, n])
        else:
            found = of_many(list(cameras), rays[:, n])
        if found is not None:
            X[n] = [*np.asarray(found), 1.0]
    return X
