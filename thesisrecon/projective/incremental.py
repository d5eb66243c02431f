"""Chapter 6 as a whole: from tracks and fundamental matrices to cameras and points in one projective frame.

Begin with a pair, add one camera after the other by resection, triangulate, adjust, discard (Beardsley,
Zisserman and Murray, IJCV 23, 1997). What makes it hold on photographs is the gate: a camera enters only
when its covariance says that it is determined; the others wait, and those still waiting at the end are left
to calibrated resection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.optimize.conditioning import whitening_transform
from thesisrecon.optimize.projective_bundle import refine_projective_bundle
from thesisrecon.optimize.triangulation_refine import refine_camera, refine_points
from thesisrecon.projective.gate import predicted_spread_px
from thesisrecon.projective.initial_pair import (
    initial_cameras,
    rank_initial_pairs,
    require_parallax,
)
from thesisrecon.projective.resection import resect_robust
from thesisrecon.projective.selection import (
    onto_all_tracks,
    select_tracks,
    subset_tracks,
    tracks_with_parallax,
)
from thesisrecon.robust.noise import noise_from_distances
from thesisrecon.types import B8, I64, Reconstruction, Tracks, TwoView

F64 = NDArray[np.float64]


@dataclass
class GrowingModel:
    """The reconstruction while it grows. ``ok`` marks the observations that the current cameras explain."""

    tracks: Tracks
    sizes: I64
    P: F64
    X: F64
    registered: B8
    ok: B8
    sigma_px: float = 1.0
    reasons: list[str] = field(default_factory=list)

    @property
    def used(self) -> B8:
        """Observations of registered views that are explained."""
        return self.ok & self.registered[self.tracks.view_index]

    @property
    def valid(self) -> B8:
        """Points with at least two explained observations."""
        return np.bincount(self.tracks.point_index[self.used], minlength=self.tracks.n_points) >= 2


@dataclass(frozen=True)
class GatedIncremental:
    """Incremental projective reconstruction behind a covariance gate.

    Parameters
    ----------
    points_per_view : tracks that take part, longest first, so that each view has about this many (the others
        are triangulated in the metric stage, where all are used).
    min_points : matches a resection needs.
    outlier_sigmas : residual gates in noise sigmas of the early and the late rounds.
    noise_floor_px : the noise is never taken to be below this (localisation of corners).
    max_spread : gate on a camera: the 80 % quantile of its predicted spread over all points, as a share of
        the long side of the image. None lets every camera in.
    bundle_iterations, final_rounds : Levenberg-Marquardt steps after each camera; rounds of re-triangulation,
        adjustment and filtering at the end.
    """

    points_per_view: int = 1500
    min_points: int = 20
    outlier_sigmas: tuple[float, float] = (12.0, 7.0)
    noise_floor_px: float = 0.3
    max_spread: float | None = 0.01
    bundle_iterations: int = 6
    final_rounds: int = 3
    restarts: int = 3

    def reconstruct(
        self,
        tracks: Tracks,
        pairs: Sequence[TwoView],
        sizes: I64,
        *,
        rng: np.random.Generator,
        attempt: int = 0,
    ) -> Reconstruction:
        """Cameras and points from tracks (the whole of them; a selection does the work) and verified pairs.

        ``sizes`` (V, 2) width, height; ``attempt`` > 0 begins with another initial pair. ``StageFailure``
        where no pair begins or fewer than two cameras result.
        """
        ranked = rank_initial_pairs(tracks, pairs)
        if not ranked:
            raise StageFailure(
                "no two photographs could be tied together",
                f"{len(pairs)} pairs were compared and none was accepted",
                "take photographs that overlap by more than half and show texture",
            )
        require_parallax(pairs)
        usable = tracks_with_parallax(tracks, pairs)
        keep = select_tracks(tracks, usable, points_per_view=self.points_per_view)
        selected = subset_tracks(tracks, keep)
        best: Reconstruction | None = None
        for pair in ranked[attempt : attempt + self.restarts]:
            found = self._from_pair(selected, pair, sizes, rng)
            if best is None or found.registered.sum() > best.registered.sum():
                best = found
            if best.registered.sum() >= min(0.5 * len(sizes) + 1, len(sizes)):
                break
        if best is None:
            raise StageFailure(
                "no other pair of photographs to begin with", f"{len(ranked)} accepted pairs, all tried"
            )
        return onto_all_tracks(best, tracks, keep)

    def _from_pair(
        self, tracks: Tracks, pair: TwoView, sizes: I64, rng: np.random.Generator
    ) -> Reconstruction:
        state = self.begin(tracks, pair, sizes)
        while self.add_next_camera(state, rng):
            self.adjust(state, self.bundle_iterations, self.outlier_sigmas[0])
        for round_number in range(self.final_rounds):
            late = round_number > 0
            self.adjust(state, 2 * self.bundle_iterations, self.outlier_sigmas[int(late)])
        return finish(state)

    def begin(self, tracks: Tracks, pair: TwoView, sizes: I64) -> GrowingModel:
        """Cameras (3.42) and points of the first two views."""
        P = np.zeros((tracks.n_views, 3, 4))
        P[pair.i], P[pair.j] = initial_cameras(pair, sizes[[pair.i, pair.j]])
        registered = np.zeros(tracks.n_views, dtype=bool)
        registered[[pair.i, pair.j]] = True
        state = GrowingModel(
            tracks, sizes, P, np.zeros((tracks.n_points, 4)), registered, np.zeros(len(tracks.xy), bool)
        )
        state.reasons = ["" for _ in range(tracks.n_views)]
        state.sigma_px = max(pair.sigma_px, self.noise_floor_px)
        for _ in range(2):
            self._retriangulate(state, self.outlier_sigmas[0])
            self.adjust(state, 2 * self.bundle_iterations, self.outlier_sigmas[0])
        return state

    def _retriangulate(self, state: GrowingModel, sigmas: float) -> None:
        """Points afresh from all observations in registered views; mark what the cameras explain."""
        t = state.tracks
        near = state.registered[t.view_index]
        view, point, xy = t.view_index[near], t.point_index[near], t.xy[near]
        X = triangulate_observations(state.P, view, point, xy, t.n_points)
        X = refine_points(state.P, X, view, point, xy, loss_px=state.sigma_px, iterations=4)
        state.X = X
        self._mark(state, sigmas)
        # A wrong observation spoils its point: try once more with what agreed.
        spoiled = np.bincount(t.point_index[near & ~state.ok], minlength=t.n_points) > 0
        again = state.used & spoiled[t.point_index]
        if again.any():
            v, p, x = t.view_index[again], t.point_index[again], t.xy[again]
            Y = triangulate_observations(state.P, v, p, x, t.n_points)
            Y = refine_points(state.P, Y, v, p, x, loss_px=state.sigma_px, iterations=4)
            better = np.bincount(p, minlength=t.n_points) >= 2
            state.X = np.where(better[:, None], Y, state.X)
            self._mark(state, sigmas)

    def _mark(self, state: GrowingModel, sigmas: float) -> None:
        """Signs of cameras and points made consistent, then ``ok`` = in front and within the gate."""
        t = state.tracks
        near = state.registered[t.view_index] & (np.abs(state.X[t.point_index]).sum(axis=1) > 0)
        k = np.flatnonzero(near)
        xh = np.einsum("kab,kb->ka", state.P[t.view_index[k]], state.X[t.point_index[k]])
        votes = np.bincount(t.point_index[k], np.sign(xh[:, 2]), minlength=t.n_points)
        flip = np.where(votes < 0, -1.0, 1.0)
        state.X = state.X * flip[:, None]
        depth = xh[:, 2] * flip[t.point_index[k]]
        with np.errstate(divide="ignore", invalid="ignore"):
            residual = np.linalg.norm(xh[:, :2] / xh[:, 2:] - t.xy[k], axis=1)
        residual = np.nan_to_num(residual, nan=np.inf)
        state.ok = np.zeros(len(t.xy), dtype=bool)
        state.ok[k] = (residual < sigmas * state.sigma_px) & (depth > 0)
        lonely = ~state.valid
        state.ok &= ~lonely[t.point_index]

    def adjust(self, state: GrowingModel, iterations: int, sigmas: float) -> None:
        """Bundle adjustment, the noise estimated afresh, then all points anew under a gate of ``sigmas``."""
        t, used = state.tracks, state.used
        if used.sum() < 2 * 8:
            return
        result = refine_projective_bundle(
            state.P, state.X, t.view_index[used], t.point_index[used], t.xy[used],
            loss_px=2.0 * state.sigma_px, max_iterations=iterations,
        )  # fmt: skip
        state.P, state.X = _whitened(result.P, result.X, state)
        norm = np.linalg.norm(result.residual_px, axis=1)
        # Two-view points carry less residual than noise: hence the floor.
        state.sigma_px = max(noise_from_distances(norm), self.noise_floor_px)
        self._retriangulate(state, sigmas)

    def add_next_camera(self, state: GrowingModel, rng: np.random.Generator) -> bool:
        """Resect the view with the most triangulated points that passes the gate; False when none does."""
        t = state.tracks
        ready = state.valid[t.point_index]
        counts = np.bincount(t.view_index[ready], minlength=t.n_views)
        counts[state.registered] = 0
        for view in np.argsort(-counts, kind="stable"):
            if counts[view] == 0:
                return False
            if counts[view] < self.min_points:
                state.reasons[view] = (
                    f"sees only {counts[view]} points of the model (needs {self.min_points})"
                )
                continue
            if self._try_camera(state, int(view), rng):
                return True
        return False

    def _try_camera(self, state: GrowingModel, view: int, rng: np.random.Generator) -> bool:
        t = state.tracks
        k = np.flatnonzero((t.view_index == view) & state.valid[t.point_index])
        X, xy = state.X[t.point_index[k]], t.xy[k]
        threshold = self.outlier_sigmas[0] * state.sigma_px
        P, inlier = resect_robust(X, xy, threshold_px=threshold, rng=rng)
        if P is None or inlier.sum() < self.min_points or inlier.mean() < 0.3:
            state.reasons[view] = (
                f"only {int(inlier.sum())} of {len(k)} points of the model agree with one camera"
            )
            return False
        refined = refine_camera(P, X[inlier], xy[inlier], loss_px=2.0 * state.sigma_px, iterations=20)
        if self.max_spread is not None:
            covariance = refined.covariance * state.sigma_px**2
            spread = predicted_spread_px(refined.P, covariance, state.X[state.valid])
            limit = self.max_spread * float(state.sizes[view].max())
            quantile = float(np.quantile(spread, 0.8))
            if not quantile < limit:
                state.reasons[view] = (
                    f"its {int(inlier.sum())} points, near one plane, do not determine its camera before "
                    f"calibration (predicted spread {min(quantile, 1e6):.0f} px, limit {limit:.0f} px)"
                )
                return False
        P = refined.P * np.sign(np.median(X[inlier] @ refined.P[2]))
        state.P[view] = P
        state.registered[view] = True
        state.reasons[view] = ""
        self._retriangulate(state, self.outlier_sigmas[0])
        return True


def _whitened(P: F64, X: F64, state: GrowingModel) -> tuple[F64, F64]:
    """Keep the frame well-conditioned: sum XX' = I over the valid points, unit norms, signs kept."""
    valid = state.valid
    T = whitening_transform(X[valid])
    X = X @ T.T
    P = P @ np.linalg.inv(T)
    length = np.linalg.norm(X, axis=1, keepdims=True)
    norm = np.linalg.norm(P, axis=(1, 2), keepdims=True)
    return P / np.where(norm > 0, norm, 1.0), X / np.where(length > 0, length, 1.0)


def finish(state: GrowingModel) -> Reconstruction:
    """The record of a grown model, with a reason for every view that is not in it."""
    for view in np.flatnonzero(~state.registered):
        if not state.reasons[view]:
            state.reasons[view] = "shares no points with the model"
    valid = state.valid
    X = np.where(valid[:, None], state.X, 0.0)
    P = np.where(state.registered[:, None, None], state.P, 0.0)
    return Reconstruction(
        "projective", P, X, state.registered, valid, state.used & valid[state.tracks.point_index],
        state.tracks, state.sizes, state.sigma_px, tuple(state.reasons),
    )  # fmt: skip
