"""Section 1.3: pictures of virtual cameras from two photographs and their dense correspondence.

Every pixel is transferred by the tensor of the virtual camera and drawn there, nearer ones in front; the
colours are those of both photographs. No surface is made, and no depth but the order of pixels is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.types import B8, F32
from thesisrecon.views.tensor.completion import complete_places, surface_step, transfer_grid
from thesisrecon.views.tensor.pair import CalibratedPair
from thesisrecon.views.tensor.path import VirtualCamera, cameras_along
from thesisrecon.views.tensor.seed import VirtualTensor, seed_of_two
from thesisrecon.views.warping import fill_holes, forward_map, sample

U8 = NDArray[np.uint8]

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
        rgb, nearness = self._mixed(layers, self._share_of_second(moved[0]), step)
        filled = fill_holes(rgb, nearness, step=step)
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
        """What the camera sees of one photograph, (H, W, 4), and its nearness (H, W); NaN where nothing."""
        xy, nearness = transfer_grid(virtual, self.places[side], threads=threads)
        source, front = forward_map(xy, nearness, size=size, step=step, threads=threads)
        return sample(self.levels[side], source, threads=threads), front

    def _mixed(self, layers: list[tuple[F32, F32]], share: np.float32, step: float) -> tuple[F32, F32]:
        """Colours and nearness of both layers together; NaN where neither sees anything."""
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
