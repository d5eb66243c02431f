"""Samples of the space that several known cameras see, used instead of scene points."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.camera_matrix import camera_centre, project
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.records import PinholeView

GRID = (8, 6)
"""Samples along the width and the height of an image."""
DEPTHS, RATIO = 12, 1.25
"""Depths between given limits, evenly in inverse depth; ratio of successive depths without limits."""
MIN_ANGLE_DEG, MAX_ANGLE_DEG = 0.5, 40.0
"""Triangulation angles that limit the depth: below, depth is uncertain; above, windows look different."""


def frustum_samples(
    views: Mapping[int, PinholeView], n_views: int, depth_range: F64 | None = None
) -> tuple[F64, B8]:
    """Sample the common frusta; return points (N, 3) and whether each of ``n_views`` shows them (V, N).

    The points lie on the rays of a grid of pixels of each view, at the depths of ``depth_range`` (V, 2), and
    are shown by the views whose image contains them. Without a range, another view shows a point only at a
    triangulation angle between ``MIN_ANGLE_DEG`` and ``MAX_ANGLE_DEG``. Points shown only by their own view
    are left out.
    """
    centres = {i: dehomogenize(camera_centre(view.P)) for i, view in views.items()}
    points, shown = [np.zeros((0, 3))], [np.zeros((n_views, 0), dtype=bool)]
    for i, view in views.items():
        away = [float(np.linalg.norm(centres[j] - centres[i])) for j in views if j != i]
        away = [distance for distance in away if distance > 0.0]
        if depth_range is not None:
            first, last = 1.0 / depth_range[i]
            depth = 1.0 / np.linspace(first, last, DEPTHS)
        elif away:
            nearest, farthest = (
                min(away) / np.tan(np.radians(MAX_ANGLE_DEG)),
                max(away) / np.tan(np.radians(MIN_ANGLE_DEG)),
            )
            depth = np.geomspace(
                0.5 * nearest, farthest, 2 + int(np.log(2.0 * farthest / nearest) / np.log(RATIO))
            )
        else:
            continue
        X = _on_rays(view, centres[i], depth)
        seen = np.zeros((n_views, len(X)), dtype=bool)
        for j in views:
            if j != i:
                seen[j] = project_inside(views[j], X)[1]
                if depth_range is None:
                    seen[j] &= _angle_within_limits(X - centres[i], X - centres[j])
        kept = seen.any(axis=0)
        seen[i] = True
        points.append(X[kept])
        shown.append(seen[:, kept])
    return np.concatenate(points), np.concatenate(shown, axis=1)


def _on_rays(view: PinholeView, centre: F64, depth: F64) -> F64:
    """Points (N, 3) on the rays of a grid of pixels, at each depth."""
    size = np.array(view.seen.shape[::-1])
    x, y = (np.linspace(0.02, 0.98, n) * (side - 1.0) for n, side in zip(GRID, size, strict=True))
    xh = np.stack([*(a.ravel() for a in np.meshgrid(x, y)), np.ones(GRID[0] * GRID[1])])
    # The third row of P has unit norm: the rays have depth 1.
    rays = np.linalg.solve(view.P[:, :3], xh).T
    return np.asarray((centre + depth[:, None, None] * rays).reshape(-1, 3))


def project_inside(view: PinholeView, X: F64) -> tuple[F64, B8]:
    """Pixels (N, 2) of points in a view, and whether they are in front of it and inside the image."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = project(view.P, X)
    size = np.array(view.seen.shape[::-1])
    inside = np.all((xy >= 0.0) & (xy <= size - 1.0), axis=1)
    return xy, np.asarray((X @ view.P[2, :3] + view.P[2, 3] > 0.0) & inside)


def _angle_within_limits(a: F64, b: F64) -> B8:
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    angle = np.degrees(np.arctan2(sine, np.sum(a * b, axis=1)))
    return np.asarray((angle >= MIN_ANGLE_DEG) & (angle <= MAX_ANGLE_DEG))
