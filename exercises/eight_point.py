"""4. Fundamental matrix by the normalised eight-point algorithm

A match of two images of a rigid scene fulfils x2' F x1 = 0, with x = (x, y, 1)'. This is one linear
equation in the nine entries of F; eight matches determine it up to scale. Normalise the points of each
image first (mean 0, mean distance sqrt 2; T1, T2), solve by the SVD, make det F = 0 by setting the least
singular value to zero, and undo the normalisation: F = T2' Fn T1 (5.1 of the thesis; Hartley and Zisserman,
algorithm 11.1).
"""

import numpy as np


def eight_point(xy1, xy2):
    """Return F (3, 3), of any scale, from pixels xy1 and xy2, both (N, 2), N >= 8."""
    raise NotImplementedError
