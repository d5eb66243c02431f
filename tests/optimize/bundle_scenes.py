"""A small synthetic block of images for the tests of bundle adjustment."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations


@dataclass(frozen=True)
class Block:
    """True cameras and points with exact observations."""

    cameras: MetricCameras
    X: np.ndarray
    view: np.ndarray
    point: np.ndarray
    xy: np.ndarray

    @property
    def Xh(self):
        return homogenize(self.X)

    def seen(self, xy=None):
        return Observations(self.view, self.point, self.xy if xy is None else xy)

    def image(self, P, X):
        """Pixels of the observations for cameras (V, 3, 4) and homogeneous points."""
        return dehomogenize(np.einsum("kab,kb->ka", P[self.view], X[self.point]))


def project_block(cameras, X, view, point):
    """The model of the metric cameras in plain NumPy."""
    Y = np.einsum("kab,kb->ka", cameras.R[view], X[point]) + cameras.t[view]
    x, y = Y[:, 0] / Y[:, 2], Y[:, 1] / Y[:, 2]
    f, aspect, skew, cx, cy, *distortion = cameras.intrinsics[cameras.group[view]].T
    d = 1.0 + sum(k * (x**2 + y**2) ** (n + 1) for n, k in enumerate(distortion))
    return np.column_stack([f * x * d + skew * y * d + cx, aspect * f * y * d + cy])


def make_block(*, views=6, points=80, k1=0.0, lens=(), groups=1, seed=3):
    """Cameras on an arc looking inwards, turned about their axes; every point seen by most of them."""
    rng = np.random.default_rng(seed)
    middle = np.array([1.0, -2.0, 0.5])
    X = rng.normal(size=(points, 3)) + middle
    angles = np.linspace(-0.7, 0.7, views)
    R, t = np.empty((views, 3, 3)), np.empty((views, 3))
    for v, angle in enumerate(angles):
        R[v] = Rotation.from_euler("yxz", [angle, 0.25 * np.sin(3 * angle), 0.5 * v]).as_matrix()
        t[v] = [0.0, 0.0, 7.0 + 0.4 * np.cos(2.0 * v)] - R[v] @ middle
    intrinsics = np.tile([1200.0, 1.0, 0.0, 515.0, 380.0, k1, *lens], (groups, 1))
    cameras = MetricCameras(R, t, intrinsics, np.arange(views) % groups)
    seen = rng.random((points, views)) < 0.8
    seen[:, :2] = True
    point, view = np.nonzero(seen)
    return Block(cameras, X, view, point, project_block(cameras, X, view, point))


def perturbed(block, *, seed=5, size=0.01):
    """Cameras and points moved off the truth."""
    rng = np.random.default_rng(seed)
    c = block.cameras
    turn = Rotation.from_rotvec(rng.normal(size=(len(c.R), 3)) * size).as_matrix()
    intrinsics = c.intrinsics.copy()
    intrinsics[:, 0] *= 1.04
    intrinsics[:, 3:5] += [-6.0, 5.0]
    intrinsics[:, 5:] = 0.0
    moved = MetricCameras(turn @ c.R, c.t + rng.normal(size=c.t.shape) * size, intrinsics, c.group)
    return moved, block.X + rng.normal(size=block.X.shape) * size
