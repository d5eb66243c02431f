"""Chapter 7 on synthetic scenes as a task: the focal lengths of one draw by the configured variant."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_from_options
from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.records import IntrinsicsPrior, Reconstruction
from validation.ablation.statistics import Sample
from validation.ablation.study import Measure, Place, Task
from validation.scenes.cube import OFF_FACE
from validation.scenes.rigs import Rig, cube_rig, make_cloud, noisy_tracks, projective_from_truth, zoomed

_STEP = 1e-6


def focal_bound(rig: Rig, sigma_px: float, *, zooming: bool, principal_std_px: float) -> F64:
    """Relative standard deviations (V,) of the focals, in percent; one of all views unless ``zooming``.

    All views share a principal point. Points seen by fewer than two views do not count.
    """
    seen = np.isfinite(rig.pixels()[..., 0])
    seen &= seen.sum(axis=0) >= 2
    n, groups = len(rig.K), len(rig.K) if zooming else 1
    size = 6 * n + groups + 2
    information = np.zeros((size, size))
    point_part = np.zeros((len(rig.X), 3, 3))
    mixed = np.zeros((len(rig.X), size, 3))
    for v in range(n):
        k = np.flatnonzero(seen[v])
        columns = np.r_[6 * v : 6 * v + 6, 6 * n + (v if zooming else 0), size - 2, size - 1]
        J, B = _derivatives(rig, v, rig.X[k])
        information[np.ix_(columns, columns)] += np.einsum("kra,krb->ab", J, J)
        point_part[k] += B.swapaxes(1, 2) @ B
        mixed[k[:, None], columns] += J.swapaxes(1, 2) @ B
    used = seen.any(axis=0)
    W, V = mixed[used], np.linalg.inv(point_part[used])
    information -= np.einsum("kac,kcd,kbd->ab", W, V, W)
    information /= sigma_px**2
    information[range(size - 2, size), range(size - 2, size)] += principal_std_px**-2
    # The pseudo-inverse removes the seven gauge freedoms; focal lengths do not depend on them.
    scale = 1.0 / np.sqrt(information.diagonal())
    value, vector = np.linalg.eigh(information * scale * scale[:, None])
    inverse = np.where(np.arange(size) < 7, 0.0, 1.0 / np.maximum(value, 1e-15))
    variance = np.sum(vector**2 * inverse, axis=1) * scale**2
    std = 100.0 * np.sqrt(variance[6 * n : 6 * n + groups])
    return std if zooming else np.repeat(std, n)


def _derivatives(rig: Rig, v: int, X: F64) -> tuple[F64, F64]:
    """Derivatives of pixels of X (M, 3) by (rotation, shift, log f, centre) (M, 2, 9) and X (M, 2, 3)."""

    def pixels(p: F64) -> F64:
        R = Rotation.from_rotvec(p[:3]).as_matrix() @ rig.R[v]
        x = (X - rig.C[v] - p[9:]) @ R.T + p[3:6]
        f = rig.K[v, [0, 1], [0, 1]] * np.exp(p[6])
        return np.asarray(x[:, :2] / x[:, 2:] * f + rig.K[v, :2, 2] + p[7:9])

    steps = _STEP * np.eye(12)
    J = np.stack([(pixels(s) - pixels(-s)) / (2.0 * _STEP) for s in steps], axis=-1)
    # Moving the centre by d is equivalent to moving all points by -d.
    return J[:, :, :9], -J[:, :, 9:]


SCENES = ("cube", "cloud")
MODES = ("constant", "zooming")
PRINCIPAL_STD = 0.01
"""Prior standard deviation of the principal point over the long side."""
ZOOM = 0.3
"""Focal lengths are multiplied by e^u with u uniform in +-ZOOM."""


@dataclass(frozen=True)
class Cell:
    """One setting: scene, mode, noise and number of cameras."""

    scene: str
    mode: str
    sigma_px: float
    views: int


@dataclass(frozen=True)
class CalibrationOverNoise(Task):
    """``views`` cameras of the cube or of a cloud with Gaussian noise of ``noise_px``, handed to the
    self-calibration as the minimum of the projective bundle adjustment in a random frame.

    ``mode`` is "constant" (one focal length) or "zooming". With ``bundle`` the metric stage follows.
    """

    noise_px: float = 1.0
    views: int = 9
    mode: str = "constant"
    bundle: bool = False

    sample: ClassVar[Sample] = "draws"
    measures: ClassVar[Sequence[Measure]] = (
        Measure("focal_error_pct", "%", "less", True, "median |f / f_true - 1| of the cameras"),
        Measure("worst_focal_error_pct", "%", "less", True, "largest |f / f_true - 1| of the cameras"),
        Measure("focal_error_over_bound", "", "less", True, "the first over its Cramer-Rao bound"),
        Measure("success_pct", "%", "more", False, "100 where the median focal error is below 3 %, else 0"),
    )

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(unknown_word("mode", self.mode, MODES))
        if self.noise_px < 0.0 or not 3 <= self.views <= 27:
            raise ValueError("noise_px is at least 0, views between 3 and 27")

    def check(self, scene: str) -> None:
        if scene not in SCENES:
            raise UsageError(unknown_word("scene", scene, SCENES))

    def unavailable(self, scene: str) -> Collection[str]:
        return () if self.noise_px else ("focal_error_over_bound",)

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        cell = Cell(scene, self.mode, self.noise_px, self.views)
        rig, projective = draw_cell(cell, seed)
        prior, rng = assumptions(rig, self.mode), np.random.default_rng(seed)
        calibration = config.selfcalibration.calibrate(projective, prior=prior, rng=rng)
        K = calibration.K
        if self.bundle:
            refined = config.metric.refine(projective, calibration, prior=prior, rng=rng, threads=1)
            assert refined.reconstruction.K is not None
            K = refined.reconstruction.K
        judged = projective.registered
        error = 100.0 * np.abs(K[judged, 0, 0] / rig.K[judged, 0, 0] - 1.0)
        median = float(np.median(error))
        bound = _bound_pct(cell, seed)
        return {
            "focal_error_pct": median,
            "focal_error_over_bound": median / bound if bound else float("nan"),
            "worst_focal_error_pct": float(error.max()),
            "success_pct": 100.0 * (median <= 3.0),
        }


def make_rig(cell: Cell, rng: np.random.Generator) -> Rig:
    """Draw the cameras."""
    if cell.scene == "cloud":
        rig = make_cloud(cell.views, rng)
    else:
        rig = cube_rig()
        if cell.views < len(rig.K):
            assert rig.flat is not None
            usable, whole = np.flatnonzero(~rig.flat), rig
            rig = whole.subset(np.sort(rng.choice(usable, cell.views, replace=False)))
            while not rig.tied_off_planes(OFF_FACE):
                rig = whole.subset(np.sort(rng.choice(usable, cell.views, replace=False)))
    return zoomed(rig, np.exp(rng.uniform(-ZOOM, ZOOM, len(rig.K)))) if cell.mode == "zooming" else rig


def assumptions(rig: Rig, mode: str) -> IntrinsicsPrior:
    """Return the prior: square pixels, principal point near the middle, no distortion."""
    options = IntrinsicsOptions(
        focal="constant" if mode == "constant" else "free", principal_point_std_rel=PRINCIPAL_STD, k1="known"
    )
    n = len(rig.K)
    return prior_from_options(options, [rig.size] * n, np.full(n, np.nan), np.ones(n))


@lru_cache(maxsize=4)
def draw_cell(cell: Cell, seed: int) -> tuple[Rig, Reconstruction]:
    """Return the true cameras and the projective reconstruction of noisy observations."""
    place = (seed, SCENES.index(cell.scene), MODES.index(cell.mode), cell.views, round(100 * cell.sigma_px))
    rng = np.random.default_rng(place)
    rig = make_rig(cell, rng)
    return rig, projective_from_truth(rig, noisy_tracks(rig, cell.sigma_px, rng), rng)


@lru_cache(maxsize=4)
def _bound_pct(cell: Cell, seed: int) -> float:
    """Median |error| of the focal lengths (%) at the Cramer-Rao bound; 0 without noise."""
    if cell.sigma_px == 0.0:
        return 0.0
    rig, projective = draw_cell(cell, seed)
    principal_px = PRINCIPAL_STD * max(rig.size)
    std = focal_bound(rig, cell.sigma_px, zooming=cell.mode == "zooming", principal_std_px=principal_px)
    # Median of |x| for standard normal x.
    return 0.6745 * float(np.median(std[projective.registered]))
