"""The vertical direction of a scene by the straight edges of its images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.camera import viewing_rays
from thesisrecon.geometry.camera_matrix import pose_of_camera
from thesisrecon.records import Image, Reconstruction

MIN_GRADIENT, MAX_WIDTH, MIN_LENGTH = 4.0, 1.4, 0.04
"""Grey levels per pixel of an edge, px RMS across it, and its length as a share of the long side."""
ALIGNED = np.sin(np.radians(1.0))
"""A line is vertical if its plane with the camera centre deviates by less from the direction."""
CONE, MIN_SHARE, MIN_IMAGES, MAX_STD_DEG = np.radians(15.0), 0.4, 3, 0.5
"""Angle about the direction expected, share of the lines in it that agree, by length, and images with them:
of buildings they are 0.5 to 0.7, of objects and trees below 0.3."""
MOST = 40  # images of which edges are read


def vertical_of_lines(
    model: Reconstruction, images: Sequence[Image], expected: F64
) -> tuple[F64, float, int] | None:
    """Unit vector to which most nearly vertical lines point, its standard deviation (degrees), and images.

    None if few of the lines within 15 degrees of the ``expected`` direction agree. The deviation is that of
    the jackknife over the images, since errors of one image are common to its lines.
    """
    normals, weights, views = list[F64](), list[F64](), list[int]()
    assert model.K is not None
    here = np.flatnonzero(model.registered)
    for v in here[:: 1 + len(here) // MOST].tolist():
        K, R = model.K[v], pose_of_camera(model.K[[v]], model.P[[v]])[0][0]
        ends = straight_edges(images[v].gray, images[v].mask)
        lens = np.zeros(1) if model.distortion is None else model.distortion[v]
        across = np.cross(*(viewing_rays(K, ends[:, k], lens) @ R for k in (0, 1)))
        length = np.linalg.norm(across, axis=1)
        near = np.abs(across @ expected) < np.sin(CONE) * length
        normals.append(across[near] / length[near, None])
        weights.append(length[near])
        views += [v] * int(near.sum())
    if len(views) < 10 or len(set(views)) < MIN_IMAGES:
        return None
    n, w, view = np.concatenate(normals), np.concatenate(weights), np.array(views)
    rng = np.random.default_rng(0)
    first = rng.integers(0, len(n), 4000)
    second = (first + rng.integers(1, len(n), 4000)) % len(n)
    c = np.cross(n[first], n[second])
    length = np.linalg.norm(c, axis=1)
    c = c[(length > ALIGNED) & (np.abs(c @ expected) > np.cos(CONE) * length)]
    c /= np.linalg.norm(c, axis=1, keepdims=True)
    if not len(c):
        return None
    u = c[int(((np.abs(c @ n.T) < ALIGNED) @ w).argmax())]

    def refined(keep: B8) -> F64:
        one = u
        for _ in range(10):
            off = np.abs(n[keep] @ one)
            weight = w[keep] * (off < 2.0 * ALIGNED) / np.maximum(off, 0.2 * ALIGNED)
            one = np.linalg.eigh(np.einsum("vi,v,vj->ij", n[keep], weight, n[keep]))[1][:, 0]
        return np.asarray(one * np.sign(one @ expected))

    u = refined(np.ones(len(n), bool))
    agree = np.abs(n @ u) < ALIGNED
    seen = np.unique(view[agree])
    if w[agree].sum() < MIN_SHARE * w.sum() or len(seen) < MIN_IMAGES:
        return None
    without = np.array([refined(view != v) for v in seen])
    spread = np.sum((without - without.mean(axis=0)) ** 2) * (len(seen) - 1) / len(seen)
    std = float(np.degrees(np.sqrt(spread)))
    return (u, std, len(seen)) if std < MAX_STD_DEG else None


def straight_edges(gray: F32, mask: B8 | None = None) -> F64:
    """End points (N, 2, 2) of straight edges: regions of one gradient direction that are long and thin."""
    smooth = scipy.ndimage.gaussian_filter(gray.astype(np.float64), 1.0)
    gy, gx = np.gradient(smooth)
    strength, found = np.hypot(gx, gy), list[F64]()
    strong = strength > MIN_GRADIENT
    if mask is not None:
        strong &= scipy.ndimage.binary_erosion(mask, iterations=3)
    # Two sets of directions: those at the border of one are in the middle of the other.
    for shift in (0.0, 0.5):
        sector = (np.arctan2(gy, gx) * (8.0 / np.pi) + shift) // 1.0 % 16.0
        label, count = np.zeros(gray.shape, np.int64), 0
        for k in range(16):
            part, number = scipy.ndimage.label(strong & (sector == k), np.ones((3, 3)))
            label += np.where(part > 0, part + count, 0)
            count += number
        row, column = np.nonzero(label > 0)
        own, weight = label[row, column] - 1, strength[row, column]
        total = np.bincount(own, weight, count)

        def mean(x: F64 | I64) -> F64:
            return np.bincount(own, weight * x, count) / total  # noqa: B023

        middle = np.column_stack([mean(column), mean(row)])
        dx, dy = column - middle[own, 0], row - middle[own, 1]
        xx, xy, yy = mean(dx * dx), mean(dx * dy), mean(dy * dy)
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        c, s = np.cos(angle), np.sin(angle)
        along, each = dx * c[own] + dy * s[own], np.arange(count)
        ends = np.column_stack([getattr(scipy.ndimage, f)(along, own, each) for f in ("minimum", "maximum")])
        straight = yy * c**2 + xx * s**2 - 2.0 * xy * c * s < MAX_WIDTH**2
        long = straight & (np.ptp(ends, axis=1) > MIN_LENGTH * max(gray.shape))
        found.append((middle[:, None] + ends[:, :, None] * np.column_stack([c, s])[:, None])[long])
    return np.concatenate(found)
