"""15. Disparity by dynamic programming along scanlines

In rectified images the pixel x of the left image is at x - d in the same row of the right one: d is its
disparity. With the cost C(x, d) = |left(x) - right(x - d)|, a row of disparities minimises the sum of C(x,
d) and of penalty |d(x) - d(x - 1)|. Forward: S(x, d) = C(x, d) + min over k of S(x - 1, k) + penalty |d -
k|. Backward: the best d of the last column, then the k that led to it (chapter 2; Cox et al. 1996).
"""

import numpy as np


def disparity(left, right, count, penalty):
    """Return integer disparities (H, W), 0 <= d < count, of grey images (H, W); without a match C is 100."""
    raise NotImplementedError
