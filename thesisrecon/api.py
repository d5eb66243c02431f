"""The public functions: :func:`reconstruct` runs the whole pipeline, the others one stage each."""

from __future__ import annotations

import numpy as np

from thesisrecon._settings import Config, as_config
from thesisrecon.alignment import align_to_positions, scaled
from thesisrecon.arrays import F64, U8
from thesisrecon.bundle_adjustment import BundleAdjustment, bundle_adjust
from thesisrecon.calibration import absolute_dual_quadric, plane_at_infinity, self_calibrate, upgrade_affine
from thesisrecon.camera import Camera
from thesisrecon.comparison import ModelComparison, compare_models
from thesisrecon.config import PipelineConfig
from thesisrecon.dense_model import depth_maps, fuse_depth_maps, texture
from thesisrecon.epipolar._drawing import draw_lines
from thesisrecon.epipolar.estimation import FundamentalEstimate, estimate_fundamental
from thesisrecon.epipolar.homography import estimate_homography
from thesisrecon.epipolar.trifocal_estimation import estimate_trifocal
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.geometry.camera_matrix import cheirality
from thesisrecon.geometry.robust_resection import resect
from thesisrecon.geometry.triangulation import triangulate
from thesisrecon.geometry.two_view import epipolar_lines
from thesisrecon.io._images import is_rgba, read_levels, read_pixels
from thesisrecon.io._meshes import write_mesh
from thesisrecon.io._models import read_cameras
from thesisrecon.model_export import export
from thesisrecon.pipeline._image_pair import ImageInput, match_pair
from thesisrecon.pipeline._loading import load
from thesisrecon.pipeline.from_matches import (
    reconstruct_from_colmap,
    reconstruct_from_matches,
    reconstruct_from_tracks,
)
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import (
    DepthMap,
    DisparityMap,
    FundamentalFit,
    Image,
    Reconstruction,
    SelfCalibration,
    TexturedMesh,
    Tracks,
    TwoView,
)
from thesisrecon.results import RunResult
from thesisrecon.selfcalibration.kruppa import kruppa
from thesisrecon.stereo.rectification import METHODS, PLANAR, RectifiedImages, disparity_range, rectify_pair
from thesisrecon.view_interpolation import interpolate_view
from thesisrecon.view_synthesis import synthesize_view
from thesisrecon.views.render import render

__all__ = [
    "BundleAdjustment", "Camera", "DepthMap", "DisparityMap", "FundamentalEstimate", "FundamentalFit",
    "Image", "ModelComparison", "PipelineConfig", "Reconstruction", "RunResult", "SelfCalibration",
    "StageFailure", "TexturedMesh", "Tracks", "TwoView", "UsageError", "absolute_dual_quadric",
    "align_to_positions", "bundle_adjust", "cheirality", "compare_models", "depth_maps",
    "draw_epipolar_lines",
    "epipolar_lines", "estimate_fundamental", "estimate_homography", "estimate_trifocal", "export",
    "fuse_depth_maps", "interpolate_view", "kruppa", "load", "match_pair", "match_rectified",
    "plane_at_infinity", "read_cameras", "reconstruct", "reconstruct_from_colmap",
    "reconstruct_from_matches", "reconstruct_from_tracks", "rectify", "render", "resect", "scaled",
    "self_calibrate", "synthesize_view", "texture", "triangulate", "upgrade_affine", "write_mesh",
]  # fmt: skip


def draw_epipolar_lines(
    image1: ImageInput, image2: ImageInput, F: F64, xy1: F64, xy2: F64, *, max_lines: int = 30
) -> tuple[U8, U8]:
    """Draw the epipolar lines of matches into both images (figure 3.11).

    Parameters
    ----------
    image1, image2 : path or ndarray (H, W), (H, W, 3) or (H, W, 4) uint8
        Files, read at full size, or images.
    F, xy1, xy2 : ndarray (3, 3), (N, 2) and (N, 2)
        Fundamental matrix and matches in pixels of these images.
    max_lines : int
        Number of matches to draw, spread over all; each has one colour in both images.

    Returns
    -------
    ndarray (H, W, 3) uint8, twice
        The images, with the line F x1 and the point x2 in the second, F' x2 and x1 in the first.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import draw_epipolar_lines
    >>> F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    >>> gray = np.full((60, 80), 128, np.uint8)
    >>> left, right = draw_epipolar_lines(gray, gray, F, np.array([[40.0, 30]]), np.array([[20.0, 30]]))
    >>> left.shape, np.unique(np.nonzero((right != 128).any(axis=2))[0]).tolist()
    ((60, 80, 3), [26, 27, 28, 29, 30, 31, 32, 33, 34])
    """
    return draw_lines(read_pixels(image1), read_pixels(image2), F, xy1, xy2, max_lines=max_lines)


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
    frame = rectify_pair(F, xy1, xy2, size1, size2, methods=PLANAR if planar else METHODS)
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
