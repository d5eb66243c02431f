"""Section 6.3: space points from their images.

Linear (DLT, Hartley and Sturm, "Triangulation", CVIU 68(2), 1997) for any number of views at once.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.camera import camera_centre
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.geometry.optimal_triangulation import correct_matches

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def triangulate_observations(P: F64, view: I64, point: I64, xy: F64, n_points: int) -> F64:
    """Linear triangulation of all points of an observation list; -> (n_points, 4) with unit norm.

    P (V, 3, 4); view, point (K,), xy (K, 2) px. Minimises the algebraic residual u p3'X - p1'X, v p3'X -
    p2'X with each row pair scaled by the norm of its camera's first two rows. Points with fewer than two
    observations come out as zeros.
    """
    scale = np.linalg.norm(P[:, :2], axis=(1, 2))
    Q = (P / np.where(scale > 0, scale, 1.0)[:, None, None])[view]
    rows = xy[:, :, None] * Q[:, 2:3] - Q[:, :2]
    outer = np.einsum("kra,krb->kab", rows, rows).reshape(len(view), 16)
    normal = np.stack([np.bincount(point, outer[:, c], minlength=n_points) for c in range(16)], axis=1)
    counts = np.bincount(point, minlength=n_points)
    X = np.zeros((n_points, 4))
    enough = counts >= 2
    X[enough] = np.linalg.eigh(normal[enough].reshape(-1, 4, 4))[1][:, :, 0]
    return X


def triangulate_linear(P: F64, xy: F64) -> F64:
    """Linear triangulation, P (V, 3, 4), xy (V, N, 2) px with NaN where not seen; -> X (N, 4) unit norm.

    Points seen in fewer than two views come out as zeros.
    """
    if P.ndim != 3 or P.shape[1:] != (3, 4) or xy.ndim != 3 or xy.shape[0] != len(P) or xy.shape[2] != 2:
        raise ValueError(f"triangulate needs P (V, 3, 4) and xy (V, N, 2); got {P.shape} and {xy.shape}")
    view, point = np.nonzero(np.isfinite(xy).all(axis=2))
    return triangulate_observations(P, view, point, xy[view, point], xy.shape[1])


def triangulation_angles(centres: F64, view: I64, point: I64, X: F64, n_points: int) -> F64:
    """Largest angle (rad) between a point's rays, against the ray of its first observation; -> (n_points,).

    centres (V, 3), X (n_points, 3); a point without observations gets 0.
    """
    rays = X[point] - centres[view]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    first = np.zeros((n_points, 3))
    first[point[::-1]] = rays[::-1]
    cosine = np.clip(np.einsum("ka,ka->k", rays, first[point]), -1.0, 1.0)
    angles = np.zeros(n_points)
    np.maximum.at(angles, point, np.arccos(cosine))
    return angles


def triangulate_midpoint(P: F64, xy: F64) -> F64:
    """Point nearest to all rays in the least-squares sense (6.3.2); P (V, 3, 4), xy (V, N, 2), NaN = not
    seen.

    Meaningful in a metric frame only: distances do not exist in a projective one, and the answer changes
    with it. Returns X (N, 4) with X4 = 1; parallel rays and points seen once come out as zeros.
    """
    M_inverse = np.linalg.inv(P[:, :, :3])
    centres = -np.einsum("vab,vb->va", M_inverse, P[:, :, 3])
    seen = np.asarray(np.isfinite(xy).all(axis=2))
    pixels = np.concatenate([np.where(seen[:, :, None], xy, 0.0), np.ones((*seen.shape, 1))], axis=2)
    rays = np.einsum("vab,vnb->vna", M_inverse, pixels)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    projector = (np.eye(3) - rays[..., :, None] * rays[..., None, :]) * seen[:, :, None, None]
    normal = projector.sum(axis=0)
    right = np.einsum("vnab,vb->na", projector, centres)
    good = (seen.sum(axis=0) >= 2) & (np.abs(np.linalg.det(normal)) > 1e-14)
    X = np.zeros((xy.shape[1], 4))
    X[good, :3] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
    X[good, 3] = 1.0
    return X


def triangulate_polynomial(P: F64, xy: F64) -> F64:
    """Optimal triangulation from two views (6.3.3): P (2, 3, 4), xy (2, N, 2); -> X (N, 4) unit norm.

    The matches are moved to the nearest pair that satisfies the epipolar constraint, after which the rays
    meet and the linear method is exact. Points not seen in both views come out as zeros.
    """
    if P.shape != (2, 3, 4):
        raise ValueError(f"the polynomial method needs exactly two cameras; got P of shape {P.shape}")
    centre = camera_centre(P[0])
    epipole = P[1] @ centre
    F = cross_matrix(epipole) @ P[1] @ np.linalg.pinv(P[0])
    F /= np.linalg.norm(F)
    both = np.isfinite(xy).all(axis=(0, 2))
    corrected = np.full_like(xy, np.nan)
    corrected[0, both], corrected[1, both] = correct_matches(F, xy[0, both], xy[1, both])
    return triangulate_linear(P, corrected)


def triangulate(
    P: F64, xy: F64, *, method: Literal["polynomial", "linear", "midpoint"] = "polynomial"
) -> F64:
    """Space points X (N, 4) from their images by one of the three methods of section 6.3.

    P (V, 3, 4) cameras; xy (V, N, 2) px, NaN = not seen. ``polynomial`` is optimal and takes two views.
    Raises ``ValueError`` for wrong shapes or an unknown method.
    """
    methods = {
        "polynomial": triangulate_polynomial,
        "linear": triangulate_linear,
        "midpoint": triangulate_midpoint,
    }
    if method not in methods:
        raise ValueError(f"triangulate knows {', '.join(methods)}; got method={method!r}")
    P, xy = np.asarray(P, dtype=np.float64), np.asarray(xy, dtype=np.float64)
    if P.ndim != 3 or P.shape[1:] != (3, 4) or xy.ndim != 3 or xy.shape[0] != len(P) or xy.shape[2] != 2:
        raise ValueError(f"triangulate needs P (V, 3, 4) and xy (V, N, 2); got {P.shape} and {xy.shape}")
    return methods[method](P, xy)
