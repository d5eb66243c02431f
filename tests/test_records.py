"""Records and counted words."""

import numpy as np

from thesisrecon.errors import counted
from thesisrecon.records import DisparityMap


def test_holes_are_filled_with_the_farther_side():
    nan = np.nan
    disparity = np.array([[nan, 5, nan, nan, 3, nan], [nan] * 6, [1, nan, 4, nan, 2, 2]], dtype=np.float32)
    filled = DisparityMap(disparity, np.isfinite(disparity).astype(np.float32), 0.5).filled()
    assert filled.dtype == np.float32
    np.testing.assert_array_equal(filled, [[5, 5, 3, 3, 3, 3], [nan] * 6, [1, 1, 4, 2, 2, 2]])


def test_counted_nouns_have_the_right_number():
    assert [counted(n, "photograph") for n in (0, 1, 2)] == ["0 photographs", "1 photograph", "2 photographs"]
    assert [counted(n, "verified match") for n in (1, 7)] == ["1 verified match", "7 verified matches"]
    assert counted(1200, "face", "1 200") == "1 200 faces"
