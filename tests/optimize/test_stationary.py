"""Every minimisation ends at a minimum: another undamped step moves no unknown by a tenth of its deviation.

The criteria are written out here, in the caller's parameters, and differentiated numerically.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.optimize.bundle_scenes import make_block, perturbed, project_block
from thesisrecon import Camera, bundle_adjust, estimate_homography, estimate_trifocal
from thesisrecon.epipolar.refinement import refine_fundamental
from thesisrecon.geometry.three_view import cameras_from_tensor
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.optimize.bundle.partial import (
    minimize_reprojection,
    refine_camera,
    refine_points,
    refine_pose,
)
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
    rows, K = moved.intrinsics[0], moved.K
    given = [Camera(K[v], moved.R[v], moved.t[v], (4000, 3000)) for v in range(len(K))]
    prior, sigma = {"k1": 0.05}, 0.4
    xy = noisy(block, seed)
    found = bundle_adjust(
        given, X, Observations(block.view, block.point, xy), free=free, prior=prior, loss=loss, loss_px=1.0,
        sigma_px=sigma,
    )  # fmt: skip
    V, columns = len(K), [0, *([3, 4] if "principal_point" in free else []), 5]

    def residuals(x):
        R = Rotation.from_rotvec(x[: 3 * V].reshape(V, 3)).as_matrix() @ [c.R for c in found.cameras]
        t = x[3 * V : 6 * V].reshape(V, 3)
        table = rows.copy()
        table[columns] = x[6 * V : 6 * V + len(columns)]
        cameras = moved.__class__(R, t, table[None], np.zeros(V, dtype=np.int64))
        points = x[6 * V + len(columns) :].reshape(-1, 3)
        off = (project_block(cameras, points, block.view, block.point) - xy) / sigma
        return np.vstack([off, [[table[5] / 0.05, 0.0]]])

    K = found.cameras[0].K
    intrinsics = np.array([K[0, 0], 1.0, 0.0, K[0, 2], K[1, 2], found.cameras[0].distortion[0]])
    t = np.array([c.t for c in found.cameras])
    x = np.concatenate([np.zeros(3 * V), t.ravel(), intrinsics[columns], found.X.ravel()])
    steps = 1e-6 * np.maximum(np.abs(x), 1e-2)
    assert found.converged
    assert sigmas_to_minimum(residuals, x, 1.0 / sigma if loss == "huber" else np.inf, steps) < 0.1


def test_too_few_iterations_are_reported():
    block = make_block(points=60)
    moved, X = perturbed(block)
    given = [Camera(K, R, t, (4000, 3000)) for K, R, t in zip(moved.K, moved.R, moved.t, strict=True)]
    seen = Observations(block.view, block.point, noisy(block, 0))
    early, late = (bundle_adjust(given, X, seen, max_iterations=n, prior={"k1": 0.05}) for n in (1, 50))
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
    seen = Observations(block.view, block.point, xy)
    Xh = np.column_stack([X, np.ones(len(X))])
    found = refine_projective_bundle(moved.P, Xh, seen, loss_px=loss_px, max_iterations=100)
    n, unit = found.P.size, np.linalg.norm(found.P, axis=(1, 2), keepdims=True)

    def residuals(x):
        P, Y = x[:n].reshape(-1, 3, 4), x[n:].reshape(-1, 4)
        z = np.einsum("kab,kb->ka", P[block.view], Y[block.point])
        return z[:, :2] / z[:, 2:] - xy

    x = np.concatenate([(found.P / unit).ravel(), found.X.ravel()])
    assert sigmas_to_minimum(residuals, x, loss_px) < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_resection_of_a_projective_and_a_calibrated_camera(seed):
    block = make_block(points=150, seed=seed)
    moved, _ = perturbed(block, seed=seed, size=OFFS[seed % 2])
    one = block.view == 1
    X, xy, loss = block.Xh[block.point[one]], noisy(block, seed)[one], 1.0
    P, _ = refine_camera(moved.P[1], X, xy, loss_px=loss)

    def of_camera(x):
        z = X @ x.reshape(3, 4).T
        return z[:, :2] / z[:, 2:] - xy

    assert sigmas_to_minimum(of_camera, P.ravel() / np.linalg.norm(P), loss) < 0.1
    free = np.array([True, False, False, False, False, True])
    found = refine_pose(moved.R[1], moved.t[1], moved.intrinsics[0], X[:, :3], xy, free=free, loss_px=loss)

    def of_pose(x):
        R = Rotation.from_rotvec(x[:3]).as_matrix() @ found.R
        row = found.intrinsics.copy()
        row[free] = x[6:]
        cameras = moved.__class__(R[None], x[None, 3:6], row[None], np.zeros(1, dtype=np.int64))
        return project_block(cameras, X[:, :3], np.zeros(len(X), int), np.arange(len(X))) - xy

    x = np.concatenate([np.zeros(3), found.t, found.intrinsics[free]])
    assert sigmas_to_minimum(of_pose, x, loss, 1e-6 * np.maximum(np.abs(x), 1e-2)) < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_points_with_fixed_cameras(seed):
    block = make_block(points=50, seed=seed)
    xy, P = noisy(block, seed), block.cameras.P
    start = block.Xh + np.random.default_rng(seed).normal(0.0, 0.1, block.Xh.shape) * [1.0, 1.0, 1.0, 0.0]
    for loss, found in (
        (np.inf, minimize_reprojection(P, start, block.view, block.point, xy)),
        (1.0, refine_points(P, start, block.view, block.point, xy, loss_px=1.0, iterations=50)),
    ):
        for j in range(len(start)):
            k = block.point == j

            def residuals(X, k=k):
                z = P[block.view[k]] @ np.append(X, 1.0)
                return z[:, :2] / z[:, 2:] - xy[k]

            assert sigmas_to_minimum(residuals, found[j, :3] / found[j, 3], loss) < 0.1


def pair(seed, *, plane=False, n=120):
    """Matches (n, 2) of two views, with noise."""
    rng, block = np.random.default_rng(seed), make_block(points=n, seed=seed)
    X = block.Xh * ([1.0, 1.0, 0.0, 1.0] if plane else 1.0)
    z = np.einsum("vab,nb->vna", block.cameras.P[[1, 4]], X)
    return z[..., :2] / z[..., 2:] + 0.5 * rng.normal(size=(2, n, 2))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("criterion", ["sampson", "epipolar-distance", "reprojection"])
@pytest.mark.parametrize("parameters", ["orthonormal", "row", "row-and-column"])
def test_fundamental_matrix(seed, criterion, parameters):
    xy1, xy2 = pair(seed)
    rng, P = np.random.default_rng(seed), make_block(seed=seed).cameras.P[[1, 4]]
    C = np.linalg.svd(P[0])[2][-1]
    e = P[1] @ C
    F = np.cross(e, (P[1] @ np.linalg.pinv(P[0])).T).T
    F *= 1.0 + 0.05 * rng.normal(size=(3, 3))
    found = refine_fundamental(F, xy1, xy2, criterion, parameters=parameters)
    # In a frame of unit size; distances are measured in pixels.
    T = TO_UNIT
    h1, h2 = (np.column_stack([xy, np.ones(len(xy))]) for xy in (xy1, xy2))
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
    h1, used = np.column_stack([xy1, np.ones(len(xy1))]), fit.inliers

    def residuals(x):
        # Sampson's distance: C' (J J')^-1 C with C = x2 x H x1 and its derivatives by the four coordinates.
        H = x.reshape(3, 3)
        z = h1[used] @ H.T
        u, v = xy2[used].T
        C = np.stack([z[:, 0] - u * z[:, 2], z[:, 1] - v * z[:, 2]], axis=1)
        J = np.zeros((len(u), 2, 4))
        J[:, 0, :2], J[:, 1, :2] = H[0, :2] - u[:, None] * H[2, :2], H[1, :2] - v[:, None] * H[2, :2]
        J[:, 0, 2] = J[:, 1, 3] = -z[:, 2]
        L = np.linalg.cholesky(J @ J.swapaxes(1, 2))
        return np.linalg.solve(L, C[..., None])[..., 0]

    scale = np.abs(fit.H) + 1e-9 * np.abs(fit.H).max()
    assert sigmas_to_minimum(residuals, fit.H.ravel(), steps=1e-6 * scale.ravel()) < 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_trifocal_tensor(seed):
    rng, block = np.random.default_rng(seed), make_block(points=30, seed=seed)
    z = np.einsum("vab,nb->vna", block.cameras.P[[0, 2, 5]], block.Xh)
    xy = z[..., :2] / z[..., 2:] + 0.4 * rng.normal(size=(3, 30, 2))
    fit = estimate_trifocal(*xy, seed=seed)
    # In a frame of unit size, and with cameras whose rows span space evenly.
    P = TO_UNIT @ np.stack(cameras_from_tensor(fit.T))
    P = np.linalg.qr(P.reshape(-1, 4))[0].reshape(3, 3, 4)
    xy = xy[:, fit.inliers] * TO_UNIT[0, 0] + TO_UNIT[:2, 2]
    view, point = (a.ravel() for a in np.indices(xy.shape[:2]))
    X = minimize_reprojection(P, np.linalg.svd(_rows(P, xy))[2][:, -1], view, point, xy.reshape(-1, 2))
    unit = np.linalg.norm(P, axis=(1, 2), keepdims=True)
    n = P.size

    def residuals(x):
        z = np.einsum("vab,nb->vna", x[:n].reshape(3, 3, 4), x[n:].reshape(-1, 4))
        return (z[..., :2] / z[..., 2:] - xy).reshape(-1, 2)

    x = np.concatenate([(P / unit).ravel(), (X / np.linalg.norm(X, axis=1, keepdims=True)).ravel()])
    assert sigmas_to_minimum(residuals, x, steps=1e-7) < 0.1


def _rows(P, xy):
    """Linear equations (N, 6, 4) of points seen by three cameras."""
    return np.concatenate([xy[:, :, c, None] * P[:, None, 2] - P[:, None, c] for c in (0, 1)]).swapaxes(0, 1)


@pytest.mark.parametrize("seed", range(20))
def test_curved_valleys(seed):
    """A narrow curved valley: damped steps along it are short and gain little."""
    rng = np.random.default_rng(seed)
    n, m = 5, 400
    A, curve = rng.normal(size=(m, n)), rng.normal(size=(n, n))
    size = 10.0 ** rng.uniform(0.0, 3.0, n)
    noise = 0.3 * rng.normal(size=m)

    def forward(x):
        y = x.copy()
        y[1:] += (curve[1:] * x[:1] ** 2 * 3.0).sum(axis=1)
        return A @ (size * y)

    true = rng.normal(size=n)
    found = minimize_residuals(
        lambda x: forward(x) - forward(true) - noise, true + rng.normal(size=n), max_iterations=500
    )
    assert sigmas_to_minimum(lambda x: (forward(x) - forward(true) - noise)[:, None], found.x) < 0.1
