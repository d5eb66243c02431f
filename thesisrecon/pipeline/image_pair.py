"""Features, matches and epipolar geometry of two images: 4.2.1, 4.2.2 and chapter 5."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon.arrays import B8
from thesisrecon.config import KINDS, PipelineConfig
from thesisrecon.config.plug_ins import FunctionMatcher, matches_of
from thesisrecon.errors import StageFailure
from thesisrecon.matching._prepared import select_found
from thesisrecon.pipeline.run import stream
from thesisrecon.records import Features, Image, Matches, Seeds, TwoView

OWN_MATCHERS = {*KINDS["matching"].values(), FunctionMatcher}
ImageInput = str | Path | ArrayLike | Image
"""A file, an array of levels (H, W), (H, W, 3) or (H, W, 4), a Pillow image, or an :class:`Image`."""
MASK_REACH = 4.0  # half width, in pixels of its scale, of the window that determines the position of a corner


def match_images(config: PipelineConfig, images: tuple[Image, Image], seed: int) -> TwoView:
    """Match two images; if they do not match, again with seeds of simulated oblique views."""
    views = [config.matching.prepare(image, detect_features(config, image)) for image in images]
    masks = images[0].mask, images[1].mask
    pair = match_views(config, views[0], views[1], (0, 1), seed, masks)
    if pair.accepted or not oblique_pairs(config):
        return pair
    features = [view.features for view in views]
    views = [prepare_oblique(config, *given) for given in zip(images, features, strict=True)]
    again = match_views(config, views[0], views[1], (0, 1), seed, masks)
    return again if again.accepted else pair


def detect_features(config: PipelineConfig, image: Image) -> Features:
    """Detect the features of an image; those with a masked pixel within ``MASK_REACH`` are dropped."""
    found, clear = config.features.detect(image), _distance_to_mask(image)
    corners: Features = _unmasked(found, clear)
    return corners if found.seeds is None else replace(corners, seeds=_unmasked(found.seeds, clear))


def oblique_pairs(config: PipelineConfig) -> int:
    """Number of pairs of an image that are matched again with seeds of simulated oblique views."""
    wanted: int = getattr(config.matching, "oblique_pairs", 0)
    return wanted if getattr(config.features, "oblique_tilts", ()) else 0


def prepare_oblique(config: PipelineConfig, image: Image, features: Features) -> Any:
    """Prepare an image for matching with seeds of simulated oblique views."""
    found: Seeds = config.features.oblique_seeds(image)  # type: ignore[attr-defined]
    seeds = _unmasked(found, _distance_to_mask(image))
    return config.matching.prepare(image, replace(features, oblique=seeds))


def _distance_to_mask(image: Image) -> Any:
    """Distance (H, W) px of each pixel to the nearest masked one; None without a mask."""
    if image.mask is None or image.mask.all():
        return None
    return scipy.ndimage.distance_transform_cdt(image.mask, "chessboard")


def _unmasked(found: Any, clear: Any) -> Any:
    if clear is None:
        return found
    return select_found(found, values_at(clear, found.xy) > MASK_REACH * found.scale)


def values_at(pixels: Any, xy: Any) -> Any:
    """Values (N,) of an array (H, W) at the nearest pixels."""
    x, y = (np.clip(np.rint(xy[:, k]).astype(np.int64), 0, pixels.shape[1 - k] - 1) for k in (0, 1))
    return pixels[y, x]


def match_views(
    config: PipelineConfig, view1: Any, view2: Any, pair: tuple[int, int], seed: int,
    masks: tuple[B8 | None, B8 | None] = (None, None),
) -> TwoView:  # fmt: skip
    """Match two prepared views, estimate F and verify it; a pair without F is rejected with a reason."""
    rng = stream(seed, "matches", *pair)
    try:
        estimate = config.epipolar.estimate
        matches = config.matching.match(view1, view2, pair=pair, estimate_fundamental=estimate, rng=rng)
        if type(config.matching) not in OWN_MATCHERS:
            matches = matches_of(config.matching, matches, pair, (view1, view2))
    except StageFailure as failure:
        return _rejected_pair(pair, 0, str(failure))
    for mask, side in zip(masks, ("xy1", "xy2"), strict=True):
        if mask is not None:
            matches = select_found(matches, values_at(mask, getattr(matches, side)))
    return verify_matches(config, matches, rng)


def verify_matches(config: PipelineConfig, matches: Matches, rng: np.random.Generator) -> TwoView:
    """Estimate F of matches and verify them; a pair without F is rejected with a reason."""
    try:
        fit = config.epipolar.estimate(matches.xy1, matches.xy2, rng)
        return config.verification.verify(matches, fit, rng)
    except StageFailure as failure:
        return _rejected_pair((matches.i, matches.j), len(matches.xy1), str(failure))


def _rejected_pair(pair: tuple[int, int], candidates: int, reason: str) -> TwoView:
    index, xy, nan = np.zeros(0, dtype=np.int64), np.zeros((0, 2)), float("nan")
    F, affine = np.zeros((3, 3)), np.zeros((0, 2, 2))
    return TwoView(*pair, F, nan, index, index, xy, xy, affine, candidates, nan, False, reason)
