"""Unknowns of the solvers of chapter 7, derived from :class:`~thesisrecon.intrinsics.IntrinsicsPrior`.

:class:`SolverUnknowns` serves the nonlinear methods, :class:`ConicConstraints` the linear ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.selfcalibration.frame import ReferenceFrame

# Error of a unit-free infinite homography: the weight of linear constraints from approximate intrinsics.
HOMOGRAPHY_NOISE = 0.01

# log focal, log of (aspect / prior aspect), skew, principal point (x, y) minus the prior one; unit-free.
_N_INTRINSICS = 5
# No skew, square pixels, principal point near the image centre.
_SQUARE_PIXEL_STD = (0.0, HOMOGRAPHY_NOISE, HOMOGRAPHY_NOISE, 0.0)


@dataclass(frozen=True)
class SolverUnknowns:
    """D unknown intrinsics and their places in the calibrations of R cameras.

    Attributes
    ----------
    index : ndarray (R, 5) of int
        Number of the unknown, -1 where the intrinsic is known. Columns: log focal, log aspect, skew,
        principal point x and y, relative to the normalized frame.
    known : ndarray (R, 5)
        Values where ``index`` is -1.
    mean, std : ndarray (D,)
        Gaussian prior of the unknowns; std inf: ``mean`` is only a starting value.
    """

    index: I64
    known: F64
    mean: F64
    std: F64

    @property
    def max_nonfocal_std(self) -> float:
        """Largest standard deviation of an unknown other than a focal length, 0 if there is none."""
        focals = np.unique(self.index[:, 0])
        others = np.delete(np.arange(len(self.std)), focals[focals >= 0])
        return float(self.std[others].max(initial=0.0))

    def calibrations(self, unknowns: F64) -> F64:
        """Build the calibrations of all cameras.

        Parameters
        ----------
        unknowns : ndarray (B, D)
            Values of the unknowns.

        Returns
        -------
        ndarray (B, R, 3, 3)
            Unit-free K.
        """
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
        """Propagate a covariance to the entries of the calibrations, to first order.

        Parameters
        ----------
        unknowns : ndarray (D,)
            Values of the unknowns.
        covariance : ndarray (D, D)
            Their covariance.

        Returns
        -------
        ndarray (R, 3, 3)
            Standard deviations of the entries of K, 0 where an entry is known.
        """
        steps = np.diag(np.full(len(unknowns), 1e-6))
        slope = (self.calibrations(unknowns + steps) - self.calibrations(unknowns - steps)) / 2e-6
        variance = np.einsum("drij,de,erij->rij", slope, covariance, slope)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def prior_residuals(self, unknowns: F64) -> F64:
        """Compute (unknowns - mean) / std.

        Parameters
        ----------
        unknowns : ndarray (B, D)
            Values of the unknowns.

        Returns
        -------
        ndarray (B, D)
            Normalized residuals, 0 without a prior.
        """
        known = np.isfinite(self.std)
        scale = np.where(known, self.std, 1.0)
        return np.where(known, (unknowns - self.mean) / scale, 0.0)

    def with_focal_prior(self) -> SolverUnknowns:
        """Replace missing focal priors by :func:`weak_focal_prior`.

        Returns
        -------
        SolverUnknowns
            Unknowns whose focal lengths all have a finite prior.
        """
        focals = np.unique(self.index[:, 0])
        focals = focals[focals >= 0]
        mean, std = self.mean.copy(), self.std.copy()
        known_mean = np.where(np.isfinite(std[focals]), mean[focals], np.nan)
        mean[focals], std[focals] = weak_focal_prior(known_mean, std[focals])
        return replace(self, mean=mean, std=std)

    def from_log_focals(self, log_f: F64) -> F64:
        """Return starting values for given log focal lengths.

        Parameters
        ----------
        log_f : ndarray (B, R)
            Log focal lengths of the cameras; a shared focal takes their median.

        Returns
        -------
        ndarray (B, D)
            Unknowns; those other than focal lengths take their prior mean.
        """
        unknowns = np.repeat(self.mean[None], len(log_f), axis=0)
        for k in np.unique(self.index[:, 0][self.index[:, 0] >= 0]):
            unknowns[:, k] = np.median(log_f[:, self.index[:, 0] == k], axis=1)
        return unknowns

    def log_focals(self, unknowns: F64) -> F64:
        """Return the log focal lengths of the cameras.

        Parameters
        ----------
        unknowns : ndarray (B, D)
            Values of the unknowns.

        Returns
        -------
        ndarray (B, R)
            Log focal lengths.
        """
        return np.asarray(np.log(self.calibrations(unknowns)[..., 0, 0]))


def weak_focal_prior(mean: F64, std: F64) -> tuple[F64, F64]:
    """Fill in unknown focal priors: 1.2 long sides within a factor of 2.5.

    Parameters
    ----------
    mean, std : ndarray (G,)
        Prior of log focal lengths, NaN or inf where unknown.

    Returns
    -------
    mean, std : ndarray (G,)
        Finite prior.

    Examples
    --------
    >>> import numpy as np
    >>> mean, std = weak_focal_prior(np.array([0.5, np.nan]), np.array([0.1, np.inf]))
    >>> np.round(np.exp([mean[1], std[1]]), 6)
    array([1.2, 2.5])
    """
    unknown = ~(np.isfinite(mean) & np.isfinite(std))
    return np.where(unknown, np.log(1.2), mean), np.where(unknown, np.log(2.5), std)


def solver_unknowns(frame: ReferenceFrame, prior: IntrinsicsPrior) -> SolverUnknowns:
    """Derive the unknowns of the registered cameras from the prior.

    Parameters
    ----------
    frame : ReferenceFrame
        Frame of :func:`~thesisrecon.selfcalibration.frame.normalized_frame`.
    prior : IntrinsicsPrior
        Prior of all views; std 0 makes a value known.

    Returns
    -------
    SolverUnknowns
        Unknowns, one for each shared value.
    """
    mean, std = _unit_free(frame, prior)
    index = np.full(mean.shape, -1, dtype=np.int64)
    means: list[float] = []
    stds: list[float] = []
    for column in range(_N_INTRINSICS):
        shared = prior.shared[frame.views, column]
        for number in np.unique(shared[std[:, column] > 0.0]):
            rows = np.flatnonzero((shared == number) & (std[:, column] > 0.0))
            index[rows, column] = len(means)
            means.append(float(mean[rows[0], column]))
            stds.append(float(std[rows[0], column]))
    return SolverUnknowns(index, mean, np.array(means), np.array(stds))


def _unit_free(frame: ReferenceFrame, prior: IntrinsicsPrior) -> tuple[F64, F64]:
    """Return the prior means and standard deviations (R, 5) in the coordinates of the frame."""
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
    """Linear constraints on the image of the absolute conic.

    Attributes
    ----------
    std : ndarray (R, 4)
        Standard deviations of skew, principal point x and y, and half the aspect; inf where unknown.
    first : ndarray (R,) of int
        Place of the first camera with the same constant K (its own if it is that one).
    reference : int
        Place of the reference camera.
    """

    std: F64
    first: I64
    reference: int


def conic_constraints(frame: ReferenceFrame, prior: IntrinsicsPrior) -> ConicConstraints:
    """Derive the linear conic constraints from the prior.

    Parameters
    ----------
    frame : ReferenceFrame
        Frame of :func:`~thesisrecon.selfcalibration.frame.normalized_frame`.
    prior : IntrinsicsPrior
        Prior of all views. Views that share or know all five intrinsics have one constant K.

    Returns
    -------
    ConicConstraints
        Constraints weighted by the prior standard deviations.
    """
    rows = frame.views
    unit = frame.pixel_from_unit[rows, 0, 0][:, None]
    std = np.column_stack([prior.std[rows, 2:5] / unit, prior.std[rows, 1] / prior.mean[rows, 1] / 2.0])
    # A constant K in pixels is constant in unit-free coordinates only if all its views share these.
    known = np.where(prior.std[rows, :5] == 0.0, prior.mean[rows, :5], np.nan)
    same_value = (known[:, None] == known[None]) | (
        prior.shared[rows, None, :5] == prior.shared[None, rows, :5]
    )
    same_unit = np.isclose(frame.pixel_from_unit[rows, None], frame.pixel_from_unit[None, rows]).all(
        axis=(2, 3)
    )
    first = (same_value.all(axis=2) & same_unit).argmax(axis=1).astype(np.int64)
    return ConicConstraints(std, first, frame.reference)


def square_pixel_constraints(frame: ReferenceFrame) -> ConicConstraints:
    """Return the constraints of square pixels and a central principal point.

    Parameters
    ----------
    frame : ReferenceFrame
        Frame of the cameras.

    Returns
    -------
    ConicConstraints
        The same constraints for every camera, none with constant K.
    """
    n = len(frame.views)
    return ConicConstraints(np.tile(_SQUARE_PIXEL_STD, (n, 1)), np.arange(n, dtype=np.int64), frame.reference)
