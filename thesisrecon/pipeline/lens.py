"""The lens before everything else: pairs of images show how much it bends lines, then images are straight.

Matches and tracks stay in pixels of the images. F, the projective reconstruction and self-calibration are in
straight pixels, those of a pinhole camera to within the division model; the metric stage is in pixels again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.epipolar.division import bend, estimate_division, is_nearly_straight, is_straight, straighten
from thesisrecon.imaging.resampling import resampled
from thesisrecon.matching._prepared import select_found
from thesisrecon.pipeline.run import Job, stream
from thesisrecon.records import Features, Image, IntrinsicsPrior, Matches, Reconstruction, Tracks, TwoView

SAMPLES = 129  # points along a side of an image at which its straight frame is measured


def bends_little(job: Job, matches: Sequence[Matches]) -> bool:
    """Whether some matches show that no lens of three images or more bends lines much."""
    prior, answer = job.prior, True
    camera = prior.shared[:, 5]
    numbers, count = np.unique(camera[prior.std[:, 5] > 0.0], return_counts=True)
    for number in numbers[count >= 3]:
        of_camera = [m for m in matches if camera[m.i] == number == camera[m.j]]
        rng = stream(job.run.seed, "lens", int(number), 1)
        answer = answer and is_nearly_straight(of_camera, job.sizes, rng)
    return answer


def lens_of_matches(job: Job, matches: Sequence[Matches]) -> F64 | None:
    """Lenses (V, 3) of the images in half diagonals; None if none bends lines much.

    Each camera whose k1 is not given has its own.
    """
    prior, sizes, answer = job.prior, job.sizes, np.zeros((len(job.sizes), 3))
    camera = prior.shared[:, 5]
    for number in np.unique(camera[prior.std[:, 5] > 0.0]):
        of_camera = [m for m in matches if camera[m.i] == number == camera[m.j]]
        found = estimate_division(of_camera, sizes, stream(job.run.seed, "lens", int(number)))
        if found is not None and found.bends:
            answer[camera == number] = found.k
    return answer if answer.any() else None


def straight_tracks(tracks: Tracks, sizes: I64, lens: F64) -> Tracks:
    """Tracks in straight pixels, without observations near the horizon of the lens; the points stay."""
    xy, magnification = straighten(tracks.xy, sizes[tracks.view_index], lens[tracks.view_index])
    near = is_straight(magnification)
    view, point = tracks.view_index[near], tracks.point_index[near]
    return replace(tracks, view_index=view, point_index=point, xy=xy[near])


def straight_pair(pair: TwoView, sizes: I64, lens: F64) -> TwoView:
    """A verified pair with its matches in straight pixels, as its F is."""
    ends = ((pair.xy1, pair.i), (pair.xy2, pair.j))
    xy1, xy2 = (straighten(xy, sizes[view], lens[view])[0] for xy, view in ends)
    return replace(pair, xy1=xy1, xy2=xy2)


def bent_pair(pair: TwoView, sizes: I64, lens: F64) -> TwoView:
    """The inverse of :func:`straight_pair`; ``sizes`` and ``lens`` of the two images."""
    return replace(pair, xy1=bend(pair.xy1, sizes[0], lens[0]), xy2=bend(pair.xy2, sizes[1], lens[1]))


def straight_matches(matches: Matches, sizes: I64, lens: F64) -> Matches:
    """Matches away from the horizon of the lens, in straight pixels; ``sizes`` and ``lens`` of the two."""
    ends = zip((matches.xy1, matches.xy2), sizes, lens, strict=True)
    (xy1, size1), (xy2, size2) = (straighten(*end) for end in ends)
    near: B8 = is_straight(size1) & is_straight(size2)
    return select_found(replace(matches, xy1=xy1, xy2=xy2), near)


@dataclass(frozen=True)
class StraightFrame:
    """The straight image of an image with a lens: its size, and that of the image."""

    size: tuple[int, int]
    of_image: tuple[int, int]
    lens: F64

    @classmethod
    def of(cls, size: tuple[int, int], lens: F64) -> StraightFrame:
        """The frame of all that is far enough from the horizon of the lens."""
        edges = [np.linspace(0.0, side - 1.0, SAMPLES) for side in size]
        every = np.stack(np.meshgrid(*edges), axis=-1).reshape(-1, 2)
        straight, magnification = straighten(every, np.array(size), lens)
        reach = np.abs(straight - (np.array(size) - 1.0) / 2.0)[is_straight(magnification)].max(axis=0)
        width, height = (2 * int(np.ceil(side)) + 1 for side in reach)
        return cls((width, height), size, lens)

    @property
    def shift(self) -> F64:
        """Middle of the straight image minus that of the image."""
        return np.asarray(np.subtract(self.size, self.of_image) / 2.0)

    def straight(self, xy: F64) -> F64:
        """Straight pixels of pixels (N, 2) of the image."""
        return np.asarray(straighten(xy, np.array(self.of_image), self.lens)[0] + self.shift)

    def bent(self, xy: F64) -> F64:
        """Pixels of the image of straight pixels (N, 2)."""
        return bend(xy - self.shift, np.array(self.of_image), self.lens)

    def image(self, image: Image) -> Image:
        """The straight image, with a mask of what it sees; it has more pixels, not more detail."""
        width = float(self.size[0])

        def lookup(rows: range) -> F64:
            x, y = np.meshgrid(np.arange(width), np.arange(float(rows.start), float(rows.stop)))
            return self.bent(np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(*x.shape, 2)

        rgb, seen = resampled(image.levels, lookup, self.size)
        return Image(image.name, rgb, self.of_image, seen)

    def features(self, features: Features, *, straight: bool) -> Features:
        """Features of the image with positions in straight pixels, or the inverse."""
        move = self.straight if straight else self.bent

        def moved(found: Any) -> Any:
            return None if found is None else replace(found, xy=move(found.xy))

        seeds, oblique = moved(features.seeds), moved(features.oblique)
        return replace(features, xy=move(features.xy), seeds=seeds, oblique=oblique)


@dataclass(frozen=True)
class Straightened:
    """A method ``prepare`` of images and features, applied to straight images."""

    prepare: Callable[[Image, Features], Any]
    frames: Mapping[str, StraightFrame]  #: by image name

    def __call__(self, image: Image, features: Features) -> Any:
        frame = self.frames[image.name]
        return self.prepare(frame.image(image), frame.features(features, straight=True))


def frames_of(job: Job) -> Mapping[str, StraightFrame]:
    """The straight frames of the images of a job with lenses, by name."""
    assert job.prior.lens is not None
    made: dict[tuple[Any, ...], StraightFrame] = {}
    answer = {}
    for image, lens in zip(job.images, job.prior.lens, strict=True):
        key = (*image.size, *lens.tolist())
        answer[image.name] = made.setdefault(key, StraightFrame.of(image.size, lens))
    return answer


def pair_from_frames(pair: TwoView, first: StraightFrame, second: StraightFrame) -> TwoView:
    """A pair in pixels of straight images in pixels of the images, with F of straight pixels."""
    F = _translation(second.shift).T @ pair.F @ _translation(first.shift)
    return replace(pair, xy1=first.bent(pair.xy1), xy2=second.bent(pair.xy2), F=F)


def pair_in_frames(pair: TwoView, first: StraightFrame, second: StraightFrame) -> TwoView:
    """The inverse of :func:`pair_from_frames`."""
    F = _translation(-second.shift).T @ pair.F @ _translation(-first.shift)
    return replace(pair, xy1=first.straight(pair.xy1), xy2=second.straight(pair.xy2), F=F)


def _translation(shift: F64) -> F64:
    return np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]], [0.0, 0.0, 1.0]])


def as_imaged(found: Reconstruction, tracks: Tracks, prior: IntrinsicsPrior) -> Reconstruction:
    """A projective reconstruction of straight tracks with all ``tracks`` in pixels of the images.

    Observations that straight tracks lack are no inliers yet.
    """
    if prior.lens is None:
        return found
    number = found.tracks.point_index * tracks.n_views + found.tracks.view_index
    every = tracks.point_index * tracks.n_views + tracks.view_index
    return replace(found, tracks=tracks, inlier=np.isin(every, number[found.inlier]))
