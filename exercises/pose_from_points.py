"""9. Camera pose from known points (resection)

A calibrated camera sees X (m) at the pixel x ~ K (R X + t). The DLT of exercise 3 gives P ~ K [R t] up to
noise, so inv(K) P is s [R t] of unknown scale s and sign. The nearest rotation to its first three columns U
S V' is R = U V' (with the sign that makes det R = 1); the scale is the mean of the singular values, and t
the last column divided by it.
"""

import numpy as np


def pose_from_points(X, xy, K):
    """Return R (3, 3) and t (3,) m from points X (N, 3) m, pixels xy (N, 2), N >= 6, and K (3, 3)."""
    raise NotImplementedError
