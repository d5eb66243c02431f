"""Incremental projective reconstruction (chapter 6; P. Beardsley, A. Zisserman, D. Murray, IJCV 23, 1997).

A camera is accepted if its covariance shows that it is determined (a view of a single plane fits its points
with an arbitrary P), and kept if it agrees with its points and verified matches; others are deferred. The
sequential reconstruction of the thesis, used by the preset ``thesis``, does without these tests.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import Notice, StageFailure, counted, require_range
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals
from thesisrecon.optimize.bundle.partial import refine_camera
from thesisrecon.optimize.ransac import Budget, resect_projective
from thesisrecon.projective import _model
from thesisrecon.projective._model import ProjectiveModel
from thesisrecon.records import Reconstruction, Tracks, TwoView


def _projection_std_px(P: F64, covariance: F64, X: F64) -> F64:
    """Std (N,) px of projections by a camera's covariance (12, 12) (6.4); inf if undetermined."""
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


def _find_inconsistent_view(
    P: F64, registered: B8, pairs: Sequence[TwoView], threshold_px: float, min_ratio: float
) -> tuple[int, float] | None:
    """The view that agrees least with the verified matches of its pairs, and its ratio; None if all do."""
    total, agreed = np.zeros(len(P)), np.zeros(len(P))
    for pair in pairs:
        if not (pair.accepted and registered[pair.i] and registered[pair.j]):
            continue
        try:
            F = fundamental_from_cameras(P[pair.i], P[pair.j])
        except ValueError:  # one camera centre
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.abs(sampson_residuals(F, pair.xy1, pair.xy2))
        total[[pair.i, pair.j]] += pair.inliers
        agreed[[pair.i, pair.j]] += float(np.mean(distance < threshold_px)) * pair.inliers
    share_of_view = np.where(total > 0, agreed / np.maximum(total, 1.0), 1.0)
    worst = int(np.argmin(share_of_view))
    return (worst, float(share_of_view[worst])) if share_of_view[worst] < min_ratio else None


_MIN_INLIER_RATIO = 0.3  # required share of inliers among the points that a camera sees
_STD_QUANTILE = 0.8  # quantile over all points of the projection standard deviations that is tested
OUTSIDE_CORE = Notice("outside-core")


@dataclass(frozen=True)
class IncrementalProjective:
    """Incremental projective reconstruction with a covariance test of each camera (6.6).

    Parameters
    ----------
    core_views : int
        Number of views above which only a core of this many well-connected views is reconstructed, twice as
        many at each further attempt; the metric stage registers the others. 0: all views are reconstructed.
    """

    core_views: int = 40

    points_per_view = 1500  # approximate number of tracks per view, longest first; the metric stage uses all
    min_points = 12  # minimum number of matches for resection: twice the six of a minimal sample
    # Inlier thresholds in noise sigmas of the early and late rounds, and lower bound of the noise.
    outlier_sigmas, noise_floor_px = (12.0, 7.0), 0.3
    # Largest 80 % quantile of the projection standard deviations over all points, as a share of the long
    # side; None accepts every camera.
    max_projection_std_rel: ClassVar[float | None] = 0.01
    # Required share of verified matches on the epipolar lines of the finished model.
    min_epipolar_inlier_ratio = 0.5
    # Levenberg-Marquardt steps after each camera; final rounds of triangulation, adjustment and filtering.
    bundle_iterations, final_rounds = 4, 3
    # Growth factor of the number of cameras after which everything is adjusted, and number of views that are
    # adjusted with each new one.
    global_bundle_growth, local_bundle_views = 1.2, 4
    max_initial_pairs = 3  # initial pairs tried in one attempt while usable views are missing

    def __post_init__(self) -> None:
        require_range(self, core_views="[0, inf)")

    def reconstruct(
        self, tracks: Tracks, pairs: Sequence[TwoView], sizes: I64, *, rng: Generator, attempt: int = 0
    ) -> Reconstruction:
        """See `thesisrecon.config.ProjectiveReconstructor.reconstruct`."""
        core = self._core(pairs, tracks.n_views, attempt)
        inside = [pair for pair in pairs if core[pair.i] and core[pair.j]]
        ranked = _model.rank_initial_pairs(tracks, inside)
        if not ranked:
            raise StageFailure.of("no-accepted-pair", counted(len(pairs), "pair"))
        _model.require_pair_with_parallax(pairs)
        if attempt >= len(ranked):
            tried = f"all {len(ranked)} accepted image pairs were tried"
            raise StageFailure(Notice("no-other-initial-pair"), tried)
        seen = _model.select_observations(tracks, core[tracks.view_index])
        selected, keep = _model.working_tracks(seen, inside, points_per_view=self.points_per_view)
        best = self._best_model(selected, inside, sizes, ranked[attempt:], rng)
        for view in np.flatnonzero(~core):
            best.reasons[view] = OUTSIDE_CORE
        return _model.expand_to_all_tracks(
            _model.to_reconstruction(best, self.min_points), tracks, keep, core
        )

    def _core(self, pairs: Sequence[TwoView], n_views: int, attempt: int) -> B8:
        """(V,) the views to reconstruct: all of a small set, else a core, larger at each attempt."""
        size = self.core_views * 2**attempt if self.core_views else n_views
        return np.ones(n_views, dtype=bool) if n_views <= size else _model.select_core(pairs, n_views, size)

    def _best_model(
        self, tracks: Tracks, pairs: Sequence[TwoView], sizes: I64, starts: Sequence[TwoView], rng: Generator
    ) -> ProjectiveModel:
        """The model with most cameras, then inliers, of initial pairs that may add a view."""

        def rank(model: ProjectiveModel) -> tuple[int, int]:
            return int(model.registered.sum()), int(model.used.sum())

        best, left, half = None, list(starts), len(sizes) // 2 + 1
        for tried in range(self.max_initial_pairs):
            found = self.begin(tracks, left.pop(0), sizes)
            self.complete(found, pairs, rng)
            if best is None or rank(found) > rank(best):
                best = found
            out = [v for v in np.flatnonzero(~best.registered) if not best.deferred[v]]
            left = [pair for pair in left if pair.i in out or pair.j in out]
            if not left or (tried > 0 and best.registered.sum() >= half):
                break
        assert best is not None
        return best

    def complete(self, model: ProjectiveModel, pairs: Sequence[TwoView], rng: Generator) -> None:
        """Add views to a model of two cameras or more in place and remove those that prove wrong."""
        self._grow(model, rng)
        while self._discard_camera(model, pairs):
            _model.adjust_all(model, self.bundle_iterations, self.outlier_sigmas[0])
            self._grow(model, rng)

    def begin(self, tracks: Tracks, pair: TwoView, sizes: I64) -> ProjectiveModel:
        """Reconstruct the initial pair: cameras (3.42) and points."""
        noise = {"sigma_px": pair.sigma_px, "noise_floor_px": self.noise_floor_px}
        model = ProjectiveModel.empty(tracks, sizes, **noise)
        views = [pair.i, pair.j]
        model.P[views] = _model.initial_cameras(pair, sizes[views])
        model.registered[views] = True
        for _ in range(2):
            _model.retriangulate_points(model, self.outlier_sigmas[0])
            _model.adjust_all(model, 2 * self.bundle_iterations, self.outlier_sigmas[0])
        return model

    def _grow(self, model: ProjectiveModel, rng: Generator) -> None:
        """Add cameras one by one with bundle adjustment after each, then run the final rounds."""
        early, late = self.outlier_sigmas
        adjusted = int(model.registered.sum())
        while (view := self.add_next_camera(model, rng)) is not None:
            if model.registered.sum() >= self.global_bundle_growth * adjusted:
                _model.adjust_all(model, self.bundle_iterations, early)
                adjusted = int(model.registered.sum())
            else:
                _model.adjust_locally(
                    model, view, self.bundle_iterations, early, n_views=self.local_bundle_views
                )
        for round_number in range(self.final_rounds):
            _model.adjust_all(model, 2 * self.bundle_iterations, late if round_number else early)

    def add_next_camera(self, model: ProjectiveModel, rng: Generator) -> int | None:
        """Resect the view best covered by model points that passes the covariance test; None if none does."""
        t = model.tracks
        ready = model.valid[t.point_index]
        counts = np.bincount(t.view_index[ready], minlength=t.n_views)
        waiting = ~model.registered & ~model.rejected
        coverage = np.where(waiting, _model.coverage_of_views(model.cell, ready, t.n_views), 0.0)
        for view in np.argsort(-coverage, kind="stable"):
            if coverage[view] <= 0.0:
                return None
            if counts[view] < self.min_points:
                model.reasons[view] = ""
            elif self._try_camera(model, int(view), rng):
                return int(view)
        return None

    def _try_camera(self, model: ProjectiveModel, view: int, rng: Generator) -> bool:
        t, early = model.tracks, self.outlier_sigmas[0]
        k = np.flatnonzero((t.view_index == view) & model.valid[t.point_index])
        X, xy = model.X[t.point_index[k]], t.xy[k]
        P, inlier, _ = resect_projective(
            X, xy, threshold_px=early * model.sigma_px, budget=Budget(0.999, 1000), rng=rng
        )
        if P is None or inlier.sum() < self.min_points or inlier.mean() < _MIN_INLIER_RATIO:
            model.reasons[view] = Notice("resection-inliers", int(inlier.sum()), counted(len(k), "point"))
            return False
        X, xy, loss_px = X[inlier], xy[inlier], _model.LOSS_SIGMAS * model.sigma_px
        P, covariance = refine_camera(P, X, xy, loss_px=loss_px, iterations=20)
        model.deferred[view] = False
        if self.max_projection_std_rel is not None:
            std_px = _projection_std_px(P, covariance * model.sigma_px**2, model.X[model.valid])
            limit = self.max_projection_std_rel * float(model.sizes[view].max())
            quantile = float(np.quantile(std_px, _STD_QUANTILE))
            if not quantile < limit:
                model.deferred[view] = True
                model.reasons[view] = Notice("planar-resection", len(X), min(quantile, 1e6), limit)
                return False
        # Depths are positive.
        model.P[view] = P * np.sign(np.median(X @ P[2]))
        model.registered[view] = True
        model.reasons[view] = ""
        seen = np.bincount(t.point_index[t.view_index == view], minlength=t.n_points) > 0
        _model.retriangulate_points(model, early, points=seen)
        return True

    def _discard_camera(self, model: ProjectiveModel, pairs: Sequence[TwoView]) -> bool:
        """Remove a wrong camera permanently; False if none is wrong or only two are left."""
        if model.registered.sum() <= 2:
            return False
        counts, shares = model.inlier_ratios()
        shares[~model.registered] = 1.0
        view = int(np.argmin(shares))
        reason = Notice("few-inlier-points", counts[view], shares[view])
        if shares[view] >= _MIN_INLIER_RATIO:
            threshold, ratio = self.outlier_sigmas[0] * model.sigma_px, self.min_epipolar_inlier_ratio
            found = _find_inconsistent_view(model.P, model.registered, pairs, threshold, ratio)
            if found is None:
                return False
            view, share = found
            reason = Notice("epipolar-contradiction", share)
        model.registered[view] = False
        model.rejected[view] = True
        model.reasons[view] = reason
        _model.retriangulate_points(model, self.outlier_sigmas[0])
        return True


class _WithoutAdjustment(IncrementalProjective):
    """Resection and triangulation alone, without a test of the new camera."""

    outlier_sigmas = (12.0, 12.0)
    max_projection_std_rel = None
    bundle_iterations, final_rounds = 0, 0


@dataclass(frozen=True)
class SequentialProjective:
    """Projective reconstruction of one view after the other in image order (6.6).

    Starts with the pair of neighbours with most matches; each further view is resected, new points are
    triangulated and outliers removed. One bundle adjustment at the end replaces a lost chapter of the thesis.
    """

    def reconstruct(
        self, tracks: Tracks, pairs: Sequence[TwoView], sizes: I64, *, rng: Generator, attempt: int = 0
    ) -> Reconstruction:
        """See `thesisrecon.config.ProjectiveReconstructor.reconstruct`."""
        _model.require_pair_with_parallax(pairs)
        accepted = [p for p in pairs if p.accepted]
        neighbours = [p for p in accepted if p.j == p.i + 1]
        candidates = sorted(neighbours or accepted, key=lambda p: (-p.inliers, p.i, p.j))
        if attempt >= len(candidates):
            accepted_pairs = f"{counted(len(candidates), 'image pair')} accepted"
            raise StageFailure(Notice("no-initial-pair"), accepted_pairs)
        incremental = _WithoutAdjustment()
        model = incremental.begin(tracks, candidates[attempt], sizes)
        while incremental.add_next_camera(model, rng) is not None:
            pass
        _model.adjust_all(model, 10, incremental.outlier_sigmas[1])
        return _model.to_reconstruction(model, incremental.min_points)
