"""Section 5.2: F from linear equations: the eight-point and the seven-point algorithm."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar._matches import MIN_PX, PairFrame, as_matches, check_matches
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conditioning import normalizing_transform, unit_norm
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import enforce_rank_two


def estimate_eight_point(xy1: F64, xy2: F64, *, normalized: bool = True, rank_two: bool = True) -> F64:
    """F of unit norm from at least eight matches (N, 2) by the eight-point algorithm (5.2).

    Minimises the algebraic residuals x2' F x1 over unit vectors. ``normalized``: with Hartley's normalisation
    (PAMI 19, 1997); the thesis uses raw pixels, which weight the entries of F unequally. ``rank_two``: the
    nearest singular matrix in the frame of the solution; the thesis does not enforce it.
    """
    xy1, xy2 = check_matches(xy1, xy2, needed=8)
    T1 = normalizing_transform(xy1) if normalized else np.eye(3)
    T2 = normalizing_transform(xy2) if normalized else np.eye(3)
    x1, x2 = homogenize(xy1) @ T1.T, homogenize(xy2) @ T2.T
    A = (x2[:, :, None] * x1[:, None, :]).reshape(len(x1), 9)
    # The triangular factor has the singular values and right vectors of all rows, and nine rows.
    _, s, Vt = np.linalg.svd(np.linalg.qr(A, mode="r"))
    if not s[7] > (1e-12 if normalized else 1e-16) * s[0]:
        raise StageFailure(
            "the matches do not determine the fundamental matrix",
            f"the equations of {len(xy1)} matches have rank below 8",
            "add matches off the dominant plane",
        )
    F = Vt[8].reshape(3, 3)
    return unit_norm(T2.T @ (enforce_rank_two(F) if rank_two else F) @ T1)


def estimate_seven_point(xy1: F64, xy2: F64) -> F64:
    """All fundamental matrices (0 to 3, 3, 3) through exactly seven matches (HZ, section 11.1.2), unit norm.

    Searches the pencil spanned by two solutions of (5.1) for singular members in all directions, also F1 -
    F2, which alpha F1 + (1 - alpha) F2 of the thesis reaches only at infinity. None for degenerate matches.
    """
    xy1, xy2 = as_matches(xy1, xy2)
    if xy1.shape != (7, 2):
        raise ValueError(f"the seven-point algorithm needs two (7, 2) arrays; got {xy1.shape}, {xy2.shape}")
    if not min(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()) > MIN_PX:
        return np.empty((0, 3, 3))
    frame = PairFrame.of(xy1, xy2)
    solutions = seven_point(frame.points(xy1, xy2)[None])[0]
    return np.array([frame.matrix_in_pixels(f) for f in solutions]).reshape(-1, 3, 3)


def seven_point(points: F64) -> list[F64]:
    """Unit F (0 to 3, 9) through each sample of seven rows (x1, y1, x2, y2) of points (B, 7, 4) in a frame.

    The null space of the equations (5.1) are the last two columns of the orthogonal factor.
    """
    x1, x2 = homogenize(points[..., :2]), homogenize(points[..., 2:])
    A = (x2[..., :, None] * x1[..., None, :]).reshape(-1, 7, 9)
    Q, R = np.linalg.qr(A.swapaxes(1, 2), mode="complete")
    found = singular_members(Q[:, :, 7:].swapaxes(1, 2))
    dependent = np.abs(np.diagonal(R, axis1=1, axis2=2)).min(axis=1) < 1e-9
    return [F[:0] if none else F for F, none in zip(found, dependent, strict=True)]


def singular_members(pencils: F64) -> list[F64]:
    """The unit members (0 to 3, 9) with determinant 0 of each of the pencils (B, 2, 9).

    The determinant is a homogeneous cubic of the pencil coordinates. It cannot vanish in four directions
    unless it vanishes everywhere, so the direction with the largest determinant of four becomes the first
    basis vector: the leading coefficient is never small and no solution is lost at infinity.
    """
    half = np.sqrt(0.5)
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [half, half], [half, -half]])
    sizes = np.abs(np.linalg.det((directions @ pencils).reshape(-1, 4, 3, 3)))
    c, s = directions[sizes.argmax(axis=1)].T[..., None]
    first, second = c * pencils[:, 0] + s * pencils[:, 1], c * pencils[:, 1] - s * pencils[:, 0]
    some = np.stack([first, second, second + first, second - first], axis=1)
    c3, c0, plus, minus = np.linalg.det(some.reshape(-1, 4, 3, 3)).T
    singular = sizes.max(axis=1) < 1e-14
    # det(x first + second) = c3 x^3 + c2 x^2 + c1 x + c0.
    cubic = np.stack([0.5 * (plus + minus) - c0, 0.5 * (plus - minus) - c3, c0], axis=1)
    companion = np.eye(3, k=-1) * np.ones((len(pencils), 1, 1))
    companion[:, 0] = -cubic / np.where(singular, 1.0, c3)[:, None]
    found = []
    for k, roots in enumerate(np.linalg.eigvals(companion)):
        x = distinct_real_roots(roots)[: 0 if singular[k] else 3, None]
        found.append((x * first[k] + second[k]) / np.sqrt(1.0 + x**2))
    return found


def distinct_real_roots(roots: F64) -> F64:
    """The real ones of the three roots of a cubic, the middle one before the outer ones.

    A double root, which rounding splits into two near ones or a complex pair, counts once, after the simple
    one; a triple root counts once.
    """
    real = np.sort(roots.real[np.abs(roots.imag) <= 1e-6 * (1.0 + np.abs(roots))])
    if len(real) < 3:
        return real[:1]
    equal = np.diff(real) <= 2e-6 * (1.0 + np.abs(real[:2]))
    if equal.all():
        return real[1:2]
    if equal.any():
        k = int(equal.argmax())
        return np.array([real[2 - 2 * k], real[k : k + 2].mean()])
    return real[[1, 0, 2]]
