"""The fundamental matrices of the camera pairs of a reconstruction, with what their matches say of each.

The Kruppa equations and the focal lengths from F know a pair by its F alone. Here F comes from the pair's own
matches (started from the cameras'), so that its covariance is that of the matches and a pair that leaves its
F open says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import fundamental_from_cameras, unit_norm
from thesisrecon.records import Reconstruction
from thesisrecon.selfcalibration.frame import ReferenceFrame

FLATTEST_REL = 1e-12
"""Curvatures below this share of the largest are raised to it: an open direction is uncertain, not inf."""

LEAST_SIGMA = 1e-12


@dataclass(frozen=True)
class PairGeometry:
    """M pairs of cameras: places ``i, j`` (M,) in the frame, ``F`` (M, 3, 3) in its unit-free coordinates,
    unit norm (x_j' F x_i = 0), ``covariance`` (M, 9, 9) of vec(F) row-major."""

    i: I64
    j: I64
    F: F64
    covariance: F64


def camera_pairs(
    frame: ReferenceFrame, reconstruction: Reconstruction, *, min_common: int = 20, refine: bool = True
) -> PairGeometry:
    """All pairs of registered cameras with at least ``min_common`` common observations.

    ``refine`` fits F to the pair's own matches; else it is that of the two cameras, which all the views
    together have determined, and the covariance is too large.
    """
    xy, order = _unit_free_table(frame, reconstruction)
    found: list[tuple[int, int, F64, F64]] = []
    P = np.concatenate([frame.A, frame.a[:, :, None]], axis=2)
    for i in range(len(order)):
        for j in range(i + 1, len(order)):
            both = np.isfinite(xy[i, :, 0]) & np.isfinite(xy[j, :, 0])
            if both.sum() < max(min_common, 8):
                continue
            try:
                start = fundamental_from_cameras(P[i], P[j])
            except ValueError:
                # One centre: no epipolar geometry.
                continue
            F, covariance = fit_fundamental(start, xy[i, both], xy[j, both], iterations=5 if refine else 0)
            if np.isfinite(F).all() and np.isfinite(covariance).all():
                found.append((i, j, F, covariance))
    columns = list(zip(*found, strict=True)) if found else [(), (), np.zeros((0, 3, 3)), np.zeros((0, 9, 9))]
    return PairGeometry(
        np.array(columns[0], dtype=np.int64), np.array(columns[1], dtype=np.int64), np.array(columns[2]),
        np.array(columns[3]),
    )  # fmt: skip


def _unit_free_table(frame: ReferenceFrame, reconstruction: Reconstruction) -> tuple[F64, I64]:
    """Inlier observations (R, N, 2) in unit-free coordinates, NaN where a view does not see a point."""
    tracks, keep = reconstruction.tracks, reconstruction.inlier
    place = np.full(tracks.n_views, -1)
    place[frame.views] = np.arange(len(frame.views))
    keep = keep & (place[tracks.view_index] >= 0)
    view, point = tracks.view_index[keep], tracks.point_index[keep]
    unit = np.linalg.inv(frame.pixel_from_unit[view])
    table = np.full((len(frame.views), tracks.n_points, 2), np.nan)
    table[place[view], point] = np.einsum("kab,kb->ka", unit, homogenize(tracks.xy[keep]))[:, :2]
    return table, frame.views


def fit_fundamental(F: F64, x1: F64, x2: F64, *, iterations: int = 5) -> tuple[F64, F64]:
    """F (3, 3) of least Sampson distances (5.4) near a start, and the covariance (9, 9) of vec(F).

    Gauss-Newton in the seven-dimensional tangent space of the matrices of rank 2 and unit norm, with Huber
    weights at 2.5 sigma. x1, x2 (N, 2). A step that does not lower the cost ends it.
    """
    F = unit_norm(F)
    B, r, J = _linearised(F, x1, x2)
    for _ in range(iterations):
        sigma = 1.4826 * float(np.median(np.abs(r)))
        w = np.minimum(1.0, 2.5 * sigma / np.maximum(np.abs(r), 1e-300)) if sigma > 0.0 else np.ones_like(r)
        U, s, Vt = np.linalg.svd((J @ B) * np.sqrt(w)[:, None], full_matrices=False)
        s = np.maximum(s, np.sqrt(FLATTEST_REL) * max(float(s[0]), 1e-300))
        trial = _rank_two(F - (B @ (Vt.T @ ((U.T @ (np.sqrt(w) * r)) / s))).reshape(3, 3))
        B_new, r_new, J_new = _linearised(trial, x1, x2)
        if not float(np.abs(r_new).sum()) < float(np.abs(r).sum()):
            break
        F, B, r, J = trial, B_new, r_new, J_new
    sigma = max(1.4826 * float(np.median(np.abs(r))) * np.sqrt(len(r) / (len(r) - 7.0)), LEAST_SIGMA)
    value, vector = np.linalg.eigh((J @ B).T @ (J @ B))
    half = B @ (vector / np.sqrt(np.maximum(value, FLATTEST_REL * max(float(value[-1]), 1e-300))))
    return F, np.asarray(sigma**2 * half @ half.T)


def _linearised(F: F64, x1: F64, x2: F64) -> tuple[F64, F64, F64]:
    """Basis (9, 7) of the tangent space, Sampson distances (N,), derivatives (N, 9) by vec(F)."""
    U, _, Vt = np.linalg.svd(F)
    across = np.stack([np.outer(U[:, 2], Vt[2]).ravel(), F.ravel()])
    basis = np.linalg.svd(across)[2][2:].T
    h1, h2 = homogenize(x1), homogenize(x2)
    l2, l1 = h1 @ F.T, h2 @ F
    gradient = np.sqrt(np.sum(l2[:, :2] ** 2, axis=1) + np.sum(l1[:, :2] ** 2, axis=1)) + 1e-300
    r = np.sum(h2 * l2, axis=1) / gradient
    J = (h2[:, :, None] * h1[:, None, :]).reshape(-1, 9) / gradient[:, None]
    return basis, r, J


def _rank_two(F: F64) -> F64:
    U, s, Vt = np.linalg.svd(F)
    return unit_norm((U[:, :2] * s[:2]) @ Vt[:2])
