"""What surfaces of depth maps have in common: inverse depth with its gradient, normals, maps and meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from thesisrecon.geometry.camera import decompose_camera
from thesisrecon.model.depth_surface import surface_from_depth
from thesisrecon.types import F64, DepthMap, TexturedMesh


@dataclass(frozen=True)
class SurfaceSample:
    """A surface at places of its view: ``inverse_depth`` (N,) and its ``gradient`` (N, 2) per px along x and
    y; NaN where there is no surface."""

    inverse_depth: F64
    gradient: F64


class FittedSurface(Protocol):
    """A surface in front of the pixels of the depth map ``given`` that it was made from."""

    @property
    def given(self) -> DepthMap: ...

    @property
    def passes_through(self) -> bool:
        """Whether the depths of ``given`` are on the surface as they are."""

    def evaluate(self, xy: F64) -> SurfaceSample:
        """The surface at places ``xy`` (N, 2) px, between pixels too."""


class DepthSurface(Protocol):
    """A way of making a surface of a depth map."""

    def fit(self, depth_map: DepthMap) -> FittedSurface:
        """The surface; NaN wherever it would have to be made up."""


def normals(surface: FittedSurface, xy: F64) -> F64:
    """Unit normals (N, 3) in the world at ``xy`` (N, 2) px, towards the camera; NaN where no surface is.

    Near a pixel the surface is the plane a . (x, y, 1) = 1 / z, whose normal in the camera is -K' a.
    """
    K, R, _ = decompose_camera(surface.given.P)
    sample = surface.evaluate(xy)
    offset = sample.inverse_depth - np.sum(sample.gradient * xy, axis=1)
    normal = -np.column_stack([sample.gradient, offset]) @ K @ R
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def resampled(surface: FittedSurface, scale: float = 1.0) -> DepthMap:
    """The surface as a depth map of ``scale`` times as many rows and columns, 1 for those it was made from.

    Deviations and counts of views are those of the nearest pixel that was given: what neighbouring pixels
    share of their errors no fit can tell. Raises ``ValueError`` where ``scale`` is not positive.
    """
    if not scale > 0.0:
        raise ValueError(f"scale must be positive; got {scale}")
    given = surface.given
    if scale == 1.0 and surface.passes_through:
        return given
    shape = tuple(max(round(n * scale), 1) for n in given.depth.shape)
    places = [(np.arange(n) + 0.5) / scale - 0.5 for n in shape]
    xy = np.stack(np.meshgrid(places[1], places[0]), axis=-1).reshape(-1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = surface.evaluate(xy).inverse_depth.reshape(shape)
        depth = np.where(rho > 0.0, 1.0 / rho, np.nan).astype(np.float32)
    nearest = np.ix_(
        *(
            np.clip(np.rint(at), 0, n - 1).astype(np.int64)
            for at, n in zip(places, given.depth.shape, strict=True)
        )
    )
    known = np.isfinite(depth)
    zoom = np.array([[scale, 0.0, 0.5 * scale - 0.5], [0.0, scale, 0.5 * scale - 0.5], [0.0, 0.0, 1.0]])
    return replace(
        given,
        P=zoom @ given.P,
        depth=depth,
        std=np.where(known, given.std[nearest], np.float32(np.nan)),
        views=np.where(known, given.views[nearest], np.uint8(0)),
    )


def sampled_mesh(surface: FittedSurface, scale: float = 1.0, *, grazing_deg: float = 10.0) -> TexturedMesh:
    """The surface in triangles, ``scale`` of them along the side of a pixel; it breaks where
    :func:`~thesisrecon.model.depth_surface.surface_from_depth` says."""
    return surface_from_depth(resampled(surface, scale), grazing_deg=grazing_deg)
