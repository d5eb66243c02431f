"""Homographies: of all matches (HZ, algorithm 4.6), by F and a plane (HZ result 13.6), of the dominant plane.

Points are rows (x1, y1, x2, y2); F and H are row-major vectors of 9. Distances are Sampson distances of H, so
that noise has the standard deviation of one coordinate.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from thesisrecon._numba import empty, kernel, zeros
from thesisrecon.arrays import B8, F64, I64, Record
from thesisrecon.epipolar._matches import PairFrame, noise_width
from thesisrecon.epipolar._sampling import squared_distances
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.homogeneous import cross_matrix, directions_across, homogenize, unit_norm
from thesisrecon.geometry.two_view import homography_linear, homography_sampson_residuals
from thesisrecon.optimize.least_squares import VARIANCE_OF_INLIERS, next_inlier_limit
from thesisrecon.optimize.ransac import Budget, inliers_by_chance, search_models

# Planes tried and matches that each is scored on: a plane with a third of the matches is found with 98 %.
TRIPLES, SUBSET = 100, 200
# Squared distance in sigma^2 beyond which a match is off the plane; noise exceeds it once in 3000.
OFF_PLANE = 16.0


@kernel(fastmath={"reassoc", "contract"})
def _squared_distances(H: F64, columns: F64) -> F64:
    """Squared distances (S, N) of matches (4, N) from homographies (S, 3, 3)."""
    squared = empty((len(H), columns.shape[1]))
    for s in range(len(H)):
        h00, h01, h02, h10, h11, h12 = H[s, 0, 0], H[s, 0, 1], H[s, 0, 2], H[s, 1, 0], H[s, 1, 1], H[s, 1, 2]
        h20, h21, h22 = H[s, 2, 0], H[s, 2, 1], H[s, 2, 2]
        for k in range(columns.shape[1]):
            x1, y1, x2, y2 = columns[0, k], columns[1, k], columns[2, k], columns[3, k]
            w = h20 * x1 + h21 * y1 + h22
            c0, c1 = h00 * x1 + h01 * y1 + h02 - w * x2, h10 * x1 + h11 * y1 + h12 - w * y2
            j00, j01, j10, j11 = h00 - x2 * h20, h01 - x2 * h21, h10 - y2 * h20, h11 - y2 * h21
            # Sums of squares (Lagrange's identity): a difference of products could round below zero.
            p, q, determinant = c0 * j10 - c1 * j00, c0 * j11 - c1 * j01, j00 * j11 - j01 * j10
            above = p * p + q * q + w * w * (c0 * c0 + c1 * c1)
            entries = j00 * j00 + j01 * j01 + j10 * j10 + j11 * j11 + w * w
            below = determinant * determinant + w * w * entries
            squared[s, k] = above / below if below > 1e-28 * entries * entries else 1e280
    return squared


def squared_plane_distances(H: F64, points: F64) -> F64:
    """Squared distances (..., N) of matches to the nearest exact ones of x2 ~ H x1: c' (J J')^-1 c.

    To first order; c are the two equations and J their derivatives by the four coordinates (Chum, Pajdla and
    Sturm, 2005). A singular H has no exact match nearby.
    """
    squared = _squared_distances(np.ascontiguousarray(H).reshape(-1, 3, 3), np.ascontiguousarray(points.T))
    return np.asarray(squared).reshape(*H.shape[:-2], len(points))


def induced_homographies(F: F64, e2: F64, points: F64, triples: I64, smallest_area: float) -> F64:
    """Homographies (S', 3, 3) of the planes of three matches each, H = A - e2 v', A = [e2]x F (HZ, 13.6).

    Each match gives v . x1 = b with b = (x2 x A x1) . (x2 x e2) / |x2 x e2|^2. ``triples`` (S, 3) of which
    twice the area in image 1 is not above the smallest are left out.
    """
    A = cross_matrix(e2) @ F
    x1, x2 = homogenize(points[triples, :2]), homogenize(points[triples, 2:])
    across = np.cross(x2, e2)
    b = np.sum(np.cross(x2, x1 @ A.T) * across, axis=2) / (np.sum(across**2, axis=2) + 1e-300)
    good = np.abs(np.linalg.det(x1)) > smallest_area
    v = np.linalg.solve(x1[good], b[good][..., None])[..., 0]
    return np.asarray(A - e2[:, None] * v[:, None])


def _normal_matrix(H: F64, points: F64, gate: float) -> F64:
    """Sum (9, 9) of squared equations in H, weights (J J')^-1 (1 - d^2 / gate^2)^2 in the gate (Tukey)."""
    weight = np.maximum(1.0 - squared_plane_distances(H, points) / gate**2, 0.0)
    G = np.zeros((9, 9))
    _add_equations(np.ascontiguousarray(H), points, weight, False, G, np.zeros(9))
    return G


@kernel
def _add_equations(H: F64, points: F64, weight: F64, nearest: bool, G: F64, g: F64) -> float:
    """Add products (9, 9) of the whitened equations times ``weight`` (N,), and (9,) with their residuals r.

    Returns sum r'r. Whitened by the Cholesky factor L of J J' (L r = c), at the matches or at the ``nearest``
    exact ones, to first order x - J' v with v = (J J')^-1 c: the gradient of c' v is twice v' times their
    coefficients there, without the product of both steps in x1 and x2, as c is bilinear.
    """
    J, row, total = empty((2, 2)), zeros((2, 9)), 0.0
    for k in range(len(points)):
        if not weight[k] > 0.0:
            continue
        # The equations c of x2 ~ H x1, with w = (H x1)_3, dc / dx1 = J, and dc / dx2 = -w I.
        m = points[k]
        w = H[2, 0] * m[0] + H[2, 1] * m[1] + H[2, 2]
        for j in range(2):
            J[0, j], J[1, j] = H[0, j] - m[2] * H[2, j], H[1, j] - m[3] * H[2, j]
        c0 = H[0, 0] * m[0] + H[0, 1] * m[1] + H[0, 2] - w * m[2]
        c1 = H[1, 0] * m[0] + H[1, 1] * m[1] + H[1, 2] - w * m[3]
        a, b = J[0, 0] ** 2 + J[0, 1] ** 2 + w * w, J[0, 0] * J[1, 0] + J[0, 1] * J[1, 1]
        # det J J', without the rounding of a difference.
        determinant = (J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]) ** 2
        determinant += w * w * (a + J[1, 0] ** 2 + J[1, 1] ** 2)
        l11, l22 = np.sqrt(a), np.sqrt(determinant / a)
        r0 = c0 / l11
        r1 = (c1 - b / l11 * r0) / l22
        total += r0 * r0 + r1 * r1
        v1 = r1 / l22 if nearest else 0.0
        v0 = (r0 - b / l11 * v1) / l11 if nearest else 0.0
        x1 = points[k, 0] - J[0, 0] * v0 - J[1, 0] * v1
        y1 = points[k, 1] - J[0, 1] * v0 - J[1, 1] * v1
        x2, y2 = points[k, 2] + w * v0, points[k, 3] + w * v1
        s, t = weight[k] / l11, weight[k] / l22
        for j in range(3):
            x = x1 if j == 0 else (y1 if j == 1 else 1.0)
            step = x - points[k, j] if j < 2 else 0.0
            across, down = x2 * x - w * v0 * step, y2 * x - w * v1 * step
            row[0, j], row[0, 6 + j] = s * x, -s * across
            row[1, j], row[1, 3 + j], row[1, 6 + j] = -t * b / a * x, t * x, -t * (down - b / a * across)
        for i in range(9):
            g[i] += row[0, i] * r0 + row[1, i] * r1
            for j in range(i, 9):
                G[i, j] += row[0, i] * row[0, j] + row[1, i] * row[1, j]
                G[j, i] = G[i, j]
    return total


def refine_plane(H: F64, points: F64, gate: float, iterations: int) -> F64:
    """Fit H (3, 3) to the points within a gate by reweighted least squares."""
    H = unit_norm(H)
    for _ in range(iterations):
        new = np.linalg.eigh(_normal_matrix(H, points, gate))[1][:, 0].reshape(3, 3)
        new = new if np.sum(new * H) >= 0.0 else -new
        moved, H = float(np.sum((new - H) ** 2)), new
        if moved < 1e-18:
            break
    return H


def find_dominant_plane(
    f: F64, points: F64, inliers: B8, *, sigma: float, rng: Generator
) -> tuple[F64, F64] | None:
    """Plane H of F with most of its inliers, and squared distances (N,) in sigma^2; None without one."""
    mine = points[inliers]
    if len(mine) < 4:
        return None
    mine = mine[rng.permutation(len(mine))[:600]]
    some, gate = mine[:SUBSET], 5.0 * sigma
    F = f.reshape(3, 3)
    triples = rng.integers(0, len(some), (TRIPLES, 3))
    planes = induced_homographies(F, np.linalg.svd(F)[0][:, 2], some, triples, 1e-3)
    cost = np.minimum(squared_plane_distances(planes, some) / gate**2, 1.0).sum(axis=1)
    if not (cost < len(some)).any():
        return None
    # The plane of three noisy matches is inaccurate elsewhere: the gate starts wide.
    H = refine_plane(planes[cost.argmin()], some, 2.0 * gate, 3)
    H = refine_plane(H, mine, gate, 4)
    squared = squared_plane_distances(H, points) / sigma**2
    return (H, squared) if (squared < 25.0).any() else None


def plane_covariance(H: F64, points: F64, sigma: float) -> F64:
    """Covariance (9, 9) of a homography fitted to points on its plane."""
    values, vectors = np.linalg.eigh(_normal_matrix(H, points, 1e6 * sigma))
    # The smallest eigenvalue belongs to the scale of H, on which no distance depends.
    half = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-14 * values[-1]))
    return np.asarray(sigma**2 * half @ half.T)


def fundamentals_of_plane(H: F64, points: F64, weights: F64, pairs: I64, gate: float) -> tuple[F64, F64, F64]:
    """[e]x H of pairs off the plane: F (S, 9), inliers (S, N) as 0 or 1, sums (S, M) of their weights.

    Plane and parallax (Chum, Werner and Matas, CVPR 2005): the epipole e is where the lines x2 x H x1 through
    the two matches and their positions on the plane meet.
    """
    x1, x2 = homogenize(points[:, :2]), homogenize(points[:, 2:])
    parallax = np.cross(x2, x1 @ H.T)
    F = unit_norm(cross_matrix(np.cross(parallax[pairs[:, 0]], parallax[pairs[:, 1]])) @ H).reshape(-1, 9)
    # No match agrees with F = 0, of one match twice.
    near = np.asarray(squared_distances(F, np.ascontiguousarray(points.T)) < gate * gate)
    agree = np.where(F.any(axis=1, keepdims=True), near, False).astype(np.float64)
    return F, agree, agree @ weights.T


_SAMPLE, _PARAMETERS = 4, 8
_ROUNDS = 8  # rounds to find the inliers
_EXACT = 1e-9  # residuals in units of the frame below which they are rounding errors
_DEPENDENT = 1e-9  # ratio of singular values of the equations below which they are dependent


@dataclass(frozen=True, eq=False)
class HomographyFit(Record):
    """A homography with its inliers and noise."""

    H: F64  #: (3, 3) x2 ~ H x1, unit norm
    inliers: B8  #: (N,)
    sigma_px: float  #: standard deviation of one image coordinate; NaN for 4 matches, as the covariance
    covariance: F64  #: (9, 9) of the entries of H (row-major), rank 8


def fit_homography(
    xy1: F64, xy2: F64, threshold_px: float | None, budget: Budget, rng: Generator
) -> HomographyFit:
    """Fit a homography; arguments as for :func:`thesisrecon.estimate_homography`."""
    if len(xy1) < _SAMPLE or min(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()) == 0.0:
        raise _undetermined(f"{counted(len(xy1), 'match')}, at least 4 different ones are needed")
    frame = PairFrame.of(xy1, xy2)
    points, inliers = frame.points(xy1, xy2), np.ones(len(xy1), dtype=bool)
    if threshold_px is None:
        H, inverse = _refine(homography_linear(points[:, :2], points[:, 2:]), points)
    else:
        gate = threshold_px * frame.scale
        H, samples = _search(points, gate, budget, rng)
        for k in range(_ROUNDS):
            before = inliers
            distance = np.sqrt(squared_plane_distances(H, points))
            if k == 0:
                first = np.abs(homography_sampson_residuals(H, points[:, :2], points[:, 2:])[:, 0])
                limit = max(noise_width(first, gate, parameters=_PARAMETERS), gate)
            else:
                limit = next_inlier_limit(distance, inliers, limit, unknowns=_PARAMETERS)
            inliers = distance <= max(limit, _EXACT)
            if inliers.sum() < _SAMPLE:
                within = f"{inliers.sum()} of {len(points)} matches within {threshold_px:g} px"
                raise _undetermined(f"the best of {samples} samples has {within}")
            if k > 0 and np.array_equal(inliers, before):
                break
            H, inverse = _refine(H, points[inliers])
        _require_more_than_chance(H, points, gate, samples)
    r = homography_sampson_residuals(H, points[inliers, :2], points[inliers, 2:])
    left = (r.size - _PARAMETERS) * (1.0 if threshold_px is None else VARIANCE_OF_INLIERS)
    sigma = float(np.sqrt(np.sum(r**2) / left)) if left else float("nan")
    h = frame.homography_to_pixels @ H.ravel()
    norm = np.linalg.norm(h)
    J = (np.eye(9) - np.outer(h, h) / norm**2) @ frame.homography_to_pixels / norm
    covariance = sigma**2 * J @ inverse @ J.T
    return HomographyFit(unit_norm(h.reshape(3, 3)), inliers, sigma / frame.scale, covariance)


def _undetermined(evidence: str) -> StageFailure:
    return StageFailure.of("undetermined-homography", evidence)


def _require_more_than_chance(H: F64, points: F64, gate: float, samples: int) -> None:
    """Raise ``StageFailure`` if some homography of wrong matches would have as many inliers."""
    # A wrong match is an inlier if x2 lies in the ellipse of the largest distance about H x1, or x1 about x2.
    x1, x2 = homogenize(points[:, :2]), points[:, 2:]
    w = x1 @ H[2]
    A = H[:2, :2] - x2[:, :, None] * H[2, :2]
    ellipse = np.sqrt(np.linalg.det(A @ A.swapaxes(1, 2) + (w**2)[:, None, None] * np.eye(2)))
    sizes = np.prod(np.ptp(points, axis=0).reshape(2, 2), axis=1)
    with np.errstate(divide="ignore"):
        unit = np.pi * ellipse / np.stack([np.abs(np.linalg.det(A)) * sizes[0], w**2 * sizes[1]])
    found = inliers_by_chance(
        squared_plane_distances(H, points), points.T, (gate, _EXACT),
        lambda largest: float(np.minimum(largest * unit, 1.0).max(axis=0).mean()), _SAMPLE,
    )  # fmt: skip
    if found is not None:
        raise StageFailure.of("homography-by-chance", found, len(points), samples)


def _through_four(points: F64, samples: I64) -> F64:
    """Homographies (B', 3, 3) of samples (B, 4) of four matches whose triangles keep their orientation."""
    # With three points of each image as the columns of A and B, and barycentric coordinates a and b of the
    # fourth, H = B diag(b / a) A^-1; the rows of A^-1 are cross products of the columns of A.
    matches = points[samples[:, :3]]
    d = matches - points[samples[:, 3:]]
    a, b = np.cross(d[:, :, 0], d[:, :, 1]), np.cross(d[:, :, 2], d[:, :, 3])
    # Points of a visible plane lie on one side of its horizon.
    good = (a * b * (a.sum(axis=1) * b.sum(axis=1))[:, None]).min(axis=1) > 0.0
    A, B = homogenize(matches[good, :, :2]), homogenize(matches[good, :, 2:])
    inverse = np.cross(A[:, [1, 2, 0]], A[:, [2, 0, 1]])
    return np.asarray((B * (b[good] / a[good])[:, :, None]).swapaxes(1, 2) @ inverse)


def _search(points: F64, gate: float, budget: Budget, rng: Generator) -> tuple[F64, int]:
    """The homography with the least truncated squared distances, and the number of samples."""

    def refit(H: F64, rows: I64) -> F64:
        return refine_plane(H, points[rows[:500]], 1.5 * gate, 3) if len(rows) >= _SAMPLE else H

    found = search_models(
        lambda samples: unit_norm(_through_four(points, samples)),
        lambda H, rows: squared_plane_distances(H, points[rows]) / gate**2,
        refit, rng, len(points), _SAMPLE, budget,
    )  # fmt: skip
    if found is None:
        raise _undetermined(
            "samples of four matches have three on one line, or a triangle of the other orientation"
        )
    return found.model, found.samples


def _refine(H: F64, points: F64) -> tuple[F64, F64]:
    """H of least Sampson distances of matches (n, 4), and the inverse (9, 9) of its information."""
    h, damping, cost, every = H.ravel() / np.linalg.norm(H), 0.0, np.inf, np.ones(len(points))
    for _ in range(50):
        G, g = np.zeros((9, 9)), np.zeros(9)
        now = _add_equations(h.reshape(3, 3), points, every, True, G, g)
        if not np.isfinite(now) and not np.isfinite(cost):
            raise _undetermined(f"the equations of {counted(len(points), 'match')} have rank below 8")
        if now <= cost:
            tangent = directions_across(h)
            information = tangent @ G @ tangent.T
            kept, cost, gradient = h, now, tangent @ g
            damping = 0.1 * damping if damping > 1e-12 else 0.0
        else:
            damping = max(10.0 * damping, 1e-6)
        values, vectors = np.linalg.eigh(information)
        if not values[0] > _DEPENDENT**2 * values[-1]:
            raise _undetermined(f"the equations of {counted(len(points), 'match')} have rank below 8")
        step = -vectors @ (vectors.T @ gradient / (values + damping * values[-1]))
        h = kept + step @ tangent
        h /= np.linalg.norm(h)
        if now <= cost and step @ information @ step < 1e-16 * max(cost, 1e-300):
            break
    half = tangent.T @ (vectors / np.sqrt(values))
    return kept.reshape(3, 3), half @ half.T
