"""Linear equations of the image of the absolute conic, from infinite homographies (chapter 7; HZ 19.5).

Homographies H_j (3.29) with det H_j = 1 transfer the conic exactly, w_j = H_j^-T w H_j^-1, so prior knowledge
of w_j is linear in w: constant K: w_j = w (R. Hartley, ECCV 1994); no skew: w_12 = 0; known principal point:
w_13 = w_23 = 0; known aspect: w_11 = w_22 (L. de Agapito, R. Hartley, E. Hayman, CVPR 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.selfcalibration._frame import HOMOGRAPHY_NOISE, ConicConstraints
from thesisrecon.selfcalibration._refinement import ENTRY_WEIGHT, UPPER, quadratic_rows

_PLACE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_REWEIGHTINGS = 4


def dual_conic_of_constant_camera(H: F64) -> tuple[F64, F64]:
    """Solve w* = H w* H' for the dual conic of a constant K (R. Hartley, ECCV 1994), H (R, 3, 3) with det 1.

    Return w* ~ K K' and the singular values (6,): the last is 0 for exact homographies; if the fifth is 0
    too, w* is one of a family.
    """
    equations = _transfer_matrix(H.swapaxes(-1, -2)) - np.eye(6)
    _, s, Vt = np.linalg.svd((ENTRY_WEIGHT[:, None] * equations).reshape(-1, 6), full_matrices=False)
    w = Vt[5][_PLACE]
    return (w if np.trace(w) > 0 else -w), s


def _transfer_matrix(M: F64) -> F64:
    """Return the matrices (..., 6, 6) from the entries of a symmetric w to those of M' w M."""
    return quadratic_rows(M[..., UPPER[0]].swapaxes(-1, -2), M[..., UPPER[1]].swapaxes(-1, -2))


def _conic_equations(H: F64, constraints: ConicConstraints, focals: F64) -> F64:
    """Return rows (B, M, 6) in the entries 11, 12, 13, 22, 23, 33 of w in the reference view.

    H (B, R, 3, 3) of determinant 1 or NaN (no row); ``focals`` (B, R) are unit-free estimates: dividing the
    coordinates by the reference focal length balances entries and weights.
    """
    focals = focals[:, constraints.first]
    scale = np.stack([focals, focals, np.ones_like(focals)], axis=-1)
    reference = scale[:, constraints.reference]
    bad = np.asarray(~np.isfinite(H).all(axis=(-2, -1)))
    scaled = np.where(bad[..., None, None], np.eye(3), H) / scale[..., :, None] * reference[:, None, None, :]
    det = np.linalg.det(scaled)
    carried = _transfer_matrix(np.linalg.inv(scaled / np.cbrt(det)[..., None, None]))
    carried[bad] = 0.0
    std = np.repeat(constraints.std[None], len(H), axis=0)
    std[..., :3] /= focals[..., None]
    weight = HOMOGRAPHY_NOISE / np.hypot(std, HOMOGRAPHY_NOISE)
    half_aspect = (carried[..., 0, :] - carried[..., 3, :]) / 2.0
    known = np.stack([carried[..., 1, :], carried[..., 2, :], carried[..., 4, :], half_aspect], axis=2)
    later = np.flatnonzero(constraints.first != np.arange(H.shape[1]))
    constant = carried[:, later] - carried[:, constraints.first[later]]
    constant[bad[:, later] | bad[:, constraints.first[later]]] = 0.0
    return np.concatenate(
        [(known * weight[..., None]).reshape(len(H), 4 * H.shape[1], 6),
         (constant * ENTRY_WEIGHT[:, None]).reshape(len(H), 6 * len(later), 6)], axis=1,
    )  # fmt: skip


def solve_conic_batch(H: F64, constraints: ConicConstraints) -> tuple[F64, F64]:
    """Solve for the conics of B planes from their homographies (B, R, 3, 3), without reweighting.

    Return squared focal lengths (B,) of the reference view and the residuals (B, M) over the second smallest
    singular value of the equations: 0 for the true plane, NaN if no real camera fits.
    """
    A = _conic_equations(H, constraints, np.ones(H.shape[:2]))
    value, vector = np.linalg.eigh(np.einsum("bri,brj->bij", A, A))
    w = vector[:, :, 0] * np.where(vector[:, [0, 3, 5], 0].sum(axis=1) < 0, -1.0, 1.0)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        f2 = 2.0 * w[:, 5] / (w[:, 0] + w[:, 3])
    bad = ~(f2 > 0) | ~np.isfinite(f2) | (w[:, 0] * w[:, 3] <= 0) | ~np.isfinite(H).all(axis=(1, 2, 3))
    residuals = np.einsum("brk,bk->br", A, w) / np.sqrt(np.maximum(value[:, 1:2], 1e-300))
    return np.where(bad, np.nan, f2), np.where(bad[:, None], np.nan, residuals)


@dataclass(frozen=True)
class ImageConic:
    """Image w (3, 3) of the absolute conic, with the singular values (6,) of its equations."""

    w: F64
    singular_values: F64

    @property
    def definite(self) -> bool:
        """Whether the conic is positive definite: the image of the absolute conic in a real camera."""
        return bool((np.linalg.eigvalsh(self.w) > 0).all())

    @property
    def determined(self) -> bool:
        """Whether the equations have one solution: the second smallest singular value stands out."""
        s = self.singular_values
        # The second bound excludes cameras without rotation, whose equations are only rounding errors.
        return bool(s[4] > 1e-7 * max(s[0], 1e-3) and s[4] > 2.0 * s[5])


def solve_conic(H: F64, constraints: ConicConstraints, *, orthogonal: F64 | None = None) -> ImageConic:
    """Solve for the conic by SVD, reweighted by the estimated focals; x' w y = 0 for ``orthogonal`` pairs."""
    focals = np.ones((1, len(H)))
    conic = ImageConic(np.eye(3), np.zeros(6))
    for _ in range(_REWEIGHTINGS):
        rows = _conic_equations(H[None], constraints, focals)[0]
        back = np.array([focals[0, constraints.first[constraints.reference]]] * 2 + [1.0])
        if orthogonal is not None:
            pairs = orthogonal / back
            x, y = np.swapaxes(pairs / np.linalg.norm(pairs, axis=-1, keepdims=True), 0, 1)
            rows = np.concatenate([rows, quadratic_rows(x, y)])
        _, s, Vt = np.linalg.svd(rows, full_matrices=False)
        w = Vt[5][_PLACE]
        w = (w if np.trace(w) > 0 else -w) / np.outer(back, back)
        conic = ImageConic(np.asarray(w / np.linalg.norm(w)), s)
        if not conic.definite:
            break
        focals = np.clip(_focals(H, conic.w), 0.02, 200.0)[None]
    return conic


def transferred_conics(H: F64, w: F64) -> F64:
    """Return w_j = H_j^-T w H_j^-1 (R, 3, 3)."""
    inverse = np.linalg.inv(H)
    return np.asarray(inverse.swapaxes(-1, -2) @ w @ inverse)


def _focals(H: F64, w: F64) -> F64:
    """Return unit-free focal lengths (R,) of the transferred conics, 1 without a homography."""
    good = np.asarray(np.isfinite(H).all(axis=(1, 2)))
    usable = np.asarray(np.where(good[:, None, None], H, np.eye(3)), dtype=np.float64)
    dual = np.linalg.inv(transferred_conics(usable, w))
    centred = dual[:, [0, 1], [0, 1]] / dual[:, 2, 2, None] - (dual[:, :2, 2] / dual[:, 2, 2, None]) ** 2
    return np.where(good, np.sqrt(np.abs(np.prod(centred, axis=1)) ** 0.5), 1.0)
