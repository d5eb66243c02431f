"""A pair of cameras that nothing is symmetric in, as both libraries and ours should see it."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from validation.references.libraries import NoReference, load


def skip_without(*libraries):
    """Skip a module of tests where one of these reference libraries cannot be had."""
    for library in libraries:
        try:
            load(library)
        except NoReference as missing:
            pytest.skip(str(missing), allow_module_level=True)


@dataclass(frozen=True)
class Looked:
    """Points X (N, 3) before cameras P (2, 3, 4) = K [R t], and their exact pixels xy (2, N, 2)."""

    K: F64
    R: F64
    t: F64
    X: F64

    @property
    def P_normalised(self):
        """[R t]."""
        return np.concatenate([self.R, self.t[:, :, None]], axis=2)

    @property
    def P(self):
        return np.asarray(self.K @ self.P_normalised)

    @property
    def xy(self):
        x = np.einsum("vab,nb->vna", self.P, np.column_stack([self.X, np.ones(len(self.X))]))
        return np.asarray(x[..., :2] / x[..., 2:])


@pytest.fixture(scope="session")
def looked():
    """The second camera is turned, moved in all directions, and has another focal length."""
    rng = np.random.default_rng(5)
    K = np.array([[[700.0, 0, 300], [0, 700, 260], [0, 0, 1]], [[640.0, 0, 340], [0, 640, 220], [0, 0, 1]]])
    R = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.1, -0.3, 0.5]]).as_matrix()
    t = np.array([[0.0, 0.0, 0.0], [-1.0, 0.4, 0.7]])
    X = rng.uniform([-2.0, -1.5, 5.0], [2.0, 1.5, 9.0], (60, 3))
    return Looked(K, R, t, X)
