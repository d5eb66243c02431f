"""The courtyard: an old yard with peeling walls, repeated windows, columns, a fountain, steps, crates and
ivy.

World frame in metres: x right along the back wall, y into it (the wall at y = 0, the yard at y < 0), z up.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from validation.scenes.materials import (
    Material,
    add_recess,
    add_window,
    blend,
    bricks,
    cut_stone,
    grid,
    grow_ivy,
    over,
    planks,
    plaster,
    rubble,
    smooth,
    spots,
    tinted,
)
from validation.scenes.procedural import fractal
from validation.scenes.raycast import Surface, World, build_world

TEXEL = 0.005
WALL_HEIGHT = 4.9
SUN = np.array([-0.42, -0.62, 0.72])
PI = 3.141592653589793
BACK, LEFT, RIGHT, GROUND, BASIN, URN, BARREL, STONE, WOOD, COLUMN = range(10)
COLUMN_SEEDS = (700, 705, 710)


def _back_wall() -> Material:
    """Plaster that peels off bricks over a stone plinth; seven windows above, six and a door below."""
    shape = grid((12.4, WALL_HEIGHT), TEXEL)
    wall, coat = bricks(shape, TEXEL, 100), plaster(shape, TEXEL, 120)
    coat = Material(coat.rgb, coat.height + np.float32(0.022), TEXEL)
    peel = fractal(shape, TEXEL, 140, wavelengths_m=(1.9, 0.03), ratio=0.62)
    wall = over(wall, coat, smooth(peel, -0.02, 0.015))
    z = (np.arange(shape[0], dtype=np.float32) * np.float32(TEXEL))[:, None] + np.zeros(shape, np.float32)
    plinth = cut_stone(shape, TEXEL, 160, (0.62, 0.30))
    plinth = Material(plinth.rgb, plinth.height + np.float32(0.03), TEXEL)
    wall = over(wall, plinth, 1.0 - smooth(z, 0.585, 0.605))
    band = cut_stone(shape, TEXEL, 170, (0.8, 0.2), (0.5, 0.46, 0.39))
    band = Material(band.rgb, band.height * np.float32(0.4) + np.float32(0.07), TEXEL)
    for low in (2.72, 4.68):
        wall = over(wall, band, smooth(0.1 - np.abs(z - (low + 0.09)), 0.0, 0.02))
    for k, x in enumerate((1.0, 2.6, 4.2, 8.2, 9.8, 11.4)):
        add_window(wall, (x - 0.42, 1.05, x + 0.42, 2.35), 200 + 10 * k)
    for k in range(7):
        x = 1.4 + 1.6 * k
        add_window(wall, (x - 0.4, 3.2, x + 0.4, 4.3), 300 + 10 * k)
    door = planks(grid((2.0, 3.0), TEXEL), TEXEL, 190, 0.155)
    add_recess(
        wall, (5.6, 0.3, 6.8, 2.5), Material(door.rgb * np.float32(1.25), door.height, TEXEL), depth_m=0.16
    )
    return wall


def _left_wall() -> Material:
    shape = grid((10.0, WALL_HEIGHT), TEXEL)
    wall = rubble(shape, TEXEL, 400, cell_m=0.26, relief_m=0.055)
    z = (np.arange(shape[0], dtype=np.float32) * np.float32(TEXEL))[:, None]
    patch = fractal(shape, TEXEL, 430, wavelengths_m=(2.6, 0.2), ratio=0.6)
    density = smooth(patch - 0.35 * (z - 1.6), 0.05, 0.5)
    return grow_ivy(wall, density, 440)


def _right_wall() -> Material:
    shape = grid((10.0, WALL_HEIGHT), TEXEL)
    wall = cut_stone(shape, TEXEL, 500, (0.55, 0.28))
    niche = rubble(grid((2.2, 3.4), TEXEL), TEXEL, 540, cell_m=0.15, relief_m=0.03)
    for k in range(4):
        x = 1.4 + 2.2 * k
        add_recess(wall, (x - 0.65, 0.7, x + 0.65, 3.1), niche, depth_m=0.13)
    z = (np.arange(shape[0], dtype=np.float32) * np.float32(TEXEL))[:, None]
    patch = fractal(shape, TEXEL, 570, wavelengths_m=(1.4, 0.15), ratio=0.65)
    return grow_ivy(wall, smooth(patch + 0.8 * (z - 4.2), 0.15, 0.5), 580)


def _ground() -> Material:
    shape = grid((12.6, 10.0), TEXEL)
    paving = rubble(shape, TEXEL, 600, cell_m=0.34, relief_m=0.022)
    earth_grain = fractal(shape, TEXEL, 640, wavelengths_m=(0.09, 2.5 * TEXEL), ratio=0.9)
    earth = Material(
        tinted((0.21, 0.165, 0.115), 0.8 + 0.35 * earth_grain), 0.018 + 0.004 * earth_grain, TEXEL
    )
    where = fractal(shape, TEXEL, 650, wavelengths_m=(1.8, 0.05), ratio=0.65)
    ground = over(paving, earth, smooth(where, 0.35, 0.5))
    ground = spots(ground, 660, share=0.09, cell_m=0.06, colour=(0.42, 0.39, 0.35))
    return spots(ground, 670, share=0.05, cell_m=0.1, colour=(0.36, 0.17, 0.04))


def _turned(
    size: tuple[float, float],
    profile: list[tuple[float, float]],
    seed: int,
    colour: tuple[float, float, float],
) -> Material:
    """A body of revolution of stained stone for a cylinder chart: ``profile`` lists (v, height)."""
    shape = grid(size, TEXEL)
    v = np.arange(shape[0], dtype=np.float64) * TEXEL
    curve = np.interp(v, [p[0] for p in profile], [p[1] for p in profile])[:, None]
    grain = fractal(shape, TEXEL, seed, wavelengths_m=(0.12, 2.5 * TEXEL), ratio=0.9, wrap=True)
    stain = fractal(shape, TEXEL, seed + 1, wavelengths_m=(0.5, 0.04), ratio=0.75, wrap=True)
    spot = smooth(fractal(shape, TEXEL, seed + 2, wavelengths_m=(0.1, 0.02), ratio=0.8, wrap=True), 0.5, 0.7)
    rgb = tinted(colour, 0.85 + 0.28 * grain + 0.2 * stain)
    rgb = blend(rgb, tinted((0.22, 0.23, 0.15), 1.0 + 0.3 * grain), 0.8 * spot)
    # The ends are smooth so that the discs that close them fit.
    calm = smooth(np.minimum(v, v[-1] - v).astype(np.float32), 0.0, 0.03)[:, None]
    return Material(rgb, (curve + 0.006 * grain * calm).astype(np.float32), TEXEL)


def _barrel() -> Material:
    size = (2 * PI * 0.3, 1.0)
    wood = planks(grid(size, TEXEL), TEXEL, 710, size[0] / 16)
    v = (np.arange(wood.shape[0], dtype=np.float32) * np.float32(TEXEL))[:, None]
    bulge = 0.09 * 4.0 * v * (1.0 - v)
    hoop = np.zeros(wood.shape, np.float32)
    for centre in (0.1, 0.28, 0.72, 0.9):
        hoop = np.maximum(hoop, smooth(0.03 - np.abs(v - centre) + 0.0 * hoop, 0.0, 0.008))
    rust = fractal(wood.shape, TEXEL, 720, wavelengths_m=(0.1, 2.5 * TEXEL), ratio=0.9, wrap=True)
    iron = Material(
        tinted((0.13, 0.09, 0.07), 0.9 + 0.5 * rust), np.full(wood.shape, 0.022, np.float32), TEXEL
    )
    body = over(Material(wood.rgb * np.float32(1.3), wood.height, TEXEL), iron, hoop)
    calm = smooth(np.minimum(v, 1.0 - v) + 0.0 * hoop, 0.0, 0.03)
    return Material(body.rgb, (body.height * calm + bulge).astype(np.float32), TEXEL)


def _column(seed: int) -> Material:
    """A drum of field stones with round ends; each column has other stones."""
    stones = rubble(grid((2 * PI * 0.22, 2.6), TEXEL), TEXEL, seed, cell_m=0.2, relief_m=0.02, wrap=True)
    row = np.arange(stones.shape[0])
    calm = smooth((np.minimum(row, row[-1] - row) * TEXEL).astype(np.float32), 0.0, 0.03)[:, None]
    return Material(stones.rgb * np.float32(1.5), stones.height * calm, TEXEL)


def _basin() -> Material:
    size = (2 * PI * 0.85, 0.7)
    rim = [(0.0, 0.0), (0.5, 0.0), (0.54, 0.1), (0.66, 0.1), (0.7, 0.07)]
    stones = rubble(grid(size, TEXEL), TEXEL, 730, cell_m=0.17, relief_m=0.03, wrap=True)
    ring = _turned(size, rim, 740, (0.5, 0.46, 0.39))
    z = (np.arange(stones.shape[0], dtype=np.float32) * np.float32(TEXEL))[:, None] + 0.0 * stones.height
    return over(stones, ring, smooth(z, 0.49, 0.51))


def _urn() -> Material:
    foot = [(0.0, 0.16), (0.12, 0.16), (0.16, 0.08), (0.3, 0.05), (0.36, 0.1), (0.42, 0.06)]
    bowl = [(0.6, 0.2), (0.8, 0.25), (0.92, 0.21), (0.98, 0.12), (1.04, 0.12), (1.08, 0.2), (1.14, 0.2)]
    return _turned((2 * PI * 0.2, 1.14), foot + bowl, 750, (0.5, 0.47, 0.42))


def build_materials(*, threads: int = 2) -> list[Material]:
    """The maps in the order of the constants above; the columns', one each, are the last."""
    makers: list[Callable[[], Material]] = [_back_wall, _left_wall, _right_wall, _ground]
    makers += [_basin, _urn, _barrel]
    makers.append(partial(cut_stone, grid((7.5, 2.5), TEXEL), TEXEL, 760, (0.7, 0.36), (0.48, 0.44, 0.37)))
    makers.append(partial(planks, grid((2.4, 2.4), TEXEL), TEXEL, 770, 0.14))
    makers += [partial(_column, seed) for seed in COLUMN_SEEDS]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(lambda make: make(), makers))


def _box(
    centre: tuple[float, float, float], size: tuple[float, float, float], material: int, turn: float = 0.0
) -> list[Surface]:
    """Six faces of a box that stands on z = centre[2], turned about z by 2 atan(turn)."""
    cos, sin = (1 - turn * turn) / (1 + turn * turn), 2 * turn / (1 + turn * turn)
    x, y, z = np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0]), np.array([0.0, 0.0, 1.0])
    c, (w, d, h) = np.array(centre), size
    at = (abs(centre[0]) % 0.9, abs(centre[1]) % 0.7)
    faces = [
        (c - 0.5 * w * x - 0.5 * d * y, x, z, (w, h)),
        (c + 0.5 * w * x - 0.5 * d * y, y, z, (d, h)),
        (c + 0.5 * w * x + 0.5 * d * y, -x, z, (w, h)),
        (c - 0.5 * w * x + 0.5 * d * y, -y, z, (d, h)),
        (c - 0.5 * w * x - 0.5 * d * y + h * z, x, y, (w, d)),
        (c + 0.5 * w * x - 0.5 * d * y, -x, y, (w, d)),
    ]
    faces = faces if centre[2] > 0 else faces[:5]
    stone = material == STONE
    return [
        Surface(o, u, v, s, material, flat=True, offset=(0.21 * k + at[0] * stone, 0.13 * k + at[1] * 0.3))
        for k, (o, u, v, s) in enumerate(faces)
    ]


def _drum(x: float, y: float, z: float, radius: float, size: tuple[float, float], material: int) -> Surface:
    along_x, _, along_z = np.eye(3)
    return Surface(np.array([x, y, z]), along_x, along_z, size, material, radius=radius)


def _lid(x: float, y: float, z: float, radius: float, material: int) -> Surface:
    (along_x, along_y, _), size = np.eye(3), (2 * radius, 2 * radius)
    origin, options = np.array([x - radius, y - radius, z]), {"disc": radius, "offset": (0.4, 0.2)}
    return Surface(origin, along_x, along_y, size, material, flat=True, **options)  # type: ignore[arg-type]


def build_objects() -> list[list[Surface]]:
    """Place all objects; small ones first, to shorten the search along the walls."""
    x, y, z = np.eye(3)
    walls = [
        Surface(np.array([-6.2, 0.0, 0.0]), x, z, (12.4, WALL_HEIGHT), BACK),
        Surface(np.array([-6.0, -9.9, 0.0]), y, z, (9.9, WALL_HEIGHT), LEFT),
        Surface(np.array([6.0, 0.0, 0.0]), -y, z, (9.9, WALL_HEIGHT), RIGHT),
        Surface(np.array([-6.3, -10.0, 0.0]), x, y, (12.6, 10.0), GROUND),
    ]
    objects = [_box((-0.6, -1.75, 3.05), (6.3, 0.4, 0.36), STONE)]
    for n, px in enumerate((-3.3, -0.95, 2.1)):
        drum = _drum(px, -1.75, 0.3, 0.22, (2 * PI * 0.22, 2.6), COLUMN + n)
        foot, head = (0.62, 0.62, 0.34), (0.56, 0.56, 0.17)
        objects += [_box((px, -1.75, 0.0), foot, STONE), [drum], _box((px, -1.75, 2.88), head, STONE)]
    for py, rise, size in (
        (-0.5, 0.0, (2.6, 1.0, 0.12)),
        (-0.36, 0.12, (2.0, 0.72, 0.12)),
        (-0.22, 0.24, (1.5, 0.44, 0.1)),
    ):
        objects.append(_box((0.0, py, rise), size, STONE))
    objects += _fountain(0.75, -3.3)
    objects.append(_box((4.3, -1.3, 0.0), (0.95, 0.95, 0.9), WOOD, 0.17))
    objects.append(_box((4.25, -1.35, 0.9), (0.6, 0.6, 0.55), WOOD, -0.1))
    objects.append(_box((4.8, -2.6, 0.0), (0.75, 0.75, 0.7), WOOD, -0.22))
    objects.append(_box((-4.9, -3.6, 0.0), (0.5, 2.0, 0.45), STONE, 0.03))
    for bx, by in ((-4.9, -1.3), (-4.15, -1.0)):
        objects.append([_drum(bx, by, 0.0, 0.3, (2 * PI * 0.3, 1.0), BARREL), _lid(bx, by, 1.0, 0.3, WOOD)])
    return objects + [[wall] for wall in walls]


def _fountain(x: float, y: float) -> list[list[Surface]]:
    basin = [_drum(x, y, 0.0, 0.85, (2 * PI * 0.85, 0.7), BASIN), _lid(x, y, 0.7, 0.92, STONE)]
    urn = [_drum(x, y, 1.05, 0.2, (2 * PI * 0.2, 1.14), URN), _lid(x, y, 2.19, 0.4, STONE)]
    return [basin, _box((x, y, 0.7), (0.5, 0.5, 0.35), STONE, 0.2), urn]


def build_courtyard() -> World:
    """The scene, ready to be traced (a few seconds)."""
    return build_world(build_objects(), build_materials(), SUN)


def build_yard(seed: int) -> World:
    """Another yard: the same walls in other places; crates, stones, barrels and columns drawn by the seed."""
    rng = np.random.default_rng([71, seed])
    x, y, z = np.eye(3)
    back, left, right = rng.permutation([BACK, LEFT, RIGHT])
    walls = [
        Surface(np.array([-6.2, 0.0, 0.0]), x, z, (12.4 if back == BACK else 9.9, WALL_HEIGHT), int(back)),
        Surface(np.array([-6.0, -9.9, 0.0]), y, z, (9.9, WALL_HEIGHT), int(left)),
        Surface(np.array([3.6, 0.0, 0.0]), -y, z, (9.9, WALL_HEIGHT), int(right)),
        Surface(np.array([-6.3, -10.0, 0.0]), x, y, (12.6, 10.0), GROUND),
    ]
    objects, places = list[list[Surface]](), list[np.ndarray]()
    while len(places) < 9:
        place = rng.uniform([-4.0, -4.4], [2.8, -0.7])
        if all(np.linalg.norm(place - other) > 1.2 for other in places):
            places.append(place)
            objects += _thing(float(place[0]), float(place[1]), rng)
    return build_world(objects + [[wall] for wall in walls], build_materials(), SUN)


def _thing(x: float, y: float, rng: np.random.Generator) -> list[list[Surface]]:
    """A crate with perhaps another one on it, a dressed stone, a barrel or a column."""
    kind, turn = int(rng.integers(4)), float(rng.uniform(-0.4, 0.4))
    width, height = float(rng.uniform(0.5, 0.95)), float(rng.uniform(0.4, 0.9))
    if kind == 0:
        crates = [_box((x, y, 0.0), (width, width, height), WOOD, turn)]
        return [*crates, _box((x, y, height), (0.6 * width, 0.6 * width, 0.5), WOOD, -turn)]
    if kind == 1:
        return [_box((x, y, 0.0), (width, 0.7 * width, 1.6 * height), STONE, turn)]
    if kind == 2:
        return [[_drum(x, y, 0.0, 0.3, (2 * PI * 0.3, 1.0), BARREL), _lid(x, y, 1.0, 0.3, WOOD)]]
    column = _drum(x, y, 0.3, 0.22, (2 * PI * 0.22, 2.6), COLUMN + int(rng.integers(len(COLUMN_SEEDS))))
    return [_box((x, y, 0.0), (0.62, 0.62, 0.34), STONE, turn), [column]]
