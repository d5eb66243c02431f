"""Section 7.3, direct: the absolute dual quadric by weighted linear equations.

Pollefeys, Verbiest and Van Gool (ECCV 2002): each camera that is square, without skew and with its principal
point in the middle gives six equations linear in the quadric. The weights suppose a focal near 1; scanning a
normalising focal over the plausible range makes them right for one of the scanned values whatever the lens.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.selfcalibration.frame import ReferenceFrame

F64 = NDArray[np.float64]

_PAIRS = [(a, b) for a in range(4) for b in range(a, 4)]


def _quadratic_rows(x: F64, y: F64) -> F64:
    """Rows r with r . q = x' Q y for the upper-triangle vector q of a symmetric Q; (..., 4), (..., 4) ->
    (..., 10)."""
    terms = [x[..., a] * y[..., b] + (x[..., b] * y[..., a] if a != b else 0.0) for a, b in _PAIRS]
    return np.stack(terms, axis=-1)


def _symmetric(q: F64) -> F64:
    Q = np.zeros((*q.shape[:-1], 4, 4))
    for k, (a, b) in enumerate(_PAIRS):
        Q[..., a, b] = Q[..., b, a] = q[..., k]
    return Q


def linear_quadric(frame: ReferenceFrame, focals: F64, *, iterations: int = 4) -> F64:
    """Absolute dual quadrics (B, 4, 4) in the reference frame for each normalising focal (B,), rank 3, Q[2,
    2] >= 0.

    The rows are those of Pollefeys et al. with uncertainties 9 (focal), 0.2 (aspect), 0.01 (skew), 0.1
    (principal point), divided by the w33 of the previous iterate.
    """
    P = np.concatenate([frame.A, frame.a[:, :, None]], axis=2)[None].repeat(len(focals), axis=0)
    P[:, :, :2] /= focals[:, None, None, None]
    p1, p2, p3 = P[:, :, 0], P[:, :, 1], P[:, :, 2]
    w11, w22, w33 = (_quadratic_rows(p, p) for p in (p1, p2, p3))
    rows = np.stack(
        [(w11 - w33) / 9, (w22 - w33) / 9, (w11 - w22) / 0.2, _quadratic_rows(p1, p2) / 0.01,
         _quadratic_rows(p1, p3) / 0.1, _quadratic_rows(p2, p3) / 0.1], axis=2,
    )  # fmt: skip
    nu = np.linalg.norm(w33, axis=-1)
    q = np.zeros((len(focals), 10))
    for _ in range(iterations):
        A = (rows / np.maximum(nu, 1e-9 * nu.max(axis=1, keepdims=True))[:, :, None, None]).reshape(
            len(focals), -1, 10
        )
        q = np.linalg.eigh(np.einsum("bri,brj->bij", A, A))[1][:, :, 0]
        nu = np.abs(np.einsum("bvk,bk->bv", w33, q))
    Q = _symmetric(q)
    Q *= np.where(np.trace(Q[:, :3, :3], axis1=1, axis2=2) < 0, -1.0, 1.0)[:, None, None]
    return Q


def quadric_hypotheses(frame: ReferenceFrame, focals: F64) -> tuple[F64, F64]:
    """Planes at infinity (B, 3) and reference focals (B,) from the scanned linear quadric.

    The plane is the quadric's null vector (the smallest eigenvalue is set to zero); a quadric whose w* of the
    reference camera is not positive keeps the normalising focal.
    """
    Q = linear_quadric(frame, focals)
    value, vector = np.linalg.eigh(Q)
    smallest = np.abs(value).argmin(axis=1)
    null = np.take_along_axis(vector, smallest[:, None, None], axis=2)[:, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        p = null[:, :3] / null[:, 3:]
        f2 = (Q[:, 0, 0] + Q[:, 1, 1]) / (2.0 * Q[:, 2, 2])
    f = np.sqrt(np.where(np.isfinite(f2) & (f2 > 0), f2, focals**2))
    good = np.isfinite(p).all(axis=1)
    return p[good], np.clip(f[good], 0.05, 50.0)
