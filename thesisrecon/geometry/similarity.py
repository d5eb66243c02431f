"""Section 3.4.4: similarities between metric models, and the errors of rotations after alignment."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64, require_finite, require_shapes
from thesisrecon.records import Similarity


def estimate_similarity(source: F64, target: F64) -> Similarity:
    """The similarity from ``source`` to ``target`` (N, 3) with the least sum of squared distances.

    Umeyama, PAMI 13(4), 1991. Fewer than 3 points, or points of one line, are a ``ValueError``.
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
    """Angles between rotations after the rotation of the world that fits them best.

    It is the chordal mean of the relative rotations: two views suffice, and the centres have no effect.
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
