"""Lenses: the image of a direction and its inverse, in normalised coordinates (K = I).

A lens is a row of numbers: up to three coefficients k1, k2, k3 of a radial lens, or twelve: k1 to k4, p1, p2,
the number of the base, d1 to d3 and s1, s2. A direction is imaged by the base at q: in perspective, at its
angle from the axis (Kannala and Brandt, 2006), or where the division model r = r_q / (1 + k1 r_q^2) has it
(Fitzgibbon, 2001). With r^2 = q'q, but for the division model, it is then moved to

    q (1 + k1 r^2 + ... + k4 r^8) / (1 + d1 r^2 + d2 r^4 + d3 r^6) + decentring p (Brown, 1966) + s r^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from thesisrecon.arrays import B8, F64

Lens = Literal["radial", "division", "fisheye", "brown", "rational", "thin-prism-fisheye"]
PERSPECTIVE, DIVISION, ANGLE = 0, 1, 2  # bases
BASE, WIDTH = 6, 12
_PLACES: dict[str, tuple[int, tuple[int, ...]]] = {
    "radial": (PERSPECTIVE, (0, 1, 2)),
    "division": (DIVISION, (0,)),
    "fisheye": (ANGLE, (0, 1, 2, 3)),
    "brown": (PERSPECTIVE, (0, 1, 4, 5, 2)),
    "rational": (PERSPECTIVE, (0, 1, 4, 5, 2, 7, 8, 9)),
    "thin-prism-fisheye": (ANGLE, (0, 1, 4, 5, 2, 3, 10, 11)),
}
"""Base of each lens, and places of its coefficients, in the order of OpenCV and COLMAP, in a row."""


def lens_row(lens: str, coefficients: F64) -> F64:
    """The row of a lens; of a radial one its coefficients. ``ValueError``: no such lens, too many numbers."""
    if lens not in get_args(Lens):
        raise ValueError(f"a lens is one of {', '.join(get_args(Lens))}; got {lens!r}")
    base, places = _PLACES[lens]
    if len(coefficients) > len(places) and np.any(coefficients[len(places) :]):
        raise ValueError(f"a {lens} lens has {len(places)} coefficients; got {len(coefficients)}")
    if lens == "radial":
        return coefficients
    row = np.zeros(WIDTH)
    row[list(places[: len(coefficients)])] = coefficients[: len(places)]
    row[BASE] = base
    return row


def named_lens(row: F64) -> tuple[Lens, F64]:
    """The simplest name of the lens of a row, and its coefficients in the order of that name."""
    if len(row) <= BASE:
        return "radial", row
    row = np.concatenate([row, np.zeros(WIDTH - len(row))])
    used = {int(k) for k in np.flatnonzero(row)} - {BASE}
    names: tuple[Lens, ...] = get_args(Lens)
    lens = next(n for n in names if _PLACES[n][0] == row[BASE] and used <= set(_PLACES[n][1]))
    return lens, row[list(_PLACES[lens][1])]


def simplest_row(lens: str, coefficients: F64) -> F64:
    """The row of the simplest lens with these coefficients: of a radial one, k1, k2, k3."""
    name, known = named_lens(lens_row(lens, coefficients))
    return np.append(known, np.zeros(3))[:3] if name == "radial" else lens_row(name, known)


def stacked_rows(rows: Sequence[F64]) -> F64:
    """Rows of lenses (V, C) of one width: that of the longest."""
    width = max((len(row) for row in rows), default=3)
    return np.array([np.append(row, np.zeros(width - len(row))) for row in rows]).reshape(-1, width)


def fit_lens(base: int, radii: F64, tangents: F64, coefficients: int) -> tuple[float, F64]:
    """Focal length and radial coefficients of least squares of a lens that images directions at radii (N,).

    ``base`` is PERSPECTIVE or ANGLE, ``tangents`` (N,) are those of the angles from the axis.
    """
    s = np.arctan(tangents) if base == ANGLE else tangents
    fit = np.linalg.lstsq(s[:, None] ** np.arange(1, 2 * coefficients + 2, 2), radii, rcond=None)[0]
    return float(fit[0]), fit[1:] / fit[0]


def straight_places(p: F64, k: F64) -> tuple[F64, F64]:
    """Straight places (..., 2) of places p of an image in half diagonals about its middle, by a lens as of
    :func:`straight_weights`, and their magnification (...), negative beyond the horizon of the lens.
    """
    r2 = np.sum(p**2, axis=-1)
    w, slope = straight_weights(k, r2)
    growth = w - 2.0 * r2 * slope
    with np.errstate(divide="ignore", invalid="ignore"):
        return p / w[..., None], np.where((w > 0.0) & (growth > 0.0), growth / w**2, -1.0)


def straight_weights(k: F64, r2: F64) -> tuple[F64, F64]:
    """w by which places at squared radii r2 (...) of an image are divided to be straight, and dw / dr^2.

    A lens k (3,), or (..., 3), in half diagonals is k1, k2 and its base: w = 1 + k1 r^2 + k2 r^4 of the
    radius in the image, or in perspective of the straight one; then w is negative where nothing is imaged.
    """
    k = np.broadcast_to(k, (*r2.shape, 3))
    w, slope = 1.0 + (k[..., 0] + k[..., 1] * r2) * r2, k[..., 0] + 2.0 * k[..., 1] * r2
    radial = k[..., 2] == PERSPECTIVE
    if not radial.any():
        return w, slope
    r, lens = np.sqrt(r2[radial]), k[radial, :2]
    s = undistort(np.column_stack([r, 0.0 * r]), lens)[:, 0]
    s2 = s**2
    back = s * (1.0 + (lens[:, 0] + lens[:, 1] * s2) * s2)
    growth = 1.0 + (3.0 * lens[:, 0] + 5.0 * lens[:, 1] * s2) * s2
    with np.errstate(divide="ignore", invalid="ignore"):
        by_radius = np.where(s > 1e-6, (1.0 / s - r / s2 / growth) / (2.0 * r), lens[:, 0])
    found = (np.abs(back - r) <= 1e-6 * (1.0 + r)) & (growth > 0.0)
    w[radial] = np.where(found, np.divide(r, s, out=np.ones_like(r), where=s > 0.0), -1.0)
    slope[radial] = np.where(found, by_radius, 0.0)
    return w, slope


def angles_from_axis(X: F64) -> F64:
    """Angles (N,) of directions (N, 3), of any length, from the optical axis."""
    return np.asarray(np.arctan2(np.linalg.norm(X[:, :2], axis=1), X[:, 2]))


def image_of_directions(X: F64, k: float | F64) -> F64:
    """Images (N, 2) of directions (N, 3), of any length, by one lens (C,)."""
    k = np.atleast_1d(k)
    if len(k) <= BASE or k[BASE] != ANGLE:
        return distort(X[:, :2] / X[:, 2:], k)
    r = np.linalg.norm(X[:, :2], axis=1, keepdims=True)
    return _bend(X[:, :2] * _quotient(np.arctan2(r, X[:, 2:]), r), k)[0]


def directions_of_image(xy: F64, k: float | F64) -> F64:
    """Unit directions (N, 3) of images (N, 2) by one lens (C,); NaN beyond all images of directions."""
    k = np.atleast_1d(k)
    if len(k) <= BASE or k[BASE] != ANGLE:
        plane = undistort(xy, k)
        # Beyond the radius up to which the distortion grows, its inverse does not exist.
        outside = np.linalg.norm(plane, axis=1) > growing_radius(k) * (1.0 + 1e-9)
        returned = np.linalg.norm(distort(plane, k) - xy, axis=1)
        outside |= returned > 1e-6 * np.maximum(1.0, np.linalg.norm(xy, axis=1))
        plane[outside] = np.nan
        rays = np.column_stack([plane, np.ones(len(xy))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    q, reached = _straighten(xy, k)
    angle = np.linalg.norm(q, axis=1, keepdims=True)
    rays = np.column_stack([q * np.sinc(angle / np.pi), np.cos(angle)])
    rays[~reached | (angle[:, 0] > np.pi)] = np.nan
    return np.asarray(rays)


def distort(xy_normalized: F64, distortion: float | F64) -> F64:
    """Apply a lens (C,) or one each (N, C) to normalised points (N, 2) in front of the camera."""
    k = np.atleast_1d(distortion)
    if k.shape[-1] > BASE:
        return _bend(_base_of(xy_normalized, k), k)[0]
    r2 = np.sum(xy_normalized**2, axis=-1, keepdims=True)
    return np.asarray(xy_normalized * _radial_factor(distortion, r2))


def undistort(xy_normalized: F64, distortion: float | F64) -> F64:
    """Invert :func:`distort` by Newton's method; points without an inverse, far outside, are not changed."""
    distorted = np.sum(xy_normalized**2, axis=-1, keepdims=True)
    k = np.atleast_1d(distortion)
    if k.shape[-1] > BASE:
        return _undistort_any(xy_normalized, k)
    slopes = k * np.arange(1, k.shape[-1] + 1)
    r2 = distorted
    with np.errstate(all="ignore"):
        for _ in range(20):
            factor = _radial_factor(k, r2)
            slope = factor * (factor + 2.0 * (_radial_factor(slopes, r2) - 1.0))
            step = (r2 * factor**2 - distorted) / slope
            r2 = r2 - step
            # Converged to rounding: the next error is the square of the relative step.
            if np.all(np.abs(step) <= 1e-9 * np.abs(r2)):
                break
        factor = _radial_factor(k, r2)
        reached = np.abs(r2 * factor**2 - distorted) <= 1e-9 * distorted
    return np.asarray(xy_normalized / np.where(reached & (factor > 0.0), factor, 1.0))


def growing_radius(distortion: F64) -> float:
    """Normalised radius up to which r (1 + k1 r^2 + k2 r^4 + ...) grows, infinity if everywhere.

    Of other lenses the inverse itself is tested.
    """
    if len(distortion) > BASE:
        return np.inf
    slopes = distortion * np.arange(3, 2 * len(distortion) + 2, 2)
    roots = np.roots([*slopes[::-1], 1.0])
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return float(np.sqrt(squares.min())) if len(squares) else np.inf


def _radial_factor(distortion: float | F64, r2: F64) -> F64:
    k = np.atleast_1d(distortion)
    factor = np.zeros_like(r2)
    for n in reversed(range(k.shape[-1])):
        factor = (factor + k[..., n : n + 1]) * r2
    return 1.0 + factor


def _base_of(xy: F64, k: F64) -> F64:
    """The image of perspective points (N, 2) by the base of a lens."""
    r2 = np.sum(xy**2, axis=-1, keepdims=True)
    base, first = k[..., BASE : BASE + 1], k[..., :1]
    with np.errstate(invalid="ignore"):
        divided = 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * np.where(base == DIVISION, first, 0.0) * r2))
    r = np.sqrt(r2)
    angle = _quotient(np.arctan(r), r)
    return np.asarray(xy * np.where(base == ANGLE, angle, np.where(base == DIVISION, divided, 1.0)))


def _quotient(angle: F64, r: F64) -> F64:
    """angle / r, and 1 at r = 0."""
    return np.asarray(np.divide(angle, r, out=np.ones_like(r), where=r > 0.0))


def _bend(q: F64, k: F64) -> tuple[F64, F64]:
    """The image (N, 2) of the base q after the polynomial, and its Jacobian (N, 2, 2)."""
    k = np.concatenate([k, np.zeros((*k.shape[:-1], WIDTH - k.shape[-1]))], axis=-1)
    numerator = np.where(k[..., BASE : BASE + 1] == DIVISION, 0.0, k[..., :4])
    p1, p2, s1, s2 = k[..., 4], k[..., 5], k[..., 10], k[..., 11]
    x, y = q[:, 0], q[:, 1]
    r2 = np.sum(q**2, axis=1, keepdims=True)
    top, bottom = _radial_factor(numerator, r2)[:, 0], _radial_factor(k[..., 7:10], r2)[:, 0]
    slopes = [_slope(c, r2) for c in (numerator, k[..., 7:10])]
    d, slope = top / bottom, (slopes[0] - slopes[1] * top / bottom) / bottom
    squared = r2[:, 0]
    image = np.stack([
        x * d + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x) + s1 * squared,
        y * d + 2.0 * p2 * x * y + p1 * (squared + 2.0 * y * y) + s2 * squared,
    ], axis=1)  # fmt: skip
    across = 2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    J = np.stack([
        d + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * s1 * x, across + 2.0 * s1 * y,
        across + 2.0 * s2 * x, d + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * s2 * y,
    ], axis=1)  # fmt: skip
    return image, J.reshape(-1, 2, 2)


def _slope(k: F64, r2: F64) -> F64:
    """The derivative (N,) of k1 r^2 + k2 r^4 + ... by r^2."""
    slopes = k * np.arange(1, k.shape[-1] + 1)
    return np.asarray(slopes[..., 0] + _radial_factor(slopes[..., 1:], r2)[:, 0] - 1.0)


def _straighten(image: F64, k: F64) -> tuple[F64, B8]:
    """Invert :func:`_bend` by Newton's method; whether each point (N,) was reached without a fold."""
    q = image.copy()
    with np.errstate(all="ignore"):
        for _ in range(40):
            at, J = _bend(q, k)
            off = image - at
            determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
            step = np.stack([
                (J[:, 1, 1] * off[:, 0] - J[:, 0, 1] * off[:, 1]) / determinant,
                (J[:, 0, 0] * off[:, 1] - J[:, 1, 0] * off[:, 0]) / determinant,
            ], axis=1)  # fmt: skip
            q = q + step
            # Converged to rounding: the next error is the square of the relative step.
            if np.all(np.abs(step) <= 1e-9 * (1e-9 + np.abs(q)), where=np.isfinite(step)):
                break
        at, J = _bend(q, k)
        reached = np.linalg.norm(at - image, axis=1) <= 1e-9 * (1.0 + np.linalg.norm(image, axis=1))
        determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    return q, reached & (determinant > 0.0) & (np.einsum("ni,ni->n", q, image) >= 0.0)


def _undistort_any(image: F64, k: F64) -> F64:
    q, reached = _straighten(image, k)
    r = np.linalg.norm(q, axis=1, keepdims=True)
    base, first = k[..., BASE : BASE + 1], k[..., :1]
    with np.errstate(invalid="ignore", divide="ignore"):
        angle = _quotient(np.tan(np.minimum(r, np.pi / 2.0)), r)
        divided = 1.0 / (1.0 + first * r**2)
    xy = q * np.where(base == ANGLE, angle, np.where(base == DIVISION, divided, 1.0))
    behind = np.where(base == ANGLE, r >= np.pi / 2.0, (base == DIVISION) & (divided <= 0.0))[:, 0]
    return np.asarray(np.where((reached & ~behind)[:, None], xy, image))
