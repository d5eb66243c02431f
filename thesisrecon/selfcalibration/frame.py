"""The frame in which chapter 7 is solved: unit-free pixels, and one camera at [I | 0].

A plane at infinity is then three numbers p with H = [[K_r, 0], [-p' K_r, 1]] (methods of Pollefeys and of
Hartley alike): P H is metric when p and K_r are right, and p is finite for every real camera because its
centre is not at infinity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.types import I64, Reconstruction

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class ReferenceFrame:
    """Registered cameras in unit-free pixels with the reference camera at [I | 0].

    ``A`` (R, 3, 3), ``a`` (R, 3) with camera i ~ [A_i | a_i]; ``views`` (R,) their view numbers;
    ``reference`` the place of the reference camera in ``views``; ``group`` (R,) camera number, 0-based and
    dense; ``pixel_from_unit`` (V, 3, 3) for all views; ``reference_from_projective`` (4, 4).
    """

    A: F64
    a: F64
    views: I64
    reference: int
    group: I64
    pixel_from_unit: F64
    reference_from_projective: F64

    @property
    def n_groups(self) -> int:
        """Number of different cameras among the registered views."""
        return int(self.group.max()) + 1

    def subset(self, keep: I64) -> ReferenceFrame:
        """The same frame with fewer cameras (places in ``views``; the reference must be among them)."""
        groups = np.unique(self.group[keep], return_inverse=True)[1]
        place = int(np.flatnonzero(keep == self.reference)[0])
        return ReferenceFrame(
            self.A[keep], self.a[keep], self.views[keep], place, groups.astype(np.int64),
            self.pixel_from_unit, self.reference_from_projective,
        )  # fmt: skip


def build_frame(
    reconstruction: Reconstruction, groups: I64, *, reference: int | None = None
) -> ReferenceFrame:
    """Move the registered cameras of a projective reconstruction into a reference frame.

    ``groups`` (V,) camera number of every view; ``reference`` a registered view (by default the one with the
    most observations).
    """
    views = np.flatnonzero(reconstruction.registered)
    unit = pixel_from_unit(reconstruction.sizes)
    P = np.linalg.inv(unit[views]) @ reconstruction.P[views]
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


def metric_from_reference(p: F64, focal: float) -> F64:
    """The upgrade H^-1 of a plane at infinity p (3,) and the reference camera's unit-free focal; -> (4,
    4)."""
    K = np.diag([focal, focal, 1.0])
    H = np.eye(4)
    H[:3, :3] = K
    H[3, :3] = -p @ K
    return np.asarray(np.linalg.inv(H), dtype=np.float64)
