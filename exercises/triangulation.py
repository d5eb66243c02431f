"""7. Linear triangulation

Two cameras P1, P2 (3, 4) see X = (X, Y, Z, 1)' at x1 and x2. With the rows p1, p2, p3 of a camera, its
pixel gives (x p3 - p1) X = 0 and (y p3 - p2) X = 0. Two images give four equations; X is the right singular
vector of the least singular value, divided by its fourth coordinate (6.3.1; Hartley and Zisserman, 12.2).
"""

import numpy as np


def triangulation(P1, P2, xy1, xy2):
    """Return points (N, 3) m from cameras P1, P2 (3, 4) and pixels xy1, xy2 (N, 2)."""
    raise NotImplementedError
