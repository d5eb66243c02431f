"""Dense matching of real pairs stays as good as it was measured to be."""

import numpy as np

from tests.synthetic import texture
from validation.scenes.stereo import StereoPair, seen_by_both


def small_pair():
    """A textured plane at disparity 5, a nearer square at 9."""
    colors = [[texture(60, 120, 3 * kind + k) for k in range(3)] for kind in range(2)]
    base, square = (np.stack(channels, axis=2).astype(np.uint8) for channels in colors)
    left, right = base[:, 20:110].copy(), base[:, 25:115].copy()
    truth = np.full((60, 90), 5.0, np.float32)
    left[20:40, 40:60], right[20:40, 31:51] = square[:20, :20], square[:20, :20]
    truth[20:40, 40:60] = 9.0
    return StereoPair("small", left, right, truth, seen_by_both(truth, None), 16)


def test_pixels_hidden_by_the_square_or_beyond_the_image_are_not_judged():
    judged = small_pair().judged
    assert not judged[:, :5].any()
    # At the left of the square lie the four columns of the plane that it covers in the right image.
    assert not judged[20:40, 36:40].any()
    assert judged[20:40, 40:60].all()
    assert judged[:20, 5:].all()
