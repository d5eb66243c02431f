"""Knowledge beside the observations: covariances, losses, fixed poses and points, priors of positions.

A prior of a point or of a camera centre becomes two observations more of a point, whose four residuals are
three deviations in standard deviations and a zero: the elimination of the points needs no other case.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.optimize.bundle.covariance import similarity_motions
from thesisrecon.optimize.bundle.projection import (
    Jacobians,
    MetricModel,
    Observations,
    SortedObservations,
    Weighting,
)

Loss = Callable[[F64], tuple[F64, F64, F64]]
"""rho / d^2, rho' and 1 + 2 s rho'' / rho' for s / d^2, the squared residual in units of the width d."""


def _squared(u: F64) -> tuple[F64, F64, F64]:
    return u, np.ones_like(u), np.ones_like(u)


def _huber(u: F64) -> tuple[F64, F64, F64]:
    root, inside = np.sqrt(np.maximum(u, 1.0)), u <= 1.0
    return np.where(inside, u, 2.0 * root - 1.0), 1.0 / root, np.where(inside, 1.0, 0.0)


def _cauchy(u: F64) -> tuple[F64, F64, F64]:
    return np.log1p(u), 1.0 / (1.0 + u), (1.0 - u) / (1.0 + u)


def _geman_mcclure(u: F64) -> tuple[F64, F64, F64]:
    return u / (1.0 + u), (1.0 + u) ** -2.0, (1.0 - 3.0 * u) / (1.0 + u)


def _tukey(u: F64) -> tuple[F64, F64, F64]:
    left = np.maximum(1.0 - u, 0.0)
    return (1.0 - left**3) / 3.0, left**2, 1.0 - 4.0 * u / np.maximum(left, 1e-12)


LOSSES: dict[str, tuple[Loss, float]] = {
    "huber": (_huber, 2.0), "squared": (_squared, 1.0), "cauchy": (_cauchy, 2.4),
    "geman-mcclure": (_geman_mcclure, 4.0), "tukey": (_tukey, 5.0),
}  # fmt: skip
"""Losses, and their widths in standard deviations of the noise."""


@dataclass(frozen=True)
class PositionPrior:
    """Known positions (P, 3) of the camera centres or points ``index`` (P,), with roots of their information.

    ``root`` (P, 3, 3) turns a deviation into standard deviations.
    """

    index: I64
    position: F64
    root: F64

    def in_frame(self, origin: F64, scale: float) -> "PositionPrior":
        """The prior in the coordinates scale (X - origin)."""
        return PositionPrior(self.index, scale * (self.position - origin), self.root / scale)


NO_PRIOR = PositionPrior(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclass(frozen=True)
class BundleKnowledge:
    """What an adjustment knows beside pixels and intrinsics.

    ``loss`` is one of ``LOSSES``; ``root`` (K, 2, 2) whitens each residual; ``fixed_poses`` (V,) and
    ``fixed_points`` (N,) do not move; ``centres`` and ``points`` are priors of positions.
    """

    loss: str = "huber"
    root: F64 | None = None
    fixed_poses: B8 | None = None
    fixed_points: B8 | None = None
    centres: PositionPrior = NO_PRIOR
    points: PositionPrior = NO_PRIOR

    @property
    def is_empty(self) -> bool:
        """Whether nothing but the loss is given."""
        given = any(a is not None for a in (self.root, self.fixed_poses, self.fixed_points))
        return not (given or len(self.centres.index) or len(self.points.index))

    def observations(self, seen: Observations) -> Observations:
        """The observations, followed by two of each prior of a view or a point with observations."""
        first, rows = [np.arange(len(seen.xy))], []
        for prior, number in ((self.centres, seen.view_index), (self.points, seen.point_index)):
            known, place = np.unique(number, return_index=True)
            rows.append(place[np.searchsorted(known, prior.index)])
        first.append(np.repeat(np.concatenate(rows), 2).astype(np.int64))
        return seen.at(np.concatenate(first))


@dataclass(frozen=True)
class KnowledgeTerms:
    """The knowledge in the order of sorted observations; ``of_prior`` (K,) is the prior of each, -1: none.

    The root of a prior (P, 2, 2, 3) has the rows of its two observations.
    """

    loss: Loss
    root: F64 | None
    fixed_points: B8 | None
    of_prior: I64
    is_centre: B8
    position: F64
    prior_root: F64

    @classmethod
    def of(cls, knowledge: BundleKnowledge, o: SortedObservations, given: int) -> "KnowledgeTerms":
        """Return the terms of the ``given`` observations and those of priors behind them."""
        priors = knowledge.centres, knowledge.points
        root = np.concatenate([prior.root for prior in priors])
        root = np.concatenate([root, np.zeros((len(root), 1, 3))], axis=1).reshape(-1, 2, 2, 3)
        whiten = knowledge.root
        if whiten is not None:
            whiten = np.concatenate([whiten, np.zeros((len(o.order) - given, 2, 2))])[o.order]
        return cls(
            LOSSES[knowledge.loss][0], whiten, knowledge.fixed_points,
            np.where(o.order >= given, o.order - given, -1),
            np.repeat([True, False], [len(prior.index) for prior in priors]),
            np.concatenate([prior.position for prior in priors]), root,
        )  # fmt: skip

    @property
    def observed(self) -> B8:
        """Whether each sorted observation (K,) is one of pixels."""
        return np.asarray(self.of_prior < 0)

    def residuals(self, rows: slice, model: MetricModel, obs: Observations, residual: F64) -> F64:
        """Whiten residuals (k, 2) of some rows, and put in those of priors."""
        root, prior = self.root, self.of_prior[rows]
        e = residual if root is None else np.einsum("kij,kj->ki", root[rows], residual)
        k = np.flatnonzero(prior >= 0)
        if len(k):
            p, half, view = prior[k] // 2, prior[k] % 2, obs.view_index[k]
            centres = -np.einsum("kji,kj->ki", model.R[view], model.t[view])
            at = np.where(self.is_centre[p, None], centres, model.X[obs.point_index[k]])
            e = e.copy()
            e[k] = np.einsum("kij,kj->ki", self.prior_root[p, half], at - self.position[p])
        return np.asarray(e)

    def cost(self, rows: slice, e: F64, delta: float) -> float:
        """1/2 sum rho of residuals; priors are squared."""
        s = np.sum(e**2, axis=1)
        rho = delta**2 * self.loss(s / delta**2)[0]
        return 0.5 * float(np.where(self.of_prior[rows] >= 0, s, rho).sum())

    def weigh(
        self, rows: slice, model: MetricModel, obs: Observations, J: Jacobians, weighting: Weighting
    ) -> float:
        """Turn plain residuals and Jacobians of some rows, in units of sigma, to weighted ones: the cost."""
        delta = weighting.delta
        parts, prior = (J.A, J.E, J.B), self.of_prior[rows]
        e = self.residuals(rows, model, obs, J.residual)
        if self.root is not None:
            for part in parts:
                part[:] = self.root[rows] @ part
        k = np.flatnonzero(prior >= 0)
        if len(k):
            root, centre = self.prior_root[prior[k] // 2, prior[k] % 2], self.is_centre[prior[k] // 2]
            for part in parts:
                part[k] = 0.0
            # C = -R' t moves by -R' d if t moves by d.
            J.A[k[centre], :, 3:6] = -root[centre] @ np.swapaxes(model.R[obs.view_index[k[centre]]], 1, 2)
            J.B[k[~centre]] = root[~centre]
        if self.fixed_points is not None:
            J.B[self.fixed_points[obs.point_index]] = 0.0
        s, cost = np.sum(e**2, axis=1), self.cost(rows, e, delta)
        _, weight, curvature = self.loss(s / delta**2)
        kept = np.maximum(curvature, weighting.min_curvature)
        weight, kept = (np.where(prior >= 0, 1.0, a) for a in (weight, kept))
        # As in the kernel: (I - (1 - sqrt(kept)) e e' / s) J, and the residual over sqrt(kept).
        kept, scale = np.sqrt(np.minimum(kept, 1.0)), np.sqrt(weight)[:, None]
        along = ((1.0 - kept) / np.maximum(s, 1e-300))[:, None, None] * e[:, :, None] * e[:, None, :]
        project = scale[:, :, None] * (np.eye(2) - along)
        for part in parts:
            part[:] = project @ part
        # ``e`` may be the same memory.
        J.residual[:] = scale / kept[:, None] * e
        return cost


def remaining_gauge(knowledge: BundleKnowledge, R: F64, t: F64, X: F64) -> F64:
    """Basis (7, m) of the similarities, as (shift, turn, scale), that leave what is known where it is.

    Poses and points of a centred and scaled frame; the priors in that frame too.
    """
    known = [np.zeros((0, 7))]
    if knowledge.fixed_poses is not None:
        known.append(similarity_motions(R[knowledge.fixed_poses], t[knowledge.fixed_poses]))
    places = [prior.position for prior in (knowledge.centres, knowledge.points)]
    if knowledge.fixed_points is not None:
        places.append(X[knowledge.fixed_points])
    at = np.concatenate(places)
    moved = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(at), 3, 3)), -cross_matrix(at), at[:, :, None]], 2
    )
    rows = np.concatenate([*known, moved.reshape(-1, 7)])
    size, V = np.linalg.svd(np.concatenate([rows, np.zeros((7, 7))]))[1:]
    return np.asarray(V[size <= 1e-6 * max(size.max(), 1e-300)].T)
