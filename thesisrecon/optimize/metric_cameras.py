"""Calibrated cameras as bundle adjustment sees them, and what is known of their intrinsics beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]
POSE_DOF = 6
# Columns of a table of intrinsics: with k1 alone, and with k2 and k3.
INTRINSIC_DOFS = (6, 8)
FOCAL = 0


@dataclass(frozen=True)
class MetricCameras:
    """Calibrated cameras whose views share what they are said to share.

    ``R`` (V, 3, 3) world-to-camera, ``t`` (V, 3); ``intrinsics`` (G, C) rows [focal_px, aspect fy/fx,
    skew_px, cx_px, cy_px, k1] (C = 6), with k2 and k3 after them where the lens needs these (C = 8);
    ``group`` (V,) the row of each view. A normalised point (x, y) is seen at (x, y) (1 + k1 r^2 + k2 r^4 + k3
    r^6), then at K = [[f, skew, cx], [0, aspect f, cy], [0, 0, 1]]. ``shared`` (G, C): rows with equal
    numbers in a column hold one and the same value there; None: every row has values of its own.
    """

    R: F64
    t: F64
    intrinsics: F64
    group: I64
    shared: I64 | None = None

    @property
    def K(self) -> F64:
        """(V, 3, 3) calibration matrices."""
        f, aspect, skew, cx, cy = self.intrinsics[self.group].T[:5]
        zero, one = np.zeros_like(f), np.ones_like(f)
        rows = [f, skew, cx, zero, aspect * f, cy, zero, zero, one]
        return np.stack(rows, axis=-1).reshape(-1, 3, 3)

    @property
    def P(self) -> F64:
        """(V, 3, 4) cameras before distortion, K [R t]."""
        return np.asarray(self.K @ np.concatenate([self.R, self.t[:, :, None]], axis=2))


@dataclass(frozen=True)
class IntrinsicsPrior:
    """What is known of the intrinsics: ``mean``, ``std`` (G, C), one row for each row of ``intrinsics``.

    Units are those of the intrinsics (px; aspect and k1 pure numbers), but the focal's std is relative: the
    prior acts on log f. std 0: the value is the mean and does not move. std inf: nothing is known. Rows that
    share a value have one prior for it: the tightest of theirs.

    ``population`` (G,): rows of equal number are cameras of one kind, whose values scatter about a common
    mean that is not known, with standard deviation ``spread`` (C,), or (G, C) where each kind has its own
    (that of its first row counts; relative for the focal; inf = no such assumption): a camera whose own
    photographs do not determine a value borrows it from the others. -1: of no kind.
    """

    mean: F64
    std: F64
    population: I64 | None = None
    spread: F64 | None = None


def check_cameras(cameras: MetricCameras, X: F64, free: B8) -> None:
    """Refuse wrong shapes and values with ``ValueError``."""
    n_views, n_rows, width = len(cameras.R), len(cameras.intrinsics), cameras.intrinsics.shape[-1]
    shapes = (cameras.R.shape, cameras.t.shape, cameras.intrinsics.shape, cameras.group.shape, X.shape[1:])
    if width not in INTRINSIC_DOFS or shapes != (
        (n_views, 3, 3), (n_views, 3), (n_rows, width), (n_views,), (3,)
    ):  # fmt: skip
        raise ValueError(
            f"a metric bundle needs R (V, 3, 3), t (V, 3), intrinsics (G, 6 or 8), group (V,); got {shapes}"
        )
    if np.shape(free) != (width,):
        raise ValueError(f"free is one flag for each of the {width} intrinsics; got shape {np.shape(free)}")
    if cameras.shared is not None and np.shape(cameras.shared) != cameras.intrinsics.shape:
        raise ValueError(
            f"shared has a number for each of the intrinsics; got shape {np.shape(cameras.shared)}"
        )
    finite = (np.isfinite(a).all() for a in (cameras.R, cameras.t, cameras.intrinsics, X))
    if not all(finite) or not (cameras.intrinsics[:, FOCAL] > 0.0).all():
        raise ValueError("cameras and points must be finite and focals positive")
    if n_views and (cameras.group.min() < 0 or cameras.group.max() >= n_rows):
        raise ValueError(f"groups must lie in 0..{n_rows - 1}")


def check_prior(prior: IntrinsicsPrior, shape: tuple[int, ...]) -> None:
    """Refuse wrong shapes and values with ``ValueError``."""
    known = np.isfinite(prior.std) if np.shape(prior.std) == shape else np.ones(shape, dtype=bool)
    if not (
        np.shape(prior.mean) == np.shape(prior.std) == shape
        and (prior.std >= 0.0).all()
        and np.isfinite(prior.mean[known]).all()
        and (prior.mean[known[:, FOCAL], FOCAL] > 0.0).all()
    ):
        raise ValueError(
            f"a prior of shape {shape} needs stds >= 0 and, where they are finite, means and positive focals"
        )
    if (prior.population is None) != (prior.spread is None):
        raise ValueError("a population needs its spread, and a spread its population")
    if prior.population is not None and prior.spread is not None:
        shapes = (np.shape(prior.population), np.shape(prior.spread))
        if shapes not in ((shape[:1], shape[1:]), (shape[:1], shape)) or not (prior.spread > 0.0).all():
            raise ValueError(
                f"population is (G,) and spread (C,) or (G, C) above 0; got {shapes}, {prior.spread}"
            )
