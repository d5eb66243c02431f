"""Strategies of hypothesis for cameras and points, and NumPy twins of the triangulation kernels."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from thesisrecon.geometry.camera_matrix import calibration_matrix, camera_from_centre
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.strata import bilinear_form, transform


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


def random_round(rng, d, n):
    """An ellipse or ellipsoid (d, d) about the origin and n of its points (n, d)."""
    T = np.eye(d)
    T[:-1] += 0.3 * rng.uniform(-1.0, 1.0, (d - 1, d))
    unit = rng.normal(size=(n, d - 1))
    x = homogenize(unit / np.linalg.norm(unit, axis=1, keepdims=True)) @ T.T
    return transform(T, np.diag([1.0] * (d - 1) + [-1.0]), "conics"), x


def gap(a, b):
    """Distance of two arrays of any scale and sign: the sine of their angle."""
    a, b = a.ravel() / np.linalg.norm(a), b.ravel() / np.linalg.norm(b)
    return float(min(np.linalg.norm(a - b), np.linalg.norm(a + b)))


def incidence_sine(dual, point):
    """|dual . point| / (|dual| |point|), 0 if the line or plane (..., d) contains the point."""
    size = np.linalg.norm(dual, axis=-1) * np.linalg.norm(point, axis=-1)
    return np.abs(np.sum(dual * point, axis=-1)) / np.maximum(size, 1e-300)


def incidence_residual(C, x):
    """|x'C x| / (|C| |x|^2), 0 on the conic or quadric C (d, d)."""
    return np.abs(bilinear_form(C, x, x)) / (np.linalg.norm(C) * np.sum(x**2, axis=-1))


def reprojection_costs(P, X, xy):
    """Sum over the views that see it of squared distances, per point; P (V, 3, 4), X (N, 4), xy (V, N, 2)."""
    xh = np.einsum("vab,nb->vna", P, X)
    return np.asarray(np.nansum((xh[..., :2] / xh[..., 2:] - xy) ** 2, axis=(0, 2)))


def view_scales(P, xy):
    """1 over the norm of M's first two rows, the pixels' origin in the middle of the view's points."""
    middle = np.nanmean(xy, axis=1)
    return 1.0 / np.linalg.norm(P[:, :2, :3] - middle[:, :, None] * P[:, 2:, :3], axis=(1, 2))


def linear_point(P, scale, xy):
    """Least singular vector of the rows of one point; P (V, 3, 4), scale (V,), xy (V, 2)."""
    rows = scale[:, None, None] * (xy[:, :, None] * P[:, 2:] - P[:, :2])
    return np.linalg.svd(rows[np.isfinite(xy[:, 0])].reshape(-1, 4))[2][3]


def iterated_point(P, scale, xy, *, passes=10, tolerance=1e-6):
    """Rows over the depths of the pass before, until these rest; else the better of last and first."""
    first = X = linear_point(P, scale, xy)
    before = None
    for _ in range(passes):
        depths = np.abs(P[:, 2] @ X)
        if before is not None and (np.abs(depths / before - 1.0) < tolerance).all():
            return X
        X, before = linear_point(P, 1.0 / depths, xy), depths
    one, last = (reprojection_costs(P, x[None], xy[:, None])[0] for x in (first, X))
    return X if last < one else first


def midpoint(P, xy):
    """Point (3,) nearest to the rays of one point."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera, pixel in zip(P, xy, strict=True):
        if np.isfinite(pixel).all():
            centre = -np.linalg.solve(camera[:, :3], camera[:, 3])
            ray = np.linalg.solve(camera[:, :3], [*pixel, 1.0])
            across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
            A, b = A + across, b + across @ centre
    return np.linalg.solve(A, b)


def least_reprojection_cost(P, xy, start):
    """Cost of the least-squares optimum of one point from a finite start (4,)."""

    def residual(x):
        xh = P @ np.append(x, 1.0)
        return (xh[:, :2] / xh[:, 2:] - xy).ravel()

    best = least_squares(residual, start[:3] / start[3], method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return 2.0 * best.cost
