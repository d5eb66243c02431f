"""The lens of rendered drives is that of the simulated tracks."""

import numpy as np

from validation.scenes.moving import CAR, Lens, _project, straighten


def test_rendered_pixels_have_the_lens_of_the_simulated_tracks():
    lens, focal = Lens(k1=0.015, aspect=1.002), 718.9
    X = np.random.default_rng(0).uniform([-3.0, -0.9, 4.0], [3.0, 0.9, 5.0], (50, 3))
    still = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), focal, CAR
    seen, pinhole = (_project(X, *still, one)[0] for one in (lens, Lens()))
    assert 3.0 < np.abs(seen - pinhole).max() < 20.0
    np.testing.assert_allclose(straighten(seen.T, focal, CAR, lens).T, pinhole, atol=1e-6)
