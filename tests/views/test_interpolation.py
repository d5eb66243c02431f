"""Views between two photographs: where points lie, and what is seen."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from tests.textures import texture
from thesisrecon.geometry.camera_matrix import compose_camera, project
from thesisrecon.views.interpolation import (
    FrameBetween,
    InterpolatedPair,
    check_monotonicity,
    other_side,
    pair_of_rectified,
    unsure,
)

SIZE = (160, 120)
SHIFTS = np.linspace(0.0, 1.0, 7)


def cloud(rng):
    return rng.uniform([-2, -2, 4], [2, 2, 9], (200, 3))


def calibration(focal, rng):
    x, y = rng.uniform(60, 90), rng.uniform(50, 70)
    return np.array([[focal, rng.normal(), x], [0.0, 1.03 * focal, y], [0.0, 0.0, 1.0]])


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
    frame = FrameBetween(np.stack([np.eye(3)] * 2), SIZE)
    for s in SHIFTS:
        between = compose_camera((1 - s) * K[0] + s * K[1], R, -R @ ((1 - s) * centres[0] + s * centres[1]))
        if s not in (0.0, 1.0) and not np.allclose(K[0], K[1]):
            # The centre weighs with the focal lengths; the sum of the cameras is what is meant.
            between = (1 - s) * P[0] + s * P[1]
        found = frame.points(project(P[0], X), project(P[1], X), float(s))
        np.testing.assert_allclose(found, project(between, X), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_cameras_of_one_focal_length_move_along_the_baseline(seed):
    rng = np.random.default_rng(100 + seed)
    X, R, K = cloud(rng), Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_matrix(), calibration(320.0, rng)
    first, step = rng.normal(0, 0.5, 3), R[0] * 0.7 + R[1] * 0.2
    P = [compose_camera(K, R, -R @ (first + s * step)) for s in SHIFTS]
    frame = FrameBetween(np.stack([np.eye(3)] * 2), SIZE)
    xy = [project(P[k], X) for k in (0, -1)]
    for k, s in enumerate(SHIFTS):
        np.testing.assert_allclose(frame.points(xy[0], xy[1], float(s)), project(P[k], X), atol=1e-9)


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
    frame = FrameBetween(H, SIZE)
    xy = [project(p, X) for p in P]
    for s in SHIFTS:
        rectified = compose_camera(K, common, -common @ ((1 - s) * centres[0] + s * centres[1]))
        expected = project(frame.original_from_rectified(float(s)) @ rectified, X)
        np.testing.assert_allclose(frame.points(xy[0], xy[1], float(s)), expected, atol=1e-9)
    for k in (0, 1):
        np.testing.assert_allclose(frame.points(xy[0], xy[1], float(k)), xy[k], atol=1e-9)


def test_corners_behind_a_camera_are_left_out_of_the_frame():
    H = np.eye(3)
    H[2, 0] = -1.0 / 100.0
    frame = FrameBetween(np.stack([H, np.eye(3)]), SIZE)
    G = frame.original_from_rectified(0.0)
    np.testing.assert_allclose(G / G[2, 2], np.linalg.inv(H) / np.linalg.inv(H)[2, 2], atol=1e-9)
    H[2] = [0.0, 0.0, -1.0]
    with pytest.raises(ValueError, match="infinity"):
        FrameBetween(np.stack([H, np.eye(3)]), SIZE).original_from_rectified(0.5)


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
        found.append(unsure(np.where(seen, here, np.nan).astype(np.float32)))
    return found[0], found[1]


def photographs(stage):
    left, right = (np.clip(np.rint(stage.at(s)[0]), 0, 255).astype(np.uint8) for s in (0.0, 1.0))
    return left, right


def psnr(a, b):
    return float(10 * np.log10(255.0**2 / np.mean((a.astype(float) - b) ** 2)))


def test_views_between_are_those_of_the_scene(stage):
    left, right = photographs(stage)
    pair = pair_of_rectified(left, right, disparities(stage))
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
        colors, near = pair.seen(s)
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
    G = pair.frame.original_from_rectified(0.5)
    back = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(G).T
    rectified = back[..., :2] / back[..., 2:]
    truth = stage.at(0.5)[0]
    inside = (rectified > 2).all(axis=-1) & (rectified < np.array(SIZE) - 4.0).all(axis=-1)
    expected = _sampled(truth, *np.clip(rectified, 0, np.array(SIZE) - 2.0).transpose(2, 0, 1))
    off = np.abs(pair.view(0.5) - expected).max(axis=-1)[inside]
    assert inside.mean() > 0.85
    assert np.quantile(off, 0.85) < 6.0
    np.testing.assert_array_equal(pair.view(1.0), turned)


def test_a_turned_view_is_the_view_through_a_homography(stage):
    left, right = photographs(stage)
    pair = pair_of_rectified(left, right, disparities(stage))
    shift = np.array([[1.0, 0.0, 7.0], [0.0, 1.0, -3.0], [0.0, 0.0, 1.0]])
    for s in (0.0, 0.5):
        off = np.abs(pair.view(s, turn=shift)[2:-8, 12:-2] - pair.view(s)[5:-5, 5:-9].astype(float))
        assert np.quantile(off, 0.9) < 1.0
        np.testing.assert_array_equal(pair.view(s, turn=-2.0 * shift), pair.view(s, turn=shift))


def test_exposures_are_interpolated_too(stage):
    left, right = photographs(stage)
    factor = np.array([0.8, 0.7, 0.75])
    darker = np.rint(right * factor).astype(np.uint8)
    pair = pair_of_rectified(left, darker, disparities(stage))
    np.testing.assert_allclose(pair.gain, factor, rtol=0.02)
    view = pair.view(0.5)
    off = np.abs(view - stage.at(0.5)[0] * np.sqrt(factor)).max(axis=-1)
    assert np.quantile(off, 0.85) < 4.0


def test_monotonicity_fails_with_a_thin_thing_in_front(stage):
    wall = check_monotonicity(np.full((20, 50), 3.0, np.float32))
    assert wall.holds
    assert wall.known == 1.0
    d = np.full((20, 50), 3.0, np.float32)
    d[:, 30:33] = 13.0
    thin = check_monotonicity(d)
    # Its left rim passes nine pixels and meets the tenth.
    assert thin.violated[:, 30:33].all()
    assert thin.violated[:, 21:30].all()
    assert thin.share == pytest.approx(12 / 50)
    slanted = check_monotonicity((3.0 + 0.3 * np.arange(50) * np.ones((20, 1))).astype(np.float32))
    assert slanted.holds
    # What both photographs see of a broad thing keeps its order; with what it hides it does not.
    assert check_monotonicity(disparities(stage)[0].disparity).holds
    assert not check_monotonicity(stage.at(0.0)[1].astype(np.float32)).holds
    with pytest.raises(ValueError, match=r"\(H, W\)"):
        check_monotonicity(np.zeros(4, np.float32))


def test_the_right_side_follows_from_the_left(stage):
    both = disparities(stage)
    implied = other_side(both[0]).disparity
    known = np.isfinite(implied) & np.isfinite(both[1].disparity)
    assert known.mean() > 0.75
    assert np.quantile(np.abs(implied - both[1].disparity)[known], 0.98) < 0.6


def test_a_pair_of_which_nothing_is_known_dissolves():
    rng = np.random.default_rng(0)
    left, right = (rng.integers(0, 256, (20, 30, 3), dtype=np.uint8) for _ in range(2))
    nothing = unsure(np.full((20, 30), np.nan, np.float32))
    view = pair_of_rectified(left, right, (nothing, nothing)).view(0.25)
    np.testing.assert_allclose(view, 0.75 * left + 0.25 * right, atol=0.6)


def test_wrong_calls_are_refused():
    image, nothing = np.zeros((20, 30, 3), np.uint8), unsure(np.zeros((20, 30), np.float32))
    pair = pair_of_rectified(image, image, (nothing, nothing))
    for s in (-0.1, 1.01, np.nan):
        with pytest.raises(ValueError, match="from 0"):
            pair.view(s)
    with pytest.raises(ValueError, match="one size"):
        pair_of_rectified(image, image[:-1], (nothing, nothing))
    with pytest.raises(ValueError, match="shape"):
        pair_of_rectified(image, image, (nothing, unsure(np.zeros((20, 29), np.float32))))
