"""8. Relative pose from the essential matrix

E = [t]x R relates points x = inv(K) (u, v, 1)' of calibrated cameras: x2' E x1 = 0. With the SVD E = U
diag(1, 1, 0) V' and W = [0 -1 0; 1 0 0; 0 0 1], R is U W V' or U W' V' (of the sign with det R = 1), and t
is the last column of U or its negative. Of these four poses, one puts the points in front of both cameras,
[I 0] and [R t] (cheirality; Hartley and Zisserman, 9.6). Exercise 7 triangulates.
"""

import numpy as np


def relative_pose(E, x1, x2):
    """Return R (3, 3) and t (3,) of unit length, X2 = R X1 + t, from E and matches x1, x2 (N, 2).

    x1 and x2 are inv(K) (u, v, 1)' without the 1. E may have any scale and sign.
    """
    raise NotImplementedError
