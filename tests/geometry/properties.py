"""What the property tests of chapter 3 share: deterministic examples and random cameras and points."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from thesisrecon.geometry.camera_matrix import calibration_matrix, camera_from_centre


def holds_for_every(*more, examples=30):
    """Run a test for the same ``examples`` seeds of a generator in every run, and for ``more`` strategies."""

    def decorate(test):
        generators = st.integers(0, 2**31).map(np.random.default_rng)
        checked = given(generators, *more)(test)
        return settings(max_examples=examples, deadline=None, derandomize=True, database=None)(checked)

    return decorate


def random_points(rng, n, d=4):
    """Homogeneous points or planes (n, d) about the origin, of any scales and signs."""
    x = np.column_stack([rng.uniform(-2.0, 2.0, (n, d - 1)), np.ones(n)])
    return np.asarray(x * (rng.uniform(0.3, 3.0, n) * rng.choice([-1.0, 1.0], n))[:, None])


def random_camera(rng, *, distance=8.0):
    """P, K, R, centre of a camera with skew that looks at points near the origin."""
    K = calibration_matrix(
        rng.uniform(800, 2000), rng.uniform(800, 2000), *rng.uniform(400, 700, 2), skew=rng.uniform(-20, 20)
    )
    R = Rotation.random(random_state=rng).as_matrix()
    centre = rng.normal(0.0, 0.3, 3) - distance * R[2]
    return camera_from_centre(K, R, centre), K, R, centre


def gap(a, b):
    """Distance of two arrays of any scale and sign: the sine of their angle."""
    a, b = a.ravel() / np.linalg.norm(a), b.ravel() / np.linalg.norm(b)
    return float(min(np.linalg.norm(a - b), np.linalg.norm(a + b)))
