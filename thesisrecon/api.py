"""One stage at a time: the front doors beside :func:`thesisrecon.reconstruct`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from thesisrecon.config import PipelineConfig, with_images
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import prior_for
from thesisrecon.io.images import read_image
from thesisrecon.pipeline.features_to_tracks import detect_features, match_views
from thesisrecon.records import DisparityMap, Image, Reconstruction, SelfCalibration, TwoView
from thesisrecon.runtime.run import stream


def match_pair(image1: Any, image2: Any, *, config: PipelineConfig | None = None, seed: int = 0) -> TwoView:
    """Verified matches and F of two photographs (files or uint8 arrays), in pixels at working size.

    Raises :class:`StageFailure` where one of them cannot be read or they do not match.
    """
    config = config or PipelineConfig()
    photographs = [
        read_image(image, max_size_px=config.images.max_size_px).images[0] for image in (image1, image2)
    ]
    views = [config.matching.prepare(image, detect_features(config, image)) for image in photographs]
    pair = match_views(config, views[0], views[1], (0, 1), seed)
    if not pair.accepted:
        raise StageFailure("the two photographs do not match", pair.reason)
    return pair


def match_rectified(
    left: Any, right: Any, *, max_disparity_px: float, config: PipelineConfig | None = None
) -> DisparityMap:
    """Disparities of a rectified pair: files, or arrays (H, W) or (H, W, 3) of levels 0 to 255, NaN = no
    pixel.

    By the matcher of ``config.dense.pairs``; x_right = x_left - d with d from 0 to ``max_disparity_px``.
    Files are taken at their own size. Raises :class:`StageFailure` for a file that cannot be read,
    ``ValueError`` for sizes that differ.
    """
    images = [side if isinstance(side, np.ndarray) else _full_size(side) for side in (left, right)]
    dense = (config or PipelineConfig()).dense
    return dense.match_rectified(images[0], images[1], max_disparity_px=max_disparity_px)


def _full_size(path: Any) -> Any:
    return read_image(path, max_size_px=np.iinfo(np.int32).max).images[0].rgb


def self_calibrate(
    reconstruction: Reconstruction,
    *,
    config: PipelineConfig | None = None,
    photographs: Sequence[Image] = (),
    seed: int = 0,
) -> SelfCalibration:
    """The metric frame and the intrinsics of a projective reconstruction (chapter 7).

    Cameras of one image size are taken for one camera, unless ``config.intrinsics.cameras`` says otherwise.
    ``photographs``, one per view, are what a variant looks at that finds parallel lines in them. Raises
    ``ValueError`` for a reconstruction of another stratum, :class:`StageFailure` where the views do not
    determine a calibration.
    """
    if reconstruction.stratum != "projective":
        raise ValueError(f"self_calibrate takes a projective reconstruction; got {reconstruction.stratum}")
    config = config or PipelineConfig()
    variant = with_images(config.selfcalibration, photographs) if photographs else config.selfcalibration
    prior = prior_for(reconstruction, config.intrinsics)
    return variant.calibrate(reconstruction, prior=prior, rng=stream(seed, "selfcalibration"))
