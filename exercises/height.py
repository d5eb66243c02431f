"""11. Height in one image by the cross ratio

A vertical segment from the ground has its base at b and its top at t (both (x, y, 1)'). With the vertical
vanishing point v and the vanishing line l of the ground (the horizon), its height is

    z = |b x t| / (alpha |l' b| |v x t|).

alpha is the same in the whole image: a segment of known height gives it (Criminisi, Reid and Zisserman
2000).
"""

import numpy as np


def height(v, l, base, top, known_base, known_top, known_height):
    """Return heights (N,) m of segments base, top (N, 2) px; v and l (3,); known_base, known_top (2,) px."""
    raise NotImplementedError
