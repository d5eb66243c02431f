"""The transfer of every pixel of a photograph by a tensor.

Where the pixels are that only one of two photographs shows.

What the other one does not see is hidden behind what it sees: of the surfaces around such a pixel the nearest
one is taken that would not stand in front of anything there.

Section 1.3: pictures of virtual cameras from two photographs and their dense correspondence.

Every pixel is transferred by the tensor of the virtual camera and drawn there, nearer ones in front; the
colours are those of both photographs. No surface is made, and no depth but the order of pixels is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numba import njit
from numpy.typing import ArrayLike

from thesisrecon.arrays import B8, F32, F64, I16, I32, U8
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.zbuffer import in_strips
from thesisrecon.views.trilinear import VirtualTensor, seed_of_first, seed_of_two
from thesisrecon.views.virtual_camera import CalibratedPair, VirtualCamera, cameras_along
from thesisrecon.views.warping import DIRECTIONS, fill_holes, forward_map, sample
from thesisrecon.views.warping_kernels import distances_to_known


@njit(cache=True, nogil=True)
def transfer_rows(T: F64, P2: F64, places: F32, first: int, xy: F64, inverse_depth: F32) -> None:
    """Where the third view sees the pixels (x, y), y from ``first`` on, with matches ``places`` (H, W, 2).

    Written are ``xy`` (H, W, 2) and ``inverse_depth`` (H, W), as ``VirtualTensor.transfer`` has them; NaN where a
    match is.
    """
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


@njit(cache=True, nogil=True)
def guess_rows(
    inverse_depth: tuple[F32, F32], P2: F64, steps: I32, distance: I16, step: float, out: F32
) -> None:
    """Nearness of all pixels of a photograph, into ``out`` (H, W): the known one, or that of a pixel around.

    ``inverse_depth`` of this photograph (H, W) and of the other (h, w), each in its own view, NaN = unknown;
    ``P2`` (3, 4) the other camera; ``distance`` (K, H, W) how many of the ``steps`` (K, 2) (down, right) lead
    to the next known pixel. Of these pixels the nearest is taken, unless its surface would stand in front of
    what the other photograph sees by more than ``step``: such a one only where all do. NaN where there is
    none.
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
                stands = _stands_before(other, P2, x, y, rho, step)
                if (before and not stands) or (before == stands and reach < least):
                    least, before = reach, stands
                    out[y, x] = rho


@njit(cache=True, nogil=True)
def _stands_before(other: F32, P2: F64, x: int, y: int, rho: float, step: float) -> bool:
    """Whether the point of a pixel at an inverse depth is in front of what the other photograph sees there."""
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


Both32 = tuple[F32, F32]

SURFACE_PX = 1.0
"""Neighbours whose disparities between the photographs differ by more are not of one surface."""
SPARSE = 16
"""Every sixteenth pixel of every sixteenth row suffices for a median."""


def complete_places(pair: CalibratedPair, places: Both32, *, agree_px: float) -> tuple[Both32, tuple[B8, B8]]:
    """Places of all pixels in the other photograph, and which of them are known, not guessed.

    Parameters
    ----------
    pair : the cameras.
    places : two (H, W, 2) px of the other photograph, NaN = unknown.
    agree_px : a place is known where the way there and back ends no farther off; inf believes all there are.

    Returns
    -------
    Two (H, W, 2) float32 and two (H, W).

    Raises
    ------
    StageFailure : where nothing of a photograph is known in the other.
    """
    known = _agreeing(places[0], places[1], agree_px), _agreeing(places[1], places[0], agree_px)
    for side in (0, 1):
        if not known[side].any():
            raise StageFailure(
                "the photographs have no dense correspondence",
                f"no pixel of photograph {side + 1} is known in the other one",
                "choose photographs that overlap more",
            )
    pairs = pair, pair.swapped()
    sure = [np.where(known[side][..., None], places[side], np.nan) for side in (0, 1)]
    own = [seed_of_first(one) for one in pairs]
    inverse_depth = [transfer_grid(own[side], sure[side])[1] for side in (0, 1)]
    steps = [surface_step(own[side], sure[side]) for side in (0, 1)]
    complete = [
        _completed(pairs[side], sure[side], (inverse_depth[side], inverse_depth[1 - side]), steps[1 - side])
        for side in (0, 1)
    ]
    return (complete[0], complete[1]), known


def transfer_grid(virtual: VirtualTensor, places: F32, *, threads: int = 1) -> tuple[F64, F32]:
    """:meth:`VirtualTensor.transfer` of all pixels with matches ``places`` (H, W, 2); (H, W, 2), (H, W)."""
    xy, inverse_depth = np.empty(places.shape), np.empty(places.shape[:2], dtype=np.float32)

    def work(rows: tuple[int, int]) -> None:
        part = slice(*rows)
        transfer_rows(virtual.T, virtual.P2, places[part], rows[0], xy[part], inverse_depth[part])

    in_strips(work, len(places), threads)
    return xy, inverse_depth


def surface_step(virtual: VirtualTensor, places: F32) -> float:
    """``SURFACE_PX`` in units of a camera's inverse depth, for the middle one of the pixels of view 1."""
    known = np.isfinite(places[::SPARSE, ::SPARSE]).all(axis=2)
    y, x = (SPARSE * index for index in np.nonzero(known))
    pixels = np.stack([x, y], axis=1).astype(np.float64)
    found = virtual.disparity_per_inverse_depth(pixels, places[y, x].astype(np.float64))
    found = found[np.isfinite(found)]
    return SURFACE_PX / float(np.median(found)) if len(found) else np.inf


def _agreeing(places: F32, others: F32, agree_px: float) -> B8:
    """(H, W) where the partner's partner is the pixel."""
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
    """``places`` (H, W, 2) with guesses where NaN; ``inverse_depth`` of this photograph and the other, ``step`` of
    the other one's surfaces."""
    own = inverse_depth[0]
    distance = np.empty((len(DIRECTIONS), *own.shape), dtype=np.int16)
    distances_to_known(own, DIRECTIONS, distance)
    guessed = np.empty_like(own)
    guess_rows(inverse_depth, np.ascontiguousarray(pair.P2), DIRECTIONS, distance, step, guessed)
    y, x = np.nonzero(np.isnan(own))
    X = np.stack([x, y, np.ones_like(x), guessed[y, x]], axis=1).astype(np.float64)
    complete = places.copy()
    complete[y, x] = dehomogenize(X @ pair.P2.T)
    return complete


AGREE_PX = 1.5
"""Half a pixel of rounding, and a pixel of noise."""
LEAST_SEEN = 0.05
"""Share of its picture that a virtual camera must have of what the photographs show."""


@dataclass(frozen=True)
class TensorSynthesis:
    """Two photographs ready for view synthesis; make it by :func:`prepare_synthesis`.

    ``pair`` the cameras; ``seeds`` the tensors <1, 2, 2> and <2, 1, 2>, or those with a third photograph;
    ``levels`` two (H, W, 4) float32, the colours and 1 where the place of the pixel is known, 0 where it is
    guessed; ``places`` two (H, W, 2) px of the other photograph; ``gain`` (3,) what makes the second as
    bright as the first.
    """

    pair: CalibratedPair
    seeds: tuple[VirtualTensor, VirtualTensor]
    levels: tuple[F32, F32]
    places: tuple[F32, F32]
    gain: F32

    @property
    def sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """(width, height) of the photographs."""
        (h1, w1), (h2, w2) = (levels.shape[:2] for levels in self.levels)
        return (w1, h1), (w2, h2)

    def along(self, frames: int, *, beyond: float = 0.0) -> list[VirtualCamera]:
        """Cameras from the first photograph to the second and beyond; see :func:`cameras_along`."""
        third = np.linalg.inv(self.seeds[0].K) @ self.seeds[0].P3
        R3 = scipy.spatial.transform.Rotation.from_matrix(third[:, :3] @ self.pair.K1).as_matrix()
        return cameras_along(self.pair, frames, sizes=self.sizes, beyond=beyond, third=(R3, third[:, 3]))

    def render(self, camera: VirtualCamera, *, threads: int = 1) -> U8:
        """The picture (H, W, 3) of a virtual camera.

        What both photographs see is mixed by how near the camera is to either, exposures likewise; what
        neither sees is filled from behind. The same bytes whatever the number of threads. Raises
        ``StageFailure`` where the camera sees next to nothing of the scene.
        """
        moved = [seed.moved(camera.rotation, camera.translation, K=camera.K) for seed in self.seeds]
        step = surface_step(moved[0], self.places[0])
        layers = [self._layer(side, moved[side], camera.size, step, threads) for side in (0, 1)]
        seen: B8 = np.isfinite(layers[0][1]) | np.isfinite(layers[1][1])
        if not seen.mean() >= LEAST_SEEN:
            raise StageFailure(
                "the virtual camera sees nothing of the scene that the photographs show",
                f"{100.0 * seen.mean():.1f} % of its picture, needed {100.0 * LEAST_SEEN:.0f} %",
                "it may be beyond the scene or look away: move it less (by baselines) or turn it back",
            )
        rgb, inverse_depth = self._mixed(layers, self._share_of_second(moved[0]), step)
        filled = fill_holes(rgb, inverse_depth, step=step)
        return np.asarray(np.clip(np.rint(filled), 0.0, 255.0), dtype=np.uint8)

    def _share_of_second(self, virtual: VirtualTensor) -> np.float32:
        """How far along the baseline the camera is: 0 beside the first photograph, 1 beside the second, and
        not beyond."""
        centre, baseline = virtual.centre, self.pair.centre2
        along = np.linalg.solve(self.pair.K1, centre[:3]) @ baseline / (centre[3] * baseline @ baseline)
        return np.float32(np.clip(along, 0.0, 1.0))

    def _layer(
        self, side: int, virtual: VirtualTensor, size: tuple[int, int], step: float, threads: int
    ) -> tuple[F32, F32]:
        """What the camera sees of one photograph, (H, W, 4), and its inverse_depth (H, W); NaN where nothing."""
        xy, inverse_depth = transfer_grid(virtual, self.places[side], threads=threads)
        source, front = forward_map(xy, inverse_depth, size=size, step=step, threads=threads)
        return sample(self.levels[side], source, threads=threads), front

    def _mixed(self, layers: list[tuple[F32, F32]], share: np.float32, step: float) -> tuple[F32, F32]:
        """Colours and inverse depth of both layers together; NaN where neither sees anything."""
        (first, near1), (second, near2) = layers
        of_second = _weight_of_second(layers, share, step)
        dark, bright = self.gain**-share, self.gain ** (1 - share)
        # Weights of 0 must not meet NaN.
        rgb = np.where((of_second < 1.0)[..., None], first[..., :3] * dark, 0.0) * (1 - of_second)[..., None]
        rgb += np.where((of_second > 0.0)[..., None], second[..., :3] * bright, 0.0) * of_second[..., None]
        return rgb, np.where(of_second > 0.5, near2, near1)


def _weight_of_second(layers: list[tuple[F32, F32]], share: np.float32, step: float) -> F32:
    """(H, W) how much of the second photograph is in the mixture, 0 to 1; NaN where neither is.

    ``share`` of it where both show the same. Where they differ the nearer surface is shown, as far as its
    photograph is to be believed: fully from half the way on, not at all in the last quarter before the
    other one, which would have shown it.
    """
    (first, near1), (second, near2) = layers
    seen1, seen2 = np.isfinite(near1), np.isfinite(near2)
    sure1, sure2 = np.nan_to_num(first[..., 3]) > 0.5, np.nan_to_num(second[..., 3]) > 0.5
    weight = np.full(near1.shape, share, dtype=np.float32)
    alike = seen1 & seen2 & (sure1 == sure2)
    weight[alike & (near2 > near1 + step)] = np.clip(4.0 * share - 1.0, 0.0, 1.0)
    weight[alike & (near1 > near2 + step)] = np.clip(4.0 * share - 2.0, 0.0, 1.0)
    # What is known is right, before what is guessed or behind it, but where a guess moves next to nothing.
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
    seed: VirtualTensor | None = None,
    agree_px: float = AGREE_PX,
) -> TensorSynthesis:
    """What does not depend on the virtual camera.

    Parameters
    ----------
    pair : the cameras, guessed or known.
    images : two (H, W, 3) levels 0 .. 255.
    places : two (H, W, 2) px: where the pixels of the one photograph are in the other, NaN = unknown.
    gain : (3,) what makes the second photograph as bright as the first.
    seed : the tensor that virtual cameras move from: that of three photographs (:func:`seed_of_three`), or
        <1, 2, 2> by default.
    agree_px : places whose way there and back ends farther off are guessed anew, for what only one photograph
        shows has no partner (:func:`complete_places`); inf where also these are right.

    Raises
    ------
    ValueError : for shapes that do not belong together.
    StageFailure : where no place is known.
    """
    rgb = [np.asarray(image, dtype=np.float32) for image in images]
    for side, (image, there) in enumerate(zip(rgb, places, strict=True)):
        if image.ndim != 3 or image.shape[2] != 3 or there.shape != (*image.shape[:2], 2):
            raise ValueError(
                f"photograph {side + 1} is (H, W, 3) with places (H, W, 2); got {image.shape} and "
                f"{there.shape}"
            )
    complete, known = complete_places(pair, places, agree_px=agree_px)
    levels = [
        np.concatenate([image, sure[..., None].astype(np.float32)], axis=2)
        for image, sure in zip(rgb, known, strict=True)
    ]
    seed = seed_of_two(pair) if seed is None else seed
    seeds = seed, seed.swapped()
    return TensorSynthesis(pair, seeds, (levels[0], levels[1]), complete, np.asarray(gain, dtype=np.float32))
