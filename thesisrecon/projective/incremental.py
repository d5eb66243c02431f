"""Section 6.4, robust: the camera that most points of the model agree with.

The covariance gate: is a resected camera determined, or does it only fit?

A camera that sees a single plane fits its points at sub-pixel residual with an arbitrary P. What tells is the
covariance of P: where it would put points of the *whole* scene, not only those it sees.

Whether the cameras of a model agree with the epipolar geometry that was found without it.

A camera that a crowd of wrong matches placed fits those matches, and may well be determined by them. What it
does not fit are the matches of its pairs, verified pair by pair before there was a model.

Chapter 6 as a whole: from tracks and fundamental matrices to cameras and points in one projective frame.

Begin with a pair, add one camera after the other by resection, triangulate, adjust, discard (Beardsley,
Zisserman and Murray, IJCV 23, 1997). What makes it hold on photographs are its gates: a camera enters only
when its covariance says that it is determined, and stays only while it explains what it sees and agrees with
the epipolar geometry of its pairs; the others wait, and those still waiting at the end are left to
calibrated resection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.homogeneous import whitening_transform
from thesisrecon.geometry.resection import resect_linear
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals
from thesisrecon.numerics.partial_bundle import refine_camera
from thesisrecon.projective.initial_pair import (
    initial_cameras,
    rank_initial_pairs,
    require_pair_with_parallax,
)
from thesisrecon.projective.model import (
    LOSS_SIGMAS,
    ProjectiveModel,
    adjust_all,
    adjust_locally,
    coverage_of_views,
    expand_to_all_tracks,
    retriangulate_points,
    select_tracks,
    select_tracks_with_parallax,
    subset_tracks,
    to_reconstruction,
)
from thesisrecon.records import Reconstruction, Tracks, TwoView

_SAMPLE = 6


def resect_ransac(
    X: F64, xy: F64, *, threshold_px: float, rng: np.random.Generator, batch: int = 64, max_batches: int = 12
) -> tuple[F64 | None, B8]:
    """RANSAC over six-point samples with a truncated-quadratic score; X (M, 4), xy (M, 2) px.

    The signs of X must be such that their depths have one sign; points of the other one count as outliers.
    Samples are drawn and solved a batch at a time; it stops when a sample free of outliers has been drawn
    with probability 0.999 at the best inlier share so far. Returns the camera of the best sample
    re-estimated from its inliers, depths positive (None where there are fewer than six), and the inliers
    (M,).
    """
    none = np.zeros(len(X), dtype=bool)
    if len(X) < _SAMPLE:
        return None, none
    # The points of one view may crowd in a corner of the model's frame: whitened anew, no digits are lost.
    M = whitening_transform(X)
    Y = X @ M.T
    Y /= np.maximum(np.linalg.norm(Y, axis=1, keepdims=True), 1e-300)
    best_cost, best, drawn = np.inf, None, 0
    scored = rng.choice(len(Y), 1000, replace=False) if len(Y) > 1000 else np.arange(len(Y))
    for _ in range(max_batches):
        samples = rng.random((batch, len(Y))).argpartition(_SAMPLE - 1, axis=1)[:, :_SAMPLE]
        P = resect_linear(Y[samples], xy[samples])
        P = np.concatenate([P, -P])
        squared = _squared_residuals(P, Y[scored], xy[scored]) / threshold_px**2
        cost = np.minimum(squared, 1.0).sum(axis=1)
        drawn += batch
        if cost.min() < best_cost:
            best_cost, best = float(cost.min()), P[cost.argmin()]
        share = 1.0 - best_cost / len(scored)
        if drawn * np.log1p(-min(share**_SAMPLE, 1 - 1e-9)) < np.log(1e-3):
            break
    if best is None:
        return None, none
    found, inlier = _polish(best, Y, xy, threshold_px)
    return (None if found is None else found @ M), inlier


def _polish(P: F64, X: F64, xy: F64, threshold_px: float) -> tuple[F64 | None, B8]:
    inlier = _squared_residuals(P[None], X, xy)[0] < threshold_px**2
    for _ in range(2):
        if inlier.sum() < _SAMPLE:
            return None, inlier
        candidate = resect_linear(X[inlier], xy[inlier])
        candidate *= np.sign(np.median(X[inlier] @ candidate[2])) or 1.0
        support = _squared_residuals(candidate[None], X, xy)[0] < threshold_px**2
        if support.sum() < inlier.sum():
            break
        P, inlier = candidate, support
    return P, inlier


def _squared_residuals(P: F64, X: F64, xy: F64) -> F64:
    """(B, M) squared reprojection residuals, infinite for a point on or behind the principal plane."""
    xh = np.einsum("bij,mj->bmi", P, X)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        squared = np.sum((xh[..., :2] / xh[..., 2:] - xy) ** 2, axis=-1)
    return np.where((xh[..., 2] > 0) & np.isfinite(squared), squared, np.inf)


def projection_std_px(P: F64, covariance: F64, X: F64) -> F64:
    """Standard deviation (px) of the projection of each point under the camera's covariance.

    P (3, 4), covariance (12, 12) of its row-major entries, X (N, 4) -> (N,): root of half the trace of J C
    J'. Points near the camera's principal plane come out infinite.
    """
    xh = X @ P.T
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = xh[:, :2] / xh[:, 2:]
        A = X / xh[:, 2:]
    blocks = covariance.reshape(3, 4, 3, 4)
    quadratic = np.einsum("na,rasb,nb->nrs", A, blocks, A)
    var_u = quadratic[:, 0, 0] - 2 * uv[:, 0] * quadratic[:, 0, 2] + uv[:, 0] ** 2 * quadratic[:, 2, 2]
    var_v = quadratic[:, 1, 1] - 2 * uv[:, 1] * quadratic[:, 1, 2] + uv[:, 1] ** 2 * quadratic[:, 2, 2]
    spread = np.sqrt(np.maximum((var_u + var_v) / 2.0, 0.0))
    return np.where(np.isfinite(spread), spread, np.inf)


def epipolar_inlier_ratios(P: F64, registered: B8, pairs: Sequence[TwoView], *, gate_px: float) -> F64:
    """Share of the verified matches of each pair within ``gate_px`` (Sampson) of the cameras' F; -> (M,).

    P (V, 3, 4). NaN for pairs that are not accepted, of which a view is not registered, or whose cameras
    have one centre.
    """
    shares = np.full(len(pairs), np.nan)
    for n, pair in enumerate(pairs):
        if not (pair.accepted and registered[pair.i] and registered[pair.j]):
            continue
        try:
            F = fundamental_from_cameras(P[pair.i], P[pair.j])
        except ValueError:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.abs(sampson_residuals(F, pair.xy1, pair.xy2))
        shares[n] = float(np.mean(distance < gate_px))
    return shares


def find_inconsistent_view(
    P: F64, registered: B8, pairs: Sequence[TwoView], *, gate_px: float, least: float
) -> tuple[int, float] | None:
    """The registered view that agrees least with its pairs, and its share; None where all reach ``least``.

    A view's share is that of all its verified matches with other registered views. One view at a time: the
    partners of a wrong camera look worse than they are as long as it is there.
    """
    shares = epipolar_inlier_ratios(P, registered, pairs, gate_px=gate_px)
    total, agreed = np.zeros(len(P)), np.zeros(len(P))
    for pair, share in zip(pairs, shares, strict=True):
        if np.isfinite(share):
            total[[pair.i, pair.j]] += pair.inliers
            agreed[[pair.i, pair.j]] += share * pair.inliers
    share_of_view = np.where(total > 0, agreed / np.maximum(total, 1.0), 1.0)
    worst = int(np.argmin(share_of_view))
    return (worst, float(share_of_view[worst])) if share_of_view[worst] < least else None


MIN_SHARE = 0.3
"""Share of the points a camera sees that must agree with it."""
QUANTILE = 0.8
"""The gate looks at the spread that this share of the points keeps below."""


@dataclass(frozen=True)
class IncrementalProjective:
    """Incremental projective reconstruction behind a covariance gate.

    Parameters
    ----------
    points_per_view : tracks that take part, longest first, so that each view has about this many (the others
        are triangulated in the metric stage, where all are used).
    min_points : matches a resection needs: twice the six that always agree; the gate judges their worth.
    outlier_sigmas : residual gates in noise sigmas of the early and the late rounds.
    noise_floor_px : the noise is never taken to be below this (localisation of corners).
    max_projection_std_rel : gate on a camera: the 80 % quantile of its predicted spread over all points, as a share of
        the long side of the image. None lets every camera in.
    min_epipolar_inlier_ratio : share of a camera's verified matches that must lie on the epipolar lines of the finished
        model.
    bundle_iterations, final_rounds : Levenberg-Marquardt steps after each camera; rounds of re-triangulation,
        adjustment and filtering at the end.
    adjust_growth : everything is adjusted whenever the cameras have grown by this factor; in between only the
        new camera and its ``neighbours`` nearest, which keeps the cost of a long sequence down.
    restarts : initial pairs that one attempt tries as long as views that could take part stay out.
    """

    points_per_view: int = 1500
    min_points: int = 12
    outlier_sigmas: tuple[float, float] = (12.0, 7.0)
    noise_floor_px: float = 0.3
    max_projection_std_rel: float | None = 0.01
    min_epipolar_inlier_ratio: float = 0.5
    bundle_iterations: int = 4
    final_rounds: int = 3
    global_bundle_growth: float = 1.2
    local_bundle_views: int = 4
    max_initial_pairs: int = 3

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

        ``sizes`` (V, 2) width, height; each ``attempt`` begins with other initial pairs. ``StageFailure``
        where no pair begins.
        """
        ranked = rank_initial_pairs(tracks, pairs)
        if not ranked:
            raise StageFailure(
                "no two photographs could be tied together",
                f"none of {counted(len(pairs), 'pair')} was accepted",
                "take photographs that overlap by more than half and show texture",
            )
        require_pair_with_parallax(pairs)
        if attempt >= len(ranked):
            raise StageFailure(
                "no other pair of photographs to begin with", f"{len(ranked)} accepted pairs, all tried"
            )
        usable = select_tracks_with_parallax(tracks, pairs)
        keep = select_tracks(tracks, usable, points_per_view=self.points_per_view)
        selected = subset_tracks(tracks, keep)
        best = self._best_start(selected, pairs, sizes, ranked[attempt:], rng)
        return expand_to_all_tracks(to_reconstruction(best), tracks, keep)

    def _best_start(
        self,
        tracks: Tracks,
        pairs: Sequence[TwoView],
        sizes: I64,
        starts: Sequence[TwoView],
        rng: np.random.Generator,
    ) -> ProjectiveModel:
        """The model with most cameras, then most explained observations, over the initial pairs tried.

        Another pair is tried only where it may give more: one with a view that is out and that was not
        merely postponed by the gate; and once half of the views are in, no other part of them is larger.
        """
        best, left, half = None, list(starts), len(sizes) // 2 + 1
        for tried in range(self.max_initial_pairs):
            found = self._from_pair(tracks, pairs, left.pop(0), sizes, rng)
            if best is None or _rank(found) > _rank(best):
                best = found
            out = [v for v in np.flatnonzero(~best.registered) if not best.deferred[v]]
            left = [pair for pair in left if pair.i in out or pair.j in out]
            if not left or (tried > 0 and best.registered.sum() >= half):
                break
        assert best is not None
        return best

    def _from_pair(
        self,
        tracks: Tracks,
        pairs: Sequence[TwoView],
        start: TwoView,
        sizes: I64,
        rng: np.random.Generator,
    ) -> ProjectiveModel:
        model = self.begin(tracks, start, sizes)
        self.complete(model, pairs, rng)
        return model

    def complete(self, model: ProjectiveModel, pairs: Sequence[TwoView], rng: np.random.Generator) -> None:
        """Add, in place, what views can be added to a model begun in any way; discard what proves wrong."""
        self._grow(model, rng)
        while self._discard_camera(model, pairs):
            adjust_all(model, self.bundle_iterations, self.outlier_sigmas[0])
            self._grow(model, rng)

    def begin(self, tracks: Tracks, pair: TwoView, sizes: I64) -> ProjectiveModel:
        """Cameras (3.42) and points of the first two views."""
        model = ProjectiveModel.empty(
            tracks, sizes, sigma_px=pair.sigma_px, noise_floor_px=self.noise_floor_px
        )
        views = [pair.i, pair.j]
        model.P[views] = initial_cameras(pair, sizes[views])
        model.registered[views] = True
        for _ in range(2):
            retriangulate_points(model, self.outlier_sigmas[0])
            adjust_all(model, 2 * self.bundle_iterations, self.outlier_sigmas[0])
        return model

    def _grow(self, model: ProjectiveModel, rng: np.random.Generator) -> None:
        """Camera after camera, with a bundle adjustment after each; then the final rounds."""
        early, late = self.outlier_sigmas
        adjusted = int(model.registered.sum())
        while (view := self.add_next_camera(model, rng)) is not None:
            if model.registered.sum() >= self.global_bundle_growth * adjusted:
                adjust_all(model, self.bundle_iterations, early)
                adjusted = int(model.registered.sum())
            else:
                adjust_locally(
                    model, view, self.bundle_iterations, early, local_bundle_views=self.local_bundle_views
                )
        for round_number in range(self.final_rounds):
            adjust_all(model, 2 * self.bundle_iterations, late if round_number else early)

    def add_next_camera(self, model: ProjectiveModel, rng: np.random.Generator) -> int | None:
        """Resect the view that sees most of the model, widest spread, and passes the gate; None when none
        does."""
        t = model.tracks
        ready = model.valid[t.point_index]
        counts = np.bincount(t.view_index[ready], minlength=t.n_views)
        waiting = ~model.registered & ~model.rejected
        spread = np.where(waiting, coverage_of_views(model.cell, ready, t.n_views), 0.0)
        for view in np.argsort(-spread, kind="stable"):
            if spread[view] <= 0.0:
                return None
            if counts[view] < self.min_points:
                model.reasons[view] = (
                    f"sees only {counted(counts[view], 'point')} of the model (needs {self.min_points})"
                )
            elif self._try_camera(model, int(view), rng):
                return int(view)
        return None

    def _try_camera(self, model: ProjectiveModel, view: int, rng: np.random.Generator) -> bool:
        t, early = model.tracks, self.outlier_sigmas[0]
        k = np.flatnonzero((t.view_index == view) & model.valid[t.point_index])
        X, xy = model.X[t.point_index[k]], t.xy[k]
        P, inlier = resect_ransac(X, xy, threshold_px=early * model.sigma_px, rng=rng)
        if P is None or inlier.sum() < self.min_points or inlier.mean() < MIN_SHARE:
            model.reasons[view] = (
                f"only {int(inlier.sum())} of {len(k)} points of the model agree with one camera"
            )
            return False
        model.deferred[view], P = self._gate(model, view, P, X[inlier], xy[inlier])
        if model.deferred[view]:
            return False
        model.P[view] = P
        model.registered[view] = True
        model.reasons[view] = ""
        seen = np.zeros(t.n_points, dtype=bool)
        seen[t.point_index[t.view_index == view]] = True
        retriangulate_points(model, early, points=seen)
        return True

    def _gate(self, model: ProjectiveModel, view: int, P: F64, X: F64, xy: F64) -> tuple[bool, F64]:
        """Whether the camera must wait, and the camera refined, oriented so that its points have positive
        depth."""
        refined = refine_camera(P, X, xy, loss_px=LOSS_SIGMAS * model.sigma_px, iterations=20)
        P = refined.P * np.sign(np.median(X @ refined.P[2]))
        if self.max_projection_std_rel is None:
            return False, P
        covariance = refined.covariance * model.sigma_px**2
        spread = projection_std_px(refined.P, covariance, model.X[model.valid])
        limit = self.max_projection_std_rel * float(model.sizes[view].max())
        quantile = float(np.quantile(spread, QUANTILE))
        if quantile < limit:
            return False, P
        model.reasons[view] = (
            f"its {len(X)} points, near one plane, do not determine its camera before calibration "
            f"(predicted spread {min(quantile, 1e6):.0f} px, limit {limit:.0f} px)"
        )
        return True, P

    def _discard_camera(self, model: ProjectiveModel, pairs: Sequence[TwoView]) -> bool:
        """Take out, for good, a camera that proved wrong; False where all hold, or too few are left."""
        if model.registered.sum() <= 2:
            return False
        counts, shares = model.explained()
        shares[~model.registered] = 1.0
        view = int(np.argmin(shares))
        reason = f"the finished model explains only {counts[view]} of its points ({shares[view]:.0%})"
        if shares[view] >= MIN_SHARE:
            found = find_inconsistent_view(
                model.P, model.registered, pairs,
                gate_px=self.outlier_sigmas[0] * model.sigma_px, least=self.min_epipolar_inlier_ratio,
            )  # fmt: skip
            if found is None:
                return False
            view, share = found
            reason = f"the model agrees with only {share:.0%} of its verified matches"
        model.registered[view] = False
        model.rejected[view] = True
        model.reasons[view] = reason
        retriangulate_points(model, self.outlier_sigmas[0])
        return True


def _rank(model: ProjectiveModel) -> tuple[int, int]:
    return int(model.registered.sum()), int(model.used.sum())
