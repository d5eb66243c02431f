"""Two views of synthetic scenes with known geometry."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from thesisrecon.camera import compose_camera
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import fundamental_from_cameras

SIZE = (1280.0, 960.0)
K = np.array([[1200.0, 0.0, 640.0], [0.0, 1200.0, 480.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Pair:
    """Exact matches xy1, xy2 of cameras P1, P2 with F."""

    xy1: F64
    xy2: F64
    F: F64
    P1: F64
    P2: F64


def make_pair(n, rng, *, planar=False):
    """n points about 5 units in front of two cameras one unit apart, turned by about 10 degrees."""
    X = rng.uniform(-1.2, 1.2, (n, 3))
    if planar:
        X[:, 2] = 0.3 * X[:, 0] - 0.2 * X[:, 1]
    X += [0.0, 0.0, 5.0]
    R = Rotation.from_rotvec(rng.normal((0.0, 0.15, 0.0), 0.05)).as_matrix()
    centre = np.array([1.0, 0.0, 0.0]) + rng.normal(0.0, 0.1, 3)
    P1, P2 = compose_camera(K, np.eye(3), np.zeros(3)), compose_camera(K, R, -R @ centre)
    return Pair(project(P1, X), project(P2, X), fundamental_from_cameras(P1, P2), P1, P2)


def with_points(pair, X, *, sigma=0.0, rng=None):
    """The matches of a pair and, after them, those of further points; noise on all of them."""
    xy = [np.r_[a, project(P, X)] for a, P in ((pair.xy1, pair.P1), (pair.xy2, pair.P2))]
    return [a + rng.normal(0.0, sigma, a.shape) if sigma else a for a in xy]


def spoil(pair, rng, *, sigma, outliers):
    """Noise on every coordinate, a share of image 2's points anywhere; xy1, xy2 and which are wrong (N,)."""
    xy1 = pair.xy1 + rng.normal(0.0, sigma, pair.xy1.shape)
    xy2 = pair.xy2 + rng.normal(0.0, sigma, pair.xy2.shape)
    wrong = rng.random(len(xy1)) < outliers
    xy2[wrong] = rng.uniform((0.0, 0.0), SIZE, (int(wrong.sum()), 2))
    return xy1, xy2, wrong


def angle_between(F1, F2):
    """Angle of two unit matrices up to sign, rad."""
    return float(min(np.linalg.norm(F1 - F2), np.linalg.norm(F1 + F2)))


def oriented(f, points, sample):
    """Whether the sample can be in front of both cameras: e2 x x2 and F x1 agree in sign for all or none."""
    F = f.reshape(3, 3)
    e2 = np.linalg.svd(F)[0][:, 2]
    x1, x2 = homogenize(points[sample, :2]), homogenize(points[sample, 2:])
    sides = np.sum((x1 @ F.T) * np.cross(e2, x2), axis=1)
    return bool((sides >= 0.0).all() or (sides <= 0.0).all())
