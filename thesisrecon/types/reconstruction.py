"""Cameras and points, what is assumed of the cameras, and what calibration says of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from thesisrecon.types.arrays import B8, F64, I64, Stratum

INTRINSICS = ("focal", "aspect", "skew", "principal_x", "principal_y", "k1")
"""The intrinsics of a view in the order of every array that has a column for each."""


@dataclass(frozen=True)
class Tracks:
    """Observations of scene points: K of them, sorted by (point, view).

    ``view_index, point_index`` (K,), ``xy`` (K, 2) px. A point is seen at most once in a view.
    """

    view_index: I64
    point_index: I64
    xy: F64
    n_views: int
    n_points: int


@dataclass(frozen=True)
class Reconstruction:
    """Cameras and points in one stratum, with the tracks they explain.

    ``P`` (V, 3, 4) (zeros where not ``registered``), ``X`` (N, 4) homogeneous (zeros where not ``valid``);
    ``inlier`` (K,) bool per observation; ``reasons`` per view, empty where registered. In the metric stratum
    ``P = K [R t]`` before distortion, with ``K`` (V, 3, 3) and the coefficients k1, k2, k3 of the lens in
    ``radial`` (V, 3), no distortion where that is None: a normalised image point (x, y) is seen at (x, y) (1
    + k1 r^2 + k2 r^4 + k3 r^6), r^2 = x^2 + y^2, before K; ``X[:, 3] = 1`` where valid.
    """

    stratum: Stratum
    P: F64
    X: F64
    registered: B8
    valid: B8
    inlier: B8
    tracks: Tracks
    sizes: I64
    sigma_px: float
    reasons: tuple[str, ...]
    K: F64 | None = None
    radial: F64 | None = None


@dataclass(frozen=True)
class Upgrade:
    """One candidate answer of self-calibration: ``metric_from_projective`` (4, 4), ``K`` (V, 3, 3) (zeros
    where not registered), the ``cost`` it reached and the ``method`` it came from.
    """

    metric_from_projective: F64
    K: F64
    cost: float
    method: str


@dataclass(frozen=True)
class MotionVerdict:
    """Whether the photographs determine the calibration under what is assumed, and the critical motion that
    the cameras come nearest to.

    ``motion`` is its name ("pure translation", "turntable", ...; empty where nothing could be measured);
    ``critical`` True where the cameras cannot be told from it by what a photographer does anyhow. A critical
    motion may still be ``identifiable``: what it leaves open, the assumptions may settle. ``evidence`` maps
    the name of each measure to its number; ``sentences`` say what was found, what it means and what to do;
    ``undetermined`` are views whose own focal length is not determined.
    """

    identifiable: bool
    motion: str
    critical: bool
    evidence: Mapping[str, float]
    sentences: tuple[str, ...] = ()
    undetermined: tuple[int, ...] = ()


@dataclass(frozen=True)
class SelfCalibration:
    """The answer of chapter 7: the best upgrade, its rivals (best first, the best included), and how sure it
    is.

    ``K_std`` (V, 3, 3) standard deviations of the entries of K by the method's own residuals: 0 where an
    entry is known, that of the assumption where the method left it as assumed, NaN where nothing is known of
    it. ``identifiable`` False where the motion does not determine the answer, with ``reasons``; ``verdict``
    is the evidence for that, None where none was gathered.
    """

    metric_from_projective: F64
    K: F64
    K_std: F64
    identifiable: bool
    reasons: tuple[str, ...]
    candidates: tuple[Upgrade, ...] = ()
    verdict: MotionVerdict | None = None

    @property
    def plane_at_infinity(self) -> F64:
        """Unit (4,) plane at infinity in the projective frame: what the upgrade takes to (0, 0, 0, 1)."""
        plane = self.metric_from_projective[3]
        return np.asarray(plane / np.linalg.norm(plane), dtype=np.float64)


@dataclass(frozen=True)
class IntrinsicInterval:
    """One intrinsic of one view: value and standard deviation (px, or a pure number) and where it is from."""

    value: float
    std: float
    source: str


@dataclass(frozen=True)
class MetricResult:
    """The end of the metric stage: the reconstruction, the intrinsics of each view with intervals, the
    self-check.

    ``intrinsics[i]`` maps "focal_px", "aspect" (fy / fx), "skew_px", "principal_x_px", "principal_y_px",
    "k1", "k2" and "k3" to an interval (empty where view i is not registered; std 0: as assumed).
    ``self_check`` holds measured numbers; ``trusted`` False with ``doubts`` where it failed; ``warnings``
    what should be known of a result that is trusted all the same (a focal that is borrowed, a prior that the
    photographs contradict).
    """

    reconstruction: Reconstruction
    intrinsics: tuple[Mapping[str, IntrinsicInterval], ...]
    self_check: Mapping[str, float]
    trusted: bool
    doubts: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Assumptions:
    """What is assumed of the intrinsics of V views, a column for each of :data:`INTRINSICS`.

    ``shared`` (V, 6): views with equal numbers in a column have the same value (one camera, constant); every
    number of its own means the value is free to vary. ``mean, std`` (V, 6): what is known beforehand, in px
    at working size where the intrinsic has that unit; the focal's std is relative (it acts on log f). std 0 =
    known to be the mean, inf = nothing is known and the mean is only a place to start (NaN for the focal,
    which has none). ``alike`` (V,): views of equal number have cameras of one kind, whose values scatter
    about a common one where they are not shared; all different = nothing of the sort is assumed.
    """

    shared: I64
    mean: F64
    std: F64
    alike: I64

    @property
    def group(self) -> I64:
        """(V,) number of the camera whose focal a view has, 0-based and dense."""
        return np.unique(self.shared[:, 0], return_inverse=True)[1].astype(np.int64)

    @property
    def focal_known(self) -> B8:
        """(V,) whether anything is known of a view's focal beforehand."""
        return np.isfinite(self.std[:, 0]) & np.isfinite(self.mean[:, 0])
