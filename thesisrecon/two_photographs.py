"""Two photographs and no model: matched, densely, and seen from elsewhere (sections 1.2 and 1.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thesisrecon.assumptions import assumptions_of_views
from thesisrecon.config import PipelineConfig, RectifiedPair
from thesisrecon.doors import match_pair
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera import calibration_matrix
from thesisrecon.io.images import Photograph, read_photographs
from thesisrecon.types import F64, TwoView
from thesisrecon.views.tensor import (
    TensorSynthesis,
    VirtualCamera,
    guessed_intrinsics,
    pair_from_fundamental,
    prepare_synthesis,
)

U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class TwoPhotographs:
    """Two ``photographs`` at working size, their verified matches and F (``pair``), and their dense
    correspondence (``dense``)."""

    photographs: tuple[Photograph, Photograph]
    pair: TwoView
    dense: RectifiedPair


def match_photographs(
    image1: Any, image2: Any, *, config: PipelineConfig | None = None, seed: int = 0, planar: bool = False
) -> TwoPhotographs:
    """Sparse and dense correspondence of two photographs, files or uint8 arrays.

    ``planar`` rectifies by homographies alone, which not all pairs allow. Raises :class:`StageFailure` where
    one of them cannot be read, they do not match, or show no parallax.
    """
    config = config or PipelineConfig()
    first, second = (_read_one(image, config) for image in (image1, image2))
    pair = match_pair(first.image, second.image, config=config, seed=seed)
    dense = config.dense.match_two_views(first.image, second.image, pair.F, pair.xy1, pair.xy2, planar=planar)
    return TwoPhotographs((first, second), pair, dense)


def tensor_views(
    found: TwoPhotographs, *, K: ArrayLike | None = None, config: PipelineConfig | None = None
) -> TensorSynthesis:
    """Two matched photographs ready for views of any camera by the trilinear tensor (section 1.3).

    ``K`` (3, 3) of both or (2, 3, 3), in pixels of the photographs as they were given: calibrated by whatever
    means. Without it what ``config.intrinsics`` says of the focal length, and where that is silent a usual
    one: the new views are then right but for a projective transform of space. Raises
    :class:`StageFailure` where the matches contradict F or the scene would not be in front.
    """
    config = config or PipelineConfig()
    K1, K2 = _intrinsics(found.photographs, K, config)
    pair = pair_from_fundamental(found.pair.F, found.pair.xy1, found.pair.xy2, K1=K1, K2=K2)
    first, second = (photograph.image for photograph in found.photographs)
    places = found.dense.places(0, first.size), found.dense.places(1, second.size)
    return prepare_synthesis(pair, (first.rgb, second.rgb), places, gain=found.dense.gain)


def synthesize_view(
    image1: Any,
    image2: Any,
    rotation: ArrayLike,
    translation: ArrayLike,
    *,
    K: ArrayLike | None = None,
    config: PipelineConfig | None = None,
) -> U8:
    """The picture of a camera that nobody had, from two photographs and the trilinear tensor (section 1.3).

    Parameters
    ----------
    image1, image2
        Files or uint8 arrays.
    rotation, translation
        R (3, 3) and t (3,): the motion from the second camera to the new one, X_new = R X_2 + t with x right,
        y down, z ahead. The unit of t is the distance of the two cameras. R = I and t = 0 show the second
        photograph again.
    K
        As in :func:`tensor_views`.

    Returns
    -------
    (H, W, 3) uint8 of the second photograph's working size and K. For many views of the same photographs call
    :func:`match_photographs` and :func:`tensor_views` once.

    Raises
    ------
    ValueError
        What is no rotation, translation or K.
    StageFailure
        Photographs that cannot be read, do not match or show no parallax; a camera that sees nothing of the
        scene.
    """
    # Before minutes of work.
    rotation, translation = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    _given_intrinsics(K)
    VirtualCamera(rotation, translation, np.eye(3), (1, 1))
    views = tensor_views(match_photographs(image1, image2, config=config), K=K, config=config)
    return views.render(VirtualCamera(rotation, translation, views.pair.K2, views.sizes[1]))


def _read_one(source: Any, config: PipelineConfig) -> Photograph:
    found = read_photographs([source], max_size_px=config.images.max_size_px)
    for name, reason in found.refused.items():
        raise StageFailure(f"{name} {reason}")
    return found.photographs[0]


def _given_intrinsics(K: ArrayLike | None) -> F64 | None:
    """K as (2, 3, 3), None where not given; ``ValueError`` for other shapes."""
    if K is None:
        return None
    given = np.asarray(K, dtype=np.float64)
    if given.shape not in ((3, 3), (2, 3, 3)):
        raise ValueError(f"K is (3, 3) for both photographs or (2, 3, 3); got {given.shape}")
    return np.broadcast_to(given, (2, 3, 3))


def _intrinsics(
    photographs: tuple[Photograph, Photograph], K: ArrayLike | None, config: PipelineConfig
) -> tuple[F64, F64]:
    """K of both in pixels at working size: given, assumed, or guessed."""
    images = [photograph.image for photograph in photographs]
    scales = np.array([image.scale for image in images])
    given = _given_intrinsics(K)
    if given is not None:
        working = given.copy()
        working[:, :2] *= scales[:, None, None]
        # Pixel (0, 0) is the centre of the first one.
        working[:, :2, 2] += 0.5 * (scales[:, None] - 1.0)
        return working[0], working[1]
    told = assumptions_of_views(
        config.intrinsics,
        [image.original_size for image in images],
        np.array([photograph.exif_focal_px for photograph in photographs]),
        scales,
    ).mean
    both = []
    for image, (f, aspect, skew, u, v, _) in zip(images, told.tolist(), strict=True):
        f = f if np.isfinite(f) else float(guessed_intrinsics(image.size)[0, 0])
        both.append(calibration_matrix(f, aspect * f, u, v, skew=skew))
    return both[0], both[1]
