"""Section 3.4.4: similarities between metric models, and the errors of rotations after alignment."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64, require_finite, require_shapes
from thesisrecon.records import Similarity


def estimate_similarity(source: F64, target: F64) -> Similarity:
    """Estimate the similarity from ``source`` to ``target`` with the least sum of squared distances.

    Parameters
    ----------
    source, target : ndarray (N, 3)
        At least 3 points, not on one line (the rotation about it is free); otherwise a ``ValueError``.

    Returns
    -------
    Similarity

    References
    ----------
    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI, 1991.

    Examples
    --------
    >>> X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> found = estimate_similarity(X, 2.0 * X + 5.0)
    >>> round(found.scale, 9), found.t.round(9).tolist()
    (2.0, [5.0, 5.0, 5.0])
    """
    require_shapes("estimate_similarity", source=(source, ("N", 3)), target=(target, ("N", 3)))
    if len(source) < 3:
        raise ValueError(f"estimate_similarity needs at least 3 points; got {len(source)}")
    require_finite("estimate_similarity", source, target)
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    s, t = source - mean_s, target - mean_t
    U, D, Vt = np.linalg.svd(t.T @ s / len(s))
    if D[1] <= 1e-12 * max(D[0], 1e-300):
        raise ValueError("estimate_similarity needs points that do not all lie on one line")
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ S @ Vt
    scale = float(np.trace(np.diag(D) @ S) / np.mean(np.sum(s**2, axis=1)))
    return Similarity(scale, R, mean_t - scale * R @ mean_s)


def rotation_errors_deg(R: F64, R_true: F64) -> F64:
    """Compute the angles between rotations after the rotation of the world that fits them best.

    It is the chordal mean of the relative rotations: two views suffice, and the centres have no effect.

    Parameters
    ----------
    R, R_true : ndarray (V, 3, 3)
        Rotations from world to camera in two worlds.

    Returns
    -------
    ndarray (V,)
        Degrees.

    Examples
    --------
    >>> R = np.array([np.eye(3), np.diag([1.0, -1.0, -1.0])])
    >>> rotation_errors_deg(R, R @ np.diag([-1.0, -1.0, 1.0])).round(9).tolist()
    [0.0, 0.0]
    """
    common = nearest_rotation(np.einsum("vji,vjk->ik", R_true, R))
    difference = np.einsum("vij,jk,vlk->vil", R_true, common, R)
    # The chord keeps its digits at small angles, where arccos of the trace loses half of them.
    chord = np.linalg.norm(difference - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)
    return np.asarray(np.degrees(2.0 * np.arcsin(np.minimum(chord, 1.0))))


def nearest_rotation(A: F64) -> F64:
    """The rotation nearest to A (3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(A)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
