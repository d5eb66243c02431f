"""Rectification and dense matching of two images (thesis, section 2.5)."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config.text import Config, as_config
from thesisrecon.io._images import is_rgba, read_levels
from thesisrecon.pipeline.image_pair import ImageInput
from thesisrecon.records import DisparityMap
from thesisrecon.stereo._epipolar_pair import pair_of_fundamental
from thesisrecon.stereo.rectification import METHODS, PLANAR, RectifiedImages, disparity_range
from thesisrecon.stereo.rectification import rectify as best_rectification


def rectify(
    image1: ImageInput, image2: ImageInput, F: F64, xy1: F64, xy2: F64, *, planar: bool = False
) -> RectifiedImages:
    """Rectify two images by their fundamental matrix: epipolar lines become common rows (2.5).

    Parameters
    ----------
    image1, image2 : path or ndarray (H, W), (H, W, 3) or (H, W, 4) uint8
        Files, read at full size, or images.
    F, xy1, xy2 : ndarray (3, 3), (N, 2) and (N, 2)
        Fundamental matrix and N >= 8 of its inliers in pixels of these images.
    planar : bool
        Allow homographies only, which need epipoles outside the images.

    Returns
    -------
    RectifiedImages
        The rectified images, for :func:`match_rectified`, and the maps between them and the images.

    Raises
    ------
    ValueError
        If an array has the wrong shape.
    StageFailure
        If the pair has no parallax or too few matches, or with ``planar`` an epipole lies inside an image.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import rectify
    >>> xy1 = np.random.default_rng(0).uniform(20, 140, (30, 2))
    >>> xy2 = xy1 - np.array([[8.0, 4]]) / np.random.default_rng(1).uniform(1, 4, (30, 1))
    >>> F = np.array([[0.0, 0, 4], [0, 0, -8], [-4, 8, 0]])
    >>> gray = np.full((160, 160), 128, np.uint8)
    >>> pair = rectify(gray, gray, F, xy1, xy2)
    >>> rows = [pair.rectified_from_original(k, xy)[:, 1] for k, xy in enumerate((xy1, xy2))]
    >>> bool(np.abs(rows[0] - rows[1]).max() < 1e-6)
    True
    """
    xy1, xy2 = np.asarray(xy1, dtype=np.float64), np.asarray(xy2, dtype=np.float64)
    images = read_levels(image1), read_levels(image2)
    size1, size2 = ((image.shape[1], image.shape[0]) for image in images)
    frame = best_rectification(pair_of_fundamental(F, xy1, xy2, size1, size2), PLANAR if planar else METHODS)
    return RectifiedImages.of(frame, images, disparity_range(frame, xy1, xy2))


def match_rectified(
    left: ImageInput, right: ImageInput, *, max_disparity_px: float, config: Config | None = None
) -> DisparityMap:
    """Compute the disparity map of a rectified pair (2.5).

    Parameters
    ----------
    left, right : path or ndarray (H, W), (H, W, 3) or (H, W, 4)
        Two images of the same size: files (read at full size; ``UsageError`` or ``StageFailure`` if one
        cannot be read), or levels 0 to 255 with NaN for missing pixels; transparent pixels are missing.
    max_disparity_px : float
        Largest disparity; x_right = x_left - d with d from 0 to this.
    config : PipelineConfig, str or path, optional
        The matcher is ``config.dense.pairs``; None: the preset ``default``.

    Returns
    -------
    DisparityMap
        Disparity and confidence of each pixel of the left image, NaN where unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import match_rectified
    >>> from scipy.ndimage import gaussian_filter
    >>> texture = gaussian_filter(128 + 300 * np.random.default_rng(0).uniform(-1, 1, (60, 90)), 1.0)
    >>> found = match_rectified(texture[:, :80], texture[:, 6:86], max_disparity_px=10)
    >>> round(float(np.nanmedian(found.disparity)), 1)
    6.0
    """
    images = [
        side if isinstance(side, np.ndarray) and not is_rgba(side) else read_levels(side)
        for side in (left, right)
    ]
    for image in images:
        # Levels of rectified images may exceed the range a little; those of 16 bits would all be white.
        if image.dtype.kind in "iu" and image.max(initial=0) > 255:
            raise ValueError(
                f"match_rectified needs grey levels 0 to 255; got {image.dtype} up to {image.max()}"
            )
    dense = as_config(config).dense
    return dense.match_rectified(images[0], images[1], max_disparity_px=max_disparity_px)
