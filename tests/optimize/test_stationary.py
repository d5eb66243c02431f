"""Every minimisation ends at a minimum: another undamped step moves no unknown by a tenth of its deviation.

The criteria are written out here, in the caller's parameters, and differentiated numerically. Points of a
plane or line, and coordinates far from the origin, lose no more digits than the frame inside says.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.optimize.bundle_scenes import make_block, perturbed, project_block
from thesisrecon import Camera, bundle_adjust, estimate_homography, estimate_trifocal, resect
from thesisrecon.api.cameras import triangulate
from thesisrecon.camera import decompose_camera
from thesisrecon.epipolar.refinement import refine_fundamental
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, whitened_frame
from thesisrecon.geometry.three_view import cameras_from_tensor
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.optimize.bundle import partial
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle
from thesisrecon.optimize.least_squares import minimize_residuals

SEEDS = range(6)
OFFS = (0.01, 0.06)
CONDITION = 1e-11
TO_UNIT = np.array([[1e-3, 0.0, -0.515], [0.0, 1e-3, -0.38], [0.0, 0.0, 1.0]])


def sigmas_to_minimum(residuals, x, delta=np.inf, steps=1e-6):
    """Largest undamped step of an unknown in standard deviations; ``residuals`` are (M, d), Huber on rows.

    Directions without effect, such as gauge freedoms, are left out.
    """
    shifts = np.diag(np.broadcast_to(steps, x.shape))
    r = residuals(x)
    J = np.stack([(residuals(x + h) - residuals(x - h)) / (2.0 * h.sum()) for h in shifts], axis=-1)
    weight = delta / np.maximum(np.linalg.norm(r, axis=1), delta) if np.isfinite(delta) else np.ones(len(r))
    root = np.sqrt(weight)[:, None]
    A, b = (root[..., None] * J).reshape(r.size, -1), (root * r).ravel()
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0.0] = 1.0
    values, V = np.linalg.eigh((A / scale).T @ (A / scale))
    used = values > CONDITION * values[-1]
    C = (V[:, used] / values[used]) @ V[:, used].T
    step = C @ ((A / scale).T @ b)
    sigma = np.sqrt(np.sum(b**2) / max(r.size - used.sum(), 1))
    return float(np.max(np.abs(step) / np.sqrt(np.maximum(np.diag(C), 1e-300)))) / sigma


def noisy(block, seed, *, wrong=0.1):
    """Pixels with noise and, for a robust loss, some wrong ones."""
    rng = np.random.default_rng(seed)
    xy = block.xy + 0.4 * rng.normal(size=block.xy.shape)
    off = rng.random(len(xy)) < wrong
    xy[off] += 5.0 * rng.normal(size=(off.sum(), 2))
    return xy


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("free", [("focal", "k1"), ("focal", "principal_point", "k1")])
@pytest.mark.parametrize("loss", ["huber", "squared"])
def test_bundle_adjust_with_a_prior(seed, free, loss):
    block = make_block(points=60, seed=seed)
    moved, X = perturbed(block, seed=seed, size=OFFS[seed % 2])
    rows, V, sigma, xy = moved.intrinsics[0], len(moved.R), 0.4, noisy(block, seed)
    options = {"loss": loss, "loss_px": 1.0, "sigma_px": sigma, "prior": {"k1": 0.05}}
    found = bundle_adjust(photographed(moved), X, block.seen(xy), free=free, **options)
    columns = [0, *([3, 4] if "principal_point" in free else []), 5]

    def residuals(x):
        pose, row, points = np.split(x, [6 * V, 6 * V + len(columns)])
        w, t = pose.reshape(2, V, 3)
        R = Rotation.from_rotvec(w).as_matrix() @ [c.R for c in found.cameras]
        table = rows.copy()
        table[columns] = row
        cameras = replace(moved, R=R, t=t, intrinsics=table[None])
        off = project_block(cameras, points.reshape(-1, 3), block.view, block.point) - xy
        return np.vstack([off / sigma, [[table[5] / 0.05, 0.0]]])

    K = found.cameras[0].K
    intrinsics = np.array([K[0, 0], 1.0, 0.0, K[0, 2], K[1, 2], found.cameras[0].distortion[0]])
    t = np.array([c.t for c in found.cameras])
    x = np.concatenate([np.zeros(3 * V), t.ravel(), intrinsics[columns], found.X.ravel()])
    steps = 1e-6 * np.maximum(np.abs(x), 1e-2)
    assert found.converged
    assert sigmas_to_minimum(residuals, x, 1.0 / sigma if loss == "huber" else np.inf, steps) < 0.1


def photographed(cameras):
    """The cameras as those of photographs."""
    parts = zip(cameras.K, cameras.R, cameras.t, strict=True)
    return [Camera(K, R, t, (4000, 3000)) for K, R, t in parts]


def test_too_few_iterations_are_reported():
    block = make_block(points=60)
    moved, X = perturbed(block)
    given = photographed(moved), X, block.seen(noisy(block, 0))
    early, late = (bundle_adjust(*given, max_iterations=n, prior={"k1": 0.05}) for n in (1, 50))
    assert not early.converged
    assert late.converged
    off = abs(early.cameras[0].K[0, 0] - late.cameras[0].K[0, 0]) / late.cameras[0].std["focal_px"]
    # No parameter is farther from the minimum than stated, up to the curvature of the cost.
    assert early.sigmas_to_minimum > 0.7 * off > 0.07


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("loss_px", [1.0, 1e3])
def test_projective_bundle(seed, loss_px):
    block = make_block(points=40, seed=seed)
    moved, X = perturbed(block, seed=seed, size=OFFS[seed % 2])
    xy = noisy(block, seed)
    found = refine_projective_bundle(
        moved.P, homogenize(X), block.seen(xy), loss_px=loss_px, max_iterations=100
    )
    n, unit = found.P.size, np.linalg.norm(found.P, axis=(1, 2), keepdims=True)

    def residuals(x):
        return block.image(x[:n].reshape(-1, 3, 4), x[n:].reshape(-1, 4)) - xy

    x = np.concatenate([(found.P / unit).ravel(), found.X.ravel()])
    assert sigmas_to_minimum(residuals, x, loss_px) < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_resection_of_a_projective_and_a_calibrated_camera(seed):
    block = make_block(points=150, seed=seed)
    moved, _ = perturbed(block, seed=seed, size=OFFS[seed % 2])
    one = block.view == 1
    X, xy, loss = block.X[block.point[one]], noisy(block, seed)[one], 1.0
    P, _ = partial.refine_camera(moved.P[1], homogenize(X), xy, loss_px=loss)
    start = P.ravel() / np.linalg.norm(P)
    assert sigmas_to_minimum(lambda x: project(x.reshape(3, 4), X) - xy, start, loss) < 0.1
    free = np.array([True, False, False, False, False, True])
    found = partial.refine_pose(moved.R[1], moved.t[1], moved.intrinsics[0], X, xy, free=free, loss_px=loss)

    def of_pose(x):
        R = Rotation.from_rotvec(x[:3]).as_matrix() @ found.R
        row = found.intrinsics.copy()
        row[free] = x[6:]
        cameras = MetricCameras(R[None], x[None, 3:6], row[None], np.zeros(1, dtype=np.int64))
        return project_block(cameras, X, np.zeros(len(X), int), np.arange(len(X))) - xy

    x = np.concatenate([np.zeros(3), found.t, found.intrinsics[free]])
    assert sigmas_to_minimum(of_pose, x, loss, 1e-6 * np.maximum(np.abs(x), 1e-2)) < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_points_with_fixed_cameras(seed):
    block = make_block(points=50, seed=seed)
    xy, P = noisy(block, seed), block.cameras.P
    away = np.random.default_rng(seed).normal(0.0, 0.1, block.Xh.shape) * [1.0, 1.0, 1.0, 0.0]
    start, far = block.Xh + away, block.Xh + 40.0 * away
    for loss, found in (
        (np.inf, partial.minimize_reprojection(P, start, block.view, block.point, xy)),
        (np.inf, partial.minimize_reprojection(P, far, block.view, block.point, xy)),
        (1.0, partial.refine_points(P, start, block.view, block.point, xy, loss_px=1.0, iterations=50)),
    ):
        for j in range(len(start)):
            k = block.point == j

            def residuals(X, k=k):
                return dehomogenize(P[block.view[k]] @ np.append(X, 1.0)) - xy[k]

            assert sigmas_to_minimum(residuals, found[j, :3] / found[j, 3], loss) < 0.1


def pair(seed, *, plane=False, n=120):
    """Matches (n, 2) of two views, with noise."""
    rng, block = np.random.default_rng(seed), make_block(points=n, seed=seed)
    X = block.Xh * ([1.0, 1.0, 0.0, 1.0] if plane else 1.0)
    return np.stack([project(P, X) for P in block.cameras.P[[1, 4]]]) + 0.5 * rng.normal(size=(2, n, 2))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("criterion", ["sampson", "epipolar-distance", "reprojection"])
def test_fundamental_matrix(seed, criterion):
    xy1, xy2 = pair(seed)
    F = fundamental_from_cameras(*make_block(seed=seed).cameras.P[[1, 4]])
    F = F * (1.0 + 0.05 * np.random.default_rng(seed).normal(size=(3, 3)))
    found = refine_fundamental(F, xy1, xy2, criterion)
    # In a frame of unit size; distances are measured in pixels.
    T, h1, h2 = TO_UNIT, homogenize(xy1), homogenize(xy2)
    U, S, Vt = np.linalg.svd(np.linalg.inv(T).T @ found @ np.linalg.inv(T))

    def residuals(x):
        A = U @ Rotation.from_rotvec(x[:3]).as_matrix()
        B = Vt.T @ Rotation.from_rotvec(x[3:6]).as_matrix()
        G = T.T @ (A @ np.diag([1.0, S[1] / S[0] * np.exp(x[6]), 0.0]) @ B.T) @ T
        p1, p2 = h1.copy(), h2.copy()
        for _ in range(8 if criterion == "reprojection" else 1):
            a, b = p1 @ G.T, p2 @ G
            off = np.sum(p2 * a, axis=1) + np.sum(b * (h1 - p1), axis=1) + np.sum(a * (h2 - p2), axis=1)
            g1, g2 = np.sum(a[:, :2] ** 2, axis=1), np.sum(b[:, :2] ** 2, axis=1)
            step = (off / (g1 + g2))[:, None]
            p1[:, :2], p2[:, :2] = (h1 - step * b)[:, :2], (h2 - step * a)[:, :2]
        if criterion == "epipolar-distance":
            return (off * np.sqrt(1.0 / g1 + 1.0 / g2))[:, None]
        return (off / np.sqrt(g1 + g2))[:, None]

    assert sigmas_to_minimum(residuals, np.zeros(7)) < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_homography(seed):
    xy1, xy2 = pair(seed, plane=True)
    fit = estimate_homography(xy1, xy2, seed=seed)
    h1, (u, v) = homogenize(xy1[fit.inliers]), xy2[fit.inliers].T

    def residuals(x):
        # Sampson's distance: C' (J J')^-1 C with C = x2 x H x1 and its derivatives by the four coordinates.
        H = x.reshape(3, 3)
        z = h1 @ H.T
        C = np.stack([z[:, 0] - u * z[:, 2], z[:, 1] - v * z[:, 2]], axis=1)
        J = np.zeros((len(u), 2, 4))
        J[:, 0, :2], J[:, 1, :2] = H[0, :2] - u[:, None] * H[2, :2], H[1, :2] - v[:, None] * H[2, :2]
        J[:, 0, 2] = J[:, 1, 3] = -z[:, 2]
        return np.linalg.solve(np.linalg.cholesky(J @ J.swapaxes(1, 2)), C[..., None])[..., 0]

    scale = np.abs(fit.H) + 1e-9 * np.abs(fit.H).max()
    assert sigmas_to_minimum(residuals, fit.H.ravel(), steps=1e-6 * scale.ravel()) < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_trifocal_tensor(seed):
    rng, block = np.random.default_rng(seed), make_block(points=30, seed=seed)
    exact = np.stack([project(P, block.Xh) for P in block.cameras.P[[0, 2, 5]]])
    xy = exact + 0.4 * rng.normal(size=exact.shape)
    fit = estimate_trifocal(*xy, seed=seed)
    # In a frame of unit size, and with cameras whose rows span space evenly.
    P = TO_UNIT @ np.stack(cameras_from_tensor(fit.T))
    P = np.linalg.qr(P.reshape(-1, 4))[0].reshape(3, 3, 4)
    xy = xy[:, fit.inliers] * TO_UNIT[0, 0] + TO_UNIT[:2, 2]
    X = triangulate(P, xy, method="optimal")
    n, unit = P.size, np.linalg.norm(P, axis=(1, 2), keepdims=True)

    def residuals(x):
        z = np.einsum("vab,nb->vna", x[:n].reshape(3, 3, 4), x[n:].reshape(-1, 4))
        return (dehomogenize(z) - xy).reshape(-1, 2)

    x = np.concatenate([(P / unit).ravel(), (X / np.linalg.norm(X, axis=1, keepdims=True)).ravel()])
    assert sigmas_to_minimum(residuals, x, steps=1e-7) < 0.1


@pytest.mark.parametrize("seed", range(20))
def test_curved_valleys(seed):
    """A narrow curved valley: damped steps along it are short and gain little."""
    rng = np.random.default_rng(seed)
    n, m = 5, 400
    A, curve = rng.normal(size=(m, n)), rng.normal(size=(n, n))
    size, noise, true = 10.0 ** rng.uniform(0.0, 3.0, n), 0.3 * rng.normal(size=m), rng.normal(size=n)

    def forward(x):
        return A @ (size * (x + np.append(0.0, 3.0 * curve[1:].sum(axis=1) * x[0] ** 2)))

    def residuals(x):
        return forward(x) - forward(true) - noise

    found = minimize_residuals(residuals, true + rng.normal(size=n), max_iterations=500)
    assert sigmas_to_minimum(lambda x: residuals(x)[:, None], found.x) < 0.1


EPS, STRETCH, NOISE = np.finfo(float).eps, 1e3, 0.3


class _Scene:
    """A block with points off the plane z = height by ``relief``, turned, then scaled by s and moved by c."""

    def __init__(
        self, *, relief=0.0, height=0.0, turn=(0.5, -0.8, 0.3), s=1.0, c=(0.0, 0.0, 0.0), line=False
    ):
        block, rng = make_block(points=100), np.random.default_rng(3)
        Y = block.Xh.copy()
        if line:
            Y[8:, 1:3] = [-2.0, 0.5]
        else:
            Y[:, 2] = height + relief * rng.normal(size=len(Y))
        G = np.eye(4)
        G[:3, :3], G[:3, 3] = s * Rotation.from_rotvec(turn).as_matrix(), c
        self.view, self.point, self.image = block.view, block.point, block.image
        self.P, self.X = block.cameras.P @ np.linalg.inv(G), Y @ G.T
        self.xy = self.image(self.P, self.X)
        self.noisy = self.xy + NOISE * rng.normal(size=self.xy.shape)
        u = np.einsum("kab,kb->ka", np.abs(self.P)[self.view], np.abs(self.X)[self.point])
        w = np.einsum("kb,kb->k", self.P[self.view, 2], self.X[self.point])
        # Rounding of a projection in the caller's frame (sums of four terms), and of the stretched frame.
        self.rounding = 16.0 * EPS * (np.abs(u[:, :2] / w[:, None]).max() + STRETCH * np.abs(self.xy).max())

    def rms(self, P, X):
        return np.sqrt(np.mean((self.image(P, X) - self.noisy) ** 2))

    def of_view(self, k):
        """Points of a view, their exact and their noisy pixels."""
        seen = self.view == k
        return self.X[self.point[seen]], self.xy[seen], self.noisy[seen]


MAP = {"s": 30.0, "c": (5e5, 5e6, 100.0)}
FLAT = {
    "z = 0": {"turn": (0.0, 0.0, 0.0)}, "tilted": {}, "tilted the other way": {"turn": (-1.1, 0.4, 2.0)},
    "off the origin": {"height": 0.7}, "far off the origin": {"height": 20.0}, "millimetres": {"s": 1e-6},
    "kilometres": {"s": 1e6}, "map coordinates": MAP, "relief 1e-12": {"relief": 1e-12},
    "relief 1e-9": {"relief": 1e-9}, "relief 1e-6": {"relief": 1e-6},
    "relief 1e-4 in map coordinates": {"relief": 1e-4, **MAP}, "relief 1e-3": {"relief": 1e-3},
}  # fmt: skip
SOLID = {
    "relief 1": {"relief": 1.0}, "relief 1 in map coordinates": {"relief": 1.0, **MAP},
    "relief 1, tiny": {"relief": 1.0, "s": 1e-6}, "a line and eight points": {"line": True},
}  # fmt: skip
scenes = pytest.mark.parametrize("kind", [pytest.param(v, id=k) for k, v in (FLAT | SOLID).items()])


@scenes
def test_a_frame_loses_no_more_digits_than_its_stretch(kind):
    scene = _Scene(**kind)
    frame = whitened_frame(scene.X)
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
    each = np.stack([partial.refine_camera(P[k], *scene.of_view(k)[:2])[0] for k in range(len(P))])
    found = {
        "refine_points": (P, partial.refine_points(P, X, view, point, xy, iterations=10)),
        "minimize_reprojection": (P, partial.minimize_reprojection(P, X, view, point, xy)),
        "refine_projective_bundle": (several.P, several.X),
        "refine_camera": (each, X),
    }
    for name, (cameras, points) in found.items():
        assert np.abs(scene.image(cameras, points) - xy).max() < scene.rounding, name


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
        X = partial.refine_points(scene.P, scene.X, scene.view, scene.point, scene.noisy, loss_px=loss_px)
        assert scene.rms(scene.P, X) < start
    for k, P in enumerate(scene.P):
        X, _, xy = scene.of_view(k)
        before, after = (project(p, X) - xy for p in (P, partial.refine_camera(P, X, xy, loss_px=1e6)[0]))
        assert np.sum(after**2) < np.sum(before**2)


@pytest.mark.parametrize("kind", [pytest.param(v, id=k) for k, v in SOLID.items()])
def test_a_camera_is_resected_from_points_that_are_not_flat(kind):
    scene = _Scene(**kind)
    X, *both = scene.of_view(1)
    for xy, limit in zip(both, (scene.rounding, 4.0 * NOISE), strict=True):
        off = project(resect(X[:, :3], xy, threshold_px=3.0).P, X) - xy
        assert np.sqrt(np.mean(off**2)) < limit


@scenes
def test_a_calibrated_camera_and_points_are_found_on_a_plane_too(kind):
    scene = _Scene(**kind)
    X, xy, _ = scene.of_view(1)
    found = resect(X[:, :3], xy, decompose_camera(scene.P[1])[0]).P
    assert np.abs(project(found, X) - xy).max() < scene.rounding
    pixels = np.full((len(scene.P), len(scene.X), 2), np.nan)
    pixels[scene.view, scene.point] = scene.xy
    for method in ("linear", "iterated", "midpoint", "optimal"):
        points = triangulate(scene.P, pixels, method=method)
        assert np.abs(scene.image(scene.P, points) - scene.xy).max() < scene.rounding, method
