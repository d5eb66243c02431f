"""Rendered scenes of wide lenses: a yard from outside, a street, and the inside of a room.

Sets of images of 60 to 180 degrees along the long side, by radial, division and equidistant lenses.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.lens import image_of_directions, lens_row
from validation.scenes.courtyard import SUN, WALL_HEIGHT
from validation.scenes.many_views import TEXEL, WIDTH, _crate, _front
from validation.scenes.materials import cut_stone, grid, planks, rubble
from validation.scenes.pose import Pose, look_at
from validation.scenes.raycast import Surface, World, build_world

PRINCIPAL = (0.507, 0.494)  # principal point, as shares of the sides


def lens_camera(size: tuple[int, int], degrees: float, lens: str, coefficients: F64) -> tuple[F64, F64]:
    """K (3, 3) and the row of a lens whose images are ``degrees`` wide along the long side."""
    row = lens_row(lens, coefficients)
    half = np.radians(degrees / 2.0)
    ray = np.array([[np.sin(half), 0.0, np.cos(half)]])
    focal = max(size) / 2.0 / float(image_of_directions(ray, row)[0, 0])
    width, height = size
    return np.array([[focal, 0, PRINCIPAL[0] * width], [0, focal, PRINCIPAL[1] * height], [0, 0, 1.0]]), row


def build_room(seed: int) -> World:
    """A room of 8 x 8 m with four different walls and crates along them, seen from inside."""
    x, y, z = np.eye(3)
    half, high, plain = WIDTH / 2.0, WALL_HEIGHT, grid((WIDTH, WIDTH), TEXEL)
    materials = [_front(100 + 10 * seed + k) for k in range(4)]
    materials.append(rubble(plain, TEXEL, 2000 + seed, cell_m=0.16, relief_m=0.015))
    materials.append(planks(plain, TEXEL, 2100 + seed, 0.2))
    walls = [
        Surface(np.array([-half, half, 0.0]), x, z, (WIDTH, high), 0),
        Surface(np.array([-half, -half, 0.0]), y, z, (WIDTH, high), 1),
        Surface(np.array([half, half, 0.0]), -y, z, (WIDTH, high), 2),
        Surface(np.array([half, -half, 0.0]), -x, z, (WIDTH, high), 3),
        Surface(np.array([-half, -half, 0.0]), x, y, (WIDTH, WIDTH), 4),
        Surface(np.array([-half, half, high]), x, -y, (WIDTH, WIDTH), 5),
    ]
    objects = list[list[Surface]]()
    for k in range(9):
        rng, side = np.random.default_rng([83, seed, k]), grid((2.0, 2.0), TEXEL)
        kind = planks(side, TEXEL, 2200 + 9 * seed + k, 0.12 + 0.01 * k)
        stone = cut_stone(side, TEXEL, 2300 + 9 * seed + k, (0.3 + 0.02 * k, 0.25))
        materials.append(kind if k % 2 else stone)
        angle = 2.0 * np.pi * (k + rng.uniform(-0.2, 0.2)) / 9.0
        place = np.array([3.1 * np.cos(angle), 3.1 * np.sin(angle), 0.0])
        size = rng.uniform([0.4, 0.4, 0.4], [0.8, 0.8, 1.5])
        objects.append(_crate(place, size, float(rng.uniform(-0.7, 0.7)), len(materials) - 1))
    return build_world(objects + [[wall] for wall in walls], materials, SUN)


def walk_inside(count: int, K: F64, lens: F64, *, seed: int = 0) -> list[Pose]:
    """Cameras on a circle in the middle of the room, looking outwards and about."""
    poses = []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        angle = 2.0 * np.pi * k / count
        C = np.array([1.5 * np.cos(angle), 1.5 * np.sin(angle), 1.6 + 0.5 * np.sin(3.0 * angle)])
        turn = angle + rng.uniform(-0.25, 0.25)
        ahead = np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.25, 0.15)])
        poses.append(Pose(K, look_at(C, C + ahead, rng.uniform(-0.08, 0.08)), C, 1.0, lens))
    return poses
