"""Synthetic cameras and points as the studies of chapters 6 and 7 take them: zoomed, noisy, projective."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.camera import compose_camera, project_camera
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle
from thesisrecon.records import Reconstruction, Tracks
from validation.scenes.cube import SIZE, make_cube
from validation.scenes.pose import look_at
from validation.scenes.transforms import random_transform


@dataclass(frozen=True)
class Rig:
    """``K, R`` (V, 3, 3), R world-to-camera, ``C`` (V, 3), ``X`` (N, 3), ``seen`` (V, N) whether a view may
    see a point (the border of the image is checked besides), ``size`` of every image; ``flat`` (V,) views
    whose points lie on one plane, which leaves a projective camera open; ``plane`` (N,) number of the plane
    that a point lies on, where points lie on planes."""

    K: F64
    R: F64
    C: F64
    X: F64
    seen: B8
    size: tuple[int, int]
    flat: B8 | None = None
    plane: I64 | None = None

    def subset(self, views: I64) -> Rig:
        """The rig of these views."""
        flat = None if self.flat is None else self.flat[views]
        return replace(
            self, K=self.K[views], R=self.R[views], C=self.C[views], seen=self.seen[views], flat=flat
        )

    def tied_off_planes(self, least: int) -> bool:
        """Return whether pairs connect all views, each with ``least`` common points off its largest plane."""
        seen = np.isfinite(self.pixels()[..., 0])
        planes = np.arange(len(self.X)) if self.plane is None else self.plane
        tied = np.zeros((len(self.K), len(self.K)), dtype=bool)
        for i in range(len(self.K)):
            for j in range(i):
                counts = np.bincount(planes[seen[i] & seen[j]], minlength=1)
                tied[i, j] = counts.sum() - counts.max() >= least
        return bool(connected_components(tied, directed=False)[0] == 1)

    def pixels(self) -> F64:
        """Exact pixels (V, N, 2), NaN where a view does not see a point."""
        t = -np.einsum("vab,vb->va", self.R, self.C)
        xy = np.stack([project_camera(K, R, t_, self.X) for K, R, t_ in zip(self.K, self.R, t, strict=True)])
        inside = (xy >= -0.5).all(axis=2) & (xy <= np.array(self.size) - 0.5).all(axis=2)
        return np.where((inside & self.seen)[..., None], xy, np.nan)


def cube_rig() -> Rig:
    """The thesis' cube sequence (5.5): always the same numbers."""
    cube = make_cube()
    facing = cube.C[:, cube.face] > 1.0
    K = np.tile(cube.K, (len(cube.R), 1, 1))
    return Rig(K, cube.R, cube.C, cube.X, facing, SIZE, cube.faces_seen() == 1, cube.face)


def zoomed(rig: Rig, factors: F64) -> Rig:
    """The rig with every focal (V,) times a factor, about the image's middle where the points are."""
    K = rig.K.copy()
    K[:, 0, 0] *= factors
    K[:, 1, 1] *= factors
    return replace(rig, K=K)


def noisy_tracks(rig: Rig, sigma_px: float, rng: np.random.Generator) -> Tracks:
    """Observations of all points that two views or more see, with Gaussian noise of ``sigma_px``."""
    xy = rig.pixels()
    return observe(xy, np.isfinite(xy[..., 0]), sigma_px, rng)


def observe(xy: F64, seen: B8, sigma_px: float, rng: np.random.Generator) -> Tracks:
    """Observations of pixels (V, N, 2) where ``seen`` (V, N), of points that two views or more see, with
    Gaussian noise of ``sigma_px``."""
    point, view = np.nonzero((seen & (seen.sum(axis=0) >= 2)).T)
    noisy = xy[view, point] + sigma_px * rng.normal(size=(len(view), 2))
    return Tracks(view, point, noisy, *seen.shape)


def projective_from_truth(rig: Rig, tracks: Tracks, rng: np.random.Generator) -> Reconstruction:
    """The minimum of the projective bundle adjustment nearest to the truth, in a random projective frame.

    The output of a perfect projective stage, as input of self-calibration studies. Flat views are
    left out, as the gate of the projective stage does.
    """
    n = len(rig.K)
    registered = np.ones(n, dtype=bool) if rig.flat is None else ~rig.flat
    P = compose_camera(rig.K, rig.R, -np.einsum("vab,vb->va", rig.R, rig.C))
    use = registered[tracks.view_index]
    use &= np.bincount(tracks.point_index[use], minlength=tracks.n_points)[tracks.point_index] >= 2
    X = np.column_stack([rig.X, np.ones(len(rig.X))])
    G = random_transform("projective", rng)
    P = P @ np.linalg.inv(G) * (rng.uniform(0.5, 2.0, n) * rng.choice([-1.0, 1.0], n))[:, None, None]
    X = X @ G.T * rng.choice([-1.0, 1.0], len(X))[:, None]
    fitted = refine_projective_bundle(
        P,
        X,
        Observations(tracks.view_index[use], tracks.point_index[use], tracks.xy[use]),
        loss_px=10.0,
        max_iterations=30,
    )
    valid = np.bincount(tracks.point_index[use], minlength=len(X)) >= 2
    sigma = float(np.sqrt(np.mean(fitted.residual_px**2)))
    reasons = tuple("" if r else "sees a single plane" for r in registered)
    return Reconstruction(
        "projective", np.where(registered[:, None, None], fitted.P, 0.0),
        np.where(valid[:, None], fitted.X, 0.0), registered, valid, use, tracks,
        np.tile(rig.size, (n, 1)).astype(np.int64), max(sigma, 1e-6), reasons,
    )  # fmt: skip


CLOUD_SIZE = (1536, 1024)
FOCAL_PX = 1500.0
SEEN = 0.75
"""Share of the points in a view's sight that it has an observation of."""


def make_cloud(views: int, rng: np.random.Generator, *, points: int = 500) -> Rig:
    """``points`` uniform in a box of 4 x 3 x 3.2, ``views`` cameras 6 to 9 off on a cap of 80 by 40 degrees.

    The principal point is off the image's middle by a normal deviate of half a percent of the long side.
    """
    X = rng.uniform([-2.0, -1.5, -1.6], [2.0, 1.5, 1.6], (points, 3))
    angles = rng.uniform([-0.7, -0.35], [0.7, 0.35], (views, 2))
    azimuth, height = angles.T
    direction = np.column_stack(
        [np.sin(azimuth) * np.cos(height), -np.cos(azimuth) * np.cos(height), np.sin(height)]
    )
    C = rng.uniform(6.0, 9.0, (views, 1)) * direction
    R = np.stack([look_at(c, rng.normal(0.0, 0.3, 3), float(rng.uniform(-0.15, 0.15))) for c in C])
    shift = rng.normal(0.0, 0.005 * CLOUD_SIZE[0], 2)
    K = np.array([[FOCAL_PX, 0.0, 767.5 + shift[0]], [0.0, FOCAL_PX, 511.5 + shift[1]], [0.0, 0.0, 1.0]])
    seen = rng.random((views, points)) < SEEN
    return Rig(np.tile(K, (views, 1, 1)), R, C, X, seen, CLOUD_SIZE)
