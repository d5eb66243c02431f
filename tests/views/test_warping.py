"""Warping and its kernels."""

import numpy as np
import pytest

from thesisrecon.imaging.raster import sample_texture
from thesisrecon.views._warping import DIRECTIONS, fill_holes, forward_map, sample

SIZE = (31, 23)


def forward_warp(image, target, near, **more):
    """Levels and inverse depth of an image seen from elsewhere."""
    source, front = forward_map(target, near, **more)
    return sample(image, source), front


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
