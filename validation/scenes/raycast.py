"""A small ray caster for surfaces with true relief: displaced planes and cylinders, sun, sky, cast shadows.

A surface is a chart: a point is (u, v, h), h metres above the base plane or base cylinder, and the solid is
where h is below the surface's height map. A ray is marched through the slab of the map, in steps no longer
than the map's slope allows or half a texel, and the crossing is then refined: depth is that of the bilinear
height map to a few micrometres. Shading is Lambertian, so a scene point has one colour from everywhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.lens import directions_of_image
from validation.scenes.kernels import BLOCK, CYLINDER, LEVELS, PLANE, trace_rows
from validation.scenes.materials import Material, smooth
from validation.scenes.pose import Pose


class Surface(NamedTuple):
    """A chart in the world: ``origin`` (3,), unit axes, ``size`` (u, v) metres, its ``material``. A plane's
    normal is u x v. A cylinder's axis is v, its ``radius`` that of the base; u runs around it once. ``disc``
    > 0 keeps of a plane only what lies within that radius of its middle. ``flat`` takes the relief for
    shading only (faces of boxes, so that their edges close). ``offset``: where on the map (0, 0) lies.
    """

    origin: F64
    u_axis: F64
    v_axis: F64
    size: tuple[float, float]
    material: int
    radius: float = 0.0
    disc: float = 0.0
    flat: bool = False
    offset: tuple[float, float] = (0.0, 0.0)


class World(NamedTuple):
    """Surfaces packed for the kernels: see :func:`build_world`."""

    kind: I64
    numbers: F64
    groups: F64
    layout: I64
    colours: F32
    heights: F32
    highest: F32
    sun: F64


def _baked(material: Material) -> F32:
    """(H, W, 5): colour times cavity darkening, and the two slopes of the height map."""
    h = material.height.astype(np.float64)
    t = material.texel_m
    slope_u, slope_v = np.zeros_like(h), np.zeros_like(h)
    slope_u[:, 1:-1] = (h[:, 2:] - h[:, :-2]) / (2 * t)
    slope_v[1:-1] = (h[2:] - h[:-2]) / (2 * t)
    mean = h
    for _ in range(3):
        mean = _box_blur(_box_blur(mean, 4).T, 4).T
    cavity = smooth((h - mean).astype(np.float32), -0.02, 0.006)
    rgb = material.rgb * (0.45 + 0.55 * cavity)[..., None]
    return np.concatenate([rgb, slope_u[..., None], slope_v[..., None]], axis=2).astype(np.float32)


def _box_blur(a: F64, radius: int) -> F64:
    padded = np.pad(a, ((radius, radius), (0, 0)), mode="edge")
    total = np.zeros_like(a)
    for shift in range(2 * radius + 1):
        total += padded[shift : shift + a.shape[0]]
    return total / (2 * radius + 1)


def _halved(a: F32) -> F32:
    """The next level: sample (r, c) is the mean of the four around (2r + 0.5, 2c + 0.5)."""
    rows, cols = a.shape[0] // 2, a.shape[1] // 2
    a = a[: 2 * rows, : 2 * cols]
    return (0.25 * (a[0::2, 0::2] + a[1::2, 0::2] + a[0::2, 1::2] + a[1::2, 1::2])).astype(np.float32)


def _block_maxima(height: F32) -> F32:
    """Highest point of each block of BLOCK x BLOCK map cells, its far border included."""
    rows, cols = -(-height.shape[0] // BLOCK), -(-height.shape[1] // BLOCK)
    padded = np.pad(
        height,
        ((0, rows * BLOCK + 1 - height.shape[0]), (0, cols * BLOCK + 1 - height.shape[1])),
        mode="edge",
    )
    top = np.full((rows, cols), -np.inf, np.float32)
    for r in range(BLOCK + 1):
        for c in range(BLOCK + 1):
            top = np.maximum(top, padded[r : r + rows * BLOCK : BLOCK, c : c + cols * BLOCK : BLOCK])
    return top


def _pack(materials: list[Material]) -> tuple[I64, F32, F32, F32]:
    """Offsets of heights, blocks and texture levels of each material, and the pools."""
    layout = np.zeros((len(materials), 3 + 3 * LEVELS), np.int64)
    colours: list[F32] = []
    heights: list[F32] = []
    highest: list[F32] = []
    at_colour = at_height = at_block = 0
    for m, material in enumerate(materials):
        blocks = _block_maxima(material.height)
        layout[m, :3] = at_height, at_block, blocks.shape[1]
        heights.append(material.height.ravel())
        highest.append(blocks.ravel())
        at_height += material.height.size
        at_block += blocks.size
        level = _baked(material)
        for k in range(LEVELS):
            layout[m, 3 + 3 * k : 6 + 3 * k] = at_colour, level.shape[0], level.shape[1]
            colours.append(level.reshape(-1, 5))
            at_colour += level.shape[0] * level.shape[1]
            level = _halved(level)
    return layout, np.concatenate(colours), np.concatenate(heights), np.concatenate(highest)


def build_world(objects: list[list[Surface]], materials: list[Material], sun: F64) -> World:
    """Pack a scene: surfaces that stand together form an object; ``sun`` is the direction to the light, any
    length. Columns of ``World.numbers``: origin, u, v, normal (12), size (2), radius, disc, lowest and
    highest height (2), steepest slope, texel, offset (2), bounding sphere (4), flat.
    """
    layout, colours, heights, highest = _pack(materials)
    surfaces = [surface for group in objects for surface in group]
    numbers = np.zeros((len(surfaces), 27))
    for s, surface in enumerate(surfaces):
        material = materials[surface.material]
        normal = np.cross(surface.u_axis, surface.v_axis)
        low, high, slope = 0.0, 0.0, 0.0
        if not surface.flat:
            h = material.height.astype(np.float64)
            low, high = float(h.min()) - 1e-4, float(h.max()) + 1e-4
            along_u, along_v = np.abs(np.diff(h, axis=1)).max(), np.abs(np.diff(h, axis=0)).max()
            slope = float(np.sqrt(along_u**2 + along_v**2)) / material.texel_m
        middle = surface.origin + 0.5 * surface.size[1] * surface.v_axis
        reach = np.sqrt((surface.radius + high) ** 2 + 0.25 * surface.size[1] ** 2)
        if not surface.radius:
            middle = middle + 0.5 * surface.size[0] * surface.u_axis
            reach = 0.5 * np.sqrt(surface.size[0] ** 2 + surface.size[1] ** 2) + max(high, -low)
        axes = [surface.origin, surface.u_axis, surface.v_axis, normal]
        relief = [low, high, slope, material.texel_m]
        shape = [*surface.size, surface.radius, surface.disc, *relief, *surface.offset]
        numbers[s] = np.concatenate([*axes, shape, middle, [reach, float(surface.flat)]])
    kind = np.array([[CYLINDER if s.radius else PLANE, s.material] for s in surfaces], np.int64)
    length = float(np.sqrt(np.sum(np.asarray(sun, float) ** 2)))
    groups = _group_bounds(objects, numbers)
    return World(kind, numbers, groups, layout, colours, heights, highest, np.asarray(sun, float) / length)


def _group_bounds(objects: list[list[Surface]], numbers: F64) -> F64:
    """Per object: bounding sphere (4) and the half-open range of its surfaces (2)."""
    bounds = np.zeros((len(objects), 6))
    first = 0
    for g, group in enumerate(objects):
        last = first + len(group)
        low = (numbers[first:last, 22:25] - numbers[first:last, 25:26]).min(axis=0)
        high = (numbers[first:last, 22:25] + numbers[first:last, 25:26]).max(axis=0)
        middle = 0.5 * (low + high)
        gap = np.sqrt(((numbers[first:last, 22:25] - middle) ** 2).sum(axis=1)) + numbers[first:last, 25]
        bounds[g] = [*middle, gap.max(), first, last]
        first = last
    return bounds


def trace(
    world: World, pose: Pose, size: tuple[int, int], *, per_pixel: int = 1, shade: bool = True
) -> tuple[F32, F64]:
    """Return linear RGB (H n, W n, 3) and depth (H n, W n) of a camera, z in metres, 0 = sky or no ray.
    ``size`` is (width, height), n = ``per_pixel`` samples along each axis; sample (r, c) looks at pixel ((c +
    0.5) / n - 0.5, ...). Without ``shade`` the colours are zero. The exposure of ``pose`` is not used.
    """
    out = np.zeros((size[1] * per_pixel, size[0] * per_pixel, 3), np.float32)
    depth = np.zeros(out.shape[:2])
    K = pose.K
    camera = np.concatenate([[K[0, 0], K[0, 2], K[1, 2]], pose.C, pose.R.ravel()])
    rays = np.empty((0, 0, 3))
    if pose.lens is not None:
        x, y = ((np.arange(side * per_pixel) + 0.5) / per_pixel - 0.5 for side in size)
        places = np.stack(np.meshgrid((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[0, 0]), axis=-1)
        rays = directions_of_image(places.reshape(-1, 2), pose.lens).reshape(*places.shape[:2], 3)
    trace_rows((*world,), camera, (per_pixel, 0), rays, out, depth, shade)
    return out, depth
