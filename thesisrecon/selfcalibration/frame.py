"""The frame in which chapter 7 is solved: unit-free pixels, and one camera at [I | 0].

A plane at infinity is then three numbers p with H = [[K_r, 0], [-p' K_r, 1]] (methods of Pollefeys and of
Hartley alike): P H is metric when p and K_r are right, and p is finite for every real camera because its
centre is not at infinity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.types import I64, Assumptions, Reconstruction

F64 = NDArray[np.float64]

FLAT = 1e-11
"""Share of the largest below which a singular value, or a distance of centres, is rounding."""

KNOWN_STD = 1e-4
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
    assumed: Assumptions | None = None

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
            self.assumed,
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
        evidence = f"{bad} of {len(P)} cameras are zero or not finite"
    else:
        S = np.linalg.svd(P / np.linalg.norm(P, axis=(1, 2))[:, None, None], compute_uv=False)
        flat = int((S[:, 2] < FLAT * S[:, 0]).sum())
        centres = np.linalg.svd(P)[2][:, 3]
        apart = float(np.sqrt(np.maximum(1.0 - (centres @ centres[0]) ** 2, 0.0)).max())
        if not flat and apart > FLAT:
            return
        evidence = (
            f"{flat} of {len(P)} cameras see a line only" if flat else f"their centres are {apart:.1e} apart"
        )
    raise StageFailure(
        "the projective cameras are not such that they can be calibrated",
        evidence,
        "photograph the scene from different places",
    )


def assumed_frame(
    reconstruction: Reconstruction, assumed: Assumptions, *, reference: int | None = None
) -> ReferenceFrame:
    """:func:`build_frame` in coordinates that have the assumed aspect and principal point in them.

    What is assumed there, known or only a place to start, is normalised away: the methods see cameras
    diag(f, f, 1) as far as the assumption holds.
    """
    frame = build_frame(
        reconstruction, assumed.group, reference=reference, unit=_unit_of(assumed, reconstruction.sizes)
    )
    known = assumed.focal_known[frame.views]
    unit = frame.pixel_from_unit[frame.views, 0, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_f = np.log(assumed.mean[frame.views, 0] / unit)
    mean, std = np.full(frame.n_groups, np.nan), np.full(frame.n_groups, np.inf)
    for g in range(frame.n_groups):
        mine = known & (frame.group == g)
        if mine.any():
            mean[g] = np.median(log_f[mine])
            std[g] = max(float(np.median(assumed.std[frame.views[mine], 0])), KNOWN_STD)
    return replace(frame, focal_mean=mean, focal_std=std, assumed=assumed)


def _unit_of(assumed: Assumptions, sizes: I64) -> F64:
    unit = pixel_from_unit(sizes)
    unit[:, 1, 1] *= assumed.mean[:, 1]
    unit[:, :2, 2] = assumed.mean[:, 3:5]
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
