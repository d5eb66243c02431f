"""View interpolation, warping and their kernels."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.synthetic import texture
from thesisrecon.api.views import prepare_rectified_pair
from thesisrecon.camera import compose_camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.imaging.raster import sample_texture
from thesisrecon.records import DisparityMap
from thesisrecon.stereo.correspondence import RectifiedPair
from thesisrecon.stereo.rectification import PlanarRectification
from thesisrecon.views._warping import DIRECTIONS, fill_holes, forward_map, sample
from thesisrecon.views.interpolation import (
    InterpolatedPair,
    disparity_of_right,
    original_from_rectified,
    prepare_interpolation,
)

SIZE = (160, 120)
SHIFTS = np.linspace(0.0, 1.0, 7)


def detect_monotonicity_violations(disparity):
    """Find the pixels of a rectified image that violate the monotonicity constraint (figure 1.1).

    If u1 is left of v1 then u2 must be left of v2; then u is left of v in every view between.
    """
    slack_px = 0.5  # Largest violation of monotonicity that counts as noise of the disparities
    at = np.arange(disparity.shape[1]) - disparity.astype(np.float64)
    padded = np.pad(at, ((0, 0), (1, 1)), constant_values=((0, 0), (-np.inf, np.inf)))
    rightmost = np.fmax.accumulate(padded[:, :-2], axis=1)
    leftmost = np.fmin.accumulate(padded[:, :1:-1], axis=1)[:, ::-1]
    return (rightmost > at + slack_px) | (leftmost < at - slack_px)


def sure(disparity):
    """Disparities that are certain where they are known."""
    return DisparityMap(disparity, np.isfinite(disparity).astype(np.float32), 0.0)


def cloud(rng):
    return rng.uniform([-2, -2, 4], [2, 2, 9], (200, 3))


def calibration(focal, rng):
    x, y = rng.uniform(60, 90), rng.uniform(50, 70)
    return np.array([[focal, rng.normal(), x], [0.0, 1.03 * focal, y], [0.0, 0.0, 1.0]])


def points_between(H, xy, s):
    """Image points of the view at s."""
    left, right = (dehomogenize(homogenize(one) @ side.T) for one, side in zip(xy, H, strict=True))
    return dehomogenize(homogenize((1.0 - s) * left + s * right) @ original_from_rectified(H, SIZE, s).T)


@pytest.mark.parametrize("seed", range(5))
def test_interpolation_along_the_baseline_is_the_projection_of_a_parallel_camera(seed):
    """P_s = (1 - s) P_0 + s P_1: the centre on the baseline, the focal length in between (Seitz and Dyer)."""
    rng = np.random.default_rng(seed)
    X, R = cloud(rng), Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_matrix()
    centres = rng.normal(0, 0.5, (2, 3))
    # Along the image plane, in any direction within it.
    centres[1] += (R[2] @ (centres[0] - centres[1])) * R[2]
    P = [compose_camera(calibration(f, rng), R, -R @ c) for f, c in zip((300.0, 340.0), centres, strict=True)]
    for s in SHIFTS:
        found = points_between(np.stack([np.eye(3)] * 2), [project(p, X) for p in P], float(s))
        np.testing.assert_allclose(found, project((1 - s) * P[0] + s * P[1], X), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_turned_cameras_are_seen_from_the_baseline_up_to_a_homography_and_exactly_at_the_ends(seed):
    rng = np.random.default_rng(200 + seed)
    X, K = cloud(rng), calibration(320.0, rng)
    centres = np.array([[-0.5, 0.1, 0.0], [0.5, -0.1, 0.1]])
    common = np.cross([0.0, 0.0, 1.0], centres[1] - centres[0])
    common = np.stack([centres[1] - centres[0], common, np.cross(centres[1] - centres[0], common)])
    common /= np.linalg.norm(common, axis=1, keepdims=True)
    turns = [Rotation.from_rotvec(rng.normal(0, 0.12, 3)).as_matrix() for _ in range(2)]
    xy = [project(compose_camera(K, R, -R @ c), X) for R, c in zip(turns, centres, strict=True)]
    H = np.stack([K @ common @ np.linalg.inv(K @ R) for R in turns])
    for s in SHIFTS:
        rectified = compose_camera(K, common, -common @ ((1 - s) * centres[0] + s * centres[1]))
        expected = project(original_from_rectified(H, SIZE, float(s)) @ rectified, X)
        np.testing.assert_allclose(points_between(H, xy, float(s)), expected, atol=1e-9)
    for k in (0, 1):
        np.testing.assert_allclose(points_between(H, xy, float(k)), xy[k], atol=1e-9)


class Stage:
    """A box in front of a slanted wall, both textured, seen by parallel cameras at s."""

    def __init__(self):
        layers = [gaussian_filter(texture(200, 320, seed), 1.0) for seed in range(6)]
        self.wall, self.box = np.stack(layers[:3], axis=-1), np.stack(layers[3:], axis=-1)
        (left, d0), (right, d1) = self.at(0.0), self.at(1.0)
        self.left, self.right = (np.clip(np.rint(a), 0, 255).astype(np.uint8) for a in (left, right))
        # Disparities of both photographs, NaN where the other one does not see the pixel.
        self.maps = []
        for here, there, sign in ((d0, d1, -1), (d1, d0, 1)):
            at = np.rint(np.arange(SIZE[0]) + sign * here).astype(int)
            other = np.take_along_axis(there, np.clip(at, 0, SIZE[0] - 1), axis=1)
            seen = (at >= 0) & (at < SIZE[0]) & (np.abs(other - here) < 1.0)
            self.maps.append(sure(np.where(seen, here, np.nan).astype(np.float32)))

    def at(self, s):
        """Colours (120, 160, 3) and disparities of the view at s."""
        y, x = np.indices(SIZE[::-1]).astype(float)
        # The wall: d = 4 + 0.02 x_0 where x_s = x_0 - s d.
        x0 = (x + 4.0 * s) / (1.0 - 0.02 * s)
        color, d = _sampled(self.wall, x0 + 60.0, y + 30.0), 4.0 + 0.02 * x0
        b = x + 16.0 * s
        box = (np.abs(b - 90.0) <= 20.0) & (np.abs(y - 60.0) <= 30.0)
        color[box] = _sampled(self.box, b + 60.0, y + 30.0)[box]
        d[box] = 16.0
        return color, d


def _sampled(image, x, y):
    """Colours (H, W, 3) of an image at places."""
    return np.stack([map_coordinates(image[..., k], [y, x], order=1) for k in range(3)], axis=-1)


@pytest.fixture(scope="module")
def stage():
    return Stage()


def psnr(a, b):
    return float(10 * np.log10(255.0**2 / np.mean((a.astype(float) - b) ** 2)))


def test_views_between_are_those_of_the_scene(stage):
    left, right = stage.left, stage.right
    pair = prepare_rectified_pair(left, right, disparity=tuple(stage.maps))
    assert isinstance(pair, InterpolatedPair)
    for s in (0.25, 0.5, 0.8):
        truth, _ = stage.at(s)
        view = pair.view(s, threads=2)
        np.testing.assert_array_equal(view, pair.view(s))
        assert view.dtype == np.uint8
        assert psnr(view, truth) > psnr((1 - s) * left + s * right, truth) + 8.0
        # Away from the rims of the box only rounding is left.
        assert np.quantile(np.abs(view - truth).max(axis=-1), 0.9) < 3.0
    np.testing.assert_array_equal(pair.view(0.0), left)
    np.testing.assert_array_equal(pair.view(1), right)


def test_rectified_and_turned_photographs_give_the_view_of_a_turned_camera(stage):
    """The same pair, its second photograph seen through a homography: between them the frame is halfway."""
    H = np.stack([np.eye(3), np.array([[1.0, 0.02, 3.0], [-0.02, 1.0, -2.0], [0.0, 0.0, 1.0]])])
    y, x = np.indices(SIZE[::-1]).astype(float)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    padded, at = np.pad(stage.right, ((8, 8), (8, 8), (0, 0)), mode="edge").astype(float), pixels @ H[1].T + 8
    turned = np.rint(_sampled(padded, at[..., 0], at[..., 1])).astype(np.uint8)
    dense = RectifiedPair(PlanarRectification(H, SIZE), (stage.left, turned), np.ones(3), *stage.maps)
    places = dense.correspondences(0, SIZE), dense.correspondences(1, SIZE)
    pair = prepare_interpolation((stage.left, turned), H, stage.maps[0], places, gain=dense.gain)
    rectified = dehomogenize(pixels @ np.linalg.inv(original_from_rectified(H, SIZE, 0.5)).T)
    inside = (rectified > 2).all(axis=-1) & (rectified < np.array(SIZE) - 4.0).all(axis=-1)
    expected = _sampled(stage.at(0.5)[0], rectified[..., 0], rectified[..., 1])
    off = np.abs(pair.view(0.5) - expected).max(axis=-1)[inside]
    assert inside.mean() > 0.85
    assert np.quantile(off, 0.85) < 6.0
    np.testing.assert_array_equal(pair.view(1.0), turned)


def test_the_right_side_follows_from_the_left_and_exposures_are_interpolated(stage):
    off = np.abs(disparity_of_right(stage.maps[0]).disparity - stage.maps[1].disparity)
    assert np.isfinite(off).mean() > 0.75
    assert np.nanquantile(off, 0.98) < 0.6
    factor = np.array([0.8, 0.7, 0.75])
    darker = np.rint(stage.right * factor).astype(np.uint8)
    pair = prepare_rectified_pair(stage.left, darker, disparity=tuple(stage.maps))
    np.testing.assert_allclose(pair.synthesis.gain, 1.0 / factor, rtol=0.02)
    off = np.abs(pair.view(0.5) - stage.at(0.5)[0] * np.sqrt(factor)).max(axis=-1)
    assert np.quantile(off, 0.85) < 4.0


def test_corners_behind_a_camera_are_left_out_and_wrong_calls_refused():
    image, still = np.zeros((20, 30, 3), np.uint8), np.zeros((20, 30), np.float32)
    for s in (-0.1, 1.01, np.nan):
        refuses(ValueError, "from 0", prepare_rectified_pair(image, image, disparity=still).view, s)
    nothing = np.full((20, 30), np.nan)
    refuses(StageFailure, "correspond", prepare_rectified_pair, image, image, disparity=nothing)
    H = np.eye(3)
    H[2, 0] = -1.0 / 100.0
    G = original_from_rectified(np.stack([H, np.eye(3)]), SIZE, 0.0)
    np.testing.assert_allclose(G / G[2, 2], np.linalg.inv(H) / np.linalg.inv(H)[2, 2], atol=1e-9)
    H[2] = [0.0, 0.0, -1.0]
    refuses(ValueError, "infinity", original_from_rectified, np.stack([H, np.eye(3)]), SIZE, 0.5)


def forward_warp(image, target, near, **more):
    """Levels and inverse depth of an image seen from elsewhere."""
    source, front = forward_map(target, near, **more)
    return sample(image, source), front


def test_strips_include_contributions_from_far_above():
    y, x = np.mgrid[0:14, 0:14].astype(float)
    target = np.stack([1.4 * x, 2.8 * y], axis=-1)
    # Every third pixel is elsewhere, so that the triangle opposite to it stands alone.
    target[::3, ::3, 1] -= 9.0
    near, options = (x + 0.01 * y).astype(np.float32), {"size": (20, 40), "step": 2.0}
    whole = forward_map(target, near, **options)
    for threads in (2, 7, 40):
        for part, again in zip(whole, forward_map(target, near, **options, threads=threads), strict=True):
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
    inner = ((back >= 1.0) & (back <= [28.0, 18.0])).all(axis=-1)
    np.testing.assert_allclose(rgb[inner][:, :2], expected[inner], atol=1e-3)
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
    near, image = np.where(front, 8.0, 0.0), np.where(front, 200.0, 50.0)[..., None]
    # Mirrored twice: the same orientation in the picture.
    parts = [a[::order, ::order] for a in (image, np.stack([x + near, y], axis=-1), near)]
    rgb, seen = forward_warp(*parts, size=(40, 24), step=1.0)
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
    for hole in np.argwhere(np.isnan(near)):
        # The first pixel that is seen in each direction.
        ways = [[tuple(hole + n * np.array(d)) for n in range(1, 18)] for d in DIRECTIONS]
        ways = [
            [at for at in way if 0 <= at[0] < 14 and 0 <= at[1] < 17 and near[at] == near[at]] for way in ways
        ]
        first = [way[0] for way in ways if way]
        z, color = np.array([near[at] for at in first]), np.array([rgb[at] for at in first])
        if not first:
            assert np.isnan(filled[tuple(hole)]).all()
            continue
        kept = z <= z.min() + max(0.5, 0.4 * np.ptp(z))
        weight = 1.0 / np.sum((np.array(first) - hole) ** 2, axis=1)
        mean = np.average(color[kept], axis=0, weights=weight[kept])
        np.testing.assert_allclose(filled[tuple(hole)], mean, rtol=1e-5)


def test_samples_are_cubic_within_the_pixel_centres():
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
    outside = np.array([[[-0.4, 3.0], [np.nan, 1.0], [3.0, 11.2], [14.0, 11.0]]], dtype=np.float32)
    np.testing.assert_array_equal(np.isnan(sample(image, outside)[0, :, 1]), [True, True, True, False])
    # Neighbours on another surface have no effect.
    apart = np.stack([at[:1, :6], at[:1, :6] * 0.5 + 3.0], axis=2).reshape(1, 12, 2)
    np.testing.assert_array_equal(sample(image, apart)[:, ::2], sample(image, at[:1, :6]))


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
    drawn, seen = rng.integers(-1, 3, (20, 30)), np.zeros((2, 20, 30, 3), dtype=np.float32)
    sample_texture(texture, uv, drawn, seen[0])
    sample_texture(texture.astype(np.float32), uv, drawn, seen[1])
    np.testing.assert_array_equal(*seen)
    at = [uv[..., 1], uv[..., 0]]
    plain = [map_coordinates(texture[..., k].astype(float), at, order=1, mode="nearest") for k in range(3)]
    plain = np.where(drawn[..., None] < 0, 0.0, np.stack(plain, axis=-1))
    np.testing.assert_allclose(seen[0], plain, atol=1e-2)
