"""Views between two or three photographs: rectified, matched and interpolated (thesis, section 1.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.api import match_pair
from thesisrecon.arrays import F32, U8
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.geometry.two_view import epipoles, require_parallax
from thesisrecon.io.images import PhotographSet, read_photograph
from thesisrecon.records import DisparityMap, Image, TwoView
from thesisrecon.views.interpolation import (
    InterpolatedPair,
    check_monotonicity,
    other_side,
    pair_of_rectified,
    unsure,
)

COARSE = 4
"""Reduction at which the largest disparity of a rectified pair is looked for, up to half its width."""
LEAST_SIDE = 64
"""Smaller images are not reduced."""
SURE = 0.3
"""Confidence of disparities that tell the largest one."""
MIDWAY = 0.5


@dataclass(frozen=True)
class Film:
    """Pictures that are drawn when they are asked for: ``draw(k, threads)`` makes the one that
    ``captions[k]`` names (h, w, 3). ``notes`` are sentences about all of them, ``told`` numbers for other
    programs, in ``places`` those of each picture."""

    captions: tuple[str, ...]
    draw: Callable[[int, int], U8]
    notes: tuple[str, ...]
    told: dict[str, Any]
    places: tuple[dict[str, Any], ...]


def interpolate_view(
    left: Any,
    right: Any,
    s: float,
    *,
    disparity: DisparityMap | F32 | tuple[F32 | DisparityMap, F32 | DisparityMap] | None = None,
    config: PipelineConfig | None = None,
) -> U8:
    """The view between two rectified photographs (section 1.2, after Seitz and Dyer 1995).

    Parameters
    ----------
    left, right : files, or (H, W, 3) uint8 arrays of parallel cameras whose rows correspond.
    s : from 0, the left photograph, to 1, the right one.
    disparity : what is known of the left photograph's disparities (H, W), x_right = x_left - d, NaN =
        unknown; or of both sides', which knows better what only one of them sees. Matched where None, by
        ``config.dense``.

    Returns
    -------
    (H, W, 3) uint8, as a camera on the line between both would see it, its focal length in between. Where the
    scene is not monotonic nearer things hide farther ones; what neither photograph shows is filled from
    behind. For many views of one pair call :func:`thesisrecon.view_interpolation.rectified_pair` once.

    Raises
    ------
    ValueError : s outside [0, 1], photographs or disparities of different or impossible shape.
    StageFailure : files that cannot be read.
    """
    if not 0.0 <= s <= 1.0:
        raise ValueError(f"s is a place from 0 (the left photograph) to 1 (the right one); got {s}")
    return rectified_pair(left, right, disparity=disparity, config=config).view(s)


def rectified_pair(
    left: Any,
    right: Any,
    *,
    disparity: DisparityMap | F32 | tuple[F32 | DisparityMap, F32 | DisparityMap] | None = None,
    config: PipelineConfig | None = None,
) -> InterpolatedPair:
    """Two rectified photographs with all that views between them need; see :func:`interpolate_view`."""
    images = [_levels(side) for side in (left, right)]
    if images[0].shape != images[1].shape:
        raise ValueError(
            f"rectified photographs have one size; got {images[0].shape[:2]} and {images[1].shape[:2]}"
        )
    if disparity is None:
        maps = _matched_both_ways(images[0], images[1], config or PipelineConfig())
    elif isinstance(disparity, tuple):
        maps = _as_map(disparity[0]), _as_map(disparity[1])
    else:
        maps = _as_map(disparity), other_side(_as_map(disparity))
    return pair_of_rectified(images[0], images[1], maps)


def _levels(side: Any) -> U8:
    if not isinstance(side, np.ndarray):
        return named_photograph(side, max_size_px=int(np.iinfo(np.int32).max)).images[0].rgb
    if side.dtype != np.uint8 or side.ndim not in (2, 3) or (side.ndim == 3 and side.shape[2] != 3):
        raise ValueError(f"a photograph is a uint8 array (H, W, 3); got {side.dtype} {side.shape}")
    return side if side.ndim == 3 else np.repeat(side[:, :, None], 3, axis=2)


def _as_map(disparity: DisparityMap | F32) -> DisparityMap:
    if isinstance(disparity, DisparityMap):
        return disparity
    disparity = np.asarray(disparity, dtype=np.float32)
    if disparity.ndim != 2:
        raise ValueError(f"disparities are (H, W), or a tuple of two such maps; got {disparity.shape}")
    return unsure(disparity)


def _matched_both_ways(left: U8, right: U8, config: PipelineConfig) -> tuple[DisparityMap, DisparityMap]:
    """Disparities of the left photograph and of the right one; the latter is the left one of the mirror."""
    match = config.dense.match_rectified
    most = _largest_disparity(left, right, config)
    mirrored = match(_mirrored(right), _mirrored(left), max_disparity_px=most)
    back = DisparityMap(_mirrored(mirrored.disparity), _mirrored(mirrored.confidence), mirrored.sigma_px)
    return match(left, right, max_disparity_px=most), back


def _mirrored(image: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(image[:, ::-1])


def _largest_disparity(left: U8, right: U8, config: PipelineConfig) -> float:
    """About the largest disparity (px), with a margin, from the pair at a quarter of its size."""
    widest = 0.5 * float(left.shape[1])
    if min(left.shape[:2]) < LEAST_SIDE:
        return widest
    small = [_reduced(image) for image in (left, right)]
    found = config.dense.match_rectified(small[0], small[1], max_disparity_px=widest / COARSE)
    sure = found.disparity[np.isfinite(found.disparity) & (found.confidence > SURE)]
    if len(sure) == 0:
        return widest
    return min(widest, COARSE * (1.05 * float(np.quantile(sure, 0.999)) + 2.0))


def _reduced(image: U8) -> F32:
    """Means of blocks of ``COARSE`` x ``COARSE`` pixels, what is left over cut off."""
    height, width = (side // COARSE for side in image.shape[:2])
    blocks = image[: COARSE * height, : COARSE * width].reshape(height, COARSE, width, COARSE, 3)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def named_photograph(source: Any, *, max_size_px: int) -> PhotographSet:
    """One file, array or record at working size, as a set of one; :class:`UsageError` where there is no such
    file, :class:`StageFailure` where it cannot be read."""
    if isinstance(source, str | Path) and not Path(source).is_file():
        raise UsageError(f"there is no photograph {source}")
    return read_photograph(source, max_size_px=max_size_px)


def relate(
    first: Image, second: Image, *, config: PipelineConfig | None = None, seed: int = 0
) -> InterpolatedPair:
    """Two photographs of any pose with all that views between them need.

    Matched, F, rectified by homographies, matched densely either way. Raises :class:`UsageError` for the same
    photograph twice and photographs of different sizes; :class:`StageFailure` where they do not match, show
    no parallax, or where the camera moved towards what they show: then rows cannot be made of its epipolar
    lines, and no view lies between but one of the two, scaled.
    """
    config = config or PipelineConfig()
    _require_alike_in_size_only((first, second))
    pair = match_pair(first.rgb, second.rgb, config=config, seed=seed)
    _require_sideways(pair, first.size)
    try:
        dense = config.dense.match_two_views(first, second, pair.F, pair.xy1, pair.xy2, planar=True)
    except StageFailure as failure:
        if "polar" not in failure.advice:
            raise
        advice = "take them from places beside each other"
        raise StageFailure(failure.reason, failure.evidence, advice) from None
    H1, H2 = getattr(dense.frame, "H1", None), getattr(dense.frame, "H2", None)
    assert H1 is not None
    assert H2 is not None
    return InterpolatedPair((first.rgb, second.rgb), np.stack([H1, H2]), dense.left, dense.right)


def _require_alike_in_size_only(photographs: Sequence[Image]) -> None:
    for first, second in combinations(photographs, 2):
        if first.size != second.size:
            sizes = " and ".join(f"{one.name} is {one.size[0]} x {one.size[1]}" for one in (first, second))
            raise UsageError(f"views lie between photographs of one size; {sizes} px")
        if np.array_equal(first.rgb, second.rgb):
            raise UsageError(f"{first.name} and {second.name} are the same photograph; give different ones")


def _require_sideways(pair: TwoView, size: tuple[int, int]) -> None:
    for name, e in zip(("first", "second"), epipoles(pair.F), strict=True):
        if abs(e[2]) * max(size) <= 1e-9 * np.hypot(e[0], e[1]):
            continue
        x, y = e[:2] / e[2]
        if -0.5 <= x <= size[0] - 0.5 and -0.5 <= y <= size[1] - 0.5:
            # Without parallax F is any, and its epipoles are anywhere.
            require_parallax(pair.F, pair.xy1, pair.xy2)
            raise StageFailure(
                "there is no view between the photographs: the camera moved towards what they show, or away",
                f"one camera stands at ({x:.0f}, {y:.0f}) px of the {name} photograph",
                "take photographs from places beside each other",
            )


def interpolation_film(
    photographs: Sequence[Image], frames: int, *, config: PipelineConfig | None = None, seed: int = 0
) -> Film:
    """Views from the first photograph to the second; of three, half way to the second and from there across
    the triangle to the third.

    Raises as :func:`relate`; ``ValueError`` for another number of photographs and less than one frame.
    """
    if len(photographs) not in (2, 3) or frames < 1:
        raise ValueError(f"a film needs 2 or 3 photographs and a frame; got {len(photographs)} and {frames}")
    _require_alike_in_size_only(photographs)
    ways = np.linspace(0.0, 1.0, frames) if frames > 1 else np.array([MIDWAY])
    pair = relate(photographs[0], photographs[1], config=config, seed=seed)
    shares: list[tuple[float, ...]]
    if len(photographs) == 2:
        shares = [(1.0 - float(s), float(s)) for s in ways]
        legs, stops = [pair], [(0, float(s)) for s in ways]
    else:
        middle = Image("the view between", pair.view(MIDWAY), photographs[0].original_size)
        legs = [pair, relate(middle, photographs[2], config=config, seed=seed)]
        stops = [(0, float(u)) if u <= MIDWAY else (1, float(2.0 * u - 1.0)) for u in ways]
        shares = [
            (1 - s, s, 0.0) if leg == 0 else (MIDWAY * (1 - s), MIDWAY * (1 - s), s) for leg, s in stops
        ]

    def draw(k: int, threads: int) -> U8:
        leg, s = stops[k]
        return legs[leg].view(s, threads=threads)

    names = [image.name for image in photographs]
    monotonic = [check_monotonicity(leg.left.disparity) for leg in legs]
    told = {
        "photographs": names,
        "violating_monotonicity": [found.share for found in monotonic],
        "known": [leg.known for leg in legs],
    }
    captions = tuple(", ".join(f"{100 * a:.0f} % {n}" for a, n in zip(w, names, strict=True)) for w in shares)
    notes = tuple(_sentence(found.share, leg.known) for found, leg in zip(monotonic, legs, strict=True))
    return Film(captions, draw, notes, told, tuple({"shares": list(w)} for w in shares))


def _sentence(share: float, known: float) -> str:
    return (
        f"{100.0 * known:.0f} % of the pixels have a partner; {100.0 * share:.1f} % of these violate "
        "monotonicity, and there nearer things hide farther ones"
    )


def interpolate_three(
    photographs: Sequence[Image],
    weights: tuple[float, float, float],
    *,
    config: PipelineConfig | None = None,
    seed: int = 0,
) -> U8:
    """The view at a place of the triangle that three photographs span, by interpolating twice (section 1.2).

    First between two of them, then between what comes of it and the third. The picture is resampled twice and
    carries the errors of both.

    Parameters
    ----------
    photographs : three of one size.
    weights : barycentric, not negative, sum 1.

    Raises
    ------
    ValueError : other weights or numbers of photographs. UsageError, StageFailure : as :func:`relate`.
    """
    w = np.asarray(weights, dtype=np.float64)
    if len(photographs) != 3 or w.shape != (3,) or not (w >= 0.0).all() or abs(w.sum() - 1.0) > 1e-6:
        raise ValueError(f"weights of three photographs are not negative and sum to 1; got {weights}")
    first, second, third = photographs
    # What is left of the first two may be lost in rounding.
    if w[0] + w[1] <= 1e-6:
        return third.rgb.copy()
    s = float(w[1] / (w[0] + w[1]))
    rgb = {0.0: first.rgb, 1.0: second.rgb}.get(s)
    if rgb is None:
        rgb = relate(first, second, config=config, seed=seed).view(s)
    if w[2] <= 0.0:
        return rgb.copy()
    middle = Image("the view between", rgb, first.original_size)
    return relate(middle, third, config=config, seed=seed).view(float(w[2]))
