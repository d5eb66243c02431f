"""View interpolation and its kernels."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.synthetic import texture
from thesisrecon.camera import compose_camera
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.records import DisparityMap
from thesisrecon.views import interpolation as kernels
from thesisrecon.views.interpolation import (
    InterpolatedPair,
    _with_all_rows,
    detect_monotonicity_violations,
    disparity_of_right,
    original_from_rectified,
)

SIZE = (160, 120)
SHIFTS = np.linspace(0.0, 1.0, 7)


def sure(disparity):
    """Disparities that are certain where they are known."""
    return DisparityMap(disparity, np.isfinite(disparity).astype(np.float32), 0.0)


def rectified_pair(left, right, maps):
    return InterpolatedPair((left, right), np.stack([np.eye(3)] * 2), *maps)


def cloud(rng):
    return rng.uniform([-2, -2, 4], [2, 2, 9], (200, 3))


def calibration(focal, rng):
    x, y = rng.uniform(60, 90), rng.uniform(50, 70)
    return np.array([[focal, rng.normal(), x], [0.0, 1.03 * focal, y], [0.0, 0.0, 1.0]])


def points_between(H, xy1, xy2, s):
    """Image points of the view at s."""
    left, right = (dehomogenize(homogenize(xy) @ side.T) for xy, side in zip((xy1, xy2), H, strict=True))
    return dehomogenize(homogenize((1.0 - s) * left + s * right) @ original_from_rectified(H, SIZE, s).T)


@pytest.mark.parametrize("seed", range(5))
def test_interpolation_along_the_baseline_is_the_projection_of_a_parallel_camera(seed):
    """P_s = (1 - s) P_0 + s P_1: the centre on the baseline, the focal length in between (Seitz and Dyer)."""
    rng = np.random.default_rng(seed)
    X, R = cloud(rng), Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_matrix()
    centres = rng.normal(0, 0.5, (2, 3))
    # Along the image plane, in any direction within it.
    centres[1] += (R[2] @ (centres[0] - centres[1])) * R[2]
    K = [calibration(focal, rng) for focal in (300.0, 340.0)]
    P = [compose_camera(k, R, -R @ c) for k, c in zip(K, centres, strict=True)]
    for s in SHIFTS:
        found = points_between(np.stack([np.eye(3)] * 2), project(P[0], X), project(P[1], X), float(s))
        np.testing.assert_allclose(found, project((1 - s) * P[0] + s * P[1], X), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_turned_cameras_are_seen_from_the_baseline_up_to_a_homography_and_exactly_at_the_ends(seed):
    rng = np.random.default_rng(200 + seed)
    X, K = cloud(rng), calibration(320.0, rng)
    centres = np.array([[-0.5, 0.1, 0.0], [0.5, -0.1, 0.1]])
    x = centres[1] - centres[0]
    x /= np.linalg.norm(x)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    common = np.stack([x, y, np.cross(x, y)])
    turns = [Rotation.from_rotvec(rng.normal(0, 0.12, 3)).as_matrix() for _ in range(2)]
    P = [compose_camera(K, R, -R @ c) for R, c in zip(turns, centres, strict=True)]
    H = np.stack([K @ common @ np.linalg.inv(K @ R) for R in turns])
    xy = [project(p, X) for p in P]
    for s in SHIFTS:
        rectified = compose_camera(K, common, -common @ ((1 - s) * centres[0] + s * centres[1]))
        expected = project(original_from_rectified(H, SIZE, float(s)) @ rectified, X)
        np.testing.assert_allclose(points_between(H, *xy, float(s)), expected, atol=1e-9)
    for k in (0, 1):
        np.testing.assert_allclose(points_between(H, *xy, float(k)), xy[k], atol=1e-9)


def test_corners_behind_a_camera_are_left_out_of_the_frame():
    H = np.eye(3)
    H[2, 0] = -1.0 / 100.0
    G = original_from_rectified(np.stack([H, np.eye(3)]), SIZE, 0.0)
    np.testing.assert_allclose(G / G[2, 2], np.linalg.inv(H) / np.linalg.inv(H)[2, 2], atol=1e-9)
    H[2] = [0.0, 0.0, -1.0]
    refuses(ValueError, "infinity", original_from_rectified, np.stack([H, np.eye(3)]), SIZE, 0.5)


class Stage:
    """A box in front of a slanted wall, both textured, seen by parallel cameras at s."""

    def __init__(self):
        layers = [gaussian_filter(texture(200, 320, seed), 1.0) for seed in range(6)]
        self.wall, self.box = np.stack(layers[:3], axis=-1), np.stack(layers[3:], axis=-1)

    def at(self, s):
        """Colours (120, 160, 3) and disparities of the view at s."""
        width, height = SIZE
        y, x = np.mgrid[0:height, 0:width].astype(float)
        # The wall: d = 4 + 0.02 x_0 where x_s = x_0 - s d.
        x0 = (x + 4.0 * s) / (1.0 - 0.02 * s)
        color, d = _sampled(self.wall, x0 + 60.0, y + 30.0), 4.0 + 0.02 * x0
        b = x + 16.0 * s
        box = (np.abs(b - 90.0) <= 20.0) & (np.abs(y - 60.0) <= 30.0)
        color[box] = _sampled(self.box, b + 60.0, y + 30.0)[box]
        d[box] = 16.0
        return color, d


def _sampled(texture, x, y):
    x0, y0 = x.astype(int), y.astype(int)
    s, t = (x - x0)[..., None], (y - y0)[..., None]
    top = (1 - s) * texture[y0, x0] + s * texture[y0, x0 + 1]
    return np.asarray((1 - t) * top + t * ((1 - s) * texture[y0 + 1, x0] + s * texture[y0 + 1, x0 + 1]))


@pytest.fixture(scope="module")
def stage():
    return Stage()


def disparities(stage):
    """Of both photographs, NaN where the other one does not see the pixel."""
    found = []
    (_, d0), (_, d1) = stage.at(0.0), stage.at(1.0)
    x = np.arange(SIZE[0])
    for here, there, sign in ((d0, d1, -1), (d1, d0, 1)):
        at = np.rint(x + sign * here).astype(int)
        inside = (at >= 0) & (at < SIZE[0])
        other = np.take_along_axis(there, np.clip(at, 0, SIZE[0] - 1), axis=1)
        seen = inside & (np.abs(other - here) < 1.0)
        found.append(sure(np.where(seen, here, np.nan).astype(np.float32)))
    return found[0], found[1]


def photographs(stage):
    left, right = (np.clip(np.rint(stage.at(s)[0]), 0, 255).astype(np.uint8) for s in (0.0, 1.0))
    return left, right


def psnr(a, b):
    return float(10 * np.log10(255.0**2 / np.mean((a.astype(float) - b) ** 2)))


def test_views_between_are_those_of_the_scene(stage):
    left, right = photographs(stage)
    pair = rectified_pair(left, right, disparities(stage))
    for s in (0.25, 0.5, 0.8):
        truth = stage.at(s)[0]
        view = pair.view(s, threads=2)
        np.testing.assert_array_equal(view, pair.view(s))
        assert view.dtype == np.uint8
        dissolved = (1 - s) * left + s * right
        assert psnr(view, truth) > psnr(dissolved, truth) + 8.0
        # Away from the rims of the box only rounding is left.
        off = np.abs(view - truth).max(axis=-1)
        assert np.quantile(off, 0.9) < 3.0
        colors, near = pair._seen(s)
        assert np.isnan(colors[..., 0]).mean() < 0.02
        known = np.isfinite(near)
        # At the left border lies what only the first photograph shows, at a guessed depth.
        assert np.quantile(np.abs(near - stage.at(s)[1])[known], 0.9) < 0.1
    np.testing.assert_array_equal(pair.view(0.0), left)
    np.testing.assert_array_equal(pair.view(1), right)


def test_rectified_and_turned_photographs_give_the_view_of_a_turned_camera(stage):
    """The same pair, its second photograph seen through a homography: between them the frame is halfway."""
    left, right = photographs(stage)
    maps = disparities(stage)
    H = np.stack([np.eye(3), np.array([[1.0, 0.02, 3.0], [-0.02, 1.0, -2.0], [0.0, 0.0, 1.0]])])
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(float)
    at = np.stack([x, y, np.ones_like(x)], axis=-1) @ H[1].T
    turned = _sampled(
        np.pad(right, ((8, 8), (8, 8), (0, 0)), mode="edge").astype(float), *(at[..., :2] + 8).T
    )
    turned = np.rint(turned.swapaxes(0, 1)).astype(np.uint8)
    pair = InterpolatedPair((left, turned), H, *maps)
    G = original_from_rectified(H, SIZE, 0.5)
    back = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(G).T
    rectified = back[..., :2] / back[..., 2:]
    truth = stage.at(0.5)[0]
    inside = (rectified > 2).all(axis=-1) & (rectified < np.array(SIZE) - 4.0).all(axis=-1)
    expected = _sampled(truth, *np.clip(rectified, 0, np.array(SIZE) - 2.0).transpose(2, 0, 1))
    off = np.abs(pair.view(0.5) - expected).max(axis=-1)[inside]
    assert inside.mean() > 0.85
    assert np.quantile(off, 0.85) < 6.0
    np.testing.assert_array_equal(pair.view(1.0), turned)


def test_exposures_are_interpolated_too(stage):
    left, right = photographs(stage)
    factor = np.array([0.8, 0.7, 0.75])
    darker = np.rint(right * factor).astype(np.uint8)
    pair = rectified_pair(left, darker, disparities(stage))
    np.testing.assert_allclose(pair.gain, factor, rtol=0.02)
    view = pair.view(0.5)
    off = np.abs(view - stage.at(0.5)[0] * np.sqrt(factor)).max(axis=-1)
    assert np.quantile(off, 0.85) < 4.0


def test_monotonicity_fails_with_a_thin_thing_in_front(stage):
    assert not detect_monotonicity_violations(np.full((20, 50), 3.0, np.float32)).any()
    d = np.full((20, 50), 3.0, np.float32)
    d[:, 30:33] = 13.0
    violated = detect_monotonicity_violations(d)
    # Its left rim passes nine pixels and meets the tenth.
    assert violated[:, 21:33].all()
    assert violated.mean() == pytest.approx(12 / 50)
    slanted = (3.0 + 0.3 * np.arange(50) * np.ones((20, 1))).astype(np.float32)
    assert not detect_monotonicity_violations(slanted).any()
    # What both photographs see of a broad thing keeps its order; with what it hides it does not.
    assert not detect_monotonicity_violations(disparities(stage)[0].disparity).any()
    assert detect_monotonicity_violations(stage.at(0.0)[1].astype(np.float32)).any()


def test_the_right_side_follows_from_the_left(stage):
    both = disparities(stage)
    implied = disparity_of_right(both[0]).disparity
    known = np.isfinite(implied) & np.isfinite(both[1].disparity)
    assert known.mean() > 0.75
    assert np.quantile(np.abs(implied - both[1].disparity)[known], 0.98) < 0.6


def test_a_pair_of_which_nothing_is_known_dissolves():
    rng = np.random.default_rng(0)
    left, right = (rng.integers(0, 256, (20, 30, 3), dtype=np.uint8) for _ in range(2))
    nothing = sure(np.full((20, 30), np.nan, np.float32))
    view = rectified_pair(left, right, (nothing, nothing)).view(0.25)
    np.testing.assert_allclose(view, 0.75 * left + 0.25 * right, atol=0.6)


def test_wrong_calls_are_refused():
    image, nothing = np.zeros((20, 30, 3), np.uint8), sure(np.zeros((20, 30), np.float32))
    pair = rectified_pair(image, image, (nothing, nothing))
    for s in (-0.1, 1.01, np.nan):
        refuses(ValueError, "from 0", pair.view, s)
    refuses(ValueError, "the same size", rectified_pair, image, image[:-1], (nothing, nothing))
    with pytest.raises(ValueError, match="the same shape"):
        rectified_pair(image, image, (nothing, sure(np.zeros((20, 29), np.float32))))


def field(seed, shape=(14, 23), holes=0.1):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    d = 4.0 + np.sin(x / 6.0) + 0.3 * y
    d[4:9, 7:13] += 6.0
    d[rng.random(shape) < holes] = np.nan
    return d.astype(np.float32)


def test_crossings_are_those_of_all_pairs():
    d = field(0)
    found = detect_monotonicity_violations(d)
    plain = np.zeros(d.shape, dtype=bool)
    for y, row in enumerate(d):
        at = np.arange(len(row)) - row
        for i in range(len(row)):
            for j in range(i + 1, len(row)):
                if at[i] > at[j] + 0.5:
                    plain[y, i] = plain[y, j] = True
    np.testing.assert_array_equal(found, plain)
    assert 0 < plain.sum() < plain.size


def test_empty_rows_take_the_nearest():
    d = np.arange(8.0, dtype=np.float32)[:, None] * np.ones((1, 5), np.float32)
    d[[0, 3, 4, 7]] = np.nan
    np.testing.assert_array_equal(_with_all_rows(d)[:, 0], [1, 1, 2, 2, 5, 5, 6, 6])
    nothing = np.full((3, 4), np.nan, np.float32)
    assert np.isnan(_with_all_rows(nothing)).all()


def neighbours(at, shape, reach, step=1):
    """Index of the pixels of a picture up to ``reach`` rows and columns away."""
    offsets = range(-reach, reach + 1, step)
    return np.ix_(*([a + k for k in offsets if 0 <= a + k < n] for a, n in zip(at, shape, strict=True)))


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
    kernels.filter_extrapolated_by_colour(levels, d, sure, (0, 9), (30.0, 0.5), out)
    kernels.filter_extrapolated_by_colour(levels, d, sure, (9, 20), (30.0, 0.5), out)
    for y, x in np.ndindex(shape):
        if sure[y, x] > 0.0 or np.isnan(d[y, x]):
            np.testing.assert_array_equal(out[y, x], d[y, x])
            continue
        part = neighbours((y, x), shape, kernels.REACH, kernels.STEP)
        apart = np.abs(levels[part] - levels[y, x]).sum(axis=-1)
        weight = np.exp(-apart / 30.0) * np.where(sure[part] > 0.0, 1.0, 0.5)
        values, weight = d[part].ravel(), weight.ravel()
        kept = np.isfinite(values)
        values, weight = values[kept], weight[kept]
        if np.ptp(np.append(values, d[y, x])) <= kernels.ONE_SURFACE_PX:
            assert out[y, x] == d[y, x]
            continue
        order = np.argsort(values)
        below = np.cumsum(weight[order])
        assert out[y, x] == values[order][np.searchsorted(below, 0.5 * weight.sum() - 1e-9)]
    # Between 15 and 18 the colours are those of the left surface.
    guessed = sure[:, 15:18] == 0.0
    assert np.median(out[:, 15:18][guessed & np.isfinite(d[:, 15:18])]) < 5.0


def test_two_pictures_become_one_by_the_rules():
    rng = np.random.default_rng(5)
    shape, s = (12, 15), 0.3
    colors = tuple(rng.uniform(0, 255, (*shape, 3)).astype(np.float32) for _ in range(2))
    fronts = tuple(rng.choice([1.0, 1.4, 6.0, np.nan], shape).astype(np.float32) for _ in range(2))
    weights = tuple(rng.choice([0.01, 0.4, 1.0], (9, 9)).astype(np.float32) for _ in range(2))
    sources = tuple(rng.uniform(-0.5, 8.5, (*shape, 2)).astype(np.float32) for _ in range(2))
    out = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
    kernels.blend(colors, fronts, sources, weights, (0.5, 0.015, s), out)
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
