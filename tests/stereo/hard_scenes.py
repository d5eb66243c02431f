"""Scenes of rectangles that are hard to match: fences, tunnels, blank walls, and photographs of them."""

from dataclasses import replace
from functools import cache

import numpy as np

from tests.stereo.depth_scenes import Rectangle, photograph_scene
from tests.synthetic import texture
from thesisrecon.geometry.camera_matrix import camera_from_centre


@cache
def textured(seed):
    """Grey levels that go on by reflection."""
    return texture(300, 300, seed)


def fence(seed=0):
    """Slats of 0.25, as far apart as they are wide, at depth 4 before a wall at 6: occlusions everywhere."""
    places = [0.5 * k - 4.0 for k in range(16)]
    slats = [
        Rectangle((x, -3.0, 4.0), (0.25, 0, 0), (0, 6.0, 0), textured(seed + k))
        for k, x in enumerate(places, 1)
    ]
    return [Rectangle((-6.0, -5.0, 6.0), (12.0, 0, 0), (0, 10.0, 0), textured(seed)), *slats]


def tunnel(seed=0):
    """Four walls along the way and one at its end."""
    z = (0.0, 0.0, 14.0)
    sides = [((-1.5, -1.2, -1.0), (0, 2.4, 0)), ((1.5, -1.2, -1.0), (0, 2.4, 0))]
    sides += [((-1.5, -1.2, -1.0), (3.0, 0, 0)), ((-1.5, 1.2, -1.0), (3.0, 0, 0))]
    walls = [Rectangle(corner, z, up, textured(seed + k)) for k, (corner, up) in enumerate(sides)]
    return [*walls, Rectangle((-1.5, -1.2, 13.0), (3.0, 0, 0), (0, 2.4, 0), textured(seed + 9))]


def blank_wall(rim=1.2, seed=0):
    """A blank square with a textured rim of that width, leaning away, at depth 5 in its middle."""
    return [leaning(4.0, 5.0, textured(seed)), leaning(4.0 - rim, 5.0 - 1e-6, 140.0)]


def leaning(half, depth, levels):
    """A square about the optical axis that leans away to the right."""
    slope = 0.3
    corner = (-half, -half, depth - slope * half)
    return Rectangle(corner, (2 * half, 0, 2 * slope * half), (0, 2 * half, 0), levels)


def looking_ahead(places, *, focal=200.0, size=(200, 150)):
    """Cameras (V, 3, 4) at places, all looking along z."""
    K = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
    return np.array([camera_from_centre(K, np.eye(3), np.array(place, dtype=float)) for place in places])


def abreast(baseline, views=3):
    """Cameras (V, 3, 4) side by side."""
    return looking_ahead([[baseline * (k - (views - 1) / 2), 0.0, 0.0] for k in range(views)])


def fenced(baseline=0.4):
    return photograph_scene(abreast(baseline), fence())


def ahead():
    """Forward motion through the tunnel, the epipole inside."""
    return photograph_scene(looking_ahead([[0.0, 0.0, z] for z in (0.0, 0.4, 0.8)]), tunnel())


def of_elsewhere():
    """Three views and one that shares nothing with them."""
    P = abreast(0.4, 4)
    P[3] = looking_ahead([[40.0, 0.0, 0.0]])[0]
    return photograph_scene(P, fence())


def far_smaller(s):
    """Four views of a wall, the last one reduced by ``s``."""
    P = abreast(0.4, 4)
    P[3] = np.array([[s, 0.0, 0.5 * s - 0.5], [0.0, s, 0.5 * s - 0.5], [0.0, 0.0, 1.0]]) @ P[3]
    return photograph_scene(P, fence()[:1], sizes=[(200, 150)] * 3 + [(int(200 * s), int(150 * s))])


def burnt_out(scene):
    """The scene with a sky of 255 and a corner of 0 in every view."""
    for image in scene.images:
        image.rgb[:60] = 255
        image.rgb[100:, :80] = 0
    return scene


def observed(scene, keep):
    """The scene with some of its observations."""
    r = scene.reconstruction
    return replace(scene, reconstruction=replace(r, inlier=np.asarray(keep(r))))


def without_points():
    return observed(fenced(), lambda r: np.zeros_like(r.inlier))
