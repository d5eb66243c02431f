"""The ray caster against closed forms: where it says a surface is, a surface is."""

import numpy as np
import pytest

from validation.scenes.materials import Material, over, smooth
from validation.scenes.photograph import Sensor, expose, integrate_pixels
from validation.scenes.procedural import courses, fractal
from validation.scenes.raycast import Rays, Surface, build_world, trace

K = np.array([[90.0, 0.0, 33.0], [0.0, 90.0, 22.0], [0.0, 0.0, 1.0]])
SIZE = (64, 48)
RIGHT, DOWN, FORWARD = np.eye(3)
SUN = np.array([0.2, -0.6, -0.7])


def material(height):
    grey = np.full((*height.shape, 3), 0.5, np.float32)
    return Material(grey, height.astype(np.float32), 0.01)


def wall(height):
    """A wall 2 m x 2 m, 2 m in front of a camera at the origin, its normal towards the camera."""
    surface = Surface(np.array([-1.0, 1.0, 2.0]), RIGHT, -DOWN, (2.0, 2.0), 0)
    return build_world([[surface]], [material(height)], SUN)


def view(world, **options):
    return trace(world, Rays(K, np.eye(3), np.zeros(3)), SIZE, **options)


def test_plane_depth_is_exact():
    depth = view(wall(np.full((201, 201), 0.05)))[1]
    # The slab is entered at the height of the map, so the depth is 2 m less the constant relief.
    np.testing.assert_allclose(depth, 1.95, atol=3e-6)


def test_relief_depth_lies_on_the_height_map():
    height = 0.04 * fractal((201, 201), 0.01, 5, wavelengths_m=(0.5, 0.05))
    depth = view(wall(height))[1]
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    X, Y = depth * (x - K[0, 2]) / K[0, 0], depth * (y - K[1, 2]) / K[1, 1]
    u, v = (X + 1.0) / 0.01, (1.0 - Y) / 0.01
    c, r = u.astype(int), v.astype(int)
    fu, fv = u - c, v - r
    top = height[r, c] * (1 - fu) + height[r, c + 1] * fu
    low = height[r + 1, c] * (1 - fu) + height[r + 1, c + 1] * fu
    assert np.abs(2.0 - depth - (top * (1 - fv) + low * fv)).max() < 1e-5
    assert np.ptp(depth) > 0.03


def test_cylinder_depth_is_the_closed_form():
    radius, distance = 0.4, 2.0
    drum = Surface(np.array([0.0, 1.0, distance]), RIGHT, -DOWN, (2 * np.pi * radius, 2.0), 0, radius=radius)
    flat = np.zeros((201, round(2 * np.pi * radius / 0.01) + 1))
    depth = view(build_world([[drum]], [material(flat)], SUN))[1]
    x = (np.arange(SIZE[0]) - K[0, 2]) / K[0, 0]
    a, b, c = 1.0 + x * x, -distance, distance**2 - radius**2
    inside = b * b - a * c
    expected = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0.0)
    np.testing.assert_allclose(depth, np.tile(expected, (SIZE[1], 1)), atol=5e-6)
    assert (depth > 0).any()
    assert (depth == 0).any()


def test_rows_traced_apart_are_the_same_bytes():
    world = wall(0.04 * fractal((201, 201), 0.01, 5, wavelengths_m=(0.5, 0.05)))
    light, depth = view(world, per_pixel=2)
    parts = [view(world, per_pixel=2, rows=(a, a + 32)) for a in (0, 32, 64)]
    assert np.array_equal(np.concatenate([p[0] for p in parts]), light)
    assert np.array_equal(np.concatenate([p[1] for p in parts]), depth)


def test_a_block_casts_its_shadow_where_the_sun_is_hidden():
    # A plate of 0.4 m hangs 0.5 m before the wall, its lit side and its back one surface each.
    plate = [
        Surface(np.array([-0.2, 0.2, 1.5]), RIGHT, -DOWN, (0.4, 0.4), 0, flat=True),
        Surface(np.array([-0.2, -0.2, 1.5]), RIGHT, DOWN, (0.4, 0.4), 0, flat=True),
    ]
    back = Surface(np.array([-1.0, 1.0, 2.0]), RIGHT, -DOWN, (2.0, 2.0), 0)
    flat = material(np.zeros((201, 201)))
    light, depth = view(build_world([plate, [back]], [flat], SUN))
    shadow = np.array([0.0, 0.0, 1.5]) - SUN * (0.5 / -SUN[2])
    shadow_px = K[:2, :2] @ shadow[:2] / 2.0 + K[:2, 2]
    c, r = (int(v) for v in np.round(shadow_px))
    assert depth[r, c] == pytest.approx(2.0, abs=1e-5)
    assert light[r, c].max() < 0.7 * light[r, 2].max()


def test_pixels_are_not_shifted_by_the_lens():
    samples = np.zeros((40, 40, 3), np.float32)
    samples[20:22, 16:18] = 1.0
    pixels = integrate_pixels(samples, 2, 0.5)[..., 0].astype(float)
    y, x = np.mgrid[:20, :20]
    assert pixels.sum() == pytest.approx(1.0, abs=1e-4)
    assert (pixels * x).sum() == pytest.approx(8.0, abs=1e-3)
    assert (pixels * y).sum() == pytest.approx(10.0, abs=1e-3)


def test_photon_noise_grows_with_light_and_a_seed_repeats_it():
    light = np.repeat(np.array([0.02, 0.3], np.float32), 20000).reshape(2, 20000, 1).repeat(3, axis=2)
    sensor = Sensor(vignetting=0.0)
    first, again = (
        expose(light, sensor, gains=(1.0, 1.0, 1.0), rng=np.random.default_rng(1)) for _ in range(2)
    )
    assert np.array_equal(first, again)
    # Levels at 0.3 of white: derivative of the tone curve times sqrt(0.3 * 6000) / 6000.
    expected = 255 * 1.055 / 2.4 * 0.3 ** (1 / 2.4 - 1) * np.sqrt(0.3 / sensor.full_well)
    assert first[1].std() == pytest.approx(expected, rel=0.05)


def test_patterns_refuse_to_be_aliased():
    with pytest.raises(ValueError, match="two texels"):
        fractal((8, 8), 0.01, 0, wavelengths_m=(0.1, 0.01))


def test_wrapped_noise_closes():
    noise = fractal((32, 128), 0.01, 3, wavelengths_m=(0.3, 0.04), wrap=True)
    step = np.abs(np.diff(noise, axis=1)).max()
    assert np.abs(noise[:, 0] - noise[:, -1]).max() <= step


def test_bricks_have_joints_and_layers_blend():
    edge, label = courses((100, 200), 0.005, 1, block_m=(0.25, 0.085))
    assert edge.min() < 0.004
    assert 0.03 < edge.max() < 0.06
    assert len(np.unique(label)) > 20
    mortar, brick = material(np.zeros((100, 200))), material(np.ones((100, 200)))
    assert np.array_equal(over(mortar, brick, smooth(edge, 0.004, 0.013)).height, smooth(edge, 0.004, 0.013))
