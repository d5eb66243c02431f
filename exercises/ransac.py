"""6. RANSAC for the fundamental matrix

Draw eight matches at random, estimate F (exercise 4, or of seven matches: exercise 5), and count the
matches whose Sampson distance |x2' F x1| / sqrt(a^2 + b^2 + c^2 + d^2) is below the threshold: (a, b) are
the first two numbers of F x1, (c, d) those of F' x2. Keep the F with most inliers (Fischler and Bolles
1981; chapter 5).
"""

import numpy as np


def ransac(xy1, xy2, threshold, eight_point, rng):
    """Return which matches are inliers, bool (N,), of pixels xy1, xy2 (N, 2), about 30 % of them wrong.

    threshold is a distance in px, eight_point(xy1, xy2) returns F, rng is a numpy Generator. 500 samples do.
    """
    raise NotImplementedError
