"""Warping and its kernels."""

import numpy as np
import pytest

from thesisrecon.camera import Camera
from thesisrecon.imaging.raster import rasterize, sample_texture
from thesisrecon.views._warping import DIRECTIONS, STRETCH, fill_holes, forward_map, sample
from thesisrecon.views.render import Light, Shading, _average_blocks, _shade

SIZE = (31, 23)


def forward_warp(image, target, near, **more):
    """Levels and inverse depth of an image seen from elsewhere."""
    source, front = forward_map(target, near, **more)
    return sample(image, source), front


def rough(seed, shape=(19, 27)):
    """A surface with jumps, missing pixels, stretched and folded places."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    near = 3.0 + np.sin(x / 5.0) + 0.7 * np.cos(y / 4.0)
    near[5:12, 8:17] += 4.0
    near += rng.normal(0.0, 0.2, shape)
    near[rng.random(shape) < 0.06] = np.nan
    target = np.stack([x + 0.9 * near + 0.03 * y, 1.2 * y + 0.2 * near], axis=-1)
    return target, near.astype(np.float32)


def joined(target, near, a, b, step):
    if not (0 <= b[0] < near.shape[0] and 0 <= b[1] < near.shape[1]):
        return False
    return bool(abs(near[a] - near[b]) <= step and np.abs(target[a] - target[b]).max() <= STRETCH)


def pieces(target, near, step):
    """Every triangle and footprint as an affine map (2, 3) from the picture to the photograph's offsets, and
    the corner of those; in the order in which they are drawn."""
    found = []
    for y, x in np.ndindex(near.shape):
        if np.isnan(near[y, x]):
            continue
        a, b, c, d = (y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)
        inside = y + 1 < near.shape[0] and x + 1 < near.shape[1]
        corners = [(a, b, c), (d, c, b), (b, d, a), (c, a, d)]
        held = [
            inside and joined(target, near, p, q, step) and joined(target, near, p, r, step)
            for p, q, r in corners
        ]
        if held[0] and held[1]:
            held[2] = held[3] = False
        found += [("triangle", *corner) for corner, kept in zip(corners, held, strict=True) if kept]
        around = [
            joined(target, near, a, (y + v, x + u), step) for v, u in ((0, 1), (0, -1), (1, 0), (-1, 0))
        ]
        if not all(around):
            found.append(("pixel", a, around, None))
    return found


def slope(target, near, a, step, has):
    values = np.concatenate([target, near[..., None]], axis=2)
    forward = values[a[0] + step[0], a[1] + step[1]] if has[0] else values[a]
    backward = values[a[0] - step[0], a[1] - step[1]] if has[1] else values[a]
    return (forward - backward) / sum(has) if any(has) else None


def plain_map(target, near, step):
    """The plain twin of ``draw_surface``: every piece against all pixels."""
    height, width = SIZE[1], SIZE[0]
    gy, gx = np.mgrid[0:height, 0:width].astype(float)
    source, front = np.full((height, width, 2), np.nan), np.full((height, width), np.nan)
    for kind, a, second, third in pieces(target, near, step):
        q = np.stack([gx, gy], axis=-1) - target[a]
        at = np.array(a[::-1], dtype=float)
        if kind == "triangle":
            M = np.stack([target[second] - target[a], target[third] - target[a]], axis=1)
            rise = np.array([near[second] - near[a], near[third] - near[a]])
            steps = np.stack([np.subtract(second, a)[::-1], np.subtract(third, a)[::-1]], axis=1)
        else:
            across, down = (
                slope(target, near, a, s, second[i : i + 2]) for s, i in (((0, 1), 0), ((1, 0), 2))
            )
            if across is None:
                across = np.array([1.0, 0, 0]) if down is None else np.array([down[1], -down[0], 0.0])
            if down is None:
                down = np.array([-across[1], across[0], 0.0])
            M, rise = np.stack([across[:2], down[:2]], axis=1), np.array([across[2], down[2]])
            steps = np.eye(2)
        if np.linalg.det(M) < 1e-9:
            continue
        uv = q @ np.linalg.inv(M).T
        if kind == "triangle":
            inside = (uv >= -1e-7).all(axis=-1) & (uv.sum(axis=-1) <= 1.0 + 1e-7)
        else:
            inside = (np.abs(uv) <= 0.5 + 1e-7).all(axis=-1)
        here = near[a] + uv @ rise
        drawn = inside & ~(front >= here)
        front[drawn] = here[drawn]
        places = at + uv @ steps.T
        source[drawn] = np.clip(places, 0.0, np.array(near.shape[::-1]) - 1.0)[drawn]
    return source, front


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_compiled_map_is_the_plain_one(seed):
    target, near = rough(seed)
    source, front = forward_map(target, near, size=SIZE, step=0.8)
    plain_source, plain_front = plain_map(target, near, 0.8)
    assert 0.3 < np.isfinite(front).mean() < 0.95
    np.testing.assert_allclose(front, plain_front, atol=1e-5)
    # Where two surfaces are equally near either is right.
    assert np.mean(np.nan_to_num(np.abs(source - plain_source).max(axis=-1)) > 1e-3) < 0.01
    for threads in (2, 3, SIZE[1]):
        again = forward_map(target, near, size=SIZE, step=0.8, threads=threads)
        np.testing.assert_array_equal(again[0], source)
        np.testing.assert_array_equal(again[1], front)


def test_strips_include_contributions_from_far_above():
    y, x = np.mgrid[0:14, 0:14].astype(float)
    target = np.stack([1.4 * x, 2.8 * y], axis=-1)
    # Every third pixel is elsewhere, so that the triangle opposite to it stands alone.
    target[::3, ::3, 1] -= 9.0
    near = (x + 0.01 * y).astype(np.float32)
    whole = forward_map(target, near, size=(20, 40), step=2.0)
    for threads in (2, 7, 40):
        for part, again in zip(
            whole, forward_map(target, near, size=(20, 40), step=2.0, threads=threads), strict=True
        ):
            np.testing.assert_array_equal(again, part)


def test_a_linear_photograph_is_moved_exactly():
    y, x = np.mgrid[0:20, 0:30].astype(float)
    image = np.stack([3.0 * x + 2.0 * y, 255.0 - 5.0 * x, x * 0 + 7.0], axis=-1)
    angle = 0.1
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = np.array([3.3, -1.6])
    target = np.stack([x, y], axis=-1) @ (1.1 * R).T + shift
    rgb, near = forward_warp(image, target, np.ones((20, 30)), size=(40, 26), threads=2)
    gy, gx = np.mgrid[0:26, 0:40].astype(float)
    back = (np.stack([gx, gy], axis=-1) - shift) @ np.linalg.inv(1.1 * R).T
    inside = ((back >= 0.0) & (back <= [29.0, 19.0])).all(axis=-1)
    beyond = ((back < -0.6) | (back > [29.6, 19.6])).any(axis=-1)
    assert inside.sum() > 300
    expected = np.stack([3.0 * back[..., 0] + 2.0 * back[..., 1], 255.0 - 5.0 * back[..., 0]], axis=-1)
    np.testing.assert_allclose(rgb[inside][:, :2], expected[inside], atol=1e-3)
    np.testing.assert_allclose(rgb[inside][:, 2], 7.0, atol=1e-5)
    np.testing.assert_array_equal(near[inside], 1.0)
    assert np.isnan(rgb[beyond]).all()
    assert np.isnan(near[beyond]).all()


@pytest.mark.parametrize("zoom", [2.0, 6.0, 16.0])
def test_enlarged_surfaces_have_no_holes_and_stay_apart(zoom):
    y, x = np.mgrid[0:24, 0:32].astype(float)
    near = np.where(x < 16, 1.0, 5.0)
    # The right half is in front and has moved away from the left one.
    target = zoom * np.stack([x - 12.0 + np.where(x < 16, 0.0, 2.0), y - 4.0], axis=-1)
    source, front = forward_map(target, near, size=(40, 30), step=1.0)
    at = np.arange(40) / zoom + 12.0
    left, right = at <= 15.0, (at >= 18.0) & (at <= 33.0)
    assert left.any()
    for seen, places in ((left, at), (right, at - 2.0)):
        np.testing.assert_allclose(source[..., 0][:, seen], np.tile(places[seen], (30, 1)), atol=1e-4)
    between = (at > 15.0 + 0.51 + 0.5 / zoom) & (at < 18.0 - 0.51 - 0.5 / zoom)
    assert np.isnan(front[:, between]).all()


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_pixel_wins_in_any_order(order):
    """A square in front of a wall; the photograph is also walked through from its other end."""
    y, x = np.mgrid[0:24, 0:40].astype(float)
    front = (np.abs(x - 20) <= 5) & (np.abs(y - 12) <= 6)
    near = np.where(front, 8.0, 0.0)
    image = np.where(front, 200.0, 50.0)[..., None]
    target = np.stack([x + near, y], axis=-1)
    parts = [a[:, ::order] if order < 0 else a for a in (image, target, near)]
    if order < 0:
        # Mirrored twice: the same orientation in the picture.
        parts = [a[::order] for a in parts]
    rgb, seen = forward_warp(parts[0], parts[1], parts[2], size=(40, 24), step=1.0)
    square = (np.abs(x - 28) <= 5) & (np.abs(y - 12) <= 6)
    hole = front & ~square & (x <= 22)
    np.testing.assert_array_equal(seen[square], 8.0)
    np.testing.assert_allclose(rgb[square], 200.0, atol=1e-3)
    assert np.isnan(rgb[hole & (x > 15) & (x < 22)]).all()
    filled = fill_holes(rgb, seen, step=1.0)
    # The cubic kernel rings beside the edge.
    np.testing.assert_allclose(filled[hole], 50.0, atol=15.0)
    assert np.isfinite(filled).all()


def test_holes_take_the_mean_of_the_background():
    rng = np.random.default_rng(3)
    near = rng.choice([1.0, 1.2, 2.4, 3.0, 5.0, np.nan, np.nan], (14, 17)).astype(np.float32)
    rgb = rng.uniform(0, 255, (14, 17, 3)).astype(np.float32)
    rgb[np.isnan(near)] = np.nan
    filled = fill_holes(rgb, near, step=0.5)
    np.testing.assert_array_equal(filled[~np.isnan(near)], rgb[~np.isnan(near)])
    for y, x in np.argwhere(np.isnan(near)):
        seen = []
        for dy, dx in DIRECTIONS:
            n = 1
            while 0 <= y + n * dy < 14 and 0 <= x + n * dx < 17:
                if not np.isnan(near[y + n * dy, x + n * dx]):
                    length = n * np.hypot(dy, dx)
                    seen.append((near[y + n * dy, x + n * dx], length, rgb[y + n * dy, x + n * dx]))
                    break
                n += 1
        if not seen:
            assert np.isnan(filled[y, x]).all()
            continue
        least, most = min(one[0] for one in seen), max(one[0] for one in seen)
        behind = least + max(0.5, 0.4 * (most - least))
        kept = [(1.0 / r**2, color) for z, r, color in seen if z <= behind]
        mean = sum(w * color for w, color in kept) / sum(w for w, _ in kept)
        np.testing.assert_allclose(filled[y, x], mean, rtol=1e-5)


def test_samples_are_cubic_within_and_linear_at_the_border():
    rng = np.random.default_rng(4)
    y, x = np.mgrid[0:12, 0:15].astype(float)
    image = np.stack([x * x - x * y, rng.uniform(0, 255, x.shape)], axis=-1).astype(np.float32)
    at = rng.uniform(1.0, 9.9, (20, 30, 2)).astype(np.float32)
    found = sample(image, at, threads=2)
    # Cubic convolution has the quadratics right.
    u, v = at[..., 0].astype(float), at[..., 1].astype(float)
    np.testing.assert_allclose(found[..., 0], u * u - u * v, atol=2e-3)
    whole = np.stack([x, y], axis=-1).astype(np.float32)
    np.testing.assert_allclose(sample(image, whole), image, rtol=1e-6, atol=1e-5)
    edge = np.array([[[-0.4, 3.0], [14.5, 11.5], [0.25, 0.0], [-0.6, 3.0], [np.nan, 1.0]]], dtype=np.float32)
    seen = sample(image, edge)[0, :, 1]
    linear = 0.75 * image[0, 0, 1] + 0.25 * image[0, 1, 1]
    np.testing.assert_allclose(seen[:3], [image[3, 0, 1], image[11, 14, 1], linear], rtol=1e-5)
    assert np.isnan(seen[3:]).all()
    image[5, 5] = np.nan
    holed = sample(image, np.array([[[4.5, 4.5], [3.5, 4.5], [9.5, 9.5]]], dtype=np.float32))[0, :, 1]
    assert np.isnan(holed[0])
    mean = image[4:6, 3:5, 1].mean()
    assert holed[1] == pytest.approx(mean, rel=1e-5)
    assert np.isfinite(holed[2])


def test_a_single_pixel_and_nothing_at_all():
    near = np.array([[1.0]])
    rgb, seen = forward_warp(np.full((1, 1, 3), 9.0), np.array([[[2.2, 1.1]]]), near, size=(4, 3))
    assert np.isfinite(seen).sum() == 1
    np.testing.assert_allclose(rgb[1, 2], 9.0)
    rgb, seen = forward_warp(np.full((1, 1, 3), 9.0), np.array([[[2.2, 1.1]]]), near * np.nan, size=(4, 3))
    assert np.isnan(seen).all()
    assert np.isnan(fill_holes(rgb, seen, step=0.0)).all()


def unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-20)


def shaded(color, points, normals, eye, shading):
    """The plain twin of ``shade_points``: Lambert's law."""
    normals, to_eye = unit(normals), unit(eye - points)
    normals = normals * np.where((normals * to_eye).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    light = np.full_like(color, shading.ambient)
    for lamp in shading.lights:
        if lamp.direction is not None:
            to_lamp = unit(np.tile(np.asarray(lamp.direction), (len(points), 1)))
        else:
            to_lamp = unit(np.asarray(lamp.position) - points)
        cosine = np.maximum((normals * to_lamp).sum(axis=1), 0.0)[:, None]
        light += cosine * lamp.color
    return np.asarray(color * light)


def test_light_is_that_of_the_formulas():
    rng = np.random.default_rng(0)
    color, (points, normals) = rng.uniform(0, 255, (500, 3)), rng.normal(size=(2, 500, 3))
    normals[:5] = 0.0
    lamps = (Light(direction=(1.0, 2.0, -3.0), color=(0.5, 0.6, 0.2)), Light(position=(0.3, 0.1, -4.0)))
    for lights in ((), lamps[:1], lamps):
        shading = Shading(ambient=0.2, lights=lights)
        eye = np.array([0.1, -0.2, -3.0])
        seen = color.astype(np.float32)
        _shade(seen, points.astype(np.float32), normals.astype(np.float32), eye, shading)
        np.testing.assert_allclose(seen, shaded(color, points, normals, eye, shading), atol=0.02)


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_blocks_are_means_before_the_background(samples):
    rng = np.random.default_rng(2)
    color = rng.uniform(-20, 300, (6 * samples, 8 * samples, 3)).astype(np.float32)
    drawn = rng.integers(-1, 2, color.shape[:2])
    behind = np.array([10, 200, 30], dtype=np.float32)
    out = np.empty((6, 8, 3), dtype=np.uint8)
    _average_blocks(color, drawn, samples, behind, out)
    plain = np.where(drawn[..., None] < 0, behind, color).reshape(6, samples, 8, samples, 3).mean(axis=(1, 3))
    assert np.abs(out - np.clip(np.rint(plain), 0, 255)).max() <= 1


def test_values_of_vertices_and_corners_are_interpolated_alike():
    rng = np.random.default_rng(3)
    vertices, faces = rng.uniform([-2, -2, 3], [2, 2, 6], (30, 3)), rng.integers(0, 30, (20, 3))
    K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
    raster = rasterize(vertices, faces, Camera(K, np.eye(3), np.zeros(3), (64, 48)))
    values = rng.uniform(size=(30, 4)).astype(np.float32)
    assert (raster.face >= 0).mean() > 0.2
    np.testing.assert_array_equal(raster.interpolate(values, faces), raster.interpolate(values[faces]))
    part = raster[10:20]
    np.testing.assert_array_equal(part.interpolate(values[faces]), raster.interpolate(values[faces])[10:20])


def test_bytes_and_floats_of_a_texture_are_sampled_alike():
    rng = np.random.default_rng(4)
    texture = rng.integers(0, 256, (9, 7, 3), dtype=np.uint8)
    uv = rng.uniform(-2, 10, (20, 30, 2)).astype(np.float32)
    drawn = rng.integers(-1, 3, (20, 30))
    seen = [np.zeros((20, 30, 3), dtype=np.float32) for _ in range(2)]
    sample_texture(texture, uv, drawn, seen[0])
    sample_texture(texture.astype(np.float32), uv, drawn, seen[1])
    np.testing.assert_array_equal(*seen)
    u, v = np.clip(uv[..., 0], 0, 6), np.clip(uv[..., 1], 0, 8)
    left, top = np.minimum(u.astype(int), 5), np.minimum(v.astype(int), 7)
    s, t = (u - left)[..., None], (v - top)[..., None]
    T = texture.astype(float)
    plain = (1 - t) * ((1 - s) * T[top, left] + s * T[top, left + 1])
    plain += t * ((1 - s) * T[top + 1, left] + s * T[top + 1, left + 1])
    np.testing.assert_allclose(seen[0], np.where(drawn[..., None] < 0, 0.0, plain), atol=1e-2)
