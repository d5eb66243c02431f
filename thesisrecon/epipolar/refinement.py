"""Section 5.3: F that minimises a geometric criterion over the seven degrees of freedom it has."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.frame import PairFrame, check_matches, check_start
from thesisrecon.epipolar.rank2.kernels import DISTANCE, GRADIENT, REPROJECTION, refine

F64 = NDArray[np.float64]

UNBOUNDED = 1e150
"""Stands for an infinite width of the loss: its square is still a number."""


def refine_gradient(
    F: F64, xy1: F64, xy2: F64, *, loss_px: float = UNBOUNDED, max_iterations: int = 50
) -> F64:
    """F (3, 3), unit norm, rank 2, that minimises the Sampson distances of (5.4) from the start ``F``.

    Levenberg-Marquardt on the orthonormal representation (Bartoli and Sturm, 2004) in place of the thesis'
    third row as a combination of the others, whose left null vector [alpha beta -1] cannot be an epipole at
    infinity; ``loss_px`` is the width of Huber's loss (least squares without). Optimal to first order in the
    noise. Raises as :func:`~thesisrecon.epipolar.frame.check_matches` with 7 matches needed, ``ValueError``
    for an F that is not a finite (3, 3) matrix of rank 2 or more.
    """
    return _refine(F, xy1, xy2, GRADIENT, loss_px, max_iterations)


def refine_epipolar_distance(
    F: F64, xy1: F64, xy2: F64, *, loss_px: float = UNBOUNDED, max_iterations: int = 50
) -> F64:
    """As :func:`refine_gradient`, but for the squared distances to both epipolar lines (5.6)."""
    return _refine(F, xy1, xy2, DISTANCE, loss_px, max_iterations)


def refine_reprojection(
    F: F64, xy1: F64, xy2: F64, *, loss_px: float = UNBOUNDED, max_iterations: int = 50
) -> F64:
    """As :func:`refine_gradient`, but for the distances of the matches to the nearest exact ones.

    The gold standard (HZ, algorithm 11.3): the maximum likelihood of F and of all points under Gaussian
    noise. Each point is eliminated by its optimal correction, so that seven parameters are left.
    """
    return _refine(F, xy1, xy2, REPROJECTION, loss_px, max_iterations)


def _refine(F: F64, xy1: F64, xy2: F64, criterion: int, loss_px: float, max_iterations: int) -> F64:
    xy1, xy2 = check_matches(xy1, xy2, needed=7)
    if not loss_px > 0.0:
        raise ValueError(f"loss_px must be positive; got {loss_px}")
    frame = PairFrame.of(xy1, xy2)
    f = check_start(F, frame)
    delta = min(loss_px * frame.scale, UNBOUNDED)
    refine(f, frame.points(xy1, xy2), criterion, np.inf, delta, max_iterations)
    return frame.matrix_in_pixels(f)
