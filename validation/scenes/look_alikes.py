"""Rendered scenes of places that look alike: towers with equal sides, equal rooms, rows of houses, windows.

Every scene also has something that is there only once: its ground, and with more ``detail`` signs and crates.
"""

from __future__ import annotations

from math import pi, tan
from typing import NamedTuple

import numpy as np

from thesisrecon.arrays import F64
from validation.scenes.courtyard import SUN, _box
from validation.scenes.materials import (
    Material,
    add_recess,
    add_window,
    bricks,
    cut_stone,
    grid,
    planks,
    plaster,
    rubble,
)
from validation.scenes.pose import Pose, look_at
from validation.scenes.raycast import Surface, World, build_world

SIZE, TEXEL, HEIGHT = (320, 240), 0.015, 4.0
GROUND, SIGN, WOOD, FRONT = range(4)
"""Materials of all scenes; the walls follow."""
TOWERS = tuple(f"{shape} tower, {n} equal sides" for shape in ("flat", "round") for n in (2, 3, 4, 6))
KINDS = (*TOWERS, "two equal rooms", "equal houses", "a row of equal windows")
SCENES = [(kind, d, seed) for kind in KINDS for d in range(3 if kind in TOWERS else 2) for seed in range(2)]
"""Kind, detail and seed of the 60 scenes; only towers have crates."""


class LookAlike(NamedTuple):
    """A scene and its true cameras."""

    world: World
    poses: list[Pose]


def build_look_alike(kind: str, detail: int, seed: int) -> LookAlike:
    """A scene of one of the ``KINDS``: ``detail`` 0 has its ground only, 1 a sign, 2 signs and crates too."""
    rng = np.random.default_rng([91, KINDS.index(kind), detail, seed])
    views = int(rng.integers(8, 21))
    if "tower" in kind:
        n = int(kind.split(",")[1].split()[0])
        walls, fronts = (_flat_tower if "flat" in kind else _round_tower)(n, rng)
        angle = 2 * pi * (np.arange(views) + rng.uniform(-0.2, 0.2, views)) / views
        ends = [(6.5 * _circle(a), 0.4 * rng.normal(size=2)) for a in angle]
        places = [(1.9 * _circle(a), a) for a in rng.uniform(0, 2 * pi, 4)]
    elif "rooms" in kind:
        walls, fronts = _rooms(rng)
        room = np.arange(views) % 2
        angle = 2 * pi * np.arange(views) / views
        ends = [
            (np.array([20.0 * r, 0.0]) + 1.1 * _circle(a), np.array([20.0 * r, 0.0]) - 2.0 * _circle(a))
            for r, a in zip(room, angle, strict=True)
        ]
        places = [(np.array([20.0 * (k % 2) + 1.5, 0.7 * k - 1.0]), pi) for k in range(4)]
    else:
        walls, fronts = _row(6.0 if "houses" in kind else 1.6, rng)
        x = np.linspace(-6.0, 6.0, views) + rng.uniform(-0.1, 0.1, views)
        ends = [(np.array([at, -7.0]), np.array([at + rng.uniform(-1, 1), 0.0])) for at in x]
        places = [(np.array([at, -0.4]), -pi / 2) for at in rng.uniform(-7, 7, 4)]
    area = (26.0, 8.0) if "tower" not in kind else (18.0, 18.0)
    ground = rubble(grid(area, TEXEL), TEXEL, 100 * seed + 7, cell_m=0.4, relief_m=0.02)
    sign = cut_stone(grid((1.6, 1.6), TEXEL), TEXEL, 50 + seed, (0.3, 0.2), (0.6, 0.2, 0.1))
    wood = planks(grid((1.6, 1.6), TEXEL), TEXEL, 60 + seed, 0.14)
    corner = {"tower": [-9.0, -9.0, 0.0], "rooms": [-3.0, -4.0, 0.0]}
    origin = next((np.array(at) for word, at in corner.items() if word in kind), np.array([-13.0, -7.9, 0.0]))
    x_axis, y_axis, _ = np.eye(3)
    floor = Surface(origin, x_axis, y_axis, area, GROUND, flat=True)
    objects = [[floor], *([wall] for wall in walls)]
    for k, (xy, turn) in enumerate(places[: (0, 1, 4)[detail]]):
        size = (0.7, 0.5, 1.1) if k % 2 == 0 else (0.6, 0.6, 0.6)
        objects.append(_box((float(xy[0]), float(xy[1]), 0.0), size, SIGN + k % 2, tan(turn / 2)))
    K = np.array([[0.9 * SIZE[0], 0, SIZE[0] / 2], [0, 0.9 * SIZE[0], SIZE[1] / 2], [0, 0, 1.0]])
    poses = []
    for (C, target), eye in zip(ends, rng.uniform(1.4, 2.0, views), strict=True):
        place = np.append(C, eye)
        aim = np.append(target, rng.uniform(1.5, 1.8) if "tower" in kind else 0.4)
        R = look_at(place, aim, float(rng.uniform(-0.03, 0.03)))
        poses.append(Pose(K, R, place, float(rng.uniform(0.9, 1.1))))
    return LookAlike(build_world(objects, [ground, sign, wood, *fronts], SUN), poses)


def _circle(angle: float) -> F64:
    return np.array([np.cos(angle), np.sin(angle)])


def _front(width: float, rng: np.random.Generator) -> Material:
    """A wall with a door and windows."""
    shape, seed = grid((width, HEIGHT), TEXEL), int(rng.integers(10**6))
    wall = [make(shape, TEXEL, seed) for make in (plaster, bricks)]
    wall.append(cut_stone(shape, TEXEL, seed, (0.5, 0.3)))
    front = wall[seed % 3]
    if width > 2.0:
        add_recess(front, (0.3, 0.05, 1.1, 1.9), wall[(seed + 1) % 3], depth_m=0.1)
    for left in np.arange(0.3, width - 0.9, 1.3):
        for low in (1.0, 2.6):
            if low > 2.0 or left > 1.1 or width < 2.0:
                add_window(front, (float(left), low, float(left) + 0.7, low + 0.9), seed + int(10 * left))
    return front


def _wall(middle: F64, angle: float, width: float, material: int) -> Surface:
    """An upright wall about a place of the ground, seen from the direction of ``angle``."""
    u = np.array([-np.sin(angle), np.cos(angle), 0.0])
    z = np.array([0.0, 0.0, 1.0])
    return Surface(np.append(middle, 0.0) - 0.5 * width * u, u, z, (width, HEIGHT), material)


def _flat_tower(n: int, rng: np.random.Generator) -> tuple[list[Surface], list[Material]]:
    sides, kinds = max(n, 4) if n == 2 else n, 2 if n == 2 else 1
    width = 11.0 / sides
    apothem = 0.5 * width / tan(pi / sides)
    angles = [2 * pi * k / sides for k in range(sides)]
    walls = [_wall(apothem * _circle(a), a, width, FRONT + k % kinds) for k, a in enumerate(angles)]
    return walls, [_front(width, rng) for _ in range(kinds)]


def _round_tower(n: int, rng: np.random.Generator) -> tuple[list[Surface], list[Material]]:
    one = _front(11.0 / n, rng)
    columns = round(11.0 / n / TEXEL)
    rgb, height = (np.tile(a[:, :columns], (1, n) + (1,) * (a.ndim - 2)) for a in (one.rgb, one.height))
    whole = Material(np.ascontiguousarray(rgb), np.ascontiguousarray(height), TEXEL)
    around = columns * n * TEXEL
    drum = Surface(np.zeros(3), np.eye(3)[0], np.eye(3)[2], (around, HEIGHT), FRONT, radius=around / (2 * pi))
    return [drum], [whole]


def _rooms(rng: np.random.Generator) -> tuple[list[Surface], list[Material]]:
    walls = list[Surface]()
    for x in (0.0, 20.0):
        for k in range(4):
            a = k * pi / 2
            walls.append(_wall(np.array([x, 0.0]) - 2.5 * _circle(a), a, 5.0, FRONT + k))
    return walls, [_front(5.0, rng) for _ in range(4)]


def _row(period: float, rng: np.random.Generator) -> tuple[list[Surface], list[Material]]:
    count = int(24.0 // period)
    middles = (np.arange(count) - 0.5 * (count - 1)) * period
    walls = [_wall(np.array([x, 0.0]), -pi / 2, period, FRONT) for x in middles]
    return walls, [_front(period, rng)]
