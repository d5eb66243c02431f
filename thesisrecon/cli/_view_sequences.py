"""Sequences of views between images, as the command ``interpolate`` writes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thesisrecon.arrays import U8
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError
from thesisrecon.records import Image
from thesisrecon.view_interpolation import prepare_pair, require_comparable_images
from thesisrecon.view_synthesis import match_images, prepare_trilinear_views
from thesisrecon.views.interpolation import InterpolatedPair, detect_monotonicity_violations
from thesisrecon.views.trilinear import camera_at

_MIDWAY = 0.5
_BEYOND = 0.5
"""Baselines by which a sequence of the tensor extends beyond either camera."""


@dataclass(frozen=True)
class ViewSequence:
    """Views that are computed on demand, with numbers for ``frames.json``.

    ``draw`` takes the number of a view and of threads; ``notes`` are sentences about the whole sequence.
    """

    captions: tuple[str, ...]
    draw: Callable[[int, int], U8]
    notes: tuple[str, ...]
    metadata: dict[str, Any]
    frame_metadata: tuple[dict[str, Any], ...]


def interpolated_sequence(
    images: Sequence[Image], frames: int, *, config: PipelineConfig, seed: int
) -> ViewSequence:
    """Interpolate from the first image to the second and, of three, across their triangle (section 1.2).

    With three images the path leads half way to the second image and from there to the third: the view half
    way is matched with the third image, so its pixels are resampled twice.
    """
    require_comparable_images(images)
    path = np.linspace(0.0, 1.0, frames) if frames > 1 else np.array([_MIDWAY])
    pair = prepare_pair(images[0], images[1], config=config, seed=seed)
    weights: list[tuple[float, ...]]
    if len(images) == 2:
        weights = [(1.0 - float(s), float(s)) for s in path]
        legs, stops = [pair], [(0, float(s)) for s in path]
    else:
        middle = Image("the interpolated view", pair.view(_MIDWAY), images[0].original_size)
        legs = [pair, prepare_pair(middle, images[2], config=config, seed=seed)]
        stops = [(0, float(u)) if u <= _MIDWAY else (1, float(2.0 * u - 1.0)) for u in path]
        weights = [
            (1 - s, s, 0.0) if leg == 0 else (_MIDWAY * (1 - s), _MIDWAY * (1 - s), s) for leg, s in stops
        ]

    def draw(k: int, threads: int) -> U8:
        leg, s = stops[k]
        return legs[leg].view(s, threads=threads)

    names = [image.name for image in images]
    violations = [_violating(leg) for leg in legs]
    metadata = {"images": names, "violating_monotonicity": violations, "known": [leg.known for leg in legs]}
    captions = tuple(
        ", ".join(f"{100 * a:.0f} % {n}" for a, n in zip(w, names, strict=True)) for w in weights
    )
    notes = tuple(
        f"{100.0 * leg.known:.0f} % of the pixels have a correspondence; {100.0 * share:.1f} % of these "
        "violate monotonicity, where near surfaces occlude far ones"
        for share, leg in zip(violations, legs, strict=True)
    )
    return ViewSequence(captions, draw, notes, metadata, tuple({"weights": list(w)} for w in weights))


def _violating(pair: InterpolatedPair) -> float:
    """Share of the known pixels of the first image that violate monotonicity."""
    disparity = pair.left.disparity
    known = max(int(np.isfinite(disparity).sum()), 1)
    return float(detect_monotonicity_violations(disparity).sum() / known)


def trilinear_sequence(
    images: Sequence[Image], frames: int, *, config: PipelineConfig, seed: int
) -> ViewSequence:
    """Compute views on the line through both cameras, from half a baseline before to half beyond."""
    if len(images) != 2:
        raise UsageError(f"the trilinear tensor takes 2 images; got {len(images)}")
    first, second = images
    if np.array_equal(first.rgb, second.rgb):
        raise UsageError(f"{first.name} and {second.name} are the same image; give different ones")
    matched = match_images(first, second, config=config, seed=seed)
    views = prepare_trilinear_views(matched, config=config)
    pair, sizes = views.pair, (first.size, second.size)
    positions = np.linspace(-_BEYOND, 1.0 + _BEYOND, frames).tolist() if frames > 1 else [_MIDWAY]
    path = [camera_at(pair, s, sizes=sizes) for s in positions]
    metadata = {
        "images": [first.name, second.name],
        "K": [pair.K1, pair.K2],
        "second_from_first": {"R": pair.R, "t": pair.t},
    }
    frame_metadata = tuple(
        {"baselines": s, "R": camera.rotation, "t": camera.translation, "K": camera.K}
        for s, camera in zip(positions, path, strict=True)
    )
    captions = tuple(_caption(s, first.name, second.name) for s in positions)
    note = (
        f"the focal lengths are assumed to be {pair.K1[0, 0]:.0f} and {pair.K2[0, 0]:.0f} px; lengths are in "
        "units of the distance between the two cameras"
    )
    return ViewSequence(
        captions, lambda k, threads: views.render(path[k], threads=threads), (note,), metadata, frame_metadata
    )


def _caption(s: float, first: str, second: str) -> str:
    if s < 0.0:
        return f"{-s:.2f} baselines before {first}"
    if s > 1.0:
        return f"{s - 1.0:.2f} baselines beyond {second}"
    return f"{100.0 * s:.0f} % of the way from {first} to {second}"
