"""Corners at two image sizes, and oriented multi-scale patches (seeds) to start the matching from.

Patches of simulated oblique views match those of another camera far to the side (J.-M. Morel and G. Yu,
"ASIFT: a new framework for fully affine invariant image comparison", SIAM J. Imaging Sciences 2, 2009).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import scipy

from thesisrecon._numba import FAST, empty, kernel
from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.errors import require_range
from thesisrecon.features.harris import CornerMeasure, select_spread
from thesisrecon.imaging.resampling import halve, resample, smooth
from thesisrecon.records import Features, Image, Seeds

PATCH_SIDE = 8
PATCH_VALUES = 32
"""Values of a patch: half of its cosine coefficients, those of low frequency, insensitive to small shifts."""


@kernel(fastmath=FAST)
def sample_patches(image: F32, xy: F64, angle: F32, side: int, spacing: float) -> F32:
    """Square patches (N, side^2) of an image, clamped, rotated by ``angle`` (N,) rad, sampled bilinearly."""
    height, width = image.shape
    out = empty((len(xy), side * side), np.float32)
    centre = 0.5 * (side - 1)
    for n in range(len(xy)):
        c, s = np.cos(angle[n]) * spacing, np.sin(angle[n]) * spacing
        for row in range(side):
            for column in range(side):
                a, b = column - centre, row - centre
                u = min(max(xy[n, 0] + c * a - s * b, 0.0), width - 1.001)
                v = min(max(xy[n, 1] + s * a + c * b, 0.0), height - 1.001)
                x0, y0 = int(u), int(v)
                p, q = np.float32(u - x0), np.float32(v - y0)
                top = image[y0, x0] + p * (image[y0, x0 + 1] - image[y0, x0])
                low = image[y0 + 1, x0] + p * (image[y0 + 1, x0 + 1] - image[y0 + 1, x0])
                out[n, row * side + column] = top + q * (low - top)
    return out


@dataclass(frozen=True)
class ObliqueView:
    """Pixels ``gray`` (h, w) of a simulated view; an image pixel x is at ``to_view`` x + ``offset``."""

    tilt: float
    direction: float
    gray: F32
    to_view: F64
    offset: F64


def simulate_view(gray: F32, tilt: float, direction: float, enlargement: float = 1.0) -> ObliqueView:
    """Compress an image by ``tilt`` along the ``direction`` (rad), which becomes the x axis of the view."""
    c, s = np.cos(direction), np.sin(direction)
    turn = enlargement * np.array([[c, s], [-s, c]])
    half = 0.5 * (np.array(gray.shape[::-1]) - 1.0)
    width, height = np.ceil(2.0 * np.abs(turn) @ half).astype(np.int64) + 1
    middle = 0.5 * np.array([width - 1.0, height - 1.0])
    back = np.asarray(np.linalg.inv(turn), np.float64)
    rows_first, start = back[::-1, ::-1], (half - back @ middle)[::-1]
    turned = scipy.ndimage.affine_transform(gray, rows_first, start, (height, width), order=1, mode="nearest")
    smooth = scipy.ndimage.gaussian_filter1d(turned, 0.8 * np.sqrt(tilt**2 - 1.0), axis=1)
    x = np.arange(int(width / tilt)) * tilt
    left = np.minimum(x.astype(np.int64), width - 2)
    share = (x - left).astype(np.float32)
    narrow = (1.0 - share) * smooth[:, left] + share * smooth[:, left + 1]
    to_view = np.diag([1.0 / tilt, 1.0]) @ turn
    offset = middle / [tilt, 1.0] - to_view @ half
    return ObliqueView(tilt, direction, np.ascontiguousarray(narrow, np.float32), to_view, offset)


@dataclass(frozen=True)
class _PyramidLevel:
    """One image size: ``gray`` (h, w), and image pixels per pixel in x and y (2,)."""

    gray: F32
    scale: F64

    def to_image(self, xy: F64) -> F64:
        """Convert pixels of this level to pixels of the image."""
        return (xy + 0.5) * self.scale - 0.5


@dataclass(frozen=True)
class MultiScaleCorners:
    """Harris corners at full and half size, and seed patches at several levels, each 1/sqrt(2) as large.

    Seeds are the multi-scale oriented patches of Brown, Szeliski and Winder (CVPR 2005), each upright and
    rotated to its dominant gradient. Small images are doubled first: the scales of the corners are 1 and 2,
    or 0.5 and 1.
    """

    full_corners: int = 3000  #: number of corners at full size; 0 for none
    half_corners: int = 1500  #: number of corners at half size; 0 for none
    spread: bool = True  #: select corners and seeds that cover the image, else the strongest
    levels: int = 5  #: number of levels; with fewer than 3 there is no half size
    measure: CornerMeasure = field(default_factory=CornerMeasure)
    """Response and its parameters at every size."""

    # Number of seeds at the finest level; each further level has 1/sqrt(2) as many.
    seeds_per_level = 1400
    # Long side below which the image, or that which was enlarged to it, is doubled.
    upsample_below_px = 1000
    # Compressions of the simulated views that give seeds for pairs with a wide baseline (ASIFT).
    oblique_tilts: ClassVar[tuple[float, ...]] = (1.414, 2.828)

    def __post_init__(self) -> None:
        require_range(self, levels="[1, inf)", full_corners="[0, inf)", half_corners="[0, inf)")
        if self.full_corners + self.half_corners == 0:
            raise ValueError("one of full_corners and half_corners must be above 0; got 0 and 0")
        if self.half_corners and self.levels < 3:
            raise ValueError(
                "half_corners must be 0 with fewer than 3 levels, because the third level has half the size; "
                f"got {self.half_corners} with levels = {self.levels}"
            )

    def detect(self, image: Image) -> Features:
        """See `thesisrecon.config.Detector.detect`."""
        levels = _image_pyramid(image.gray, self.levels, doubled=self._is_small(image))
        found = [self.measure._find(level.gray) for level in levels]
        parts = []
        for index, count in ((0, self.full_corners), (2, self.half_corners)):
            if index < len(levels):
                xy, response = found[index]
                kept = self._select(xy, response, count)
                nominal = np.float32(round(2.0 * levels[index].scale[0]) / 2.0)
                parts.append((levels[index].to_image(xy[kept]), np.full(len(kept), nominal), response[kept]))
        xy, scale, response = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(-response, kind="stable")
        return Features(xy[order], scale[order], response[order], seeds=self._seeds(levels, found))

    def _select(self, xy: F64, response: F32, count: int) -> I64:
        if self.spread:
            return select_spread(xy, response, count)
        return np.arange(min(count, len(xy)), dtype=np.int64)

    def _is_small(self, image: Image) -> bool:
        return max(image.size) < self.upsample_below_px * max(image.scale, 1.0)

    def _seeds(self, levels: list[_PyramidLevel], found: list[tuple[F64, F32]]) -> Seeds:
        upright, turned = list[tuple[Any, ...]](), list[tuple[Any, ...]]()
        for index, (level, (corners, response)) in enumerate(zip(levels, found, strict=True)):
            kept = self._select(corners, response, int(self.seeds_per_level / np.sqrt(2.0) ** index))
            xy = level.to_image(corners[kept])
            scale = np.full(len(kept), np.sqrt(np.prod(level.scale)), np.float32)
            for part, seen in zip((upright, turned), _patches(level.gray, corners[kept]), strict=True):
                part.append((xy, scale, *seen))
        return _joined_seeds([*upright, *turned])

    def oblique_seeds(self, image: Image) -> Seeds:
        """Seeds of simulated oblique views, in the orientation of the image and rotated to their gradient."""
        enlargement, none = 2.0 if self._is_small(image) else 1.0, np.empty(0, np.float32)
        parts: list[tuple[Any, ...]] = [
            (np.empty((0, 2)), none, none, np.empty((0, PATCH_SIDE**2), np.float32), np.empty((0, 2, 2)))
        ]
        # Views are at least two patches wide, in directions over 180 degrees, 72 apart for tilt 1.
        for tilt in self.oblique_tilts if min(image.gray.shape) >= 64 else ():
            count = int(np.ceil(np.pi * tilt / np.radians(72.0)))
            for direction in np.pi * np.arange(count) / count:
                view = simulate_view(image.gray, tilt, direction, enlargement)
                parts += self._seeds_of_view(view, image.size)
        return _joined_seeds(parts)

    def _seeds_of_view(
        self, view: ObliqueView, size: tuple[int, int]
    ) -> list[tuple[F64, F32, F32, F32, F64]]:
        """Fields of the seeds of each level of one simulated view, with patches that are not normalised."""
        parts, to_image = [], np.linalg.inv(view.to_view)
        for index, level in enumerate(_image_pyramid(view.gray, self.levels, doubled=False)):
            corners, response = self.measure._find(level.gray)
            xy = (level.to_image(corners) - view.offset) @ to_image.T
            spacing = np.sqrt(np.prod(level.scale))
            # Half a patch: beyond the border of the image the view repeats border pixels.
            margin = PATCH_SIDE * spacing * np.sqrt(np.linalg.det(to_image))
            inside = ((xy > margin) & (xy < np.array(size) - 1.0 - margin)).all(axis=1)
            corners, response, xy = corners[inside], response[inside], xy[inside]
            # Half the density of the image: many views show the same surface.
            count = int(0.5 * self.seeds_per_level / view.tilt / np.sqrt(2.0) ** index)
            kept = self._select(corners, response, count)
            size_px = np.full(len(kept), spacing * np.sqrt(np.linalg.det(to_image)), np.float32)
            for turned, (angle, raw) in enumerate(_patches(level.gray, corners[kept], -view.direction)):
                label = angle if turned else np.zeros_like(angle)
                c, s = np.cos(angle), np.sin(angle)
                turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2).astype(np.float64)
                parts.append((xy[kept], size_px, label, raw, spacing * (to_image @ turn)))
        return parts


def _image_pyramid(plane: F32, levels: int, *, doubled: bool) -> list[_PyramidLevel]:
    """Levels of a pyramid, each 1/sqrt(2) of the one before."""
    height, width = plane.shape
    first = resample(plane, 2 * width, 2 * height) if doubled else plane
    found = [_PyramidLevel(first, np.array([width, height]) / first.shape[::-1])]
    for index in range(1, levels):
        finer = found[max(index - 2, 0)]
        h, w = finer.gray.shape
        if min(h, w) < 32:
            break
        if index == 1:
            # A step of sqrt(2) needs a weaker low-pass than halving: sigma 0.6 avoids aliasing.
            gray = resample(smooth(finer.gray, 0.6), round(w / np.sqrt(2.0)), round(h / np.sqrt(2.0)))
            found.append(_PyramidLevel(gray, finer.scale * (w, h) / gray.shape[::-1]))
        else:
            found.append(_PyramidLevel(halve(finer.gray), 2.0 * finer.scale))
    return found


def _patches(gray: F32, corners: F64, upright: float = 0.0) -> list[tuple[F32, F32]]:
    """Angles (N,) and patches of corners: ``upright``, and rotated to their dominant direction."""
    blurred, straight = smooth(gray, 2.0), np.full(len(corners), upright, np.float32)
    # The direction of the gradient, averaged with sigma of about 4 px; never exactly 0.
    around = sample_patches(blurred, corners, np.zeros_like(straight), 7, 2.0).reshape(-1, 7, 7)
    gx = (around[:, 1:-1, 2:] - around[:, 1:-1, :-2]).sum(axis=(1, 2))
    gy = (around[:, 2:, 1:-1] - around[:, :-2, 1:-1]).sum(axis=(1, 2))
    turned = np.arctan2(gy, gx).astype(np.float32)
    angles = straight, np.where(turned == 0.0, np.float32(1e-6), turned)
    return [(angle, sample_patches(blurred, corners, angle, PATCH_SIDE, 4.0)) for angle in angles]


def _joined_seeds(parts: Sequence[tuple[Any, ...]]) -> Seeds:
    """Seeds of the fields of parts, with patches that are not normalised, without those of no contrast."""
    xy, scale, angle, raw, *frame = (np.concatenate(column) for column in zip(*parts, strict=True))
    patches, ok = _normalize_patches(raw)
    return Seeds(xy[ok], scale[ok], angle[ok], patches[ok], *(each[ok] for each in frame))


def _normalize_patches(patches: F32) -> tuple[F32, B8]:
    """Lowest ``PATCH_VALUES`` cosine coefficients but the mean, of unit norm, and which have contrast."""
    contrast = patches.std(axis=1)
    coefficients = (patches - patches.mean(axis=1, keepdims=True)) @ _low_frequencies()
    norm = np.linalg.norm(coefficients, axis=1, keepdims=True)
    return (coefficients / np.maximum(norm, 1e-6)).astype(np.float32), contrast > 1.0


def _low_frequencies() -> F32:
    """Cosine functions (PATCH_SIDE^2, PATCH_VALUES) of the lowest frequencies except zero, orthonormal."""
    rows = scipy.fft.dct(np.eye(PATCH_SIDE), norm="ortho", axis=0)
    u, v = np.divmod(np.arange(PATCH_SIDE**2), PATCH_SIDE)
    order = np.argsort(u**2 + v**2, kind="stable")[1 : PATCH_VALUES + 1]
    return np.asarray(np.kron(rows, rows)[order].T, dtype=np.float32)
