"""Weights of interpolations against their plain formulas."""

import numpy as np
import pytest

from thesisrecon.geometry.raster import cubic_weights


def keys_kernel(x):
    """Keys' kernel with a = -1/2 at distances x from a pixel, written as in the paper."""
    s = np.abs(x)
    near = 1.5 * s**3 - 2.5 * s**2 + 1.0
    far = -0.5 * s**3 + 2.5 * s**2 - 4.0 * s + 2.0
    return np.where(s <= 1.0, near, np.where(s < 2.0, far, 0.0))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.73, 1.0])
def test_cubic_weights_are_those_of_keys(share):
    weights = np.empty(4)
    cubic_weights(share, weights)
    np.testing.assert_allclose(weights, keys_kernel(share - np.arange(-1.0, 3.0)), atol=1e-15)
    assert weights.sum() == pytest.approx(1.0, abs=1e-15)
