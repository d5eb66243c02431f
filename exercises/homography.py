"""2. Homography by the normalised DLT

Two images of a plane are related by x2 ~ H x1, with x = (x, y, 1)'. Each match gives two equations in the
nine entries of H, the first two rows of x2 x (H x1) = 0:

    [ 0'      -x1'    y2 x1' ]
    [ x1'      0'    -x2 x1' ] h = 0,    h = the rows of H.

With N >= 4 matches, h is the right singular vector of the least singular value. Normalise first: T1, T2
bring the points of each image to mean 0 and mean distance sqrt 2. Afterwards H = inv(T2) Hn T1 (Hartley and
Zisserman, algorithm 4.2).
"""

import numpy as np


def homography(xy1, xy2):
    """Return H (3, 3), of any scale, from pixels xy1 and xy2, both (N, 2), N >= 4."""
    raise NotImplementedError
