"""1. Points and lines in homogeneous coordinates

A pixel (x, y) is the vector (x, y, 1)', a line the vector l with l' x = 0. The line through two points is l
= x1 x x2 (cross product), and two lines meet in x = l x m, which is divided by its third coordinate.
"""

import numpy as np


def intersection(a, b, c, d):
    """Return the pixels (N, 2) where line ab meets line cd; a, b, c, d are pixels (N, 2)."""
    raise NotImplementedError
