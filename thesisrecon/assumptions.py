"""What the user lets the pipeline assume of the cameras, as the stages take it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thesisrecon.config import IntrinsicsAssumption
from thesisrecon.types import F64, I64, FocalPrior


def camera_groups(original_sizes: Sequence[tuple[int, int]], cameras: str) -> I64:
    """(V,) camera numbers: one per distinct size of the originals ("shared"), or one per image
    ("per-image").
    """
    if cameras == "per-image":
        return np.arange(len(original_sizes), dtype=np.int64)
    distinct = list(dict.fromkeys(original_sizes))
    return np.array([distinct.index(size) for size in original_sizes], dtype=np.int64)


def focal_prior(wish: IntrinsicsAssumption, exif_focal_px: F64, scales: F64) -> FocalPrior | None:
    """What is known of the focal lengths at working size; None where nothing is, or nothing has a weight.

    exif_focal_px (V,) original px, NaN = not said; scales (V,) working over original size.
    """
    if wish.focal_std_rel is None or not (wish.exif or wish.focal_px is not None):
        return None
    focal = exif_focal_px if wish.focal_px is None else np.full(len(scales), wish.focal_px)
    return FocalPrior(focal * scales, wish.focal_std_rel) if np.isfinite(focal).any() else None


def prior_warnings(wish: IntrinsicsAssumption, exif_focal_px: F64) -> list[str]:
    """What the user must hear of a wish for EXIF focal lengths (V,) that the photographs cannot grant."""
    if not wish.exif or wish.focal_px is not None or not len(exif_focal_px):
        return []
    silent, total = int((~np.isfinite(exif_focal_px)).sum()), len(exif_focal_px)
    if silent == total:
        return [f"none of the {total} photographs names its focal length; no prior was used"]
    if silent:
        return [f"{silent} of the {total} photographs name no focal length and have no prior"]
    return []
