"""Views of virtual cameras from two images by the trilinear tensor (thesis, section 1.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon._settings import Config, as_config
from thesisrecon.arrays import F64, U8
from thesisrecon.config import PipelineConfig
from thesisrecon.geometry._conditioning import require_calibration
from thesisrecon.geometry.camera_matrix import calibration_matrix
from thesisrecon.intrinsics import prior_from_options
from thesisrecon.io._images import read_image
from thesisrecon.pipeline._image_pair import match_pair
from thesisrecon.records import Image, TwoView
from thesisrecon.stereo.correspondence import RectifiedPair
from thesisrecon.views.trilinear import VirtualCamera, default_intrinsics, pair_from_fundamental
from thesisrecon.views.trilinear_synthesis import TensorSynthesis, prepare_synthesis


@dataclass(frozen=True)
class MatchedImages:
    """Two images with their sparse and dense correspondences."""

    images: tuple[Image, Image]  #: at working size
    pair: TwoView  #: verified matches and F
    dense: RectifiedPair
    exif_focal_px: F64  #: (2,) of the originals, NaN = unknown


def match_images(image1: Any, image2: Any, *, config: Config | None = None, seed: int = 0) -> MatchedImages:
    """Match two images sparsely and densely.

    Parameters
    ----------
    image1, image2 : str, Path, ndarray (H, W, 3) uint8 or Image
        The images.
    config, seed : PipelineConfig or str or path, int
        Configuration (None: the default) and random seed.

    Returns
    -------
    MatchedImages
        Input of :func:`prepare_trilinear_views`.

    Raises
    ------
    UsageError, StageFailure
        If a file does not exist or cannot be read; if the images do not match or show no parallax.
    """
    config = as_config(config)
    read = [read_image(source, max_size_px=config.images.max_size_px) for source in (image1, image2)]
    first, second = (found.images[0] for found in read)
    pair = match_pair(first, second, config=config, seed=seed)
    dense = config.dense.match_two_views(first, second, pair.F, pair.xy1, pair.xy2)
    focals = np.array([float(found.exif_focal_px[0]) for found in read])
    return MatchedImages((first, second), pair, dense, focals)


def prepare_trilinear_views(
    found: MatchedImages, *, K: ArrayLike | None = None, config: Config | None = None
) -> TensorSynthesis:
    """Prepare two matched images for views of any camera by the trilinear tensor (section 1.3).

    Parameters
    ----------
    found : MatchedImages
        Result of :func:`match_images`.
    K : array_like (3, 3) or (2, 3, 3), optional
        Intrinsics of both images, in pixels of the given images. If None, the prior of ``config.intrinsics``;
        without a focal length there, a typical one: the views are then correct up to a projective
        transformation of space.
    config : PipelineConfig, str or path, optional
        The default configuration if None.

    Returns
    -------
    TensorSynthesis
        Its ``render(camera)`` computes a view.

    Raises
    ------
    ValueError, StageFailure
        If K is invalid; if the matches contradict F, or no solution has the scene in front of both cameras.
    """
    config = as_config(config)
    K1, K2 = _intrinsics(found, K, config)
    pair = pair_from_fundamental(found.pair.F, found.pair.xy1, found.pair.xy2, K1=K1, K2=K2)
    first, second = found.images
    places = found.dense.correspondences(0, first.size), found.dense.correspondences(1, second.size)
    return prepare_synthesis(pair, (first.rgb, second.rgb), places, gain=found.dense.gain)


def synthesize_view(
    image1: Any,
    image2: Any,
    rotation: ArrayLike,
    translation: ArrayLike,
    *,
    K: ArrayLike | None = None,
    config: Config | None = None,
    seed: int = 0,
) -> U8:
    """Compute the view of a virtual camera from two images by the trilinear tensor (section 1.3).

    Parameters
    ----------
    image1, image2 : str, Path or ndarray (H, W, 3) uint8
        The images.
    rotation, translation : array_like (3, 3) and (3,)
        Motion from the second camera to the virtual one, X_new = R X_2 + t (x right, y down, z forwards), in
        units of the distance between the two cameras. R = I and t = 0 reproduce the second image.
    K : array_like (3, 3) or (2, 3, 3), optional
        Intrinsics, as in :func:`prepare_trilinear_views`.
    config, seed : PipelineConfig or str or path, int
        Configuration (None: the default) and random seed of the matching.

    Returns
    -------
    ndarray (H, W, 3) uint8
        The view, with the working size and K of the second image.

    Raises
    ------
    ValueError
        If the rotation, translation, K or seed is invalid.
    StageFailure
        If the images cannot be read, do not match or show no parallax, or the camera does not see the scene.

    Notes
    -----
    For many views of one pair call :func:`match_images` and :func:`prepare_trilinear_views` once.

    Examples
    --------
    >>> import numpy as np
    >>> import thesisrecon
    >>> R, t = 2.0 * np.eye(3), np.zeros(3)
    >>> thesisrecon.synthesize_view("a.jpg", "b.jpg", R, t)
    Traceback (most recent call last):
        ...
    ValueError: a rotation has R'R = I and det R = 1; this one is off by 3, det 8
    """
    # Checked before the matching, which takes minutes.
    rotation, translation = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    _given_intrinsics(K)
    VirtualCamera(rotation, translation, np.eye(3), (1, 1))
    found = match_images(image1, image2, config=config, seed=seed)
    views = prepare_trilinear_views(found, K=K, config=config)
    return views.render(VirtualCamera(rotation, translation, views.pair.K2, views.sizes[1]))


def _given_intrinsics(K: ArrayLike | None) -> F64 | None:
    """Return K as (2, 3, 3), None if not given; ``ValueError`` if it is not that of a camera."""
    if K is None:
        return None
    given = np.asarray(K, dtype=np.float64)
    if given.shape not in ((3, 3), (2, 3, 3)):
        raise ValueError(f"K must be (3, 3) for both images or (2, 3, 3); got {given.shape}")
    both = np.broadcast_to(given, (2, 3, 3))
    for one in both:
        require_calibration("view synthesis", one)
    return both


def _intrinsics(found: MatchedImages, K: ArrayLike | None, config: PipelineConfig) -> tuple[F64, F64]:
    """K of both images in pixels at working size: given, from the prior, or typical."""
    scales = np.array([image.scale for image in found.images])
    given = _given_intrinsics(K)
    if given is not None:
        working = given.copy()
        working[:, :2] *= scales[:, None, None]
        # Pixel (0, 0) is the centre of the first one.
        working[:, :2, 2] += 0.5 * (scales[:, None] - 1.0)
        return working[0], working[1]
    sizes = [image.original_size for image in found.images]
    prior = prior_from_options(config.intrinsics, sizes, found.exif_focal_px, scales).mean
    both = []
    for image, (f, aspect, skew, u, v, _) in zip(found.images, prior.tolist(), strict=True):
        f = f if np.isfinite(f) else float(default_intrinsics(image.size)[0, 0])
        both.append(calibration_matrix(f, aspect * f, u, v, skew=skew))
    return both[0], both[1]
