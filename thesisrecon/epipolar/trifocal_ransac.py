"""Section 3.6.3 by the method of 5.4: the trifocal tensor of tracks many of which are wrong.

Samples of six tracks (Quan 1995; Torr and Zisserman 1997; Hartley and Zisserman, algorithm 16.4), scored by
their reprojection in all three views over several widths of the noise; every better sample is refined on the
tracks it agrees with; at the end the noise is estimated, the tracks are judged by it, and the tensor of least
reprojection error of the right ones, with the lines that agree, is found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64
from thesisrecon.epipolar.six_point import (
    SAMPLE,
    WIDTHS,
    draw_samples,
    reprojection_distances,
    search_trifocal,
)
from thesisrecon.epipolar.trifocal_estimation import (
    NO_SEGMENTS,
    TrifocalFit,
    refine_trifocal,
    require_determined,
)
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.lines_and_planes import line_through, unit_normals
from thesisrecon.geometry.three_view import check_triplets, tensor_equations, tensor_from_cameras
from thesisrecon.geometry.two_view import estimate_homography, homography_residuals
from thesisrecon.numerics.ransac import required_samples

CHUNK, COMPLETIONS = 200, 1000
REFINEMENTS, SHORT = 3, 4
ROUNDS, MIXTURE_STEPS = 6, 100
INSIDE = 3.5
"""Widths of the noise within which a track is right: of 3 freedoms, 99.3 % are."""
LINE_INSIDE = 3.2
OFF_PLANE, PLANE_ROUNDS, PLANE_WIDTH = 4, 6, 6.0
HUBER = 3.0
"""Widths of the noise from which a residual counts less in the refinement."""
NEEDED, SMALLEST_PX = 9, 1e-50
"""Tracks, and their spread, below which powers of it underflow."""
WEAK = 0.2
"""As in :func:`estimate_trifocal`, but less: of a plane and a wrong track or two that happen to fit it is
0.25 to 0.4."""


@dataclass(frozen=True)
class RobustTrifocal:
    """A :class:`TrifocalFit` of the right matches and which they are.

    ``fit`` of the inliers alone, in their order; ``inliers`` (N,) of the points, ``line_inliers`` (M,) of the
    lines, ``samples`` drawn.
    """

    fit: TrifocalFit
    inliers: B8
    line_inliers: B8
    samples: int


@dataclass(frozen=True)
class TrifocalRansac:
    """Robust estimation of three views.

    ``threshold_px`` is the width of the score: the root of the sum of a track's squared distances in three
    views up to which it is surely good; tracks up to four times as far still count for something, so noise of
    0.2 to 1 threshold is served. Sampling ends with ``confidence`` that one sample was right, or after
    ``max_samples``.
    """

    threshold_px: float = 2.0
    confidence: float = 0.9999
    max_samples: int = 20000

    def __post_init__(self) -> None:
        if not (0.0 < self.threshold_px < np.inf and 0.0 < self.confidence < 1.0 and self.max_samples >= 1):
            raise ValueError(f"needed threshold_px > 0, 0 < confidence < 1, max_samples >= 1; got {self}")

    def estimate(
        self, points: F64, segments: F64 = NO_SEGMENTS, *, rng: Generator | None = None
    ) -> RobustTrifocal:
        """The tensor of tracks points (3, N >= 9, 2) px and lines segments (3, M, 2, 2) px, some wrong.

        The lines do not take part in the search. The same generator gives the same answer (None: one with
        seed 0). Raises ``ValueError`` for wrong shapes and values that are not finite, ``StageFailure`` for
        too few tracks, for tracks of which no more agree than by chance, and where the right ones leave the
        tensor free, exactly or up to their noise.
        """
        points, segments = check_triplets(points, segments)
        rng = np.random.default_rng(0) if rng is None else rng
        n = points.shape[1]
        if n < NEEDED:
            raise StageFailure(
                "too few tracks for the robust geometry of three views",
                f"found {n}, needed at least {NEEDED}",
                "use photographs that overlap more",
            )
        frame = _Frame.of(points)
        cameras, samples = self._search(frame, points, rng)
        fit, inliers = self._settle(frame, cameras, points)
        line_inliers = np.zeros(segments.shape[1], dtype=bool)
        if segments.shape[1]:
            fit, inliers, line_inliers = self._with_lines(frame, fit, points, segments)
        p, s = points[:, inliers], segments[:, line_inliers]
        self._refuse_a_plane(p, fit.sigma_px)
        xy = np.concatenate([p, s.reshape(3, -1, 2)], axis=1)
        require_determined(fit, tensor_equations(p, s), xy, weak=WEAK)
        return RobustTrifocal(fit, inliers, line_inliers, samples)

    def _search(self, frame: _Frame, points: F64, rng: Generator) -> tuple[F64, int]:
        """Conditioned cameras of the best score and the number of samples."""
        # In random order, so that a bad sample shows early that it is one.
        track = frame.tracks(points)[rng.permutation(points.shape[1])]
        threshold, best, bar, drawn = self.threshold_px * frame.scale, np.zeros((3, 3, 4)), 0.0, 0
        needed = self.max_samples
        while drawn < needed:
            count = min(CHUNK, needed - drawn)
            samples = draw_samples(rng.random((count, SAMPLE)), len(track))
            found = search_trifocal(track, samples, track, threshold, bar, best)
            drawn += count
            if found > bar:
                best, bar = self._improve(frame, track, best, found)
                share = float(np.mean(_distances(best, track) < threshold / np.sqrt(WIDTHS[1])))
                needed = min(needed, required_samples(share, SAMPLE, self.confidence, self.max_samples))
        if not bar > 0.0:
            raise self._no_consensus(points.shape[1], 0)
        best, _ = self._off_the_plane(frame, track, best, bar, rng)
        return best, drawn + COMPLETIONS

    def _off_the_plane(
        self, frame: _Frame, track: F64, best: F64, bar: float, rng: Generator
    ) -> tuple[F64, float]:
        """The best with four tracks that agree and two that do not, where that is better.

        Most samples of a scene with a dominant plane lie on it but for one, and explain nothing else (Chum,
        Werner and Matas, CVPR 2005, for two views).
        """
        threshold = self.threshold_px * frame.scale
        near = _distances(best, track) < threshold / np.sqrt(WIDTHS[1])
        on, off = np.flatnonzero(near), np.flatnonzero(~near)
        if len(on) < SAMPLE or len(off) < 2:
            return best, bar
        four = on[draw_samples(rng.random((COMPLETIONS, SAMPLE - 2)), len(on))]
        two = off[draw_samples(rng.random((COMPLETIONS, 2)), len(off))]
        better = best.copy()
        # The solver's frame is of the first five, no four of which may be of one plane. Judged by the others
        # alone: on the plane no sample is as good as what was refined there.
        found = search_trifocal(
            track, np.concatenate([two, four], axis=1), track[off], threshold, 0.0, better
        )
        if not found > 0.0:
            return best, bar
        better, found = self._improve(frame, track, better, 0.0)
        return (better, found) if found > bar else (best, bar)

    def _improve(self, frame: _Frame, track: F64, P: F64, value: float) -> tuple[F64, float]:
        """Cameras refined on the tracks they agree with, while their score grows."""
        threshold = self.threshold_px * frame.scale
        for _ in range(REFINEMENTS):
            near = _distances(P, track) < threshold / np.sqrt(WIDTHS[-1])
            if near.sum() < NEEDED:
                break
            xy = track[near].reshape(-1, 3, 2).swapaxes(0, 1)
            refined = _refined(P, xy, threshold)
            grown = self._value(refined, track, threshold)
            if not grown > value:
                break
            P, value = refined, grown
        return P, value

    def _value(self, P: F64, track: F64, threshold: float) -> float:
        squared = (_distances(P, track) / threshold) ** 2
        return float(sum(np.sum(np.maximum(0.0, 1.0 - squared * w)) for w in WIDTHS) / len(WIDTHS))

    def _settle(self, frame: _Frame, P: F64, points: F64) -> tuple[TrifocalFit, B8]:
        """The fit of the tracks within the noise, which they tell, until they stay the same."""
        track = frame.tracks(points)
        T, inliers = frame.tensor_in_pixels(P), np.zeros(len(track), dtype=bool)
        for round_ in range(ROUNDS):
            now, sigma = self._judge(frame, P, track)
            if round_ and np.array_equal(now, inliers):
                break
            inliers = now
            fit = refine_trifocal(T, points[:, inliers], NO_SEGMENTS, loss_px=HUBER * sigma)
            T, P = fit.T, frame.cameras_in_frame(fit.P)
        return fit, inliers

    def _with_lines(
        self, frame: _Frame, fit: TrifocalFit, points: F64, segments: F64
    ) -> tuple[TrifocalFit, B8, B8]:
        """The fit of the right tracks and of the lines that agree with them, judged anew with it once."""
        for _ in range(2):
            now, sigma = self._judge(frame, frame.cameras_in_frame(fit.P), frame.tracks(points))
            # The noise of lines need not be that of points.
            lines = _line_distances_px(fit.P, segments) <= LINE_INSIDE * max(sigma, self.threshold_px / 2.0)
            fit = refine_trifocal(fit.T, points[:, now], segments[:, lines], loss_px=HUBER * sigma)
        return fit, now, lines

    def _judge(self, frame: _Frame, P: F64, track: F64) -> tuple[B8, float]:
        """Which tracks are right, and their noise in px; ``StageFailure`` where they may be so by chance."""
        distances_px = _distances(P, track) / frame.scale
        sigma = _track_noise(distances_px, self.threshold_px, frame.width_px)
        right = distances_px <= INSIDE * sigma
        found = int(right.sum())
        if found < NEEDED or _by_chance(found, len(track), INSIDE * sigma / frame.width_px):
            raise self._no_consensus(len(track), found)
        return right, sigma

    def _refuse_a_plane(self, points: F64, sigma_px: float) -> None:
        """``StageFailure`` where fewer than 4 tracks are off a plane: any two off it decide all the rest."""
        off = np.zeros(points.shape[1], dtype=bool)
        for _ in range(PLANE_ROUNDS):
            distances = [
                homography_residuals(
                    estimate_homography(points[0, ~off], points[v, ~off]), points[0], points[v]
                )
                for v in (1, 2)
            ]
            worst = np.max(distances, axis=0)
            off = worst > max(float(np.quantile(worst, 0.8)), PLANE_WIDTH * sigma_px)
        count = int(np.sum(worst > PLANE_WIDTH * sigma_px))
        if count < OFF_PLANE:
            raise StageFailure(
                "the matches do not determine the geometry of three views",
                f"{count} of {len(off)} tracks are off a plane or a rotation, {OFF_PLANE} are needed",
                "use matches of more than one plane from three places",
            )

    def _no_consensus(self, n: int, found: int) -> StageFailure:
        return StageFailure(
            "no geometry of three views explains the tracks",
            f"{found} of {n} tracks agree on one, no more than would by chance",
            "the photographs may not overlap, or the tracks are wrong",
        )


@dataclass(frozen=True)
class _Frame:
    """Image coordinates scale (xy - centre) of each view; ``centre`` (3, 2) px; one scale for all views."""

    centre: F64
    scale: float

    @classmethod
    def of(cls, points: F64) -> _Frame:
        """Raises ``StageFailure`` for points on a line or in one place of a view."""
        centre = np.median(points, axis=1)
        offsets = points - points.mean(axis=1, keepdims=True)
        spread = np.linalg.svd(offsets, compute_uv=False) / np.sqrt(points.shape[1])
        if not (spread[:, 1] > np.maximum(1e-9 * spread[:, 0], SMALLEST_PX)).all():
            raise StageFailure(
                "the tracked points of a photograph lie on one line",
                f"spread along and across {spread[:, 0].min():.3g} and {spread[:, 1].min():.3g} px",
                "such points leave the geometry of three views free",
            )
        return cls(centre, float(1.0 / spread[:, 0].mean()))

    @property
    def width_px(self) -> float:
        """Two standard deviations of the points' places."""
        return 2.0 / self.scale

    def tracks(self, points: F64) -> F64:
        """(N, 6) rows x1, y1, x2, y2, x3, y3."""
        return np.ascontiguousarray(
            (self.scale * (points - self.centre[:, None])).swapaxes(0, 1).reshape(-1, 6)
        )

    def _to_pixels(self) -> F64:
        H = np.tile(np.eye(3), (3, 1, 1))
        H[:, 0, 0] = H[:, 1, 1] = 1.0 / self.scale
        H[:, :2, 2] = self.centre
        return H

    def cameras_in_pixels(self, P: F64) -> F64:
        """Cameras (3, 3, 4) in pixels."""
        return np.asarray(self._to_pixels() @ P)

    def cameras_in_frame(self, P: F64) -> F64:
        """Cameras (3, 3, 4) of pixels in the frame, unit norm."""
        P = np.linalg.inv(self._to_pixels()) @ P
        return np.asarray(P / np.linalg.norm(P, axis=(1, 2), keepdims=True))

    def tensor_in_pixels(self, P: F64) -> F64:
        """T (3, 3, 3) in pixels of cameras in the frame."""
        return tensor_from_cameras(*self.cameras_in_pixels(P))


def _distances(P: F64, track: F64) -> F64:
    out = np.empty(len(track))
    reprojection_distances(P, track, out)
    return out


def _refined(P: F64, xy: F64, threshold: float) -> F64:
    """Cameras (3, 3, 4), unit norm, after a few steps to the least reprojection error of xy (3, n, 2)."""
    fit = refine_trifocal(tensor_from_cameras(*P), xy, NO_SEGMENTS, loss_px=threshold, max_iterations=SHORT)
    return np.asarray(fit.P / np.linalg.norm(fit.P, axis=(1, 2), keepdims=True))


def _track_noise(distances_px: F64, threshold_px: float, width_px: float) -> float:
    """Standard deviation of a coordinate of the right tracks, by expectation and maximisation; px.

    distances_px (N,) are roots of sums over three views, those of right tracks sigma times a chi variable of
    3 freedoms, less the 18 of a tensor fitted to them; wrong tracks are even in the space of the three
    residuals up to ``width_px``. Starts at ``threshold_px`` / 2.5 with half of the tracks right (Torr and
    Zisserman, MLESAC, 2000).
    """
    squared = np.minimum(distances_px, width_px) ** 2
    # The densities of the distances are d^2 times these: normal, and even in a ball.
    even, share, sigma = 3.0 / width_px**3, 0.5, threshold_px / 2.5
    for _ in range(MIXTURE_STEPS):
        normal = np.sqrt(2.0 / np.pi) / sigma**3 * np.exp(-0.5 * squared / sigma**2)
        right = share * normal / (share * normal + (1.0 - share) * even)
        total = float(right.sum())
        if total < 1.0:
            return sigma
        # Below a hundred-thousandth of the threshold the residuals are rounding.
        freedom = max(3.0 * total - 18.0, total)
        now = max(np.sqrt(float(right @ squared) / freedom), 1e-5 * threshold_px)
        share = min(max(total / len(squared), 1e-3), 1.0 - 1e-3)
        if abs(now - sigma) < 1e-4 * sigma:
            return float(now)
        sigma = float(now)
    return sigma


def _line_distances_px(P: F64, segments: F64) -> F64:
    """Root of the sum of squared distances of six segment ends to a reprojected line; (M,) px.

    P (3, 3, 4) and segments (3, M, 2, 2) in px; the line of space is that nearest to the three planes of its
    segments, which is exact for exact segments. inf where it has no image.
    """
    ends = homogenize(segments)
    planes = np.einsum("vma,vab->mvb", unit_normals(line_through(ends[:, :, 0], ends[:, :, 1])), P)
    planes = planes / np.maximum(np.linalg.norm(planes, axis=2, keepdims=True), 1e-300)
    lines = np.linalg.svd(planes)[2][:, 2:]
    p, q = np.einsum("vab,mb->vma", P, lines[:, 0]), np.einsum("vab,mb->vma", P, lines[:, 1])
    images = line_through(p, q)
    size = np.linalg.norm(images[:, :, :2], axis=2)
    images = images / np.where(size > 0.0, size, 1.0)[:, :, None]
    off = np.einsum("vmea,vma->mve", ends, images)
    total = np.sqrt(np.sum(off**2, axis=(1, 2)))
    return np.where((size > 0.0).all(axis=0), total, np.inf)


def _by_chance(found: int, n: int, radius: float) -> bool:
    """Whether wrong tracks alone are expected to show so many within ``radius`` widths more often than 1e-3.

    The number of samples times that of choices of the others times the chance of each (Moisan and Stival
    2004); a track is near with the volume of the ball of its three residuals.
    """
    chance = min(1.0, 4.19 * radius**3)
    k = np.arange(1, found + 1)
    choices = float(np.sum(np.log((n - found + k) / k)))
    samples = float(np.sum(np.log((found - np.arange(SAMPLE)) / np.arange(1, SAMPLE + 1))))
    expected = choices + samples + np.log(n) + (found - SAMPLE) * np.log(chance)
    return bool(expected > np.log(1e-3))
