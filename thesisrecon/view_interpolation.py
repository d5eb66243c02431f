"""Views between two or three images: rectified, matched and interpolated (thesis, section 1.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from thesisrecon.arrays import F32, U8
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.geometry.two_view import epipoles, require_parallax_of_matches
from thesisrecon.io.images import read_image
from thesisrecon.pipeline.features_to_tracks import match_pair
from thesisrecon.records import DisparityMap, Image, TwoView
from thesisrecon.stereo.semi_global import match_both_sides
from thesisrecon.views.interpolation import (
    InterpolatedPair,
    check_monotonicity,
    disparity_of_right,
    pair_from_rectified,
    with_full_confidence,
)

_COARSE = 4
"""Reduction at which the largest disparity of a rectified pair is searched, up to half its width."""
_MIN_SIDE = 64
"""Smaller images are not reduced."""
_MIN_CONFIDENCE = 0.3
"""Of the disparities that determine the largest one."""
_MIDWAY = 0.5
_MIDDLE_NAME = "the interpolated view"


@dataclass(frozen=True)
class ViewSequence:
    """Views that are computed on demand.

    Parameters
    ----------
    captions : tuple of str
        One per view.
    draw : callable
        Takes the number of a view and of threads; returns (H, W, 3) uint8.
    notes : tuple of str
        Sentences about the whole sequence, without full stops.
    metadata : dict
        Numbers about the whole sequence, for ``frames.json``.
    frame_metadata : tuple of dict
        Numbers about each view.
    """

    captions: tuple[str, ...]
    draw: Callable[[int, int], U8]
    notes: tuple[str, ...]
    metadata: dict[str, Any]
    frame_metadata: tuple[dict[str, Any], ...]


def interpolate_view(
    left: Any,
    right: Any,
    s: float,
    *,
    disparity: DisparityMap | F32 | tuple[F32 | DisparityMap, F32 | DisparityMap] | None = None,
    config: PipelineConfig | None = None,
) -> U8:
    """Interpolate the view between two rectified images.

    Parameters
    ----------
    left, right : str, Path or ndarray (H, W, 3) uint8
        Images of parallel cameras with corresponding rows.
    s : float
        Position on the baseline, from 0 (left image) to 1 (right image).
    disparity : ndarray (H, W), DisparityMap or tuple of both sides, optional
        Disparities of the left image, x_right = x_left - d, NaN = unknown; those of the right image add what
        only it shows. Matched by ``config.dense`` if None.
    config : PipelineConfig, optional
        The default configuration if None.

    Returns
    -------
    ndarray (H, W, 3) uint8
        The view of a camera on the baseline, with an interpolated focal length. Near surfaces occlude far
        ones where the scene violates monotonicity; regions that neither image shows are filled from behind.

    Raises
    ------
    ValueError
        If ``s`` is outside [0, 1], or images or disparities differ in shape.
    UsageError, StageFailure
        If a file does not exist or cannot be read.

    Notes
    -----
    For many views of one pair call :func:`prepare_rectified_pair` once.

    References
    ----------
    Thesis, section 1.2; S. Seitz and C. Dyer, "Physically-valid view synthesis by image interpolation", 1995.

    Examples
    --------
    >>> import numpy as np
    >>> import thesisrecon
    >>> left = np.arange(32 * 32 * 3, dtype=np.uint8).reshape(32, 32, 3)
    >>> view = thesisrecon.interpolate_view(left, left, 0.5, disparity=np.zeros((32, 32), np.float32))
    >>> np.array_equal(view, left)
    True
    """
    if not 0.0 <= s <= 1.0:
        raise ValueError(f"s must be between 0 (left image) and 1 (right image); got {s}")
    return prepare_rectified_pair(left, right, disparity=disparity, config=config).view(s)


def prepare_rectified_pair(
    left: Any,
    right: Any,
    *,
    disparity: DisparityMap | F32 | tuple[F32 | DisparityMap, F32 | DisparityMap] | None = None,
    config: PipelineConfig | None = None,
) -> InterpolatedPair:
    """Prepare two rectified images for any number of views between them.

    Parameters
    ----------
    left, right, disparity, config
        As in :func:`interpolate_view`.

    Returns
    -------
    InterpolatedPair
        Its ``view(s)`` interpolates.

    Raises
    ------
    ValueError
        If the images differ in size or the disparities in shape.
    """
    images = [_pixels(side) for side in (left, right)]
    if images[0].shape != images[1].shape:
        raise ValueError(
            f"rectified images must have one size; got {images[0].shape[:2]} and {images[1].shape[:2]}"
        )
    if disparity is None:
        maps = _matched_both_ways(images[0], images[1], config or PipelineConfig())
    elif isinstance(disparity, tuple):
        maps = _as_map(disparity[0]), _as_map(disparity[1])
    else:
        maps = _as_map(disparity), disparity_of_right(_as_map(disparity))
    return pair_from_rectified(images[0], images[1], maps)


def _pixels(side: Any) -> U8:
    if not isinstance(side, np.ndarray):
        return read_image(side, max_size_px=int(np.iinfo(np.int32).max)).images[0].rgb
    if side.dtype != np.uint8 or side.ndim not in (2, 3) or (side.ndim == 3 and side.shape[2] != 3):
        raise ValueError(f"an image must be a uint8 array (H, W, 3); got {side.dtype} {side.shape}")
    return side if side.ndim == 3 else np.repeat(side[:, :, None], 3, axis=2)


def _as_map(disparity: DisparityMap | F32) -> DisparityMap:
    if isinstance(disparity, DisparityMap):
        return disparity
    disparity = np.asarray(disparity, dtype=np.float32)
    if disparity.ndim != 2:
        raise ValueError(f"disparities must be (H, W), or a tuple of two such maps; got {disparity.shape}")
    return with_full_confidence(disparity)


def _matched_both_ways(left: U8, right: U8, config: PipelineConfig) -> tuple[DisparityMap, DisparityMap]:
    most = _largest_disparity(left, right, config)
    match = partial(config.dense.match_rectified, max_disparity_px=most)
    return match_both_sides(match, left, right)


def _largest_disparity(left: U8, right: U8, config: PipelineConfig) -> float:
    """Estimate the largest disparity (px), with a margin, from the pair at a quarter of its size."""
    widest = 0.5 * float(left.shape[1])
    if min(left.shape[:2]) < _MIN_SIDE:
        return widest
    small = [_reduced(image) for image in (left, right)]
    found = config.dense.match_rectified(small[0], small[1], max_disparity_px=widest / _COARSE)
    sure = found.disparity[np.isfinite(found.disparity) & (found.confidence > _MIN_CONFIDENCE)]
    if len(sure) == 0:
        return widest
    return min(widest, _COARSE * (1.05 * float(np.quantile(sure, 0.999)) + 2.0))


def _reduced(image: U8) -> F32:
    """Average blocks of ``_COARSE`` x ``_COARSE`` pixels; incomplete blocks are cut off."""
    height, width = (side // _COARSE for side in image.shape[:2])
    blocks = image[: _COARSE * height, : _COARSE * width].reshape(height, _COARSE, width, _COARSE, 3)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def prepare_pair(
    first: Image, second: Image, *, config: PipelineConfig | None = None, seed: int = 0
) -> InterpolatedPair:
    """Match and rectify two images of any pose for any number of views between them.

    Sparse matching, F, rectification by homographies and dense matching in both directions.

    Parameters
    ----------
    first, second : Image
        Images of one size.
    config : PipelineConfig, optional
        The default configuration if None.
    seed : int
        Random seed.

    Returns
    -------
    InterpolatedPair
        Its ``view(s)`` interpolates.

    Raises
    ------
    UsageError
        If the images are the same or differ in size.
    StageFailure
        If the images do not match, show no parallax, or the camera moved forwards: epipolar lines then cannot
        become rows, and every view in between is one of the images, scaled.
    """
    config = config or PipelineConfig()
    _check_images((first, second))
    pair = match_pair(first.rgb, second.rgb, config=config, seed=seed)
    _require_sideways_motion(pair, (first, second))
    try:
        dense = config.dense.match_two_views(first, second, pair.F, pair.xy1, pair.xy2, planar=True)
    except StageFailure as failure:
        if "polar" not in failure.advice:
            raise
        advice = "take the images side by side, not one behind the other"
        raise StageFailure(failure.reason, failure.evidence, advice) from None
    H1, H2 = getattr(dense.frame, "H1", None), getattr(dense.frame, "H2", None)
    assert H1 is not None
    assert H2 is not None
    return InterpolatedPair((first.rgb, second.rgb), np.stack([H1, H2]), dense.left, dense.right)


def _check_images(images: Sequence[Image]) -> None:
    """Require images of one size and of different content."""
    for first, second in combinations(images, 2):
        if first.size != second.size:
            sizes = " and ".join(f"{one.name} is {one.size[0]} x {one.size[1]}" for one in (first, second))
            raise UsageError(f"interpolation needs images of one size; {sizes} px")
        if np.array_equal(first.rgb, second.rgb):
            raise UsageError(f"{first.name} and {second.name} are the same image; give different ones")


def _require_sideways_motion(pair: TwoView, images: tuple[Image, Image]) -> None:
    """Refuse a pair with an epipole inside an image."""
    size = images[0].size
    for image, e in zip(images, epipoles(pair.F), strict=True):
        if abs(e[2]) * max(size) <= 1e-9 * np.hypot(e[0], e[1]):
            continue
        x, y = e[:2] / e[2]
        if -0.5 <= x <= size[0] - 0.5 and -0.5 <= y <= size[1] - 0.5:
            # Without parallax F is not unique, and neither are its epipoles.
            require_parallax_of_matches(pair.F, pair.xy1, pair.xy2)
            raise StageFailure(
                "there is no view between the images: the camera moved towards the scene or away from it",
                f"the epipole lies at ({x:.0f}, {y:.0f}) px, inside {image.name}",
                "take the images side by side, not one behind the other",
            )


def interpolated_sequence(
    images: Sequence[Image], frames: int, *, config: PipelineConfig | None = None, seed: int = 0
) -> ViewSequence:
    """Interpolate from the first image to the second and, of three, across their triangle.

    With three images the path leads half way to the second image and from there to the third.

    Parameters
    ----------
    images : sequence of Image
        Two or three images of one size.
    frames : int
        Number of views.
    config : PipelineConfig, optional
        The default configuration if None.
    seed : int
        Random seed.

    Returns
    -------
    ViewSequence
        The views.

    Raises
    ------
    ValueError
        For another number of images, or fewer than one frame.
    UsageError, StageFailure
        As :func:`prepare_pair`.
    """
    if len(images) not in (2, 3) or frames < 1:
        raise ValueError(f"a sequence needs 2 or 3 images and a frame; got {len(images)} and {frames}")
    _check_images(images)
    path = np.linspace(0.0, 1.0, frames) if frames > 1 else np.array([_MIDWAY])
    pair = prepare_pair(images[0], images[1], config=config, seed=seed)
    weights: list[tuple[float, ...]]
    if len(images) == 2:
        weights = [(1.0 - float(s), float(s)) for s in path]
        legs, stops = [pair], [(0, float(s)) for s in path]
    else:
        middle = Image(_MIDDLE_NAME, pair.view(_MIDWAY), images[0].original_size)
        legs = [pair, prepare_pair(middle, images[2], config=config, seed=seed)]
        stops = [(0, float(u)) if u <= _MIDWAY else (1, float(2.0 * u - 1.0)) for u in path]
        weights = [
            (1 - s, s, 0.0) if leg == 0 else (_MIDWAY * (1 - s), _MIDWAY * (1 - s), s) for leg, s in stops
        ]

    def draw(k: int, threads: int) -> U8:
        leg, s = stops[k]
        return legs[leg].view(s, threads=threads)

    names = [image.name for image in images]
    violations = [check_monotonicity(leg.left.disparity).share for leg in legs]
    metadata = {
        "images": names,
        "violating_monotonicity": violations,
        "known": [leg.known for leg in legs],
    }
    captions = tuple(
        ", ".join(f"{100 * a:.0f} % {n}" for a, n in zip(w, names, strict=True)) for w in weights
    )
    notes = tuple(
        f"{100.0 * leg.known:.0f} % of the pixels have a correspondence; {100.0 * share:.1f} % of these "
        "violate monotonicity, where near surfaces occlude far ones"
        for share, leg in zip(violations, legs, strict=True)
    )
    return ViewSequence(captions, draw, notes, metadata, tuple({"weights": list(w)} for w in weights))


def interpolate_three(
    images: Sequence[Image],
    weights: tuple[float, float, float],
    *,
    config: PipelineConfig | None = None,
    seed: int = 0,
) -> U8:
    """Interpolate a view inside the triangle of three images by interpolating twice (section 1.2).

    First between two images, then between the result and the third. The pixels are resampled twice, and the
    errors of both steps add up.

    Parameters
    ----------
    images : sequence of Image
        Three images of one size.
    weights : tuple of float
        Barycentric coordinates: not negative, sum 1.
    config : PipelineConfig, optional
        The default configuration if None.
    seed : int
        Random seed.

    Returns
    -------
    ndarray (H, W, 3) uint8
        The view.

    Raises
    ------
    ValueError
        For other weights or numbers of images.
    UsageError, StageFailure
        As :func:`prepare_pair`.
    """
    w = np.asarray(weights, dtype=np.float64)
    if len(images) != 3 or w.shape != (3,) or not (w >= 0.0).all() or abs(w.sum() - 1.0) > 1e-6:
        raise ValueError(f"weights of three images must not be negative and must sum to 1; got {weights}")
    first, second, third = images
    # Below this the weights of the first two images are rounding.
    if w[0] + w[1] <= 1e-6:
        return third.rgb.copy()
    s = float(w[1] / (w[0] + w[1]))
    rgb = {0.0: first.rgb, 1.0: second.rgb}.get(s)
    if rgb is None:
        rgb = prepare_pair(first, second, config=config, seed=seed).view(s)
    if w[2] <= 0.0:
        return rgb.copy()
    middle = Image(_MIDDLE_NAME, rgb, first.original_size)
    return prepare_pair(middle, third, config=config, seed=seed).view(float(w[2]))
