"""The surfaces of the courtyard: colour and relief maps built from procedural patterns.

A :class:`Material` holds linear RGB in [0, 1] and height in metres above the surface's base, both (H, W).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thesisrecon.arrays import F32
from validation.scenes.procedural import cells, courses, fractal, ivy

Colour = tuple[float, float, float]
Box = tuple[float, float, float, float]


class Material(NamedTuple):
    """Linear ``rgb`` (H, W, 3), ``height`` (H, W) in metres; sample (row, col) at (col, row) texel_m."""

    rgb: F32
    height: F32
    texel_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) samples."""
        return self.height.shape[0], self.height.shape[1]


def smooth(x: F32, low: float, high: float) -> F32:
    """The cubic step from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t), dtype=np.float32)


def tinted(colour: Colour, factor: F32) -> F32:
    """One colour times a map: (H, W, 3)."""
    return (np.array(colour, np.float32) * factor[..., None]).astype(np.float32)


def blend(a: F32, b: F32, weight: F32) -> F32:
    """a where the weight is 0, b where it is 1; colours or heights."""
    w = weight[..., None] if a.ndim == 3 else weight
    return (a + (b - a) * w).astype(np.float32)


def over(below: Material, above: Material, weight: F32) -> Material:
    """One material laid over another."""
    return Material(
        blend(below.rgb, above.rgb, weight), blend(below.height, above.height, weight), below.texel_m
    )


def grid(size_m: tuple[float, float], texel_m: float) -> tuple[int, int]:
    """(H, W) of a map of (width, height) metres."""
    return round(size_m[1] / texel_m) + 1, round(size_m[0] / texel_m) + 1


def bricks(shape: tuple[int, int], texel_m: float, seed: int) -> Material:
    """Red bricks with recessed mortar, of different colours, weathered."""
    edge, label = courses(shape, texel_m, seed, block_m=(0.25, 0.085))
    grain = fractal(shape, texel_m, seed + 1, wavelengths_m=(0.08, 2.5 * texel_m), ratio=0.8)
    inside = smooth(edge, 0.004, 0.013)
    shade = 0.62 + 0.75 * label + 0.22 * grain
    brick = tinted((0.36, 0.15, 0.09), shade) + tinted((0.03, 0.03, 0.05), np.float32(1.0) - label)
    mortar = tinted((0.42, 0.39, 0.34), 0.8 + 0.3 * grain)
    height = inside * (0.014 + 0.006 * label) + 0.003 * grain
    return Material(blend(mortar, brick, inside), height.astype(np.float32), texel_m)


def cut_stone(
    shape: tuple[int, int],
    texel_m: float,
    seed: int,
    block_m: tuple[float, float],
    colour: Colour = (0.44, 0.40, 0.33),
) -> Material:
    """Ashlar: large blocks with chiselled faces, lichen and dark joints."""
    edge, label = courses(shape, texel_m, seed, block_m=block_m, wobble_m=0.006)
    grain = fractal(shape, texel_m, seed + 1, wavelengths_m=(0.16, 2.5 * texel_m), ratio=0.85)
    stain = fractal(shape, texel_m, seed + 2, wavelengths_m=(1.2, 0.08), ratio=0.7)
    inside = smooth(edge, 0.006, 0.022)
    lichen = smooth(fractal(shape, texel_m, seed + 3, wavelengths_m=(0.12, 0.02), ratio=0.8), 0.55, 0.8)
    face = tinted(colour, 0.65 + 0.5 * label + 0.25 * grain + 0.16 * stain)
    face = blend(face, tinted((0.50, 0.46, 0.22), 0.8 + 0.3 * grain), 0.75 * lichen)
    joint = tinted((0.16, 0.145, 0.12), 0.8 + 0.3 * grain)
    height = inside * (0.022 + 0.014 * label) + 0.008 * grain
    return Material(blend(joint, face, inside), height.astype(np.float32), texel_m)


def rubble(
    shape: tuple[int, int], texel_m: float, seed: int, *, cell_m: float, relief_m: float, wrap: bool = False
) -> Material:
    """Irregular field stones of many colours; also the paving, flatter, and drums of columns, wrapped."""
    edge, label = cells(shape, texel_m, seed, cell_m=cell_m, wrap=wrap)
    grain = fractal(shape, texel_m, seed + 3, wavelengths_m=(0.1, 2.5 * texel_m), ratio=0.85, wrap=wrap)
    inside = smooth(edge, 0.01, 0.045)
    warm = np.mod(label * 7.31, 1.0).astype(np.float32)
    stone = tinted((0.30, 0.28, 0.26), 0.55 + 0.95 * label + 0.3 * grain)
    stone += tinted((0.10, 0.05, 0.0), warm * (0.8 + 0.2 * grain))
    speck = smooth(
        fractal(shape, texel_m, seed + 4, wavelengths_m=(0.06, 2.5 * texel_m), ratio=0.9, wrap=wrap), 0.5, 0.7
    )
    stone = blend(stone, 1.7 * stone, 0.5 * speck)
    joint = tinted((0.17, 0.145, 0.11), 0.75 + 0.45 * grain)
    bulge = inside * (0.55 + 0.3 * label) + 0.15 * smooth(edge, 0.0, 0.4 * cell_m)
    return Material(
        blend(joint, stone, inside), (relief_m * (bulge + 0.14 * grain)).astype(np.float32), texel_m
    )


def plaster(shape: tuple[int, int], texel_m: float, seed: int) -> Material:
    """Old ochre plaster: stains that ran down, patches, cracks and speckle."""
    u = np.arange(shape[1], dtype=np.float32)[None, :]
    tall = fractal(
        (shape[0] // 8 + 2, shape[1]), texel_m, seed, wavelengths_m=(0.4, 3.0 * texel_m), ratio=0.8
    )
    rows = np.arange(shape[0], dtype=np.float32) / 8.0
    low = rows.astype(np.int64)
    t = (rows - low)[:, None].astype(np.float32)
    runs = blend(tall[low], tall[low + 1], t + 0.0 * u)
    blotch = fractal(shape, texel_m, seed + 1, wavelengths_m=(1.6, 0.05), ratio=0.75)
    speckle = fractal(shape, texel_m, seed + 2, wavelengths_m=(0.05, 2.5 * texel_m), ratio=0.95)
    crack = fractal(shape, texel_m, seed + 3, wavelengths_m=(0.9, 0.03), ratio=0.6)
    line = np.float32(1.0) - smooth(np.abs(crack), 0.004, 0.018)
    rgb = tinted((0.52, 0.41, 0.25), 0.95 + 0.18 * blotch + 0.13 * runs + 0.15 * speckle)
    rgb = blend(rgb, tinted((0.34, 0.31, 0.27), 0.9 + 0.2 * speckle), 0.8 * smooth(blotch, 0.25, 0.6))
    rgb = blend(rgb, tinted((0.13, 0.10, 0.08), np.ones(shape, np.float32)), 0.8 * line)
    height = 0.012 * blotch + 0.0025 * speckle - 0.006 * line
    return Material(rgb, height.astype(np.float32), texel_m)


def planks(shape: tuple[int, int], texel_m: float, seed: int, width_m: float) -> Material:
    """Weathered upright planks with grain, gaps and nail heads."""
    x = (np.arange(shape[1], dtype=np.float32) * np.float32(texel_m))[None, :]
    y = (np.arange(shape[0], dtype=np.float32) * np.float32(texel_m))[:, None]
    index = np.floor(x / width_m).astype(np.int64)
    place = x - index.astype(np.float32) * np.float32(width_m)
    gap = smooth(np.minimum(place, width_m - place), 0.003, 0.011)
    across = fractal(
        (shape[0] // 10 + 2, shape[1]), texel_m, seed, wavelengths_m=(0.06, 2.2 * texel_m), ratio=0.95
    )
    shift = (np.arange(shape[0])[:, None] // 10 + 0 * index) % across.shape[0]
    fibre = across[shift, np.arange(shape[1])[None, :]]
    blotch = fractal(shape, texel_m, seed + 1, wavelengths_m=(0.35, 0.03), ratio=0.8)
    tone = (np.mod(index * 0.618, 1.0)).astype(np.float32)
    rgb = tinted((0.27, 0.19, 0.12), (0.65 + 0.6 * tone + 0.25 * blotch + 0.22 * fibre) * (0.2 + 0.8 * gap))
    nail = (np.mod(y, 0.45) - 0.1) ** 2 + (place - 0.5 * width_m) ** 2 < 0.011**2
    rgb[nail] = np.array([0.05, 0.045, 0.045], np.float32)
    return Material(rgb, (gap * (0.012 + 0.004 * tone) + 0.002 * fibre).astype(np.float32), texel_m)


def border_distance(material: Material, box: Box, *, arch: bool = False) -> F32:
    """Signed distance (m) to the border of (left, bottom, right, top); ``arch`` rounds the top."""
    shape, texel = material.shape, np.float32(material.texel_m)
    x = (np.arange(shape[1], dtype=np.float32) * texel)[None, :]
    y = (np.arange(shape[0], dtype=np.float32) * texel)[:, None]
    left, bottom, right, top = box
    inside = np.minimum(np.minimum(x - left, right - x), np.minimum(y - bottom, top - y))
    if not arch:
        return np.asarray(inside, dtype=np.float32)
    radius = 0.5 * (right - left)
    spring = top - radius
    cap = radius - np.sqrt((x - 0.5 * (left + right)) ** 2 + (y - spring) ** 2)
    return np.asarray(np.where(y > spring, cap, inside), dtype=np.float32)


def _region(material: Material, box: Box, margin: float) -> tuple[slice, slice, Box]:
    t = material.texel_m
    c0, r0 = max(0, int((box[0] - margin) / t)), max(0, int((box[1] - margin) / t))
    c1, r1 = int((box[2] + margin) / t) + 2, int((box[3] + margin) / t) + 2
    local = (box[0] - c0 * t, box[1] - r0 * t, box[2] - c0 * t, box[3] - r0 * t)
    return slice(r0, r1), slice(c0, c1), local


def add_window(material: Material, box: Box, seed: int) -> None:
    """Cut a window into a wall, in place: stone frame, recess, bars, dark panes with dirt, and a sill."""
    rows, cols, local = _region(material, box, 0.3)
    part = Material(material.rgb[rows, cols], material.height[rows, cols], material.texel_m)
    shape, texel = part.shape, part.texel_m
    d = border_distance(part, local)
    grain = fractal(shape, texel, seed, wavelengths_m=(0.12, 2.5 * texel), ratio=0.85)
    frame = smooth(d, -0.135, -0.125) * (1.0 - smooth(d, -0.004, 0.004))
    stone = Material(tinted((0.50, 0.46, 0.39), 0.85 + 0.25 * grain), 0.045 + 0.005 * grain, texel)
    sill = border_distance(part, (local[0] - 0.2, local[1] - 0.17, local[2] + 0.2, local[1] - 0.03))
    slab = Material(stone.rgb * np.float32(0.85), stone.height + np.float32(0.045), texel)
    x = (np.arange(shape[1], dtype=np.float32) * np.float32(texel) - local[0])[None, :]
    y = (np.arange(shape[0], dtype=np.float32) * np.float32(texel) - local[1])[:, None]
    w, h = local[2] - local[0], local[3] - local[1]
    bar = np.minimum(np.abs(x - 0.5 * w) - 0.028, np.minimum(np.abs(y - h / 3), np.abs(y - 2 * h / 3)) - 0.02)
    bars = 1.0 - smooth(np.minimum(bar, d - 0.055).astype(np.float32), -0.004, 0.008)
    dirt = fractal(shape, texel, seed + 3, wavelengths_m=(0.5, 0.02), ratio=0.8)
    pane = tinted((0.035, 0.045, 0.055), 1.0 + 0.5 * np.clip(dirt, -1, 1)) + tinted(
        (0.08, 0.075, 0.065), smooth(dirt, 0.2, 1.0)
    )
    glass = Material(pane, np.full(shape, -0.15, np.float32), texel)
    wood = Material(tinted((0.20, 0.27, 0.22), 0.9 + 0.35 * grain), np.full(shape, -0.11, np.float32), texel)
    result = over(over(part, stone, frame), slab, smooth(sill, 0.0, 0.012))
    result = over(result, over(glass, wood, bars), smooth(d, 0.0, 0.03))
    material.rgb[rows, cols], material.height[rows, cols] = result.rgb, result.height


def add_recess(material: Material, box: Box, inner: Material, *, depth_m: float, arch: bool = True) -> None:
    """Sink a door or a blind arch into a wall, in place, with a raised stone surround."""
    rows, cols, local = _region(material, box, 0.35)
    part = Material(material.rgb[rows, cols], material.height[rows, cols], material.texel_m)
    shape, texel = part.shape, part.texel_m
    d = border_distance(part, local, arch=arch)
    stone = cut_stone(shape, texel, 900 + int(100 * box[0]), (0.33, 0.24), (0.52, 0.48, 0.40))
    surround = Material(stone.rgb, 0.035 + stone.height * np.float32(0.5), texel)
    fill = Material(
        inner.rgb[: shape[0], : shape[1]], inner.height[: shape[0], : shape[1]] - np.float32(depth_m), texel
    )
    result = over(over(part, surround, smooth(d, -0.22, -0.205)), fill, smooth(d, 0.0, 0.035))
    material.rgb[rows, cols], material.height[rows, cols] = result.rgb, result.height


def grow_ivy(material: Material, density: F32, seed: int) -> Material:
    """Cover a wall with ivy where ``density`` (H, W) allows; leaves stand off the wall."""
    height, tint = ivy(material.shape, material.texel_m, seed, density=density)
    leaf = (height > 0).astype(np.float32)
    green = tinted((0.10, 0.20, 0.035), 0.45 + 1.1 * tint) + tinted((0.05, 0.02, 0.0), smooth(tint, 0.7, 1.0))
    lifted = Material(green, (np.maximum(material.height, 0.0) + height).astype(np.float32), material.texel_m)
    return over(material, lifted, leaf)


def spots(material: Material, seed: int, *, share: float, cell_m: float, colour: Colour) -> Material:
    """Scattered pebbles, leaves or marks: round dots of one colour with small relief."""
    edge, label = cells(material.shape, material.texel_m, seed, cell_m=cell_m)
    core = smooth(edge, 0.3 * cell_m, 0.4 * cell_m) * (label < share)
    factor = 0.6 + 0.8 * np.mod(label * 37.0, 1.0).astype(np.float32)
    dots = Material(tinted(colour, factor), material.height + np.float32(0.1 * cell_m), material.texel_m)
    return over(material, dots, core.astype(np.float32))
