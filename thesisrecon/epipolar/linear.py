"""Section 5.2: fundamental matrices from linear equations: eight and more matches, and exactly seven."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.frame import SMALLEST_PX, PairFrame, as_matches, check_matches
from thesisrecon.epipolar.search import seven_point
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize, normalizing_transform
from thesisrecon.geometry.two_view import enforce_rank_two, unit_norm

UNDETERMINED_REL = 1e-12
"""Ratio of the eighth to the first singular value below which the matches leave F free."""


def estimate_eight_point(xy1: F64, xy2: F64, *, normalized: bool = True, rank_two: bool = True) -> F64:
    """F (3, 3), unit norm, that minimises the algebraic residuals (5.2) over matches (N >= 8, 2) px.

    ``normalized`` conditions the pixels first (Hartley, "In defence of the eight-point algorithm", PAMI
    1997); raw pixels, as the thesis has it, weight the entries of F unequally and are the worse the larger
    the image. ``rank_two`` moves to the nearest singular matrix (in the frame it was solved in), which the
    thesis' linear method does not.

    Raises ``ValueError`` for fewer than 8 matches, wrong shapes or coordinates that are not finite, and
    ``StageFailure`` where the matches leave F free (all on a line, or on a plane without noise).
    """
    xy1, xy2 = as_matches(xy1, xy2)
    if len(xy1) < 8:
        raise ValueError(f"the eight-point algorithm needs at least 8 matches; got {len(xy1)}")
    xy1, xy2 = check_matches(xy1, xy2, needed=8)
    T1 = normalizing_transform(xy1) if normalized else np.eye(3)
    T2 = normalizing_transform(xy2) if normalized else np.eye(3)
    x1, x2 = homogenize(xy1) @ T1.T, homogenize(xy2) @ T2.T
    A = (x2[:, :, None] * x1[:, None, :]).reshape(len(x1), 9)
    # The triangular factor has the singular values and right vectors of all rows, and nine rows.
    _, s, Vt = np.linalg.svd(np.linalg.qr(A, mode="r"))
    if not s[7] > UNDETERMINED_REL * s[0] * (1.0 if normalized else 1e-4):
        raise StageFailure(
            "the matches leave the fundamental matrix free",
            f"the equations of {len(xy1)} matches have rank below 8",
            "matches on one plane do that; some off the plane are needed",
        )
    F = Vt[8].reshape(3, 3)
    return unit_norm(T2.T @ (enforce_rank_two(F) if rank_two else F) @ T1)


def estimate_seven_point(xy1: F64, xy2: F64) -> F64:
    """The fundamental matrices through exactly seven matches (7, 2) px; (k, 3, 3), k = 0 to 3, unit norm.

    The pencil f1, f2 of solutions of (5.1) is searched for its singular members; all directions count, also
    F1 - F2, which alpha f1 + (1 - alpha) f2 of the thesis reaches only at infinity. Empty where the seven
    matches are degenerate (their equations dependent, or every member singular). Raises ``ValueError`` for
    other shapes or coordinates that are not finite.
    """
    xy1, xy2 = as_matches(xy1, xy2)
    if xy1.shape != (7, 2):
        raise ValueError(f"the seven-point algorithm needs two (7, 2) arrays; got {xy1.shape}, {xy2.shape}")
    if not min(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()) > SMALLEST_PX:
        return np.empty((0, 3, 3))
    frame = PairFrame.of(xy1, xy2)
    solutions = np.empty((3, 9))
    count = seven_point(frame.points(xy1, xy2), np.arange(7), solutions)
    return np.array([frame.matrix_in_pixels(f) for f in solutions[:count]]).reshape(count, 3, 3)
