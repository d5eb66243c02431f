"""Light sources and the way a surface answers to them (2.6): Lambert's law and a highlight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.types import F32, F64, TexturedMesh
from thesisrecon.views.kernels import shade_points, sum_face_normals


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

    @property
    def row(self) -> list[float]:
        """As :func:`~thesisrecon.views.kernels.shade_points` takes it."""
        if self.position is not None:
            return [1.0, *self.position, *self.color]
        return [0.0, *(self.direction or (0.0, 0.0, 0.0)), *self.color]


@dataclass(frozen=True)
class Shading:
    """Light everywhere (``ambient``), ``lights``, and a highlight (Blinn 1977) of strength ``specular`` and
    width by ``shininess``. Both sides of a surface answer alike. Photographs hold the light they were taken
    in: a texture is as it was seen without any shading."""

    ambient: float = 0.3
    lights: tuple[Light, ...] = ()
    specular: float = 0.0
    shininess: float = 30.0

    def shade(self, color: F32, points: F32, normals: F32, eye: F64) -> None:
        """Light colours (P, 3), 0 to 255, in place, of points (P, 3) seen from ``eye`` (3,), with
        normals (P, 3) of any length."""
        lamps = np.array([light.row for light in self.lights], dtype=np.float64).reshape(-1, 7)
        surface = (float(self.ambient), float(self.specular), float(self.shininess))
        shade_points(color, points, normals, np.asarray(eye, dtype=np.float64), lamps, surface)


def vertex_normals(mesh: TexturedMesh) -> F64:
    """Unit normals (N, 3): the mean over the faces at a vertex, by their area."""
    total = np.zeros_like(mesh.vertices)
    sum_face_normals(mesh.vertices, mesh.faces, total)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None])
