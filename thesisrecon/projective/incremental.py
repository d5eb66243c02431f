"""Incremental projective reconstruction (chapter 6; P. Beardsley, A. Zisserman, D. Murray, IJCV 23, 1997).

An initial pair, then one camera after the other: resection, triangulation, bundle adjustment, outlier
removal. A camera is accepted if its covariance shows that it is determined: a view of a single plane fits its
points at subpixel residuals with an arbitrary P. It is kept if it explains its points and agrees with the
verified matches of its pairs, since many wrong matches can determine a wrong camera. Other views are deferred
to calibrated resection.
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
    retriangulate_points,
    to_reconstruction,
)
from thesisrecon.projective.track_selection import (
    coverage_of_views,
    expand_to_all_tracks,
    select_tracks,
    select_tracks_with_parallax,
    subset_tracks,
)
from thesisrecon.records import Reconstruction, Tracks, TwoView

_SAMPLE = 6
# Required share of inliers among the points that a camera sees.
_MIN_INLIER_RATIO = 0.3
# Quantile over all points of the projection standard deviations that is tested.
_STD_QUANTILE = 0.8


def resect_ransac(
    X: F64, xy: F64, *, threshold_px: float, rng: np.random.Generator, batch: int = 64, max_batches: int = 12
) -> tuple[F64 | None, B8]:
    """Resect a camera by RANSAC over six-point samples with a truncated-quadratic score (6.4; HZ 7.1).

    Samples are drawn in batches until one without outliers was drawn with probability 0.999 at the best
    inlier ratio.

    Parameters
    ----------
    X : ndarray (M, 4)
        Points, signed so that depths have one sign; points of the other sign are outliers.
    xy : ndarray (M, 2)
        Pixels.
    threshold_px : float
        Inlier threshold.
    rng : numpy.random.Generator
        Draws the samples.
    batch, max_batches : int
        Samples per batch and maximum number of batches.

    Returns
    -------
    P : ndarray (3, 4) or None
        Camera estimated from the inliers, depths positive; None below six inliers.
    inlier : ndarray (M,) of bool
        Inliers.
    """
    none = np.zeros(len(X), dtype=bool)
    if len(X) < _SAMPLE:
        return None, none
    # The points of one view may fill a corner of the frame: whitening keeps all digits.
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
    found, inlier = _refit(best, Y, xy, threshold_px)
    return (None if found is None else found @ M), inlier


def _refit(P: F64, X: F64, xy: F64, threshold_px: float) -> tuple[F64 | None, B8]:
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
    """Return squared reprojection residuals (B, M), inf on or behind the principal plane."""
    xh = np.einsum("bij,mj->bmi", P, X)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        squared = np.sum((xh[..., :2] / xh[..., 2:] - xy) ** 2, axis=-1)
    return np.where((xh[..., 2] > 0) & np.isfinite(squared), squared, np.inf)


def projection_std_px(P: F64, covariance: F64, X: F64) -> F64:
    """Compute the standard deviation of projections under the covariance of a camera.

    The root of half the trace of J C J'.

    Parameters
    ----------
    P : ndarray (3, 4)
        Camera.
    covariance : ndarray (12, 12)
        Covariance of its entries, row-major.
    X : ndarray (N, 4)
        Points of the whole scene.

    Returns
    -------
    ndarray (N,)
        Standard deviations in pixels; inf near the principal plane.
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


def _epipolar_inlier_ratios(P: F64, registered: B8, pairs: Sequence[TwoView], *, threshold_px: float) -> F64:
    """Return the share (M,) of verified matches of each pair within ``threshold_px`` (Sampson) of F.

    NaN for pairs that are not accepted, not registered, or have one camera centre.
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
        shares[n] = float(np.mean(distance < threshold_px))
    return shares


def find_inconsistent_view(
    P: F64, registered: B8, pairs: Sequence[TwoView], *, threshold_px: float, min_ratio: float
) -> tuple[int, float] | None:
    """Find the registered view that agrees least with the verified matches of its pairs.

    One view at a time, since a wrong camera also lowers the ratios of its partners.

    Parameters
    ----------
    P : ndarray (V, 3, 4)
        Cameras.
    registered : ndarray (V,) of bool
        Views with a camera.
    pairs : sequence of TwoView
        Verified pairs.
    threshold_px : float
        Largest Sampson distance of an inlier.
    min_ratio : float
        Required inlier ratio over all matches of a view with registered views.

    Returns
    -------
    tuple of (int, float) or None
        The view and its ratio; None if all views reach ``min_ratio``.
    """
    shares = _epipolar_inlier_ratios(P, registered, pairs, threshold_px=threshold_px)
    total, agreed = np.zeros(len(P)), np.zeros(len(P))
    for pair, share in zip(pairs, shares, strict=True):
        if np.isfinite(share):
            total[[pair.i, pair.j]] += pair.inliers
            agreed[[pair.i, pair.j]] += share * pair.inliers
    share_of_view = np.where(total > 0, agreed / np.maximum(total, 1.0), 1.0)
    worst = int(np.argmin(share_of_view))
    return (worst, float(share_of_view[worst])) if share_of_view[worst] < min_ratio else None


@dataclass(frozen=True)
class IncrementalProjective:
    """Incremental projective reconstruction with a covariance test of each camera.

    Parameters
    ----------
    points_per_view : int
        Approximate number of tracks per view, longest first; the metric stage uses all.
    min_points : int
        Matches needed for resection: twice the six that always agree.
    outlier_sigmas : (float, float)
        Inlier thresholds in noise sigmas of the early and late rounds.
    noise_floor_px : float
        Lower bound of the noise (localization of corners).
    max_projection_std_rel : float, optional
        Largest 80 % quantile of the projection standard deviations over all points, as a share of the long
        side; None accepts every camera.
    min_epipolar_inlier_ratio : float
        Required share of verified matches on the epipolar lines of the finished model.
    bundle_iterations, final_rounds : int
        Levenberg-Marquardt steps after each camera; final rounds of triangulation, adjustment and filtering.
    global_bundle_growth : float
        Growth factor of the number of cameras after which everything is adjusted.
    local_bundle_views : int
        Number of views adjusted with a new one in between.
    max_initial_pairs : int
        Initial pairs tried in one attempt while usable views are missing.

    References
    ----------
    P. Beardsley, A. Zisserman, D. Murray, IJCV 23, 1997; HZ 18.
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
        """Reconstruct cameras and points from tracks and verified pairs.

        Parameters
        ----------
        tracks : Tracks
            All tracks; a selection is used.
        pairs : sequence of TwoView
            Verified pairs.
        sizes : ndarray (V, 2) of int
            Width and height.
        rng : numpy.random.Generator
            Draws the resection samples.
        attempt : int
            Number of the attempt; each begins with other initial pairs.

        Returns
        -------
        Reconstruction
            Projective reconstruction.

        Raises
        ------
        StageFailure
            If no pair is accepted, shows parallax or is left.
        """
        ranked = rank_initial_pairs(tracks, pairs)
        if not ranked:
            raise StageFailure(
                "no image pair was accepted",
                f"none of {counted(len(pairs), 'pair')} was verified",
                "take images that overlap by more than half and show texture",
            )
        require_pair_with_parallax(pairs)
        if attempt >= len(ranked):
            raise StageFailure(
                "no other initial pair is left", f"all {len(ranked)} accepted image pairs were tried"
            )
        usable = select_tracks_with_parallax(tracks, pairs)
        keep = select_tracks(tracks, usable, points_per_view=self.points_per_view)
        selected = subset_tracks(tracks, keep)
        best = self._best_model(selected, pairs, sizes, ranked[attempt:], rng)
        return expand_to_all_tracks(to_reconstruction(best), tracks, keep)

    def _best_model(
        self,
        tracks: Tracks,
        pairs: Sequence[TwoView],
        sizes: I64,
        starts: Sequence[TwoView],
        rng: np.random.Generator,
    ) -> ProjectiveModel:
        """Return the model with most cameras, then most inliers, over the initial pairs tried.

        Another pair is tried only if it may add a view that was not merely deferred; once half of the views
        are registered, no other part is larger.
        """
        best, left, half = None, list(starts), len(sizes) // 2 + 1
        for tried in range(self.max_initial_pairs):
            found = self.begin(tracks, left.pop(0), sizes)
            self.complete(found, pairs, rng)
            if best is None or _rank(found) > _rank(best):
                best = found
            out = [v for v in np.flatnonzero(~best.registered) if not best.deferred[v]]
            left = [pair for pair in left if pair.i in out or pair.j in out]
            if not left or (tried > 0 and best.registered.sum() >= half):
                break
        assert best is not None
        return best

    def complete(self, model: ProjectiveModel, pairs: Sequence[TwoView], rng: np.random.Generator) -> None:
        """Add views to a model in place and remove those that prove wrong.

        Parameters
        ----------
        model : ProjectiveModel
            Model with at least two cameras.
        pairs : sequence of TwoView
            Verified pairs.
        rng : numpy.random.Generator
            Draws the resection samples.
        """
        self._grow(model, rng)
        while self._discard_camera(model, pairs):
            adjust_all(model, self.bundle_iterations, self.outlier_sigmas[0])
            self._grow(model, rng)

    def begin(self, tracks: Tracks, pair: TwoView, sizes: I64) -> ProjectiveModel:
        """Reconstruct the initial pair: cameras (3.42) and points.

        Parameters
        ----------
        tracks : Tracks
            Observations.
        pair : TwoView
            Initial pair.
        sizes : ndarray (V, 2) of int
            Width and height.

        Returns
        -------
        ProjectiveModel
            Model of two views.
        """
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
        """Add cameras one by one with bundle adjustment after each, then run the final rounds."""
        early, late = self.outlier_sigmas
        adjusted = int(model.registered.sum())
        while (view := self.add_next_camera(model, rng)) is not None:
            if model.registered.sum() >= self.global_bundle_growth * adjusted:
                adjust_all(model, self.bundle_iterations, early)
                adjusted = int(model.registered.sum())
            else:
                adjust_locally(model, view, self.bundle_iterations, early, n_views=self.local_bundle_views)
        for round_number in range(self.final_rounds):
            adjust_all(model, 2 * self.bundle_iterations, late if round_number else early)

    def add_next_camera(self, model: ProjectiveModel, rng: np.random.Generator) -> int | None:
        """Resect the view with the best coverage by model points that passes the covariance test.

        Parameters
        ----------
        model : ProjectiveModel
            Model, changed in place.
        rng : numpy.random.Generator
            Draws the resection samples.

        Returns
        -------
        int or None
            The view; None if no view can be added.
        """
        t = model.tracks
        ready = model.valid[t.point_index]
        counts = np.bincount(t.view_index[ready], minlength=t.n_views)
        waiting = ~model.registered & ~model.rejected
        coverage = np.where(waiting, coverage_of_views(model.cell, ready, t.n_views), 0.0)
        for view in np.argsort(-coverage, kind="stable"):
            if coverage[view] <= 0.0:
                return None
            if counts[view] < self.min_points:
                model.reasons[view] = (
                    f"sees only {counted(counts[view], 'point')} of the model (at "
                    f"least {self.min_points} needed)"
                )
            elif self._try_camera(model, int(view), rng):
                return int(view)
        return None

    def _try_camera(self, model: ProjectiveModel, view: int, rng: np.random.Generator) -> bool:
        t, early = model.tracks, self.outlier_sigmas[0]
        k = np.flatnonzero((t.view_index == view) & model.valid[t.point_index])
        X, xy = model.X[t.point_index[k]], t.xy[k]
        P, inlier = resect_ransac(X, xy, threshold_px=early * model.sigma_px, rng=rng)
        if P is None or inlier.sum() < self.min_points or inlier.mean() < _MIN_INLIER_RATIO:
            model.reasons[view] = (
                f"only {int(inlier.sum())} of {len(k)} points of the model are inliers of its resection"
            )
            return False
        model.deferred[view], P = self._covariance_test(model, view, P, X[inlier], xy[inlier])
        if model.deferred[view]:
            return False
        model.P[view] = P
        model.registered[view] = True
        model.reasons[view] = ""
        seen = np.zeros(t.n_points, dtype=bool)
        seen[t.point_index[t.view_index == view]] = True
        retriangulate_points(model, early, points=seen)
        return True

    def _covariance_test(
        self, model: ProjectiveModel, view: int, P: F64, X: F64, xy: F64
    ) -> tuple[bool, F64]:
        """Return whether to defer the camera, and the refined camera with positive depths."""
        refined = refine_camera(P, X, xy, loss_px=LOSS_SIGMAS * model.sigma_px, iterations=20)
        P = refined.P * np.sign(np.median(X @ refined.P[2]))
        if self.max_projection_std_rel is None:
            return False, P
        covariance = refined.covariance * model.sigma_px**2
        std_px = projection_std_px(refined.P, covariance, model.X[model.valid])
        limit = self.max_projection_std_rel * float(model.sizes[view].max())
        quantile = float(np.quantile(std_px, _STD_QUANTILE))
        if quantile < limit:
            return False, P
        model.reasons[view] = (
            f"its {len(X)} points lie near one plane and do not determine its camera before calibration "
            f"(predicted standard deviation {min(quantile, 1e6):.0f} px, limit {limit:.0f} px)"
        )
        return True, P

    def _discard_camera(self, model: ProjectiveModel, pairs: Sequence[TwoView]) -> bool:
        """Remove a wrong camera permanently; False if none is wrong or only two are left."""
        if model.registered.sum() <= 2:
            return False
        counts, shares = model.inlier_ratios()
        shares[~model.registered] = 1.0
        view = int(np.argmin(shares))
        reason = f"only {counts[view]} of its points are inliers of the finished model ({shares[view]:.0%})"
        if shares[view] >= _MIN_INLIER_RATIO:
            threshold, ratio = self.outlier_sigmas[0] * model.sigma_px, self.min_epipolar_inlier_ratio
            found = find_inconsistent_view(
                model.P, model.registered, pairs, threshold_px=threshold, min_ratio=ratio
            )
            if found is None:
                return False
            view, share = found
            reason = f"only {share:.0%} of its verified matches agree with the epipolar geometry of the model"
        model.registered[view] = False
        model.rejected[view] = True
        model.reasons[view] = reason
        retriangulate_points(model, self.outlier_sigmas[0])
        return True


def _rank(model: ProjectiveModel) -> tuple[int, int]:
    return int(model.registered.sum()), int(model.used.sum())
