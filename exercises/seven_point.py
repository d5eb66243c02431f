"""5. Fundamental matrix from seven matches

Seven matches leave a pencil F = a F1 + (1 - a) F2: F1 and F2 are the last two right singular vectors of the
(7, 9) matrix of x2' F x1 = 0. det F = 0 is a cubic in a with one or three real roots, each of which is a
solution (5.2). A cubic is determined by its values at four a (numpy.polyfit, numpy.roots).
"""

import numpy as np


def seven_point(xy1, xy2):
    """Return all F (S, 3, 3), S = 1 or 3, of any scale, from seven matches in pixels, both (7, 2)."""
    raise NotImplementedError
