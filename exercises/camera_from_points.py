"""3. Camera calibration by the DLT

A camera P (3, 4) sees X = (X, Y, Z, 1)' at x ~ P X. Each known point gives two linear equations in the
twelve entries of P, as for a homography; six points or more determine it. Normalise pixels and points
first. Then P ~ K [R t]: the RQ decomposition of the first three columns (scipy.linalg.rq) gives K, upper
triangular with a positive diagonal, and the rotation R, det R = 1. With this K, t = inv(K) P[:, 3]; at last
K is divided by K[2, 2] (Hartley and Zisserman, 7.1).
"""

import numpy as np


def camera_from_points(X, xy):
    """Return K (3, 3), R (3, 3) and t (3,) m, x ~ K (R X + t), of points X (N, 3) m and pixels xy (N, 2)."""
    raise NotImplementedError
