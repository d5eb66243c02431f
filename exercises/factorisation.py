"""12. Factorisation of affine cameras

Affine cameras see x = M X + t. With the centroid of the points as the origin, t is the mean of the pixels
of an image. The centred pixels of V images (rows x and y of image 1, of image 2 ...) form a matrix W (2 V,
N) = M X of rank 3. With the SVD U S V', M is the first three columns of U S, and X the first three rows of
V', up to an affine transformation (Tomasi and Kanade 1992).
"""

import numpy as np


def factorisation(xy):
    """Return M (V, 2, 3), t (V, 2) and X (N, 3) from pixels (V, N, 2): xy[v, n] ~ M[v] X[n] + t[v]."""
    raise NotImplementedError
