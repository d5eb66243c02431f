"""The compiled loops of interpolation beside plain NumPy."""

import numpy as np
import pytest

from thesisrecon.views.interpolation_kernels import (
    NEAR,
    ONE_SURFACE_PX,
    REACH,
    SPARSE,
    blend,
    fill_empty_rows,
    mark_crossings,
    place_between,
    settle_guesses,
    smooth_guesses,
    take_back,
    weigh,
)


def field(seed, shape=(14, 23), holes=0.1):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    d = 4.0 + np.sin(x / 6.0) + 0.3 * y
    d[4:9, 7:13] += 6.0
    d[rng.random(shape) < holes] = np.nan
    return d.astype(np.float32)


@pytest.mark.parametrize("slack", [0.0, 0.5])
def test_crossings_are_those_of_all_pairs(slack):
    d = field(0)
    found = np.ones(d.shape, dtype=bool)
    mark_crossings(d, slack, found)
    plain = np.zeros(d.shape, dtype=bool)
    for y, row in enumerate(d):
        at = np.arange(len(row)) - row
        for i in range(len(row)):
            for j in range(i + 1, len(row)):
                if at[i] > at[j] + slack:
                    plain[y, i] = plain[y, j] = True
    np.testing.assert_array_equal(found, plain)
    assert 0 < plain.sum() < plain.size


def test_empty_rows_take_the_nearest():
    d = np.arange(8.0, dtype=np.float32)[:, None] * np.ones((1, 5), np.float32)
    d[[0, 3, 4, 7]] = np.nan
    fill_empty_rows(d)
    np.testing.assert_array_equal(d[:, 0], [1, 1, 2, 2, 5, 5, 6, 6])
    nothing = np.full((3, 4), np.nan, np.float32)
    fill_empty_rows(nothing)
    assert np.isnan(nothing).all()


def test_disparities_are_taken_back_as_interpolation_says():
    whole, sure = field(1, holes=0.0), np.random.default_rng(1).random((14, 23)).astype(np.float32)
    H = np.array([[1.1, 0.05, -2.0], [-0.03, 0.9, 1.2], [1e-3, -2e-3, 1.0]])
    shape = (16, 20)
    places, d, conf = np.empty((*shape, 2)), np.empty(shape, np.float32), np.empty(shape, np.float32)
    take_back((whole, sure), H, (0, 16), places, d, conf)
    y, x = np.mgrid[0:16, 0:20].astype(float)
    xh = np.stack([x, y, np.ones(shape)], axis=-1) @ H.T
    at = xh[..., :2] / xh[..., 2:]
    np.testing.assert_allclose(places, at, atol=1e-12)
    u, v = np.clip(at[..., 0], 0, 22), np.clip(at[..., 1], 0, 13)
    x0, y0 = np.minimum(u.astype(int), 21), np.minimum(v.astype(int), 12)
    four = np.stack([whole[y0, x0], whole[y0, x0 + 1], whole[y0 + 1, x0], whole[y0 + 1, x0 + 1]])
    s, t = u - x0, v - y0
    smooth = (1 - t) * ((1 - s) * four[0] + s * four[1]) + t * ((1 - s) * four[2] + s * four[3])
    nearest = np.rint(v).astype(int), np.rint(u).astype(int)
    plain = np.where(np.ptp(four, axis=0) <= ONE_SURFACE_PX, smooth, whole[nearest])
    np.testing.assert_allclose(d, plain, atol=1e-5)
    inside = (at > -0.5).all(axis=-1) & (at[..., 0] < 22.5) & (at[..., 1] < 13.5)
    np.testing.assert_array_equal(conf, np.where(inside, sure[nearest], 0.0))
    assert 0.2 < inside.mean() < 1.0
    H[2] = [-0.1, 0.0, 1.0]
    take_back((whole, sure), H, (0, 16), places, d, conf)
    assert np.isnan(places[:, 10:]).all()
    assert np.isnan(d[:, 10:]).all()
    assert np.isfinite(d[:, :10]).all()


def test_pixels_lie_between_as_the_homography_says():
    rng = np.random.default_rng(2)
    places, d = rng.uniform(0, 30, (5, 7, 2)), field(3, (5, 7))
    G = np.array([[0.9, 0.1, 3.0], [-0.1, 1.1, -2.0], [4e-3, -0.05, 1.0]])
    target = np.empty((5, 7, 2))
    place_between(places, d, 0.3, G, (0, 5), target)
    moved = places - 0.3 * np.stack([d, 0 * d], axis=-1).astype(float)
    xh = np.concatenate([moved, np.ones((5, 7, 1))], axis=-1) @ G.T
    plain = np.where(xh[..., 2:] > 0, xh[..., :2] / xh[..., 2:], np.nan)
    np.testing.assert_allclose(target, plain, rtol=1e-12)
    assert 0 < np.isnan(plain).sum() < plain.size


def test_guesses_become_medians_of_pixels_of_their_colour():
    rng = np.random.default_rng(6)
    shape = (20, 31)
    d = np.where(np.arange(31) < 15, 4.0, 12.0) + rng.uniform(0, 0.3, shape)
    d[rng.random(shape) < 0.1] = np.nan
    d = d.astype(np.float32)
    sure = rng.choice([0.0, 0.7], shape).astype(np.float32)
    levels = np.where(np.arange(31) < 18, 60.0, 200.0)[None, :, None] + rng.uniform(0, 40, (*shape, 3))
    levels = levels.astype(np.float32)
    out = np.empty_like(d)
    settle_guesses(levels, d, sure, (0, 9), (30.0, 0.5), out)
    settle_guesses(levels, d, sure, (9, 20), (30.0, 0.5), out)
    for y, x in np.ndindex(shape):
        if sure[y, x] > 0.0 or np.isnan(d[y, x]):
            np.testing.assert_array_equal(out[y, x], d[y, x])
            continue
        rows = [v for v in range(y - REACH, y + REACH + 1, SPARSE) if 0 <= v < shape[0]]
        columns = [u for u in range(x - REACH, x + REACH + 1, SPARSE) if 0 <= u < shape[1]]
        part = np.ix_(rows, columns)
        apart = np.abs(levels[part] - levels[y, x]).sum(axis=-1)
        weight = np.exp(-apart / 30.0) * np.where(sure[part] > 0.0, 1.0, 0.5)
        values, weight = d[part].ravel(), weight.ravel()
        kept = np.isfinite(values)
        values, weight = values[kept], weight[kept]
        if np.ptp(np.append(values, d[y, x])) <= ONE_SURFACE_PX:
            assert out[y, x] == d[y, x]
            continue
        order = np.argsort(values)
        below = np.cumsum(weight[order])
        assert out[y, x] == values[order][np.searchsorted(below, 0.5 * weight.sum() - 1e-9)]
    # Between 15 and 18 the colours are those of the left surface.
    guessed = sure[:, 15:18] == 0.0
    assert np.median(out[:, 15:18][guessed & np.isfinite(d[:, 15:18])]) < 5.0


def test_a_guess_alone_goes_with_those_around():
    d = field(7)
    rng = np.random.default_rng(7)
    d[rng.random(d.shape) < 0.15] += 9.0
    sure = rng.choice([0.0, 0.0, 1.0], d.shape).astype(np.float32)
    out = np.empty_like(d)
    for rows in ((0, 5), (5, 14)):
        smooth_guesses(d, sure, rows, out)
    for y, x in np.ndindex(d.shape):
        around = d[max(y - NEAR, 0) : y + NEAR + 1, max(x - NEAR, 0) : x + NEAR + 1].ravel()
        around = np.sort(around[np.isfinite(around)])
        expected = d[y, x]
        if sure[y, x] == 0.0 and np.isfinite(expected) and np.ptp(around) > ONE_SURFACE_PX:
            expected = around[len(around) // 2]
        np.testing.assert_array_equal(out[y, x], expected)
    assert (out != d).sum() > 20


def test_weights_are_confidences_but_at_rims():
    d = field(4, holes=0.0)
    sure = np.random.default_rng(4).random(d.shape).astype(np.float32)
    sure[3:6] = 0.0
    out = np.empty_like(sure)
    weigh(d, sure, (0.01, 0.25, 0.5), out)
    padded = np.pad(d, 1, mode="edge")
    steps = [padded[1:-1, 2:], padded[1:-1, :-2], padded[2:, 1:-1], padded[:-2, 1:-1]]
    rim = (np.abs(np.stack(steps) - d) > ONE_SURFACE_PX).any(axis=0)
    assert rim.any()
    plain = np.where(sure > 0, np.maximum(sure, 0.25) * np.where(rim, 0.5, 1.0), 0.01)
    np.testing.assert_allclose(out, plain, rtol=1e-6)


def test_two_pictures_become_one_by_the_rules():
    rng = np.random.default_rng(5)
    shape, s = (12, 15), 0.3
    colors = tuple(rng.uniform(0, 255, (*shape, 3)).astype(np.float32) for _ in range(2))
    fronts = tuple(rng.choice([1.0, 1.4, 6.0, np.nan], shape).astype(np.float32) for _ in range(2))
    weights = tuple(rng.choice([0.01, 0.4, 1.0], (9, 9)).astype(np.float32) for _ in range(2))
    sources = tuple(rng.uniform(-0.5, 8.5, (*shape, 2)).astype(np.float32) for _ in range(2))
    out = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
    blend(colors, fronts, sources, weights, (0.5, 0.015, s), out)
    for y, x in np.ndindex(shape):
        n, w, c = ([float(f[y, x]) for f in fronts], [], [color[y, x].astype(float) for color in colors])
        for k in (0, 1):
            u, v = np.clip(np.rint(sources[k][y, x]), 0, 8).astype(int)
            w.append(float(weights[k][v, u]))
        sure = [weight > 0.015 for weight in w]
        if np.isnan(n).all():
            assert np.isnan(out[0][y, x]).all()
            assert np.isnan(out[1][y, x])
            continue
        if np.isnan(n).any():
            expected = c[int(np.isnan(n[0]))]
        elif abs(n[0] - n[1]) <= 0.5:
            a, b = (1 - s) * w[0], s * w[1]
            expected = (a * c[0] + b * c[1]) / (a + b)
        elif all(sure):
            expected = c[int(np.argmax(n))]
        else:
            expected = c[int(np.argmin(n))] if not any(sure) else c[sure.index(True)]
        np.testing.assert_allclose(out[0][y, x], expected, rtol=1e-5)
        assert float(out[1][y, x]) in n
