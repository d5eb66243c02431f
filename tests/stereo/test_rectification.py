"""Planar and polar rectification of cameras in every relative position, and resampling through a map."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.geometry.properties import holds_for_every
from tests.synthetic import texture
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix, camera_from_centre, project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.imaging.resampling import STRIP_ROWS, sample_cubic, warp_image
from thesisrecon.stereo import rectification
from thesisrecon.stereo._epipolar_pair import (
    MAX_GROWTH,
    MAX_SHRINK,
    EpipolarPencil,
    pair_of_cameras,
    pair_of_fundamental,
)
from thesisrecon.stereo.rectification import (
    PolarRectification,
    RectifiedImages,
    disparity_range,
    jacobians,
    matches_in_frame,
    measure_quality,
    polar,
    rectify,
)

SIZE = (640, 480)
MOTIONS = (
    "beside", "toed in", "rolled", "upwards", "parallel", "behind", "forward", "diagonal", "half forward",
)  # fmt: skip
PLANAR = MOTIONS[:6]


@dataclass(frozen=True)
class PairOfCameras:
    """``P`` (2, 3, 4), points ``X`` (N, 3), their pixels, ``sizes``."""

    P: np.ndarray
    X: np.ndarray
    xy1: np.ndarray
    xy2: np.ndarray
    sizes: tuple

    @property
    def F(self):
        return fundamental_from_cameras(self.P[0], self.P[1])


def make_pair(motion, rng, *, noise_px=0.0, points=300):
    """Two cameras about 8 from a cloud of points; the second one moved as ``motion`` says."""
    centre, turn = {
        "beside": ((1.5, 0.1, 0.05), (0.01, 0.03, 0.02)), "toed in": ((2.5, 0.2, 0.1), (0.0, -0.3, 0.05)),
        "rolled": ((-1.5, 0.3, 0.1), (0.05, 0.1, 0.9)), "upwards": ((0.1, -1.5, 0.2), (-0.15, 0.0, 0.0)),
        "parallel": ((1.5, 0.0, 0.0), (0.0, 0.0, 0.0)), "behind": ((-2.0, 0.0, -0.5), (0.0, 0.15, 0.0)),
        "forward": ((0.1, 0.05, 2.0), (0.01, 0.02, 0.05)),
        "half forward": ((1.2, 0.1, 2.0), (0.0, -0.3, 0.0)),
        "diagonal": ((0.8, 0.1, 2.0), (0.0, -0.05, 0.1)),
    }[motion]  # fmt: skip
    same, K1 = motion == "parallel", calibration_matrix(700.0, 700.0, 322.0, 236.0)
    sizes = SIZE, SIZE if same else (600, 500)
    K2 = K1 if same else calibration_matrix(640.0, 640.0, 295.0, 255.0)
    R = np.stack([np.eye(3), Rotation.from_rotvec(turn).as_matrix()])
    P = camera_from_centre(np.stack([K1, K2]), R, np.array([(0.0, 0.0, 0.0), centre]))
    X = np.column_stack([rng.uniform(a, b, 9 * points) for a, b in ((-4, 4), (-3, 3), (5, 11))])
    xy = np.stack([project(camera, X) for camera in P])
    inside = ((xy >= 0.0) & (xy <= np.array(sizes)[:, None] - 1.0)).all(axis=(0, 2))
    seen = np.flatnonzero(inside & (X @ P[1, 2, :3] + P[1, 2, 3] > 0.1))[:points]
    xy = xy[:, seen] + noise_px * rng.normal(size=(2, len(seen), 2))
    return PairOfCameras(P, X[seen], *xy, sizes)


PLANAR_METHODS = (
    rectification.hartley,
    rectification.loop_zhang,
    rectification.minimum_distortion,
    rectification.common_orientation,
)
CASES = [(method, motion) for method in PLANAR_METHODS for motion in PLANAR]
CASES += [(polar, motion) for motion in MOTIONS]


def named(value):
    return value if isinstance(value, str) else value.__name__


def both_pairs(scene):
    """The pair of F, and that of the cameras."""
    return (
        pair_of_fundamental(scene.F, scene.xy1, scene.xy2, *scene.sizes),
        pair_of_cameras(*scene.P, *scene.sizes, xy1=scene.xy1, xy2=scene.xy2),
    )


def matched(rectified, pair):
    """Differences (N, 2) of the rectified matches."""
    left, right = matches_in_frame(rectified, pair.matches)
    return left - right


@pytest.mark.parametrize(("method", "motion"), CASES, ids=named)
def test_exact_matches_share_their_row_and_nearer_ones_are_farther_left_on_the_right(method, motion):
    scene = make_pair(motion, np.random.default_rng(0))
    for pair in both_pairs(scene)[method is rectification.common_orientation :]:
        rectified = method(pair)
        left = rectified.rectified_from_original(0, scene.xy1)
        right = rectified.rectified_from_original(1, scene.xy2)
        seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
        assert seen.mean() > 0.97
        assert np.abs(left - right)[seen, 1].max() < 1e-8
        # A point ten percent farther on the ray of view 0 has a smaller disparity.
        beyond = rectified.rectified_from_original(1, project(scene.P[1], 1.1 * scene.X), within=False)
        assert (beyond[seen, 0] > right[seen, 0]).all()


@pytest.mark.parametrize(("method", "motion"), CASES, ids=named)
def test_no_pixel_shrinks_by_more_than_is_stated_and_none_is_mirrored(method, motion):
    scene = make_pair(motion, np.random.default_rng(1))
    pair = both_pairs(scene)[1]
    rectified = method(pair)
    quality = measure_quality(rectified, pair)
    assert quality.min_scale >= 1.0 / MAX_SHRINK - 1e-2
    assert quality.size_ratio <= MAX_GROWTH
    for side in (0, 1):
        inside = np.isfinite(rectified.rectified_from_original(side, pair.regions[side])).all(axis=1)
        J = jacobians(rectified, side, pair.regions[side][inside])
        reported = np.isfinite(J).all(axis=(1, 2))
        assert (np.linalg.det(J[reported]) > 0.0).all()
        assert reported.mean() > 0.95


@holds_for_every(st.sampled_from(CASES), examples=60)
def test_the_maps_are_inverse_to_each_other(rng, case):
    method, motion = case
    scene = make_pair(motion, rng)
    rectified = method(both_pairs(scene)[1])
    width, height = rectified.size
    # The last row of a full turn is the first one again.
    places = rng.uniform([-0.4, -0.4], [width - 0.6, height - 1.6], (200, 2))
    for side in (0, 1):
        xy = rectified.original_from_rectified(side, places)
        shown = np.isfinite(xy).all(axis=1) & (np.abs(xy) < 2000.0).all(axis=1)
        assert np.abs(rectified.rectified_from_original(side, xy[shown]) - places[shown]).max() < 1e-9
        pixels = rng.uniform([0.0, 0.0], np.array(scene.sizes[side]) - 1.0, (200, 2))
        there = rectified.rectified_from_original(side, pixels)
        shown = np.isfinite(there).all(axis=1)
        back = rectified.original_from_rectified(side, there[shown])
        assert np.abs(back - pixels[shown]).max(initial=0.0) < 1e-9
        if method is not polar:
            # A third as many pixels a side show the same area.
            smaller = rectified.reduced(1 / 3).rectified_from_original(side, pixels[shown], within=False)
            np.testing.assert_allclose(smaller, (there[shown] + 0.5) / 3.0 - 0.5, atol=1e-9)


@pytest.mark.parametrize(
    ("method", "motion"), [(rectification.loop_zhang, "toed in"), (polar, "forward")], ids=named
)
def test_the_lookup_is_the_map_at_whole_pixels(method, motion):
    rectified = method(both_pairs(make_pair(motion, np.random.default_rng(2)))[0])
    rows = range(37, 42)
    x, y = np.meshgrid(np.arange(float(rectified.size[0])), np.array(rows, dtype=np.float64))
    expected = rectified.original_from_rectified(1, np.column_stack([x.ravel(), y.ravel()]))
    np.testing.assert_allclose(rectified._lookup(1, rows).reshape(-1, 2), expected, atol=1e-10)
    outside = np.array([[-1.0, 3.0], [3.0, -1.0], [rectified.size[0], 3.0], [3.0, rectified.size[1]]])
    assert np.isnan(rectified.original_from_rectified(0, outside)).all()


def test_a_parallel_pair_stays_as_it_is():
    scene = make_pair("parallel", np.random.default_rng(3))
    for method in (
        rectification.loop_zhang,
        rectification.minimum_distortion,
        rectification.common_orientation,
    ):
        for H in method(both_pairs(scene)[1]).H:
            expected = np.eye(3)
            expected[:2, 2] = (H / H[2, 2])[:2, 2]
            # The disparities of any scene slope a little; a shear takes part of that.
            atol = 0.1 if method is rectification.minimum_distortion else 1e-6
            np.testing.assert_allclose(H / H[2, 2], expected, atol=atol)


def test_disparities_of_a_common_orientation_are_inverse_depths():
    scene = make_pair("toed in", np.random.default_rng(4))
    pair = both_pairs(scene)[1]
    rectified = rectification.common_orientation(pair)
    d = matched(rectified, pair)[:, 0]
    # The third coordinate of the new orientation is that of H1 M1 over its scale.
    M = rectified.H[0] @ scene.P[0, :, :3]
    inverse = np.linalg.norm(M[2]) / (scene.X @ M[2])
    slope, offset = np.polyfit(inverse, d, 1)
    assert slope > 0.0
    np.testing.assert_allclose(d, slope * inverse + offset, atol=1e-8)


def test_each_planar_method_is_best_at_what_it_minimises():
    scene = make_pair("beside", np.random.default_rng(5))
    pair = both_pairs(scene)[0]
    centre = (np.array(scene.sizes[1]) - 1.0) / 2.0
    J = jacobians(rectification.hartley(pair), 1, centre[None])[0]
    s = np.linalg.svd(J, compute_uv=False)
    assert s[0] / s[1] == pytest.approx(1.0, abs=1e-5)
    spread = [np.ptp(np.quantile(matched(m(pair), pair)[:, 0], [0.01, 0.99])) for m in PLANAR_METHODS[:3]]
    assert spread[0] == min(spread)
    for motion in ("beside", "toed in", "rolled", "behind"):
        pair = both_pairs(make_pair(motion, np.random.default_rng(6), noise_px=0.1))[0]
        found = {m: measure_quality(m(pair), pair) for m in PLANAR_METHODS[:3]}
        assert np.abs(np.array(found[rectification.loop_zhang].orthogonality_deg) - 90.0).max() < 5.0
        assert np.abs(np.array(found[rectification.loop_zhang].aspect) - 1.0).max() < 0.1
        least = min(quality.distortion for quality in found.values())
        # The crop, which the measure heeds, depends on the result.
        assert found[rectification.minimum_distortion].distortion < least + 0.01


@pytest.mark.parametrize("motion", ["forward", "diagonal", "half forward"])
def test_epipoles_inside_are_for_polar_frames_alone(motion):
    scene = make_pair(motion, np.random.default_rng(8))
    pair = both_pairs(scene)[1]
    for method in PLANAR_METHODS:
        refuses(StageFailure, "polar", method, pair)
    for best in (
        rectify(pair_of_fundamental(scene.F, scene.xy1, scene.xy2, *scene.sizes)),
        rectify(pair_of_cameras(*scene.P, *scene.sizes, xy1=scene.xy1, xy2=scene.xy2)),
        rectify(pair_of_cameras(*scene.P, *scene.sizes)),
    ):
        assert isinstance(best, PolarRectification)
        for side, size in enumerate(pair.pencil.sizes):
            pixels = np.random.default_rng(0).uniform([0.0, 0.0], np.array(size) - 1.0, (500, 2))
            assert np.isfinite(best.rectified_from_original(side, pixels)).all(axis=1).mean() > 0.5


def test_the_best_is_planar_for_neighbours_and_polar_where_planar_frames_stretch(monkeypatch):
    scene = make_pair("beside", np.random.default_rng(9))
    best = rectify(pair_of_fundamental(scene.F, scene.xy1, scene.xy2, *scene.sizes))
    assert isinstance(best, rectification.PlanarRectification)
    wide = both_pairs(make_pair("toed in", np.random.default_rng(9)))[0]
    monkeypatch.setattr(rectification, "BENDING", -1.0)
    assert isinstance(rectify(wide, (rectification.minimum_distortion, polar)), PolarRectification)


def test_matches_bound_the_disparities_and_a_few_wrong_ones_do_not():
    scene = make_pair("beside", np.random.default_rng(10))
    rectified = rectification.common_orientation(pair_of_cameras(*scene.P, *scene.sizes))
    low, high = disparity_range(rectified, scene.xy1, scene.xy2)
    left = rectified.rectified_from_original(0, scene.xy1)
    d = left[:, 0] - rectified.rectified_from_original(1, scene.xy2)[:, 0]
    assert low < d.min()
    assert d.max() < high
    wrong = scene.xy1.copy()
    wrong[:2] = rectified.original_from_rectified(0, left[:2] - [300.0, 0.0], within=False)
    again = disparity_range(rectified, wrong, scene.xy2)
    assert abs(again[0] - low) + abs(again[1] - high) < 0.2 * (high - low)
    refuses(StageFailure, "disparity range", disparity_range, rectified, scene.xy1[:0], scene.xy2[:0])


@pytest.mark.parametrize("scale", [0.25, 0.5, 2.0])
def test_images_of_unequal_resolution_have_one_resolution_in_a_polar_frame(scale):
    pair = make_pair("forward", np.random.default_rng(11))
    S = np.array([[scale, 0.0, 0.5 * scale - 0.5], [0.0, scale, 0.5 * scale - 0.5], [0.0, 0.0, 1.0]])
    same, other = both_pairs(pair)[1], pair_of_cameras(
        pair.P[0], S @ pair.P[1], pair.sizes[0], tuple(round(scale * side) for side in pair.sizes[1]),
        xy1=pair.xy1, xy2=(pair.xy2 + 0.5) * scale - 0.5,
    )  # fmt: skip
    frames = [polar(one) for one in (same, other)]
    most = [np.ptp(matched(frame, one)[:, 0]) for frame, one in zip(frames, (same, other), strict=True)]
    # The range of the disparities is that of equal images, in pixels of the frame.
    assert 0.6 < most[1] / most[0] < 1.1 * max(scale, 1.0)
    np.testing.assert_allclose(matched(frames[1], other)[:, 1], 0.0, atol=1e-6)


@pytest.mark.parametrize("motion", ["beside", "toed in", "upwards", "diagonal"])
def test_images_in_the_other_order_do_not_fit_the_fundamental_matrix(motion):
    """Their rows would be off by tens of pixels; with noise the right ones are within one or two."""
    scene = make_pair(motion, np.random.default_rng(13), noise_px=0.5)
    sizes = scene.sizes[::-1]
    refuses(
        StageFailure, "does not fit the matches", pair_of_fundamental, scene.F, scene.xy2, scene.xy1, *sizes
    )
    rectify(pair_of_fundamental(scene.F.T, scene.xy2, scene.xy1, *sizes))


def test_pairs_that_cannot_be_rectified_are_refused_with_a_reason():
    rng = np.random.default_rng(11)
    scene = make_pair("beside", rng)
    given = {"F": scene.F, "xy1": scene.xy1, "xy2": scene.xy2, "size1": SIZE, "size2": SIZE}
    H = np.array([[1.0, 0.02, 5.0], [-0.02, 1.0, 3.0], [1e-5, 2e-5, 1.0]])
    turned = dehomogenize(homogenize(scene.xy1) @ H.T) + 0.1 * rng.normal(size=scene.xy1.shape)
    ahead = make_pair("forward", np.random.default_rng(12))
    # Half of the points moved to the other side of the epipole, where their lines run on.
    e = np.linalg.svd(ahead.F.T)[2][2]
    other = ahead.xy2.copy()
    other[::2] = 2.0 * e[:2] / e[2] - other[::2]
    for words, change in (
        ("no parallax", {"xy2": turned}),
        ("opposite halves", {"F": ahead.F, "xy1": ahead.xy1, "xy2": other, "size2": ahead.sizes[1]}),
        ("too few", {"xy1": scene.xy1[:5], "xy2": scene.xy2[:5]}),
        ("rank 1", {"F": np.outer([1.0, 2.0, 3.0], [3.0, 1.0, 2.0])}),
    ):
        refuses(StageFailure, words, pair_of_fundamental, **(given | change))
    for change in (
        {"F": np.zeros((3, 3))}, {"F": np.eye(2)}, {"F": np.full((3, 3), np.nan)},
        {"xy1": np.zeros((4, 2))}, {"xy1": np.full((300, 2), np.inf)}, {"size1": (1, 480)},
        {"size2": (640, 0)},
    ):  # fmt: skip
        refuses(ValueError, r"rectif|matches|image", pair_of_fundamental, **(given | change))
    same, near, away = (scene.P.copy() for _ in range(3))
    same[1] = same[1, :, :3] @ np.eye(3, 4)
    near[1, :, 3] *= 1e-5
    away[1] = camera_from_centre(scene.P[0, :, :3], np.diag([-1.0, 1.0, -1.0]), np.array([1.5, 0.0, -5.0]))
    x2 = project(near[1], scene.X) + 0.05 * rng.normal(size=scene.xy1.shape)
    refuses(StageFailure, "the same centre", pair_of_cameras, *same, SIZE, SIZE)
    refuses(StageFailure, "no parallax", pair_of_cameras, *near, SIZE, SIZE, xy1=scene.xy1, xy2=x2)
    refuses(StageFailure, "in front of both", pair_of_cameras, *away, SIZE, SIZE)


def planar_frame(H, size):
    """Both images mapped by one homography."""
    return rectification.PlanarRectification(np.stack([H, H]), size)


def test_strips_do_not_show_and_grey_is_one_channel():
    image = texture(260, 200).astype(np.float32)
    H = np.array([[0.8, 0.1, 3.0], [-0.1, 0.7, 20.0], [1e-4, 0.0, 1.0]])
    rectified = planar_frame(H, (150, 2 * STRIP_ROWS + 1))
    whole = np.empty((rectified.size[1], 150, 1), np.float32)
    sample_cubic(image[:, :, None], rectified._lookup(0, range(rectified.size[1])), True, whole)
    grey = rectified.warp(image, 0)
    np.testing.assert_array_equal(grey, whole[:, :, 0])
    colour = rectified.warp(np.repeat(image[:, :, None], 3, axis=2), 1)
    np.testing.assert_array_equal(colour, np.repeat(grey[:, :, None], 3, axis=2))


def test_whole_pixels_are_kept_and_quadratics_are_reproduced():
    image = texture(40, 50).astype(np.float32)
    np.testing.assert_allclose(planar_frame(np.eye(3), (50, 40)).warp(image, 0), image, atol=1e-4)
    one = warp_image(image, lambda rows: np.full((len(rows), 1, 2), 3.0), (1, 1))
    assert one[0, 0] == pytest.approx(image[3, 3], abs=1e-4)
    assert np.isnan(planar_frame(np.eye(3), (53, 40)).warp(image, 0)[:, 50:]).all()

    def quadratic(x, y):
        return 0.05 * x**2 - 0.03 * x * y + 0.02 * y**2 + x

    y, x = np.mgrid[0:40, 0:50].astype(np.float64)
    larger = planar_frame(np.array([[1.3, 0.2, -5.0], [-0.2, 1.4, 2.0], [0.0, 0.0, 1.0]]), (60, 60))
    found = larger.warp(quadratic(x, y).astype(np.float32), 0)
    u, v = np.moveaxis(larger._lookup(0, range(60)), 2, 0)
    inner = (u > 2) & (u < 47) & (v > 2) & (v < 37)
    np.testing.assert_allclose(found[inner], quadratic(u, v)[inner], atol=1e-3)


@pytest.mark.parametrize("limits", [(-41, 30), (-30, -5), (0, 12), (5, 40)], ids=str)
def test_every_match_of_the_range_is_in_the_moved_images(limits):
    columns = np.broadcast_to(np.arange(80, dtype=np.uint8)[:, None], (10, 80, 3))
    pair = RectifiedImages.of(planar_frame(np.eye(3), (80, 10)), (columns, columns), limits)
    assert pair.max_disparity_px == limits[1] - limits[0]
    x, d = (a.ravel() for a in np.meshgrid(np.arange(80), np.arange(limits[0], limits[1] + 1)))
    x, d = (a[(x - d >= 0) & (x - d < 80)] for a in (x, d))
    ends = [np.column_stack([a, np.full(len(a), 4)]).astype(float) for a in (x, x - d)]
    moved = [pair.rectified_from_original(side, xy) for side, xy in enumerate(ends)]
    np.testing.assert_array_equal(moved[0][:, 0] - moved[1][:, 0], d - limits[0])
    for side, image in enumerate((pair.left, pair.right)):
        at = moved[side].astype(int)
        np.testing.assert_array_equal(image[at[:, 1], at[:, 0], 0], ends[side][:, 0])
        np.testing.assert_array_equal(pair.original_from_rectified(side, moved[side]), ends[side])


def test_levels_of_rectified_images_are_those_of_images():
    """Cubic convolution alone overshoots beside an edge."""
    edge = np.zeros((20, 30, 3), np.uint8)
    edge[:, 15:] = 255
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    pair = RectifiedImages.of(planar_frame(half, (30, 20)), (edge, edge), (0, 5))
    assert np.isnan(pair.left[:, 0]).all()
    assert (pair.left[:, 1:].min(), pair.left[:, 1:].max()) == (0.0, 255.0)


def test_lines_beside_an_image_parallel_to_its_border_have_finite_ends():
    rows = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # l = (0, a, b): y = -b / a
    middles = np.full((2, 2), [49.5, 39.5])
    pencil = EpipolarPencil(np.stack([rows, rows]), middles, np.full(2, 50.0), ((100, 80),) * 2)
    phi = pencil.angles(0, np.array([[20.0, 10.0], [20.0, 200.0], [20.0, -90.0], [5.0, 79.0]]))
    lines, enter, leave = pencil.chords(0, phi)
    assert (lines.direction[:, 1] == 0.0).all()
    assert (leave >= enter).tolist() == [True, False, False, True]
    assert np.isfinite([enter, leave]).all()
    assert leave[0] - enter[0] == pytest.approx(99 / 50)
