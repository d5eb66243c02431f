"""Rigs of the thesis' comparison of triangulation methods, in metric, affine and projective frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.camera import compose_camera
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.strata import Group
from validation.scenes.rigs import Rig, make_cloud
from validation.scenes.transforms import random_transform

CAP_PX = 1000.0
"""Image distances are capped here: a point in a focal plane projects to infinity."""


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
    """Draw a transform (4, 4) of space into a frame of this stratum.

    In a projective frame the plane at infinity has any direction and lies up to 8 units from the middle of
    the scene, whose points reach 3 units and whose cameras are 6 to 9 units away.
    """
    G = random_transform("metric" if group == "projective" else group, rng)
    if group != "projective":
        return G
    normal = rng.normal(size=3)
    plane = np.eye(4)
    plane[3] = np.append(normal / np.linalg.norm(normal), rng.uniform(-8.0, 8.0))
    return G @ plane


def cameras_of(rig: Rig) -> F64:
    """Return P (V, 3, 4) of the rig."""
    return compose_camera(rig.K, rig.R, -np.einsum("vab,vb->va", rig.R, rig.C))


def squared_distances(P: F64, X: F64, xy: F64) -> F64:
    """Return the sum (N,) over views of squared projection distances, each capped at ``CAP_PX``."""
    xh = np.einsum("vab,nb->vna", P, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = np.sum((xh[..., :2] / xh[..., 2:] - xy) ** 2, axis=2)
    return np.asarray(np.minimum(np.nan_to_num(squared, nan=np.inf), CAP_PX**2).sum(axis=0))


@dataclass(frozen=True)
class DrawnRig:
    """One draw.

    ``G`` (4, 4): transform of space; ``P`` (V, 3, 4): cameras in the transformed frame; ``xy`` (V, N, 2):
    noisy pixels; ``X`` (N, 3): true points before the transform; ``centre`` (3,): centre of the first
    camera.
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
    return DrawnRig(G, cameras_of(rig) @ np.linalg.inv(G), xy, rig.X[seen], rig.C[0])
