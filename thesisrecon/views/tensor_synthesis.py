"""View synthesis from two images by the trilinear tensor (thesis, section 1.3).

Every pixel is transferred by the tensor of the virtual camera and drawn there, nearer pixels in front. A
pixel without correspondence is occluded in the other image; it takes the depth of the nearest surrounding
surface that would not stand in front of anything the other image shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon._numba import kernel
from thesisrecon.arrays import B8, F32, F64, I16, I32, U8
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.imaging.raster import run_in_strips
from thesisrecon.views._warping import DIRECTIONS, distances_to_known, fill_holes, forward_map, sample
from thesisrecon.views.tensor import CalibratedPair, VirtualCamera, VirtualTensor, seed_of_two

AGREE_PX = 1.5
"""Tolerance of the forward-backward check: half a pixel of rounding and a pixel of noise."""


@kernel
def _transfer_rows(T: F64, P2: F64, places: F32, first: int, xy: F64, inverse_depth: F32) -> None:
    """Transfer the pixels of rows from ``first`` to the third view, see :meth:`VirtualTensor.transfer`."""
    height, width = inverse_depth.shape
    for row in range(height):
        y = float(first + row)
        for column in range(width):
            x = float(column)
            x2, y2 = float(places[row, column, 0]), float(places[row, column, 1])
            xy[row, column, 0] = xy[row, column, 1] = inverse_depth[row, column] = np.nan
            if not (np.isfinite(x2) and np.isfinite(y2)):
                continue
            a0 = P2[0, 0] * x + P2[0, 1] * y + P2[0, 2]
            a1 = P2[1, 0] * x + P2[1, 1] * y + P2[1, 2]
            a2 = P2[2, 0] * x + P2[2, 1] * y + P2[2, 2]
            # The direction of the epipolar line a_4 x a; its length cancels.
            l0 = P2[2, 3] * a0 - P2[0, 3] * a2
            l1 = P2[2, 3] * a1 - P2[1, 3] * a2
            l2 = -(l0 * x2 + l1 * y2)
            u = v = w = 0.0
            for i, xi in enumerate((x, y, 1.0)):
                for j, lj in enumerate((l0, l1, l2)):
                    weight = xi * lj
                    u += weight * T[i, j, 0]
                    v += weight * T[i, j, 1]
                    w += weight * T[i, j, 2]
            if not -w * (l0 * P2[0, 3] + l1 * P2[1, 3] + l2 * P2[2, 3]) > 0.0:
                continue
            xy[row, column, 0] = u / w
            xy[row, column, 1] = v / w
            inverse_depth[row, column] = (l0 * a0 + l1 * a1 + l2 * a2) / w


@kernel
def _extrapolate_inverse_depth(
    inverse_depth: tuple[F32, F32], P2: F64, steps: I32, distance: I16, step: float, out: F32
) -> None:
    """Complete the inverse depth of the first image of two from the surrounding pixels.

    The nearest known pixel in any direction (``distance`` steps away, see :func:`distances_to_known`) is used
    whose surface would not occlude a surface that the other image shows; if all would, the nearest of all.
    """
    own, other = inverse_depth
    for y in range(own.shape[0]):
        for x in range(own.shape[1]):
            out[y, x] = own[y, x]
            if not np.isnan(own[y, x]):
                continue
            least, before = np.inf, True
            for k in range(steps.shape[0]):
                n = distance[k, y, x]
                if n < 1:
                    continue
                reach = n * n * (steps[k, 0] ** 2 + steps[k, 1] ** 2)
                rho = own[y + n * steps[k, 0], x + n * steps[k, 1]]
                stands = _occludes(other, P2, x, y, rho, step)
                if (before and not stands) or (before == stands and reach < least):
                    least, before = reach, stands
                    out[y, x] = rho


@kernel
def _occludes(other: F32, P2: F64, x: int, y: int, rho: float, step: float) -> bool:
    """Whether a pixel at inverse depth ``rho`` lies in front of the surface in the other image there."""
    u = P2[0, 0] * x + P2[0, 1] * y + P2[0, 2] + rho * P2[0, 3]
    v = P2[1, 0] * x + P2[1, 1] * y + P2[1, 2] + rho * P2[1, 3]
    w = P2[2, 0] * x + P2[2, 1] * y + P2[2, 2] + rho * P2[2, 3]
    if not w > 0.0:
        return True
    column, row = np.rint(u / w), np.rint(v / w)
    if not (0 <= row < other.shape[0] and 0 <= column < other.shape[1]):
        return False
    # A comparison with NaN is false.
    return bool(rho / w > other[int(row), int(column)] + step)


def _transfer_image(virtual: VirtualTensor, places: F32, *, threads: int = 1) -> tuple[F64, F32]:
    """Pixels (H, W, 2) of image 1 in the third view, and their inverse depth."""
    xy, inverse_depth = np.empty(places.shape), np.empty(places.shape[:2], dtype=np.float32)

    def work(rows: tuple[int, int]) -> None:
        part = slice(*rows)
        _transfer_rows(virtual.T, virtual.P2, places[part], rows[0], xy[part], inverse_depth[part])

    run_in_strips(work, len(places), threads)
    return xy, inverse_depth


def _surface_step(virtual: VirtualTensor, places: F32) -> float:
    """``SURFACE_PX`` as a difference of inverse depth in the third view, for the median pixel."""
    surface_px = 1.0  # Largest difference of disparity between neighbouring pixels of one surface
    sparse = 16  # Subsampling step for medians
    known = np.isfinite(places[::sparse, ::sparse]).all(axis=2)
    y, x = (sparse * index for index in np.nonzero(known))
    pixels = np.stack([x, y], axis=1).astype(np.float64)
    found = virtual.disparity_per_inverse_depth(pixels, places[y, x].astype(np.float64))
    found = found[np.isfinite(found)]
    return surface_px / float(np.median(found)) if len(found) else np.inf


def _agreeing(places: F32, others: F32, agree_px: float) -> B8:
    """Pixels (H, W) that pass the forward-backward check."""
    if np.isinf(agree_px):
        return np.asarray(np.isfinite(places).all(axis=2))
    height, width = others.shape[:2]
    at = np.rint(places)
    inside = np.all((at >= 0) & (at <= np.array([width - 1, height - 1])), axis=2)
    x, y = np.where(inside[..., None], at, 0).astype(np.int64).transpose(2, 0, 1)
    own = np.indices(places.shape[:2])[::-1].transpose(1, 2, 0)
    # A comparison with NaN is false.
    return np.asarray(inside & (np.linalg.norm(others[y, x] - own, axis=2) <= agree_px))


def _completed(pair: CalibratedPair, places: F32, inverse_depth: tuple[F32, F32], step: float) -> F32:
    """``places`` (H, W, 2) with guesses for NaN, from the inverse depth of both images."""
    own, P2 = inverse_depth[0], np.ascontiguousarray(pair.P2)
    guessed = np.empty_like(own)
    _extrapolate_inverse_depth(inverse_depth, P2, DIRECTIONS, distances_to_known(own), step, guessed)
    y, x = np.nonzero(np.isnan(own))
    X = np.stack([x, y, np.ones_like(x), guessed[y, x]], axis=1).astype(np.float64)
    complete = places.copy()
    complete[y, x] = dehomogenize(X @ pair.P2.T)
    return complete


@dataclass(frozen=True)
class TensorSynthesis:
    """Two images prepared for view synthesis by :func:`prepare_synthesis`."""

    pair: CalibratedPair
    levels: tuple[F32, F32]  #: (H, W, 4) colours, and 1 where the correspondence is known, 0 where guessed
    places: tuple[F32, F32]  #: (H, W, 2) corresponding pixels in the other image
    gain: F32  #: (3,) factor of the exposure of the second image

    @property
    def sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Width and height of both images."""
        (h1, w1), (h2, w2) = (levels.shape[:2] for levels in self.levels)
        return (w1, h1), (w2, h2)

    def render(self, camera: VirtualCamera, *, threads: int = 1) -> U8:
        """Render a virtual camera: both images blended by its position, holes filled from behind."""
        min_seen = 0.05  # Minimum share of the image that must show the scene
        seed = seed_of_two(self.pair)
        moved = [s.moved(camera.rotation, camera.translation, K=camera.K) for s in (seed, seed.swapped)]
        step = _surface_step(moved[0], self.places[0])
        layers = []
        for virtual, places, levels in zip(moved, self.places, self.levels, strict=True):
            xy, near = _transfer_image(virtual, places, threads=threads)
            source, front = forward_map(xy, near, size=camera.size, step=step, threads=threads)
            layers.append((sample(levels, source, threads=threads), front))
        seen: B8 = np.isfinite(layers[0][1]) | np.isfinite(layers[1][1])
        if not seen.mean() >= min_seen:
            raise StageFailure(
                "the virtual camera sees almost nothing of the scene",
                f"{100.0 * seen.mean():.1f} % of its image, needed {100.0 * min_seen:.0f} %",
                "move the camera less (in baselines) or rotate it back",
            )
        rgb, inverse_depth = self._mixed(layers, self._share_of_second(moved[0]), step)
        filled = fill_holes(rgb, inverse_depth, step=step)
        return np.clip(np.rint(np.nan_to_num(filled)), 0.0, 255.0).astype(np.uint8)

    def _share_of_second(self, virtual: VirtualTensor) -> np.float32:
        """Position of the camera along the baseline, clipped to 0 (first image) and 1 (second image)."""
        centre, baseline = camera_centre(virtual.P3), self.pair.centre2
        along = np.linalg.solve(self.pair.K1, centre[:3]) @ baseline / (centre[3] * baseline @ baseline)
        return np.float32(np.clip(along, 0.0, 1.0))

    def _mixed(self, layers: list[tuple[F32, F32]], share: np.float32, step: float) -> tuple[F32, F32]:
        """Blended colours and inverse depth of both layers, NaN where both are empty."""
        (first, near1), (second, near2) = layers
        of_second = _weight_of_second(layers, share, step)
        dark, bright = self.gain**-share, self.gain ** (1 - share)
        # Weights of 0 must not meet NaN.
        rgb = np.where((of_second < 1.0)[..., None], first[..., :3] * dark, 0.0) * (1 - of_second)[..., None]
        rgb += np.where((of_second > 0.0)[..., None], second[..., :3] * bright, 0.0) * of_second[..., None]
        return rgb, np.where(of_second > 0.5, near2, near1)


def _weight_of_second(layers: list[tuple[F32, F32]], share: np.float32, step: float) -> F32:
    """Blending weight (H, W) of the second image, NaN where both are empty.

    Where both show the same surface it is ``share``. Where they differ, the nearer surface is shown: with
    full weight if the camera is in the half of the baseline next to its own image, with weight 0 in the last
    quarter before the other image, which does not show it.
    """
    (first, near1), (second, near2) = layers
    seen1, seen2 = np.isfinite(near1), np.isfinite(near2)
    sure1, sure2 = np.nan_to_num(first[..., 3]) > 0.5, np.nan_to_num(second[..., 3]) > 0.5
    weight = np.full(near1.shape, share, dtype=np.float32)
    alike = seen1 & seen2 & (sure1 == sure2)
    weight[alike & (near2 > near1 + step)] = np.clip(4.0 * share - 1.0, 0.0, 1.0)
    weight[alike & (near1 > near2 + step)] = np.clip(4.0 * share - 2.0, 0.0, 1.0)
    # Known correspondences are used at any depth, except close to the image of the extrapolated pixel.
    weight[seen1 & seen2 & sure1 & ~sure2] = np.clip(4.0 * share - 3.0, 0.0, 1.0)
    weight[seen1 & seen2 & sure2 & ~sure1] = np.clip(4.0 * share, 0.0, 1.0)
    weight[seen1 & ~seen2] = 0.0
    weight[seen2 & ~seen1] = 1.0
    weight[~(seen1 | seen2)] = np.nan
    return weight


def prepare_synthesis(
    pair: CalibratedPair,
    images: tuple[ArrayLike, ArrayLike],
    places: tuple[F32, F32],
    *,
    gain: ArrayLike = (1.0, 1.0, 1.0),
    agree_px: float = AGREE_PX,
) -> TensorSynthesis:
    """Complete the correspondences of all pixels and prepare the images for any virtual camera."""
    known = _agreeing(places[0], places[1], agree_px), _agreeing(places[1], places[0], agree_px)
    for side in (0, 1):
        if not known[side].any():
            raise StageFailure(
                "the images have no dense correspondence",
                f"no pixel of image {side + 1} has a known correspondence",
                "choose images that overlap more",
            )
    pairs = pair, pair.swapped
    sure = [np.where(known[side][..., None], places[side], np.nan) for side in (0, 1)]
    own = [seed_of_two(one, first=True) for one in pairs]
    near = [_transfer_image(own[side], sure[side])[1] for side in (0, 1)]
    steps = [_surface_step(own[side], sure[side]) for side in (0, 1)]
    complete = [_completed(pairs[k], sure[k], (near[k], near[1 - k]), steps[1 - k]) for k in (0, 1)]
    levels = [
        np.concatenate([np.asarray(image, dtype=np.float32), seen[..., None].astype(np.float32)], axis=2)
        for image, seen in zip(images, known, strict=True)
    ]
    return TensorSynthesis(
        pair, (levels[0], levels[1]), (complete[0], complete[1]), np.asarray(gain, dtype=np.float32)
    )
