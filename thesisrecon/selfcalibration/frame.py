"""The frame in which chapter 7 is solved: unit-free pixels, and one camera at [I | 0].

A plane at infinity is then three numbers p with H = [[K_r, 0], [-p' K_r, 1]] (methods of Pollefeys and of
Hartley alike): P H is metric when p and K_r are right, and p is finite for every real camera because its
centre is not at infinity.

Which intrinsics of the cameras are unknown, and what is known of them beforehand.

Every method of chapter 7 that solves for more than focals takes its unknowns from here, so that "known",
"constant" and "free" mean the same to all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.records import Reconstruction

_RANK_TOLERANCE = 1e-11
"""Share of the largest below which a singular value, or a distance of centres, is rounding."""

HOMOGRAPHY_NOISE = 0.01

_KNOWN_FOCAL_STD = 1e-4
"""Relative deviation that a focal known exactly gets, so that every criterion stays finite."""


@dataclass(frozen=True)
class ReferenceFrame:
    """Registered cameras in unit-free pixels with the reference camera at [I | 0].

    ``A`` (R, 3, 3), ``a`` (R, 3) with camera i ~ [A_i | a_i]; ``views`` (R,) their view numbers;
    ``reference`` the place of the reference camera in ``views``; ``group`` (R,) camera number, 0-based and
    dense; ``pixel_from_unit`` (V, 3, 3) for all views; ``reference_from_projective`` (4, 4). ``focal_mean,
    focal_std`` (G,): what is known of the groups' log focals, NaN and infinite where that is nothing; None
    where nothing is known of any. ``assumed`` is all that is known of the views, None where nobody said.
    """

    A: F64
    a: F64
    views: I64
    reference: int
    group: I64
    pixel_from_unit: F64
    reference_from_projective: F64
    focal_mean: F64 | None = None
    focal_std: F64 | None = None
    prior: IntrinsicsPrior | None = None

    @property
    def n_groups(self) -> int:
        """Number of different cameras among the registered views."""
        return int(self.group.max()) + 1

    def subset(self, keep: I64) -> ReferenceFrame:
        """The same frame with fewer cameras (places in ``views``; the reference must be among them)."""
        kept, groups = np.unique(self.group[keep], return_inverse=True)
        place = int(np.flatnonzero(keep == self.reference)[0])
        return ReferenceFrame(
            self.A[keep], self.a[keep], self.views[keep], place, groups.astype(np.int64),
            self.pixel_from_unit, self.reference_from_projective,
            None if self.focal_mean is None else self.focal_mean[kept],
            None if self.focal_std is None else self.focal_std[kept],
            self.prior,
        )  # fmt: skip


def build_frame(
    reconstruction: Reconstruction, groups: I64, *, reference: int | None = None, unit: F64 | None = None
) -> ReferenceFrame:
    """Move the registered cameras of a projective reconstruction into a reference frame.

    ``groups`` (V,) camera number of every view; ``reference`` a registered view (by default the one with the
    most observations); ``unit`` (V, 3, 3) pixels from unit-free coordinates (by default the origin is the
    image centre and the unit the long side).
    """
    views = np.flatnonzero(reconstruction.registered)
    unit = pixel_from_unit(reconstruction.sizes) if unit is None else unit
    P = np.linalg.inv(unit[views]) @ reconstruction.P[views]
    _require_cameras_of_full_rank(P)
    if reference is None:
        seen = reconstruction.tracks.view_index[reconstruction.inlier]
        reference = int(views[np.bincount(seen, minlength=len(unit))[views].argmax()])
    place = int(np.flatnonzero(views == reference)[0])
    U, S, Vt = np.linalg.svd(P[place])
    projective_from_reference = np.column_stack([Vt[:3].T @ np.diag(1.0 / S) @ U.T, Vt[3]])
    Q = P @ projective_from_reference
    Q /= np.linalg.norm(Q[:, :, :3], axis=(1, 2))[:, None, None] / np.sqrt(3.0)
    others = np.delete(np.linalg.norm(Q[:, :, 3], axis=1), place)
    baseline = float(np.median(others)) if len(others) else 1.0
    projective_from_reference[:, 3] /= max(baseline, 1e-12)
    Q[:, :, 3] /= max(baseline, 1e-12)
    dense_group = np.unique(groups[views], return_inverse=True)[1].astype(np.int64)
    return ReferenceFrame(
        Q[:, :, :3],
        Q[:, :, 3],
        views,
        place,
        dense_group,
        unit,
        np.linalg.inv(projective_from_reference),
    )


def _require_cameras_of_full_rank(P: F64) -> None:
    """``StageFailure`` where a camera (R, 3, 4) is no camera, or all have one centre."""
    if not np.isfinite(P).all() or (np.linalg.norm(P, axis=(1, 2)) == 0.0).any():
        bad = int((~np.isfinite(P)).any(axis=(1, 2)).sum() + (np.linalg.norm(P, axis=(1, 2)) == 0.0).sum())
        evidence = f"{bad} of {len(P)} projective cameras are zero or not finite"
    else:
        S = np.linalg.svd(P / np.linalg.norm(P, axis=(1, 2))[:, None, None], compute_uv=False)
        flat = int((S[:, 2] < _RANK_TOLERANCE * S[:, 0]).sum())
        centres = np.linalg.svd(P)[2][:, 3]
        apart = float(np.sqrt(np.maximum(1.0 - (centres @ centres[0]) ** 2, 0.0)).max())
        if not flat and apart > _RANK_TOLERANCE:
            return
        evidence = (
            f"{flat} of {len(P)} projective cameras have rank below 3" if flat else f"the camera centres are {apart:.1e} apart"
        )
    raise StageFailure(
        "the projective cameras cannot be calibrated",
        evidence,
        "take images from different positions",
    )


def normalized_frame(
    reconstruction: Reconstruction, prior: IntrinsicsPrior, *, reference: int | None = None
) -> ReferenceFrame:
    """:func:`build_frame` in coordinates that have the assumed aspect and principal point in them.

    What is assumed there, known or only a place to start, is normalised away: the methods see cameras
    diag(f, f, 1) as far as the assumption holds.
    """
    frame = build_frame(
        reconstruction, prior.group, reference=reference, unit=_unit_of(prior, reconstruction.sizes)
    )
    known = prior.focal_known[frame.views]
    unit = frame.pixel_from_unit[frame.views, 0, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_f = np.log(prior.mean[frame.views, 0] / unit)
    mean, std = np.full(frame.n_groups, np.nan), np.full(frame.n_groups, np.inf)
    for g in range(frame.n_groups):
        mine = known & (frame.group == g)
        if mine.any():
            mean[g] = np.median(log_f[mine])
            std[g] = max(float(np.median(prior.std[frame.views[mine], 0])), _KNOWN_FOCAL_STD)
    return replace(frame, focal_mean=mean, focal_std=std, prior=prior)


def _unit_of(prior: IntrinsicsPrior, sizes: I64) -> F64:
    unit = pixel_from_unit(sizes)
    unit[:, 1, 1] *= prior.mean[:, 1]
    unit[:, :2, 2] = prior.mean[:, 3:5]
    return unit


def metric_from_calibration(p: F64, K: F64) -> F64:
    """The upgrade H^-1 (4, 4) of a plane at infinity p (3,) and the reference camera's unit-free K (3, 3).

    NaN where K is singular.
    """
    H = np.eye(4)
    H[:3, :3] = K
    H[3, :3] = -p @ K
    try:
        return np.asarray(np.linalg.inv(H), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.full((4, 4), np.nan)


_N_INTRINSICS = 5
"""log focal, log aspect over the assumed one, skew, principal point (x, y) off the assumed one, unit-free."""


@dataclass(frozen=True)
class SolverUnknowns:
    """D unknown numbers and where they stand in the calibrations of R cameras.

    ``place`` (R, 5): number of the unknown in :data:`COLUMNS`, -1 where ``value`` (R, 5) is known. ``mean``
    and ``std`` (D,): what is known of the unknowns; infinite where that is nothing, and then ``mean`` is only
    a place to start.
    """

    index: I64
    known: F64
    mean: F64
    std: F64

    @property
    def max_nonfocal_std(self) -> float:
        """The largest deviation of an unknown that is no focal, 0 where there is none."""
        focals = np.unique(self.index[:, 0])
        others = np.delete(np.arange(len(self.std)), focals[focals >= 0])
        return float(self.std[others].max(initial=0.0))

    def calibrations(self, unknowns: F64) -> F64:
        """Unit-free K (B, R, 3, 3) of unknowns (B, D)."""
        values = np.repeat(self.known[None], len(unknowns), axis=0)
        free = self.index >= 0
        values[:, free] = unknowns[:, self.index[free]]
        K = np.zeros((*values.shape[:2], 3, 3))
        K[..., 0, 0] = np.exp(np.clip(values[..., 0], -12.0, 12.0))
        K[..., 1, 1] = K[..., 0, 0] * np.exp(np.clip(values[..., 1], -3.0, 3.0))
        K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = values[..., 2], values[..., 3], values[..., 4]
        K[..., 2, 2] = 1.0
        return K

    def calibration_std(self, unknowns: F64, covariance: F64) -> F64:
        """Standard deviations (R, 3, 3) of the entries of the calibrations at unknowns (D,) with their
        ``covariance`` (D, D), to first order; 0 where an entry is known."""
        steps = np.diag(np.full(len(unknowns), 1e-6))
        slope = (self.calibrations(unknowns + steps) - self.calibrations(unknowns - steps)) / 2e-6
        variance = np.einsum("drij,de,erij->rij", slope, covariance, slope)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def prior_residuals(self, unknowns: F64) -> F64:
        """(unknowns - mean) / std (B, D), 0 where nothing is known."""
        known = np.isfinite(self.std)
        scale = np.where(known, self.std, 1.0)
        return np.where(known, (unknowns - self.mean) / scale, 0.0)

    def with_focal_prior(self) -> SolverUnknowns:
        """The same, what is told of no focal replaced by :func:`weak_focal_prior`."""
        focals = np.unique(self.index[:, 0])
        focals = focals[focals >= 0]
        mean, std = self.mean.copy(), self.std.copy()
        known_mean = np.where(np.isfinite(std[focals]), mean[focals], np.nan)
        mean[focals], std[focals] = weak_focal_prior(known_mean, std[focals])
        return replace(self, mean=mean, std=std)

    def from_log_focals(self, log_f: F64) -> F64:
        """Unknowns (B, D) of log focals (B, R) of the cameras; what has no prior mean starts at 0.

        A focal that several cameras share starts at their median; focals that are known are not asked for.
        """
        unknowns = np.repeat(self.mean[None], len(log_f), axis=0)
        for k in np.unique(self.index[:, 0][self.index[:, 0] >= 0]):
            unknowns[:, k] = np.median(log_f[:, self.index[:, 0] == k], axis=1)
        return unknowns

    def log_focals(self, unknowns: F64) -> F64:
        """Log focals (B, R)."""
        return np.asarray(np.log(self.calibrations(unknowns)[..., 0, 0]))


def weak_focal_prior(mean: F64, std: F64) -> tuple[F64, F64]:
    """Finite means and deviations (G,) of log focals: 1.2 long sides to a factor of 2.5 where nothing is
    known."""
    unknown = ~(np.isfinite(mean) & np.isfinite(std))
    return np.where(unknown, np.log(1.2), mean), np.where(unknown, np.log(2.5), std)


def solver_unknowns(
    frame: ReferenceFrame, prior: IntrinsicsPrior, *, focals_only: bool = False
) -> SolverUnknowns:
    """The unknowns of the registered cameras; ``focals_only`` takes all the others for known.

    The frame must be one of :func:`thesisrecon.selfcalibration.frame.normalized_frame`, whose coordinates have
    the assumed aspect and principal point in them already.
    """
    mean, std = _unit_free(frame, prior)
    if focals_only:
        std[:, 1:] = 0.0
    place = np.full(mean.shape, -1, dtype=np.int64)
    means: list[float] = []
    stds: list[float] = []
    for column in range(_N_INTRINSICS):
        shared = prior.shared[frame.views, column]
        for number in np.unique(shared[std[:, column] > 0.0]):
            rows = np.flatnonzero((shared == number) & (std[:, column] > 0.0))
            place[rows, column] = len(means)
            means.append(float(mean[rows[0], column]))
            stds.append(float(std[rows[0], column]))
    return SolverUnknowns(place, mean, np.array(means), np.array(stds))


def _unit_free(frame: ReferenceFrame, prior: IntrinsicsPrior) -> tuple[F64, F64]:
    """Means and standard deviations (R, 5) in the coordinates of the frame."""
    rows, unit = frame.views, frame.pixel_from_unit[frame.views]
    mean, std = np.zeros((len(rows), _N_INTRINSICS)), prior.std[rows, :_N_INTRINSICS].copy()
    focal = prior.mean[rows, 0]
    unknown = ~(np.isfinite(focal) & np.isfinite(std[:, 0]))
    mean[:, 0] = np.log(np.where(unknown, unit[:, 0, 0], focal) / unit[:, 0, 0])
    std[unknown, 0] = np.inf
    std[:, 1] /= prior.mean[rows, 1]
    mean[:, 2] = prior.mean[rows, 2] / unit[:, 0, 0]
    std[:, 2] /= unit[:, 0, 0]
    std[:, 3] /= unit[:, 0, 0]
    std[:, 4] /= unit[:, 1, 1]
    return mean, std


@dataclass(frozen=True)
class ConicConstraints:
    """What makes the image conic linear: ``std`` (R, 4) of skew, principal x, y and half the aspect, infinite
    where nothing is known; ``first`` (R,) the place of the first camera of the same constant K (its own where
    it is that one); ``reference`` the place of the reference view.
    """

    std: F64
    first: I64
    reference: int


def conic_constraints(frame: ReferenceFrame, prior: IntrinsicsPrior) -> ConicConstraints:
    """The assumptions in the coordinates of an ``normalized_frame``.

    Known or roughly known intrinsics are equations weighed by their deviation; views that share or know all
    five are one constant K.
    """
    rows = frame.views
    unit = frame.pixel_from_unit[rows, 0, 0][:, None]
    std = np.column_stack([prior.std[rows, 2:5] / unit, prior.std[rows, 1] / prior.mean[rows, 1] / 2.0])
    # A constant K is constant in unit-free coordinates only where these are the same for all its views.
    known = np.where(prior.std[rows, :5] == 0.0, prior.mean[rows, :5], np.nan)
    same_value = (known[:, None] == known[None]) | (
        prior.shared[rows, None, :5] == prior.shared[None, rows, :5]
    )
    same_unit = np.isclose(frame.pixel_from_unit[rows, None], frame.pixel_from_unit[None, rows]).all(
        axis=(2, 3)
    )
    first = (same_value.all(axis=2) & same_unit).argmax(axis=1).astype(np.int64)
    return ConicConstraints(std, first, frame.reference)


_SQUARE_PIXEL_STD = (0.0, HOMOGRAPHY_NOISE, HOMOGRAPHY_NOISE, 0.0)
"""Deviations of cameras without skew, with square pixels and the principal point near the middle."""


def square_pixel_constraints(frame: ReferenceFrame) -> ConicConstraints:
    """Square pixels and a central principal point for every camera, and no constancy."""
    n = len(frame.views)
    return ConicConstraints(np.tile(_SQUARE_PIXEL_STD, (n, 1)), np.arange(n, dtype=np.int64), frame.reference)
