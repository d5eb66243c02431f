"""10. Vanishing line and affine rectification of a plane

Parallel lines of a plane meet in one vanishing point v in the image: l' v = 0 for all their lines l. With
more than two, v is the singular vector of the least singular value of the lines, each of unit length, in
coordinates of order 1: divide pixels by 1000 first. Two directions give the vanishing line l = v1 x v2, of
pixels again, and H = [1 0 0; 0 1 0; l'], l divided by its third coordinate, makes parallel lines parallel
again (Hartley and Zisserman, 2.7.2).
"""

import numpy as np


def horizon(segments1, segments2):
    """Return H (3, 3) for pixels, from two groups of parallel segments (N, 2, 2): two ends, x and y."""
    raise NotImplementedError
