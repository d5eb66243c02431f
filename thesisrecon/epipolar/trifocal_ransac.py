"""Section 3.6.3 by the method of 5.4: the trifocal tensor of tracks with outliers.

Samples of six tracks (Quan 1995; Torr and Zisserman 1997; HZ, algorithm 16.4) are scored by their
reprojection in all three views over several widths of the noise; every better sample is refined on its
inliers. At the end the noise is estimated, tracks and lines are tested against it, and the tensor with the
least reprojection error is computed.
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
    search_trifocal,
    three_view_distances,
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
# Maximum distance of an inlier in sigma: 99.3 % of a chi variable with 3 degrees of freedom.
INSIDE = 3.5
LINE_INSIDE = 3.2
OFF_PLANE, PLANE_ROUNDS, PLANE_WIDTH = 4, 6, 6.0
# Width of Huber's loss in sigma.
HUBER = 3.0
# Minimum number of tracks, and the spread below which powers underflow.
NEEDED, MIN_PX = 9, 1e-50
# Stricter than for matches without outliers: a plane with a few wrong tracks that fit has 0.25 to 0.4.
WEAK = 0.2


@dataclass(frozen=True)
class RobustTrifocal:
    """A trifocal fit of the inliers.

    Parameters
    ----------
    fit : TrifocalFit
        Fit of the inliers alone, in their order.
    inliers : ndarray (N,) of bool
        Inliers among the points.
    line_inliers : ndarray (M,) of bool
        Inliers among the lines.
    samples : int
        Number of samples.
    """

    fit: TrifocalFit
    inliers: B8
    line_inliers: B8
    samples: int


@dataclass(frozen=True)
class TrifocalRansac:
    """Robust estimation of the geometry of three views.

    Parameters
    ----------
    threshold_px : float
        Width of the score: root of the sum of a track's squared distances in three views. Tracks up to four
        times as far still contribute, which suits noise of 0.2 to 1 threshold.
    confidence : float
        Probability of a sample without outliers at which sampling stops.
    max_samples : int
        Maximum number of samples.
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
        """Estimate the trifocal tensor of points and lines with outliers.

        The lines do not take part in the search.

        Parameters
        ----------
        points : ndarray (3, N, 2)
            Points of N >= 9 tracks, px.
        segments : ndarray (3, M, 2, 2)
            Ends of matched line segments, px.
        rng : numpy.random.Generator, optional
            Source of the samples; seed 0 by default.

        Returns
        -------
        RobustTrifocal
            The fit and its inliers.

        Raises
        ------
        ValueError
            If the shapes are wrong or values are not finite.
        StageFailure
            If there are too few tracks, no more agree than expected by chance, or the inliers do not
            determine the tensor, exactly or within their noise.
        """
        points, segments = check_triplets(points, segments)
        rng = np.random.default_rng(0) if rng is None else rng
        n = points.shape[1]
        if n < NEEDED:
            raise StageFailure(
                "too few tracks for the robust trifocal tensor",
                f"found {n}, needed at least {NEEDED}",
                "use images with more overlap",
            )
        frame = _Frame.of(points)
        cameras, samples = self._search(frame, points, rng)
        fit, inliers = self._iterate_inliers(frame, cameras, points)
        line_inliers = np.zeros(segments.shape[1], dtype=bool)
        if segments.shape[1]:
            fit, inliers, line_inliers = self._with_lines(frame, fit, points, segments)
        p, s = points[:, inliers], segments[:, line_inliers]
        self._require_off_plane_tracks(p, fit.sigma_px)
        xy = np.concatenate([p, s.reshape(3, -1, 2)], axis=1)
        require_determined(fit, tensor_equations(p, s), xy, weak=WEAK)
        return RobustTrifocal(fit, inliers, line_inliers, samples)

    def _search(self, frame: _Frame, points: F64, rng: Generator) -> tuple[F64, int]:
        """Conditioned cameras of the best score and the number of samples."""
        # Random order, so that a bad sample is rejected early.
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
        """Try samples of four inliers and two outliers of the best cameras, and keep a better result.

        With a dominant plane most samples have all but one track on it and explain nothing else (Chum, Werner
        and Matas, CVPR 2005, for two views).
        """
        threshold = self.threshold_px * frame.scale
        near = _distances(best, track) < threshold / np.sqrt(WIDTHS[1])
        on, off = np.flatnonzero(near), np.flatnonzero(~near)
        if len(on) < SAMPLE or len(off) < 2:
            return best, bar
        four = on[draw_samples(rng.random((COMPLETIONS, SAMPLE - 2)), len(on))]
        two = off[draw_samples(rng.random((COMPLETIONS, 2)), len(off))]
        better = best.copy()
        # No four of the first five tracks may be coplanar, as they define the solver's frame. The score uses
        # the other tracks alone, since no sample on the plane is as good as the refined cameras.
        found = search_trifocal(
            track, np.concatenate([two, four], axis=1), track[off], threshold, 0.0, better
        )
        if not found > 0.0:
            return best, bar
        better, found = self._improve(frame, track, better, 0.0)
        return (better, found) if found > bar else (best, bar)

    def _improve(self, frame: _Frame, track: F64, P: F64, value: float) -> tuple[F64, float]:
        """Refine cameras on their inliers while their score increases."""
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

    def _iterate_inliers(self, frame: _Frame, P: F64, points: F64) -> tuple[TrifocalFit, B8]:
        """Fit the tracks within the estimated noise until they stay the same."""
        track = frame.tracks(points)
        T, inliers = frame.tensor_in_pixels(P), np.zeros(len(track), dtype=bool)
        for round_ in range(ROUNDS):
            now, sigma = self._test_tracks(frame, P, track)
            if round_ and np.array_equal(now, inliers):
                break
            inliers = now
            fit = refine_trifocal(T, points[:, inliers], NO_SEGMENTS, loss_px=HUBER * sigma)
            T, P = fit.T, frame.cameras_in_frame(fit.P)
        return fit, inliers

    def _with_lines(
        self, frame: _Frame, fit: TrifocalFit, points: F64, segments: F64
    ) -> tuple[TrifocalFit, B8, B8]:
        """Fit the inlier tracks and the lines that agree with them, tested twice."""
        for _ in range(2):
            now, sigma = self._test_tracks(frame, frame.cameras_in_frame(fit.P), frame.tracks(points))
            # Lines may have a different noise.
            lines = _line_distances_px(fit.P, segments) <= LINE_INSIDE * max(sigma, self.threshold_px / 2.0)
            fit = refine_trifocal(fit.T, points[:, now], segments[:, lines], loss_px=HUBER * sigma)
        return fit, now, lines

    def _test_tracks(self, frame: _Frame, P: F64, track: F64) -> tuple[B8, float]:
        """Inlier tracks and their noise in px; ``StageFailure`` if they may agree by chance."""
        distances_px = _distances(P, track) / frame.scale
        sigma = _track_noise(distances_px, self.threshold_px, frame.width_px)
        right = distances_px <= INSIDE * sigma
        found = int(right.sum())
        if found < NEEDED or _by_chance(found, len(track), INSIDE * sigma / frame.width_px):
            raise self._no_consensus(len(track), found)
        return right, sigma

    def _require_off_plane_tracks(self, points: F64, sigma_px: float) -> None:
        """Raise ``StageFailure`` if fewer than 4 tracks are off a plane: any two would determine the rest."""
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
                "the matches do not determine the trifocal tensor",
                f"{count} of {len(off)} tracks are off a plane or a rotation; {OFF_PLANE} are needed",
                "use matches off one plane from three different positions",
            )

    def _no_consensus(self, n: int, found: int) -> StageFailure:
        return StageFailure(
            "no trifocal tensor explains the tracks",
            f"{found} of {n} tracks agree with one, no more than expected by chance",
            "check that the images overlap and that the tracks are correct",
        )


@dataclass(frozen=True)
class _Frame:
    """Coordinates scale (xy - centre) with ``centre`` (3, 2) px and one scale for all views."""

    centre: F64
    scale: float

    @classmethod
    def of(cls, points: F64) -> _Frame:
        """Frame of points (3, N, 2); ``StageFailure`` for collinear points."""
        centre = np.median(points, axis=1)
        offsets = points - points.mean(axis=1, keepdims=True)
        spread = np.linalg.svd(offsets, compute_uv=False) / np.sqrt(points.shape[1])
        if not (spread[:, 1] > np.maximum(1e-9 * spread[:, 0], MIN_PX)).all():
            raise StageFailure(
                "the tracked points of an image are collinear",
                f"spread along and across {spread[:, 0].min():.3g} and {spread[:, 1].min():.3g} px",
                "collinear points do not determine the trifocal tensor; use tracks from the whole image",
            )
        return cls(centre, float(1.0 / spread[:, 0].mean()))

    @property
    def width_px(self) -> float:
        """Two standard deviations of the point positions."""
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
    three_view_distances(P, track, out)
    return out


def _refined(P: F64, xy: F64, threshold: float) -> F64:
    """Cameras (3, 3, 4), unit norm, after a few steps to the least reprojection error of xy (3, n, 2)."""
    fit = refine_trifocal(tensor_from_cameras(*P), xy, NO_SEGMENTS, loss_px=threshold, max_iterations=SHORT)
    return np.asarray(fit.P / np.linalg.norm(fit.P, axis=(1, 2), keepdims=True))


def _track_noise(distances_px: F64, threshold_px: float, width_px: float) -> float:
    """Standard deviation of a coordinate of the right tracks by expectation maximisation; px.

    distances_px (N,) are roots of sums over three views: sigma times a chi variable of 3 degrees of freedom
    for right tracks, minus the 18 of the tensor; wrong tracks are uniform in the space of the three residuals
    up to ``width_px``. Starts at ``threshold_px`` / 2.5 with half of the tracks right (Torr and Zisserman,
    MLESAC, 2000).
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
        # Residuals below 1e-5 of the threshold are rounding errors.
        freedom = max(3.0 * total - 18.0, total)
        now = max(np.sqrt(float(right @ squared) / freedom), 1e-5 * threshold_px)
        share = min(max(total / len(squared), 1e-3), 1.0 - 1e-3)
        if abs(now - sigma) < 1e-4 * sigma:
            return float(now)
        sigma = float(now)
    return sigma


def _line_distances_px(P: F64, segments: F64) -> F64:
    """Root of the sum of squared distances of six segment ends to a reprojected line; (M,) px.

    P (3, 3, 4) and segments (3, M, 2, 2) in px. The space line is nearest to the three planes of its
    segments, exact for exact segments; inf if it has no image.
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
    """Return whether wrong tracks alone reach so many within ``radius`` widths more often than 1e-3.

    Number of samples times choices of the others times the chance of each (Moisan and Stival 2004); the
    chance of a track is the volume of the ball of its three residuals.
    """
    chance = min(1.0, 4.19 * radius**3)
    k = np.arange(1, found + 1)
    choices = float(np.sum(np.log((n - found + k) / k)))
    samples = float(np.sum(np.log((found - np.arange(SAMPLE)) / np.arange(1, SAMPLE + 1))))
    expected = choices + samples + np.log(n) + (found - SAMPLE) * np.log(chance)
    return bool(expected > np.log(1e-3))
