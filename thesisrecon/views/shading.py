"""Light sources and the way a surface answers to them (2.6): Lambert's law and a highlight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.types import F32, F64, TexturedMesh


@dataclass(frozen=True)
class Light:
    """A lamp: at ``position`` (3,), or far away in ``direction`` (3,), the one towards it; ``color`` is its
    strength in red, green and blue, 1 as bright as the texture says. Exactly one of the two is given."""

    direction: tuple[float, float, float] | None = None
    position: tuple[float, float, float] | None = None
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if (self.direction is None) == (self.position is None):
            raise ValueError("a Light has either a direction or a position")
        if self.direction is not None and not np.linalg.norm(self.direction) > 0.0:
            raise ValueError("the direction of a Light must not be zero")

    def towards(self, points: F32) -> F32:
        """Unit vectors (N, 3) from points (N, 3) to the lamp."""
        if self.direction is not None:
            unit = np.asarray(self.direction) / np.linalg.norm(self.direction)
            return np.broadcast_to(unit.astype(np.float32), points.shape)
        offset = np.asarray(self.position, dtype=np.float32) - points
        return _unit(offset)


@dataclass(frozen=True)
class Shading:
    """Light everywhere (``ambient``), ``lights``, and a highlight (Blinn 1977) of strength ``specular`` and
    width by ``shininess``. Both sides of a surface answer alike. Photographs hold the light they were taken
    in: a texture is as it was seen without any shading."""

    ambient: float = 0.3
    lights: tuple[Light, ...] = ()
    specular: float = 0.0
    shininess: float = 30.0

    def shade(self, color: F32, points: F32, normals: F32, eye: F64) -> F32:
        """Colours (N, 3) 0..255 of points (N, 3) with unit normals (N, 3) seen from ``eye`` (3,)."""
        to_eye = _unit(eye.astype(np.float32) - points)
        normals = normals * np.where((normals * to_eye).sum(axis=1) < 0.0, -1.0, 1.0)[:, None].astype(
            np.float32
        )
        light = np.full_like(color, self.ambient)
        shine = np.zeros_like(color)
        for lamp in self.lights:
            to_lamp = lamp.towards(points)
            strength = np.asarray(lamp.color, dtype=np.float32)
            cosine = np.maximum((normals * to_lamp).sum(axis=1), 0.0)
            light += cosine[:, None] * strength
            half = np.maximum((normals * _unit(to_lamp + to_eye)).sum(axis=1), 0.0) * (cosine > 0.0)
            shine += (255.0 * self.specular * half**self.shininess)[:, None] * strength
        shaded: F32 = color * light + shine
        return shaded


def vertex_normals(mesh: TexturedMesh) -> F64:
    """Unit normals (N, 3): the mean over the faces at a vertex, by their area."""
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(mesh.vertices)
    for k in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(mesh.faces[:, k], across[:, axis], minlength=len(total))
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None])


def _unit(vectors: F32) -> F32:
    length = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.float32(1e-20))
    unit: F32 = (vectors / length).astype(np.float32)
    return unit
