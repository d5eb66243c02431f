"""13. Self-calibration by the absolute dual quadric

Projective cameras P (V, 3, 4) of one unknown focal length, with the principal point at the origin, see the
absolute dual quadric Q (4, 4), symmetric, as w = P Q P' ~ diag(f^2, f^2, 1). Each camera gives four linear
equations in the ten entries of Q: w01 = w02 = w12 = 0 and w00 = w11. Their singular vector is Q, and f =
sqrt(w00 / w22) (7.2; Hartley and Zisserman, 19.3).
"""

import numpy as np


def dual_quadric(P):
    """Return the focal lengths (V,) of projective cameras P (V, 3, 4), any scale, whose f is of order 1."""
    raise NotImplementedError
