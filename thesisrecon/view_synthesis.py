"""Views between, beside and beyond two photographs, by the trilinear tensor (thesis, section 1.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.api import match_pair
from thesisrecon.arrays import F64, U8
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError
from thesisrecon.geometry.camera_matrix import calibration_matrix
from thesisrecon.intrinsics import assumptions_of_views
from thesisrecon.records import Image, TwoView
from thesisrecon.stereo.correspondence import RectifiedPair
from thesisrecon.view_interpolation import Film, named_photograph
from thesisrecon.views.trilinear_synthesis import TensorSynthesis, prepare_synthesis
from thesisrecon.views.virtual_camera import VirtualCamera, guessed_intrinsics, pair_from_fundamental

BEYOND = 0.5
"""How many baselines a film goes on beyond either photograph."""


@dataclass(frozen=True)
class MatchedPhotographs:
    """Two photographs at working size, ``images``, their verified matches and F, ``pair``, and their dense
    correspondence; ``exif_focal_px`` (2,) of the originals, NaN = not said."""

    images: tuple[Image, Image]
    pair: TwoView
    dense: RectifiedPair
    exif_focal_px: F64 = field(default_factory=lambda: np.full(2, np.nan))


def match_photographs(
    image1: Any, image2: Any, *, config: PipelineConfig | None = None, seed: int = 0
) -> MatchedPhotographs:
    """Sparse and dense correspondence of two photographs: files, uint8 arrays or :class:`Image` records.

    Raises :class:`UsageError` where there is no such file, :class:`StageFailure` where one of them cannot be
    read, they do not match, or show no parallax.
    """
    config = config or PipelineConfig()
    images, focals = [], []
    for source in (image1, image2):
        found = named_photograph(source, max_size_px=config.images.max_size_px)
        images.append(found.images[0])
        focals.append(float(found.exif_focal_px[0]))
    first, second = images
    pair = match_pair(first, second, config=config, seed=seed)
    dense = config.dense.match_two_views(first, second, pair.F, pair.xy1, pair.xy2)
    return MatchedPhotographs((first, second), pair, dense, np.array(focals))


def tensor_views(
    found: MatchedPhotographs, *, K: ArrayLike | None = None, config: PipelineConfig | None = None
) -> TensorSynthesis:
    """Two matched photographs ready for views of any camera by the trilinear tensor (section 1.3).

    ``K`` (3, 3) of both or (2, 3, 3), in pixels of the photographs as they were given: calibrated by whatever
    means. Without it what ``config.intrinsics`` says of the focal length, and where that is silent a usual
    one: the new views are then right but for a projective transform of space. Raises
    :class:`StageFailure` where the matches contradict F or the scene would not be in front.
    """
    config = config or PipelineConfig()
    K1, K2 = _intrinsics(found, K, config)
    pair = pair_from_fundamental(found.pair.F, found.pair.xy1, found.pair.xy2, K1=K1, K2=K2)
    first, second = found.images
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


def tensor_film(
    photographs: Sequence[Image], frames: int, *, config: PipelineConfig | None = None, seed: int = 0
) -> Film:
    """Views on the line through both cameras, from half a baseline before the first to as far beyond the
    second.

    Raises :class:`UsageError` for another number of photographs, :class:`StageFailure` as
    :func:`match_photographs` and :func:`tensor_views`, ``ValueError`` for less than one frame.
    """
    if len(photographs) != 2:
        raise UsageError(f"the trilinear tensor makes views of 2 photographs; got {len(photographs)}")
    first, second = photographs
    if np.array_equal(first.rgb, second.rgb):
        raise UsageError(f"{first.name} and {second.name} are the same photograph; give different ones")
    views = tensor_views(match_photographs(first, second, config=config, seed=seed), config=config)
    path = views.along(frames, beyond=BEYOND)
    ways = np.linspace(-BEYOND, 1.0 + BEYOND, frames).tolist() if frames > 1 else [0.5]

    def draw(k: int, threads: int) -> U8:
        return views.render(path[k], threads=threads)

    K = views.pair.K1, views.pair.K2
    told = {
        "photographs": [first.name, second.name],
        "K": list(K),
        "second_from_first": {"R": views.pair.R, "t": views.pair.t},
    }
    places = tuple(
        {"baselines": s, "R": camera.rotation, "t": camera.translation, "K": camera.K}
        for s, camera in zip(ways, path, strict=True)
    )
    captions = tuple(_caption(s, first.name, second.name) for s in ways)
    note = (
        f"the focal lengths are taken for {K[0][0, 0]:.0f} and {K[1][0, 0]:.0f} px; lengths are in units of "
        "the distance between the two cameras"
    )
    return Film(captions, draw, (note,), told, places)


def _caption(s: float, first: str, second: str) -> str:
    if s < 0.0:
        return f"{-s:.2f} baselines before {first}"
    if s > 1.0:
        return f"{s - 1.0:.2f} baselines beyond {second}"
    return f"{100.0 * s:.0f} % of the way from {first} to {second}"


def _given_intrinsics(K: ArrayLike | None) -> F64 | None:
    """K as (2, 3, 3), None where not given; ``ValueError`` for other shapes."""
    if K is None:
        return None
    given = np.asarray(K, dtype=np.float64)
    if given.shape not in ((3, 3), (2, 3, 3)):
        raise ValueError(f"K is (3, 3) for both photographs or (2, 3, 3); got {given.shape}")
    return np.broadcast_to(given, (2, 3, 3))


def _intrinsics(found: MatchedPhotographs, K: ArrayLike | None, config: PipelineConfig) -> tuple[F64, F64]:
    """K of both in pixels at working size: given, assumed, or guessed."""
    scales = np.array([image.scale for image in found.images])
    given = _given_intrinsics(K)
    if given is not None:
        working = given.copy()
        working[:, :2] *= scales[:, None, None]
        # Pixel (0, 0) is the centre of the first one.
        working[:, :2, 2] += 0.5 * (scales[:, None] - 1.0)
        return working[0], working[1]
    sizes = [image.original_size for image in found.images]
    told = assumptions_of_views(config.intrinsics, sizes, found.exif_focal_px, scales).mean
    both = []
    for image, (f, aspect, skew, u, v, _) in zip(found.images, told.tolist(), strict=True):
        f = f if np.isfinite(f) else float(guessed_intrinsics(image.size)[0, 0])
        both.append(calibration_matrix(f, aspect * f, u, v, skew=skew))
    return both[0], both[1]
