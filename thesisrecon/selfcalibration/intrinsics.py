"""Which intrinsics of the cameras are unknown, and what is known of them beforehand.

Every method of chapter 7 that solves for more than focals takes its unknowns from here, so that "known",
"constant" and "free" mean the same to all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.selfcalibration.frame import ReferenceFrame
from thesisrecon.types import Assumptions

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

COLUMNS = 5
"""log focal, log aspect over the assumed one, skew, principal point (x, y) off the assumed one, unit-free."""


@dataclass(frozen=True)
class UnknownIntrinsics:
    """D unknown numbers and where they stand in the calibrations of R cameras.

    ``place`` (R, 5): number of the unknown in :data:`COLUMNS`, -1 where ``value`` (R, 5) is known. ``mean``
    and ``std`` (D,): what is known of the unknowns; infinite where that is nothing, and then ``mean`` is only
    a place to start.
    """

    place: I64
    value: F64
    mean: F64
    std: F64

    @property
    def loosest(self) -> float:
        """The largest deviation of an unknown that is no focal, 0 where there is none."""
        focals = np.unique(self.place[:, 0])
        others = np.delete(np.arange(len(self.std)), focals[focals >= 0])
        return float(self.std[others].max(initial=0.0))

    def calibrations(self, unknowns: F64) -> F64:
        """Unit-free K (B, R, 3, 3) of unknowns (B, D)."""
        values = np.repeat(self.value[None], len(unknowns), axis=0)
        free = self.place >= 0
        values[:, free] = unknowns[:, self.place[free]]
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

    def deviations(self, unknowns: F64) -> F64:
        """(unknowns - mean) / std (B, D), 0 where nothing is known."""
        known = np.isfinite(self.std)
        scale = np.where(known, self.std, 1.0)
        return np.where(known, (unknowns - self.mean) / scale, 0.0)

    def with_weak_focals(self) -> UnknownIntrinsics:
        """The same, what is told of no focal replaced by :func:`focal_prior`."""
        focals = np.unique(self.place[:, 0])
        focals = focals[focals >= 0]
        mean, std = self.mean.copy(), self.std.copy()
        told = np.where(np.isfinite(std[focals]), mean[focals], np.nan)
        mean[focals], std[focals] = focal_prior(told, std[focals])
        return replace(self, mean=mean, std=std)

    def start(self, log_f: F64) -> F64:
        """Unknowns (B, D) of log focals (B, R) of the cameras; what has no prior mean starts at 0.

        A focal that several cameras share starts at their median; focals that are known are not asked for.
        """
        unknowns = np.repeat(self.mean[None], len(log_f), axis=0)
        for k in np.unique(self.place[:, 0][self.place[:, 0] >= 0]):
            unknowns[:, k] = np.median(log_f[:, self.place[:, 0] == k], axis=1)
        return unknowns

    def focals(self, unknowns: F64) -> F64:
        """Log focals (B, R)."""
        return np.asarray(np.log(self.calibrations(unknowns)[..., 0, 0]))


def focal_prior(mean: F64, std: F64) -> tuple[F64, F64]:
    """Finite means and deviations (G,) of log focals: 1.2 long sides to a factor of 2.5 where nothing is
    known."""
    silent = ~(np.isfinite(mean) & np.isfinite(std))
    return np.where(silent, np.log(1.2), mean), np.where(silent, np.log(2.5), std)


def unknown_intrinsics(
    frame: ReferenceFrame, assumed: Assumptions, *, focals_only: bool = False
) -> UnknownIntrinsics:
    """The unknowns of the registered cameras; ``focals_only`` takes all the others for known.

    The frame must be one of :func:`thesisrecon.selfcalibration.frame.assumed_frame`, whose coordinates have
    the assumed aspect and principal point in them already.
    """
    mean, std = _unit_free(frame, assumed)
    if focals_only:
        std[:, 1:] = 0.0
    place = np.full(mean.shape, -1, dtype=np.int64)
    means: list[float] = []
    stds: list[float] = []
    for column in range(COLUMNS):
        shared = assumed.shared[frame.views, column]
        for number in np.unique(shared[std[:, column] > 0.0]):
            rows = np.flatnonzero((shared == number) & (std[:, column] > 0.0))
            place[rows, column] = len(means)
            means.append(float(mean[rows[0], column]))
            stds.append(float(std[rows[0], column]))
    return UnknownIntrinsics(place, mean, np.array(means), np.array(stds))


def _unit_free(frame: ReferenceFrame, assumed: Assumptions) -> tuple[F64, F64]:
    """Means and standard deviations (R, 5) in the coordinates of the frame."""
    rows, unit = frame.views, frame.pixel_from_unit[frame.views]
    mean, std = np.zeros((len(rows), COLUMNS)), assumed.std[rows, :COLUMNS].copy()
    focal = assumed.mean[rows, 0]
    silent = ~(np.isfinite(focal) & np.isfinite(std[:, 0]))
    mean[:, 0] = np.log(np.where(silent, unit[:, 0, 0], focal) / unit[:, 0, 0])
    std[silent, 0] = np.inf
    std[:, 1] /= assumed.mean[rows, 1]
    mean[:, 2] = assumed.mean[rows, 2] / unit[:, 0, 0]
    std[:, 2] /= unit[:, 0, 0]
    std[:, 3] /= unit[:, 0, 0]
    std[:, 4] /= unit[:, 1, 1]
    return mean, std
