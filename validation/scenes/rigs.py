"""Synthetic cameras and points as the studies of chapters 6 and 7 take them: zoomed, noisy, projective."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.camera import project_camera
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.optimize.bundle.projection import Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle
from thesisrecon.records import Reconstruction, Tracks
from validation.scenes.cube import SIZE, make_cube
from validation.scenes.pose import look_at

Group = Literal["projective", "affine", "metric", "euclidean"]


@dataclass(frozen=True)
class Rig:
    """Cameras (V), points ``X`` (N, 3), ``seen`` (V, N) whether a view may see a point (the border of the
    image is checked besides); ``flat`` (V,) views whose points lie on one plane, which leaves a projective
    camera open; ``plane`` (N,) number of the plane that a point lies on.
    """

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
    """Noisy observations of pixels (V, N, 2) where ``seen`` (V, N), of points of two views or more."""
    point, view = np.nonzero((seen & (seen.sum(axis=0) >= 2)).T)
    noisy = xy[view, point] + sigma_px * rng.normal(size=(len(view), 2))
    return Tracks(view, point, noisy, *seen.shape)


def projective_from_truth(rig: Rig, tracks: Tracks, rng: np.random.Generator) -> Reconstruction:
    """The minimum of the projective bundle adjustment nearest to the truth, in a random projective frame."""
    n = len(rig.K)
    registered = np.ones(n, dtype=bool) if rig.flat is None else ~rig.flat
    P = camera_from_centre(rig.K, rig.R, rig.C)
    use = registered[tracks.view_index]
    use &= np.bincount(tracks.point_index[use], minlength=tracks.n_points)[tracks.point_index] >= 2
    X = np.column_stack([rig.X, np.ones(len(rig.X))])
    G = random_transform("projective", rng)
    P = P @ np.linalg.inv(G) * (rng.uniform(0.5, 2.0, n) * rng.choice([-1.0, 1.0], n))[:, None, None]
    X = X @ G.T * rng.choice([-1.0, 1.0], len(X))[:, None]
    seen = Observations(tracks.view_index[use], tracks.point_index[use], tracks.xy[use])
    fitted = refine_projective_bundle(P, X, seen, loss_px=10.0, max_iterations=30)
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
SEEN = 0.75  # Share of the points in a view's sight that it has an observation of


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


CAP_PX = 1000.0  # Image distances are capped here: a point in a focal plane projects to infinity


def beside(rng: np.random.Generator, views: int, points: int) -> Rig:
    """Draw cameras on a cap around a point cloud that all of them see."""
    rig = make_cloud(views, rng, points=points)
    return replace(rig, seen=np.ones_like(rig.seen))


def ahead(rng: np.random.Generator, views: int, points: int) -> Rig:
    """Draw cameras one behind the other, with the epipoles in the middle of the images."""
    rig = beside(rng, views, points)
    steps = np.column_stack([rng.normal(0.0, 0.05, (views, 2)), np.arange(views)])
    return replace(rig, R=np.repeat(rig.R[:1], views, axis=0), C=rig.C[0] + 0.5 * steps @ rig.R[0])


SCENES: dict[str, tuple[Callable[[np.random.Generator, int, int], Rig], int]] = {
    "two views beside each other": (beside, 2),
    "two views one ahead of the other": (ahead, 2),
    "five views": (beside, 5),
}


def frame_of(group: Group, rng: np.random.Generator) -> F64:
    """Draw a transform (4, 4) of space into a frame of this stratum."""
    G = random_transform("metric" if group == "projective" else group, rng)
    if group != "projective":
        return G
    normal = rng.normal(size=3)
    plane = np.eye(4)
    plane[3] = np.append(normal / np.linalg.norm(normal), rng.uniform(-8.0, 8.0))
    return G @ plane


def squared_distances(P: F64, X: F64, xy: F64) -> F64:
    """Return the sum (N,) over views of squared projection distances, each capped at ``CAP_PX``."""
    xh = np.einsum("vab,nb->vna", P, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = np.sum((xh[..., :2] / xh[..., 2:] - xy) ** 2, axis=2)
    return np.asarray(np.minimum(np.nan_to_num(squared, nan=np.inf), CAP_PX**2).sum(axis=0))


@dataclass(frozen=True)
class DrawnRig:
    """One draw: transform ``G`` (4, 4) of space, cameras ``P`` in that frame, noisy pixels ``xy`` (V, N, 2);
    true points ``X`` (N, 3) and the ``centre`` of the first camera before the transform.
    """

    G: F64
    P: F64
    xy: F64
    X: F64
    centre: F64

    def errors_pct(self, X: F64) -> F64:
        """Return distances (N,) of X (N, 4) from the true points, in % of theirs from the first camera."""
        off = np.linalg.norm(dehomogenize(X @ np.linalg.inv(self.G).T) - self.X, axis=1)
        share = off / np.linalg.norm(self.X - self.centre, axis=1)
        return np.asarray(np.nan_to_num(100.0 * share, nan=np.inf), dtype=np.float64)


def draw_rig(scene: str, sigma_px: float, frame: Group, rng: np.random.Generator, points: int) -> DrawnRig:
    """Draw a rig, its noise and its frame; the pixels do not depend on the frame."""
    make, views = SCENES[scene]
    rig = make(rng, views, points)
    exact = rig.pixels()
    seen = np.isfinite(exact).all(axis=(0, 2))
    xy = exact[:, seen] + sigma_px * rng.normal(size=(views, int(seen.sum()), 2))
    G = frame_of(frame, rng)
    return DrawnRig(G, camera_from_centre(rig.K, rig.R, rig.C) @ np.linalg.inv(G), xy, rig.X[seen], rig.C[0])


def random_transform(group: Group, rng: np.random.Generator) -> F64:
    """Draw a well-conditioned transform (4, 4) that belongs to no smaller group."""
    if group == "projective":
        return np.eye(4) + _shift_of_norm(rng, (4, 4), 0.5)
    G = np.eye(4)
    G[:3, 3], scale = rng.normal(size=3), float(np.exp(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 1.0)))
    if group == "affine":
        G[:3, :3] = scale * (np.eye(3) + _shift_of_norm(rng, (3, 3), 0.5))
    else:
        R = Rotation.random(random_state=rng).as_matrix()
        G[:3, :3] = scale * R if group == "metric" else R
    return G


def _shift_of_norm(rng: np.random.Generator, shape: tuple[int, int], norm: float) -> F64:
    """Noise whose norm below 1 keeps the identity plus it invertible."""
    noise = rng.normal(size=shape)
    return np.asarray(norm * noise / np.linalg.norm(noise))
