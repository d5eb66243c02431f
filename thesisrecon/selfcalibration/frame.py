"""Reference frame of chapter 7: unit-free pixels, one camera at [I | 0].

With H = [[K_r, 0], [-p' K_r, 1]], P H is metric if the plane at infinity p and K_r are right (HZ 19.1); p is
finite for every real camera, whose centre is not at infinity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.records import Reconstruction

# Relative size below which a singular value, or a distance of centres, is rounding.
_RANK_TOLERANCE = 1e-11

# Relative standard deviation of an exactly known focal length; keeps every criterion finite.
_KNOWN_FOCAL_STD = 1e-4


@dataclass(frozen=True)
class ReferenceFrame:
    """Registered cameras in unit-free pixels with the reference camera at [I | 0].

    Attributes
    ----------
    A, a : ndarray (R, 3, 3), (R, 3)
        Camera i is [A_i | a_i] up to scale.
    views : ndarray (R,) of int
        View number of each camera.
    reference : int
        Place of the reference camera in ``views``.
    group : ndarray (R,) of int
        Camera number of each view, 0-based and dense; views of one group share their focal length.
    pixel_from_unit : ndarray (V, 3, 3)
        Pixels from unit-free coordinates, for all views.
    reference_from_projective : ndarray (4, 4)
        Transform of points from the projective frame of the reconstruction.
    focal_mean, focal_std : ndarray (G,), optional
        Prior of the log focal lengths of the groups; NaN and inf where unknown.
    prior : IntrinsicsPrior, optional
        Prior of all views.
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
        """Return the same frame with fewer cameras.

        Parameters
        ----------
        keep : ndarray (M,) of int
            Places in ``views``; the reference must be among them.

        Returns
        -------
        ReferenceFrame
            Frame of the chosen cameras.
        """
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
    """Transform the registered cameras of a projective reconstruction to a reference frame.

    Parameters
    ----------
    reconstruction : Reconstruction
        Projective reconstruction.
    groups : ndarray (V,) of int
        Camera number of every view.
    reference : int, optional
        Registered view to place at [I | 0]; by default the one with the most observations.
    unit : ndarray (V, 3, 3), optional
        Pixels from unit-free coordinates; by default centred, with the long side as unit.

    Returns
    -------
    ReferenceFrame
        Cameras with a median baseline of 1.

    Raises
    ------
    StageFailure
        If a camera has rank below 3 or all camera centres coincide.
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
    """Raise ``StageFailure`` if a camera (R, 3, 4) has rank below 3 or all centres coincide."""
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
            f"{flat} of {len(P)} projective cameras have rank below 3"
            if flat
            else f"the camera centres are {apart:.1e} apart"
        )
    raise StageFailure(
        "the projective cameras cannot be calibrated",
        evidence,
        "take images from different positions",
    )


def normalized_frame(
    reconstruction: Reconstruction, prior: IntrinsicsPrior, *, reference: int | None = None
) -> ReferenceFrame:
    """Build a reference frame whose coordinates absorb the prior aspect ratio and principal point.

    In these coordinates K = diag(f, f, 1) if the prior holds.

    Parameters
    ----------
    reconstruction : Reconstruction
        Projective reconstruction.
    prior : IntrinsicsPrior
        Prior of the intrinsics of every view.
    reference : int, optional
        Registered view to place at [I | 0].

    Returns
    -------
    ReferenceFrame
        Frame with the focal priors of its camera groups.

    Raises
    ------
    StageFailure
        Below three cameras, if one has rank below 3, or if all centres coincide.
    """
    _require_three_cameras(reconstruction)
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


def _require_three_cameras(reconstruction: Reconstruction) -> None:
    n = int(reconstruction.registered.sum())
    if n < 3:
        raise StageFailure(
            "self-calibration needs at least 3 registered images",
            f"{n} were registered",
            "add images with more overlap",
        )


def _unit_of(prior: IntrinsicsPrior, sizes: I64) -> F64:
    unit = pixel_from_unit(sizes)
    unit[:, 1, 1] *= prior.mean[:, 1]
    unit[:, :2, 2] = prior.mean[:, 3:5]
    return unit


def metric_from_calibration(p: F64, K: F64) -> F64:
    """Compute the upgrade H^-1 from the plane at infinity and the reference calibration.

    Parameters
    ----------
    p : ndarray (3,)
        Plane at infinity (p, 1).
    K : ndarray (3, 3)
        Unit-free calibration of the reference camera.

    Returns
    -------
    ndarray (4, 4)
        Metric from reference frame; NaN if K is singular.

    References
    ----------
    HZ 19.1; M. Pollefeys, R. Koch, L. Van Gool, IJCV 32(1), 1999.

    Examples
    --------
    >>> import numpy as np
    >>> H_inv = metric_from_calibration(np.array([0.1, 0.0, 0.2]), np.diag([2.0, 2.0, 1.0]))
    >>> np.round(H_inv[3], 6)
    array([0.1, 0. , 0.2, 1. ])
    """
    H = np.eye(4)
    H[:3, :3] = K
    H[3, :3] = -p @ K
    try:
        return np.asarray(np.linalg.inv(H), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.full((4, 4), np.nan)


def _example_frame(n: int = 6, f: float = 1.2) -> tuple[ReferenceFrame, F64]:
    """Return ``n`` exact cameras of focal length ``f`` and the plane at infinity p (3,), for the examples."""
    rng = np.random.default_rng(0)
    K, p = np.diag([f, f, 1.0]), np.array([0.1, -0.2, 0.3])
    R = scipy.spatial.transform.Rotation.from_rotvec(
        0.4 * rng.normal(size=(n, 3)) * (np.arange(n) > 0)[:, None]
    ).as_matrix()
    a = rng.normal(size=(n, 3)) * (np.arange(n) > 0)[:, None]
    A = K @ R @ np.linalg.inv(K) + a[:, :, None] * p
    views, unit = np.arange(n), np.tile(np.eye(3), (n, 1, 1))
    return ReferenceFrame(A, a, views, 0, np.zeros(n, dtype=np.int64), unit, np.eye(4)), p
