"""The public functions: :func:`reconstruct` runs the whole pipeline, the others one stage each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thesisrecon._settings import Config, as_config
from thesisrecon.alignment import align_to_positions, scaled
from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.comparison import ModelComparison, compare_models
from thesisrecon.config import PipelineConfig
from thesisrecon.epipolar.estimation import estimate_fundamental
from thesisrecon.epipolar.homography import estimate_homography
from thesisrecon.epipolar.trifocal_estimation import estimate_trifocal
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.geometry.robust_resection import resect
from thesisrecon.geometry.triangulation import triangulate
from thesisrecon.intrinsics import prior_for
from thesisrecon.io._images import read_image
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
from thesisrecon.runtime._run import stream
from thesisrecon.selfcalibration.stratified import Stratified, upgrade_to_affine, with_images
from thesisrecon.view_interpolation import interpolate_view
from thesisrecon.view_synthesis import synthesize_view
from thesisrecon.views.render import render

__all__ = [
    "Camera", "DisparityMap", "FundamentalFit", "Image", "ModelComparison", "PipelineConfig",
    "Reconstruction", "RunResult", "SelfCalibration", "StageFailure", "TexturedMesh", "Tracks", "TwoView",
    "UsageError", "align_to_positions", "compare_models", "estimate_fundamental", "estimate_homography",
    "estimate_trifocal", "export", "interpolate_view", "load", "match_pair", "match_rectified", "reconstruct",
    "reconstruct_from_colmap", "reconstruct_from_matches", "reconstruct_from_tracks", "render", "resect",
    "scaled", "self_calibrate", "synthesize_view", "triangulate", "upgrade_affine",
]  # fmt: skip


def match_rectified(
    left: ImageInput, right: ImageInput, *, max_disparity_px: float, config: Config | None = None
) -> DisparityMap:
    """Compute the disparity map of a rectified pair (2.5).

    Parameters
    ----------
    left, right : path or ndarray (H, W) or (H, W, 3)
        Files (read at full size; ``UsageError`` or ``StageFailure`` if one cannot be read), or grey levels 0
        to 255 with NaN for missing pixels; of one size.
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
    images = [side if isinstance(side, np.ndarray) else _full_size(side) for side in (left, right)]
    dense = as_config(config).dense
    return dense.match_rectified(images[0], images[1], max_disparity_px=max_disparity_px)


def _full_size(path: ImageInput) -> np.ndarray:
    return read_image(path, max_size_px=np.iinfo(np.int32).max).images[0].rgb


def self_calibrate(
    reconstruction: Reconstruction,
    *,
    config: Config | None = None,
    images: Sequence[Image] = (),
    seed: int = 0,
) -> SelfCalibration:
    """Estimate the metric frame and the intrinsics of a projective reconstruction (chapter 7).

    Parameters
    ----------
    reconstruction : Reconstruction
        Projective reconstruction of at least three views.
    config : PipelineConfig, str or path, optional
        ``config.selfcalibration`` is the method, ``config.intrinsics`` the prior knowledge; by default images
        of one size share one camera.
    images, seed : sequence of Image, int
        The images, one per view, for methods that detect parallel lines; and the random seed.

    Returns
    -------
    SelfCalibration
        ``metric_from_projective`` (4, 4), ``K`` (V, 3, 3) with standard deviations, and all candidates.

    Raises
    ------
    ValueError, StageFailure
        If the reconstruction is not projective or the seed is invalid; if no calibration is determined.

    Examples
    --------
    Six views of a cloud of points by one camera of unknown focal length:

    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from thesisrecon import Camera, Reconstruction, Tracks, self_calibrate
    >>> K = np.array([[800.0, 0, 319.5], [0, 800, 239.5], [0, 0, 1]])
    >>> angles = np.radians([[0, -30, 5], [25, -15, 0], [-5, 0, 20], [15, 15, 0], [-20, 25, 5], [5, 40, -15]])
    >>> R = Rotation.from_euler("xyz", angles).as_matrix()
    >>> cameras = [Camera(K, r, np.array([0.0, 0, 5]), (640, 480)) for r in R]
    >>> X = np.random.default_rng(0).uniform(-1, 1, (80, 3))
    >>> xy = np.stack([camera.project(X) for camera in cameras], axis=1).reshape(-1, 2)
    >>> tracks = Tracks(np.tile(np.arange(6), 80), np.repeat(np.arange(80), 6), xy, 6, 80)
    >>> H = np.random.default_rng(1).normal(size=(4, 4))
    >>> P = np.array([camera.P for camera in cameras]) @ np.linalg.inv(H)
    >>> projective = Reconstruction(
    ...     "projective", P, np.column_stack([X, np.ones(80)]) @ H.T, np.ones(6, bool), np.ones(80, bool),
    ...     np.ones(480, bool), tracks, sizes=np.tile([640, 480], (6, 1)), sigma_px=0.5, reasons=("",) * 6,
    ... )
    >>> round(self_calibrate(projective).K[0, 0, 0])
    800
    """
    if reconstruction.stratum != "projective":
        raise ValueError(f"self_calibrate takes a projective reconstruction; got {reconstruction.stratum}")
    config = as_config(config)
    prior = prior_for(reconstruction, config.intrinsics)
    method, rng = with_images(config.selfcalibration, images), stream(seed, "selfcalibration")
    return method.calibrate(reconstruction, prior=prior, rng=rng)


def upgrade_affine(
    reconstruction: Reconstruction,
    plane: F64 | None = None,
    *,
    config: Config | None = None,
    images: Sequence[Image] = (),
    seed: int = 0,
) -> Reconstruction:
    """Upgrade a projective reconstruction to an affine one (3.3, chapter 7).

    Parallel lines and ratios of lengths along them are then those of the scene.

    Parameters
    ----------
    reconstruction : Reconstruction
        Projective reconstruction.
    plane : ndarray (4,), optional
        Plane at infinity in the projective frame. None: located by the first step of the method if
        ``config.selfcalibration`` is :class:`~thesisrecon.selfcalibration.stratified.Stratified` (no
        calibration needed), else taken from :func:`self_calibrate`.
    config, images, seed
        As for :func:`self_calibrate`.

    Returns
    -------
    Reconstruction
        The same cameras and points in an affine frame.

    Raises
    ------
    ValueError, StageFailure
        If the reconstruction is not projective, the plane is zero or not finite, or the seed is invalid; if
        the plane at infinity cannot be located.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import Reconstruction, Tracks, upgrade_affine
    >>> none = Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), 1, 2)
    >>> projective = Reconstruction(
    ...     "projective", np.eye(3, 4)[None], np.array([[1.0, 2, 4, 3], [0, 1, 2, 1]]), np.ones(1, bool),
    ...     np.ones(2, bool), np.zeros(0, bool), none, np.array([[640, 480]]), 1.0, ("",),
    ... )
    >>> affine = upgrade_affine(projective, plane=np.array([0.0, 0, 0.5, 0]))
    >>> affine.stratum, bool((affine.X[:, 3] == 1).all())
    ('affine', True)
    """
    if reconstruction.stratum != "projective":
        raise ValueError(f"upgrade_affine takes a projective reconstruction; got {reconstruction.stratum}")
    if plane is None:
        config = as_config(config)
        method = with_images(config.selfcalibration, images)
        rng = stream(seed, "selfcalibration")
        prior = prior_for(reconstruction, config.intrinsics)
        if isinstance(method, Stratified):
            plane = method.locate(reconstruction, prior=prior, rng=rng)
        else:
            plane = method.calibrate(reconstruction, prior=prior, rng=rng).plane_at_infinity
    return upgrade_to_affine(reconstruction, plane)
