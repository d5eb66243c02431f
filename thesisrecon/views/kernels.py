"""Compiled loops of rendering; each has a plain twin in the tests."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F32, F64, I64


@njit(cache=True, nogil=True)
def sum_face_normals(vertices: F64, faces: I64, total: F64) -> None:
    """Add to ``total`` (N, 3), for each vertex, the cross products of the sides of its faces: their normals
    by twice their areas."""
    for m in range(faces.shape[0]):
        i, j, l = faces[m, 0], faces[m, 1], faces[m, 2]
        ux, uy, uz = (
            vertices[j, 0] - vertices[i, 0],
            vertices[j, 1] - vertices[i, 1],
            vertices[j, 2] - vertices[i, 2],
        )
        vx, vy, vz = (
            vertices[l, 0] - vertices[i, 0],
            vertices[l, 1] - vertices[i, 1],
            vertices[l, 2] - vertices[i, 2],
        )
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for v in (i, j, l):
            total[v, 0] += nx
            total[v, 1] += ny
            total[v, 2] += nz


@njit(cache=True, nogil=True)
def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = max(np.sqrt(x * x + y * y + z * z), 1e-20)
    return x / length, y / length, z / length


@njit(cache=True, nogil=True)
def shade_points(
    color: F32, points: F32, normals: F32, eye: F64, lamps: F64, surface: tuple[float, float, float]
) -> None:
    """Turn colours (P, 3), 0 to 255, into what the eye (3,) sees of them under lamps.

    ``points``, ``normals`` (P, 3), the latter of any length, turned towards the eye; those of length 0 have
    no lamp's light. ``lamps`` (L, 7): 1 and a position, or 0 and the direction towards the lamp, and its
    colour. ``surface``: ambient light, strength and exponent of the highlight.
    """
    ambient, specular, shininess = surface
    for p in range(color.shape[0]):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        nx, ny, nz = _unit(normals[p, 0], normals[p, 1], normals[p, 2])
        ex, ey, ez = _unit(eye[0] - px, eye[1] - py, eye[2] - pz)
        if nx * ex + ny * ey + nz * ez < 0.0:
            nx, ny, nz = -nx, -ny, -nz
        light_r = light_g = light_b = ambient
        shine_r = shine_g = shine_b = 0.0
        for k in range(lamps.shape[0]):
            at = lamps[k, 0]
            lx, ly, lz = _unit(lamps[k, 1] - at * px, lamps[k, 2] - at * py, lamps[k, 3] - at * pz)
            cosine = nx * lx + ny * ly + nz * lz
            if cosine <= 0.0:
                continue
            light_r += cosine * lamps[k, 4]
            light_g += cosine * lamps[k, 5]
            light_b += cosine * lamps[k, 6]
            if specular > 0.0:
                hx, hy, hz = _unit(lx + ex, ly + ey, lz + ez)
                shine = 255.0 * specular * max(nx * hx + ny * hy + nz * hz, 0.0) ** shininess
                shine_r += shine * lamps[k, 4]
                shine_g += shine * lamps[k, 5]
                shine_b += shine * lamps[k, 6]
        color[p, 0] = np.float32(color[p, 0] * light_r + shine_r)
        color[p, 1] = np.float32(color[p, 1] * light_g + shine_g)
        color[p, 2] = np.float32(color[p, 2] * light_b + shine_b)


@njit(cache=True, nogil=True)
def average_blocks(color: F32, drawn: I64, samples: int, background: F32, out: np.ndarray) -> None:
    """Means of ``samples`` x ``samples`` blocks of colours (samples H, samples W, 3), the background (3,)
    where ``drawn`` < 0, rounded into ``out`` (H, W, 3) uint8."""
    total = np.empty(3, dtype=np.float32)
    share = np.float32(1.0 / (samples * samples))
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            total[:] = np.float32(0.0)
            for v in range(samples * y, samples * (y + 1)):
                for u in range(samples * x, samples * (x + 1)):
                    for k in range(3):
                        total[k] += color[v, u, k] if drawn[v, u] >= 0 else background[k]
            for k in range(3):
                out[y, x, k] = np.uint8(min(max(np.rint(total[k] * share), 0.0), 255.0))
