"""Points of a plane or line, and coordinates far from the origin, in each function that whitens space.

Residuals are computed from the returned cameras and points, in the caller's frame.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.optimize.bundle_scenes import make_block
from thesisrecon import resect
from thesisrecon.api.cameras import triangulate
from thesisrecon.camera import decompose_camera
from thesisrecon.geometry.conditioning import centred_frame, whitening_transform
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.optimize.bundle.partial import minimize_reprojection, refine_camera, refine_points
from thesisrecon.optimize.bundle.projective import refine_projective_bundle

EPS, STRETCH, NOISE = np.finfo(float).eps, 1e3, 0.3


class _Scene:
    """A block with points off the plane z = height by ``relief``, turned, then scaled by s and moved by c."""

    def __init__(
        self, *, relief=0.0, height=0.0, turn=(0.5, -0.8, 0.3), s=1.0, c=(0.0, 0.0, 0.0), line=False, seed=3
    ):
        block = make_block(points=100, seed=seed)
        rng = np.random.default_rng(seed)
        Y = block.Xh.copy()
        if line:
            Y[8:, 1:3] = [-2.0, 0.5]
        else:
            Y[:, 2] = height + relief * rng.normal(size=len(Y))
        G = np.eye(4)
        G[:3, :3], G[:3, 3] = s * Rotation.from_rotvec(turn).as_matrix(), c
        self.view, self.point = block.view, block.point
        self.P, self.X = block.cameras.P @ np.linalg.inv(G), Y @ G.T
        self.xy = self.image(self.P, self.X)
        self.noisy = self.xy + NOISE * rng.normal(size=self.xy.shape)
        u = np.einsum("kab,kb->ka", np.abs(self.P)[self.view], np.abs(self.X)[self.point])
        w = np.einsum("kb,kb->k", self.P[self.view, 2], self.X[self.point])
        # Rounding of a projection in the caller's frame (sums of four terms), and of the stretched frame.
        self.rounding = 16.0 * EPS * (np.abs(u[:, :2] / w[:, None]).max() + STRETCH * np.abs(self.xy).max())

    def image(self, P, X):
        u = np.einsum("kab,kb->ka", P[self.view], X[self.point])
        return u[:, :2] / u[:, 2:]

    def rms(self, P, X):
        return np.sqrt(np.mean((self.image(P, X) - self.noisy) ** 2))


MAP = {"s": 30.0, "c": (5e5, 5e6, 100.0)}
FLAT = {
    "z = 0": {"turn": (0.0, 0.0, 0.0)},
    "tilted": {},
    "tilted the other way": {"turn": (-1.1, 0.4, 2.0)},
    "off the origin": {"height": 0.7},
    "far off the origin": {"height": 20.0},
    "millimetres": {"s": 1e-6},
    "kilometres": {"s": 1e6},
    "map coordinates": MAP,
    "relief 1e-12": {"relief": 1e-12},
    "relief 1e-9": {"relief": 1e-9},
    "relief 1e-6": {"relief": 1e-6},
    "relief 1e-4 in map coordinates": {"relief": 1e-4, **MAP},
    "relief 1e-3": {"relief": 1e-3},
}
SOLID = {
    "relief 1": {"relief": 1.0},
    "relief 1 in map coordinates": {"relief": 1.0, **MAP},
    "relief 1, tiny": {"relief": 1.0, "s": 1e-6},
    "a line and eight points": {"line": True},
}
scenes = pytest.mark.parametrize("kind", [pytest.param(v, id=k) for k, v in (FLAT | SOLID).items()])


@scenes
def test_a_frame_loses_no_more_digits_than_its_stretch(kind):
    scene = _Scene(**kind)
    frame = centred_frame(scene.X, whitening_transform)
    s = np.linalg.svd(frame.S, compute_uv=False)
    assert s[0] <= STRETCH * (1.0 + 1e-9) * s[3]
    P = frame.cameras_back(frame.cameras(scene.P))
    X = frame.points_back(frame.points(scene.X))
    assert np.abs(scene.image(P, X) - scene.xy).max() < scene.rounding


@scenes
def test_exact_points_and_cameras_stay_where_they_are(kind):
    scene = _Scene(**kind)
    P, X, view, point, xy = scene.P, scene.X, scene.view, scene.point, scene.xy
    several = refine_projective_bundle(P, X, Observations(view, point, xy), max_iterations=20)
    found = {
        "refine_points": (P, refine_points(P, X, view, point, xy, iterations=10)),
        "minimize_reprojection": (P, minimize_reprojection(P, X, view, point, xy)),
        "refine_projective_bundle": (several.P, several.X),
    }
    for name, (cameras, points) in found.items():
        assert np.abs(scene.image(cameras, points) - xy).max() < scene.rounding, name
    for k in range(len(P)):
        seen = view == k
        u = X[point[seen]] @ refine_camera(P[k], X[point[seen]], xy[seen])[0].T
        assert np.abs(u[:, :2] / u[:, 2:] - xy[seen]).max() < scene.rounding


@scenes
def test_the_cost_of_what_is_returned_falls_and_is_the_one_reported(kind):
    scene = _Scene(**kind)
    start = scene.rms(scene.P, scene.X)
    observations = Observations(scene.view, scene.point, scene.noisy)
    result = refine_projective_bundle(scene.P, scene.X, observations, loss_px=1e3, max_iterations=60)
    reached = scene.rms(result.P, result.X)
    gap = scene.image(result.P, result.X) - scene.noisy - result.residual_px
    assert np.abs(gap).max() < scene.rounding
    assert result.cost == pytest.approx(reached**2 * len(gap), rel=1e-9)
    # The residual that the freedoms leave, plus four standard deviations.
    left = 1.0 - (11 * len(scene.P) + 3 * len(scene.X) - 15) / (2 * len(gap))
    assert reached < NOISE * np.sqrt(left) * (1.0 + 4.0 / np.sqrt(4 * left * len(gap)))
    for loss_px in (1.0, 1e6):
        X = refine_points(scene.P, scene.X, scene.view, scene.point, scene.noisy, loss_px=loss_px)
        assert scene.rms(scene.P, X) < start
    for k in range(len(scene.P)):
        seen = scene.view == k
        X, xy = scene.X[scene.point[seen]], scene.noisy[seen]
        rms = []
        for P in (scene.P[k], refine_camera(scene.P[k], X, xy, loss_px=1e6)[0]):
            u = X @ P.T
            rms.append(np.sqrt(np.mean((u[:, :2] / u[:, 2:] - xy) ** 2)))
        assert rms[1] < rms[0]


@pytest.mark.parametrize("kind", [pytest.param(v, id=k) for k, v in SOLID.items()])
def test_a_camera_is_resected_from_points_that_are_not_flat(kind):
    scene = _Scene(**kind)
    seen = scene.view == 1
    X = scene.X[scene.point[seen]]
    for xy, limit in ((scene.xy, scene.rounding), (scene.noisy, 4.0 * NOISE)):
        found = resect(X[:, :3], xy[seen], threshold_px=3.0)
        u = X @ found.P.T
        assert np.sqrt(np.mean((u[:, :2] / u[:, 2:] - xy[seen]) ** 2)) < limit


@scenes
def test_a_calibrated_camera_and_points_are_found_on_a_plane_too(kind):
    scene = _Scene(**kind)
    seen = scene.view == 1
    X, xy = scene.X[scene.point[seen]], scene.xy[seen]
    u = X @ resect(X[:, :3], xy, decompose_camera(scene.P[1])[0]).P.T
    assert np.abs(u[:, :2] / u[:, 2:] - xy).max() < scene.rounding
    pixels = np.full((len(scene.P), len(scene.X), 2), np.nan)
    pixels[scene.view, scene.point] = scene.xy
    for method in ("linear", "iterated", "midpoint", "optimal"):
        points = triangulate(scene.P, pixels, method=method)
        assert np.abs(scene.image(scene.P, points) - scene.xy).max() < scene.rounding, method
