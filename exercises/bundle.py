"""14. Bundle adjustment of three cameras

The maximum likelihood for Gaussian noise minimises the reprojection errors x - pi(K (R(r) X + t)) over the
rotation vectors r and translations t of all cameras and all points X together. scipy.optimize.least_squares
minimises a vector of residuals; scipy.spatial.transform.Rotation.from_rotvec(r) gives R. The frame and its
scale are free: the result is judged by its pixels (6.4; Hartley and Zisserman, 18.1).
"""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation


def bundle(K, r, t, X, xy):
    """Return r (V, 3), t (V, 3) and X (N, 3) of least reprojection error from initial ones.

    K (3, 3) is known; pixels xy (V, N, 2); x ~ K (R X + t).
    """
    raise NotImplementedError
