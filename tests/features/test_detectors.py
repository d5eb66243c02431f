import numpy as np
import pytest
from scipy.ndimage import convolve1d, correlate1d, gaussian_filter, maximum_filter
from scipy.special import erf

from tests.conftest import refuses
from tests.constants import with_constants
from tests.synthetic import photograph, texture
from thesisrecon.features.harris import (
    CornerMeasure,
    HarrisCorners,
    corner_response,
    enforce_spacing,
    fit_maxima,
    select_spread,
)
from thesisrecon.features.multiscale import (
    PATCH_VALUES,
    MultiScaleCorners,
    _low_frequencies,
    _normalize_patches,
    sample_patches,
    simulate_view,
)
from thesisrecon.imaging.resampling import gaussian_taps
from thesisrecon.records import Image

HARRIS = CornerMeasure(formula="harris", integration_sigma_px=1.0, colour=True)
VARIANTS = [
    HarrisCorners(),
    MultiScaleCorners(),
    HarrisCorners(selection="spread", measure=HARRIS),
    MultiScaleCorners(measure=HARRIS),
]


def chessboard(dx, dy):
    """Four quadrants meeting at (60 + dx, 50 + dy); an edge is the integral of a Gaussian of sigma 0.4."""
    x, y = np.arange(120) - 60 - dx, np.arange(100) - 50 - dy
    return photograph(128 + 90 * erf(x / 0.57)[None] * erf(y / 0.57)[:, None])


@pytest.mark.parametrize(
    "variant", [HarrisCorners(), with_constants(MultiScaleCorners, upsample_below_px=0)()]
)
@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.3, -0.2), (-0.45, 0.4)])
def test_a_corner_is_found_between_the_pixels(variant, dx, dy):
    features = variant.detect(chessboard(dx, dy))
    distance = np.linalg.norm(features.xy - (60 + dx, 50 + dy), axis=1)
    assert distance.min() < 0.25


@pytest.mark.parametrize("variant", VARIANTS)
def test_corners_are_sorted_inside_and_the_same_each_time(variant):
    image = photograph(texture(200, 260))
    features, again = variant.detect(image), variant.detect(image)
    assert len(features.xy) > 300
    assert (np.diff(features.response) <= 0).all()
    assert (features.xy >= 0).all()
    assert (features.xy <= (259, 199)).all()
    assert features.xy.dtype == np.float64
    assert features.scale.dtype == features.response.dtype == np.float32
    assert np.array_equal(features.xy, again.xy)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("size", [(1, 1), (2, 3), (9, 9), (20, 20), (5, 400), (64, 48)])
@pytest.mark.parametrize("kind", ["blank", "noise"])
def test_tiny_blank_and_noisy_images_do_no_harm(variant, size, kind):
    rng = np.random.default_rng(0)
    gray = np.full(size, 77.0) if kind == "blank" else rng.uniform(0, 255, size)
    features = variant.detect(photograph(gray))
    assert len(features.xy) == len(features.scale) == len(features.response)
    assert np.isfinite(features.xy).all()
    if kind == "blank":
        assert len(features.xy) == 0


def test_thesis_corners_keep_their_distance_and_their_number():
    features = with_constants(HarrisCorners, spacing_rel=0.02)(max_corners=150).detect(
        photograph(texture(300, 400))
    )
    distance = np.linalg.norm(features.xy[:, None] - features.xy[None], axis=2) + 1e9 * np.eye(
        len(features.xy)
    )
    assert len(features.xy) == 150
    assert distance.min() >= 0.02 * 400


def test_corners_that_are_spread_cover_the_image_though_one_side_is_faint():
    gray = texture(400, 1100)
    gray[:, 550:] = 128 + 0.15 * (gray[:, 550:] - 128)
    features = MultiScaleCorners(full_corners=600, half_corners=300).detect(photograph(gray))
    assert (features.xy[:, 0] > 560).mean() > 0.1
    strongest = MultiScaleCorners(full_corners=600, half_corners=0, spread=False).detect(photograph(gray))
    assert set(strongest.scale.tolist()) == {1.0}
    assert (strongest.xy[:, 0] > 560).mean() < 0.05


@pytest.mark.parametrize(("width", "scales"), [(420, {0.5, 1.0}), (1040, {1.0, 2.0})])
def test_two_sizes_and_seeds_twice_in_the_pixels_of_the_photograph(width, scales):
    features = MultiScaleCorners().detect(photograph(texture(300, width)))
    assert set(features.scale.tolist()) == scales
    seeds = features.seeds
    assert seeds is not None
    assert seeds.patches.dtype == np.float32
    assert np.abs(np.linalg.norm(seeds.patches, axis=1) - 1).max() < 1e-4
    assert (seeds.angle == 0).mean() == pytest.approx(0.5, abs=0.01)
    assert (seeds.xy <= (width - 1, 299)).all()


def test_turned_patches_turn_with_the_photograph():
    gray = texture(301, 301, 8)
    one = MultiScaleCorners().detect(photograph(gray)).seeds
    two = MultiScaleCorners().detect(photograph(np.rot90(gray))).seeds
    assert one is not None
    assert two is not None
    first, second = one.angle != 0, two.angle != 0
    # np.rot90 takes pixel (x, y) to (y, width - 1 - x).
    moved = np.stack([one.xy[first, 1], 300 - one.xy[first, 0]], 1)
    agreement = []
    for n in range(0, len(moved), 7):
        distance = np.linalg.norm(two.xy[second] - moved[n], axis=1) + np.abs(
            two.scale[second] - one.scale[first][n]
        )
        m = int(np.argmin(distance))
        if distance[m] < 0.2:
            agreement.append(float(one.patches[first][n] @ two.patches[second][m]))
    assert len(agreement) > 50
    assert np.median(agreement) > 0.95


def test_patches_are_their_low_frequencies_whatever_the_exposure():
    rows = np.random.default_rng(0).normal(100, 20, (5, 64)).astype(np.float32)
    flat = np.full((1, 64), 70.0, np.float32)
    patches, structured = _normalize_patches(np.concatenate([rows, 0.5 * rows + 30, flat]))
    assert structured.tolist() == [True] * 10 + [False]
    assert patches[:5] == pytest.approx(patches[5:10], abs=1e-5)
    waves = _low_frequencies()
    assert waves.T @ waves == pytest.approx(np.eye(PATCH_VALUES), abs=1e-6)
    checkerboard = (-1.0) ** np.add(*np.indices((8, 8))).ravel()
    assert np.abs(checkerboard @ waves).max() < 0.2 * np.linalg.norm(checkerboard)


@pytest.mark.parametrize("formula", ["noble", "harris"])
def test_both_formulas_find_the_same_corner_and_no_edge(formula):
    measure = CornerMeasure(formula=formula)
    xy, response = measure._find(chessboard(0.3, -0.2).gray[None])
    # det - k trace^2 has the flatter top.
    assert np.linalg.norm(xy[0] - (60.3, 49.8)) < (0.25 if formula == "noble" else 0.5)
    assert (response[1:] < 0.01 * response[0]).all()


def test_a_grey_photograph_has_the_same_response_in_colour():
    image = photograph(texture(90, 110))
    gray, colour = CornerMeasure(), CornerMeasure(colour=True)
    one, three = gray._response(gray._channels(image)), colour._response(colour._channels(image))
    assert colour._channels(image).shape == (3, 90, 110)
    assert np.abs(one - three).max() < 1e-4 * one.max()


def test_corners_that_only_colour_shows_are_found_in_colour():
    """Red and green squares of one luminance."""
    board = chessboard(0.0, 0.0).rgb[:, :, 0] > 128
    rgb = np.where(board[:, :, None], np.array([200, 60, 90]), np.array([50, 136, 91])).astype(np.uint8)
    image = Image("a.png", rgb, (120, 100))
    found = {c: HarrisCorners(measure=CornerMeasure(colour=c)).detect(image) for c in (False, True)}
    assert found[False].response.max(initial=0.0) < 0.01 * found[True].response.max()
    assert np.linalg.norm(found[True].xy[0] - (60.0, 50.0)) < 3.0


def test_without_surface_fit_corners_stay_on_pixels_and_with_it_they_are_nearer():
    error = {False: [], True: []}
    for dx, dy in np.random.default_rng(1).uniform(-0.5, 0.5, (12, 2)):
        for subpixel, reported in error.items():
            measure = CornerMeasure(subpixel=subpixel)
            xy, _ = measure._find(chessboard(dx, dy).gray[None])
            assert subpixel or not (xy % 1.0).any()
            reported.append(np.linalg.norm(xy[0] - (60 + dx, 50 + dy)))
    assert np.mean(error[True]) < 0.5 * np.mean(error[False])


def brute_force_suppression(xy, response, count):
    """The ``count`` corners that keep longest as the circle around each shrinks that no clearly stronger one
    may enter."""
    radius = np.full(len(xy), np.inf)
    for i in range(len(xy)):
        for j in range(len(xy)):
            if 0.9 * response[j] > response[i]:
                radius[i] = min(radius[i], float(np.hypot(*(xy[i] - xy[j]))))
    return set(np.argsort(-radius, kind="stable")[:count].tolist())


def test_spread_selection_is_adaptive_non_maximal_suppression():
    rng = np.random.default_rng(5)
    xy, response = rng.uniform(0, 300, (68, 2)), np.sort(rng.exponential(size=68))[::-1]
    kept = select_spread(xy, response.astype(np.float32), 40)
    assert set(kept.tolist()) == brute_force_suppression(xy, response, 40)
    assert (np.diff(kept) > 0).all()


@pytest.mark.parametrize("selection", ["spacing", "spread"])
def test_each_selection_keeps_the_number_and_the_strongest(selection):
    image = photograph(texture(300, 400))
    features = HarrisCorners(max_corners=100, selection=selection).detect(image)
    everything = with_constants(HarrisCorners, spacing_rel=0.0)(10**6, 0.0).detect(image)
    assert len(features.xy) == 100 < len(everything.xy)
    assert np.array_equal(features.xy[0], everything.xy[0])


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (HarrisCorners, "max_corners", 0), (HarrisCorners, "threshold_rel", 2.0),
        (HarrisCorners, "threshold_rel", np.nan), (MultiScaleCorners, "full_corners", -1),
        (MultiScaleCorners, "levels", 0), (MultiScaleCorners, "levels", 2),
        (CornerMeasure, "integration_sigma_px", 0.0),
    ],
)  # fmt: skip
def test_a_detector_or_measure_that_cannot_be_is_refused(kind, field, value):
    refuses(ValueError, field, kind, **{field: value})


@pytest.mark.parametrize("enlargement", [1.0, 2.0])
def test_a_simulated_view_shows_each_pixel_where_it_says(enlargement):
    y, x = np.mgrid[:90, :140]
    blob = 200.0 * np.exp(-((x - 85.3) ** 2 + (y - 40.6) ** 2) / 18.0)
    view = simulate_view(blob.astype(np.float32), 2.0, 0.7, enlargement)
    row, column = np.mgrid[: view.gray.shape[0], : view.gray.shape[1]]
    middle = np.array([(column * view.gray).sum(), (row * view.gray).sum()]) / view.gray.sum()
    assert np.abs(middle - (view.to_view @ [85.3, 40.6] + view.offset)).max() < 0.05
    assert np.linalg.det(view.to_view) == pytest.approx(0.5 * enlargement**2)


def moments_twin(channels, derivative, taps):
    """(3, H, W): M11, M12, M22 by convolutions, summed over the channels."""
    total = np.zeros((3, *channels.shape[1:]))
    for channel in channels.astype(np.float64):
        gx, gy = (correlate1d(channel, derivative, axis=axis) for axis in (1, 0))
        for m, product in enumerate((gx * gx, gx * gy, gy * gy)):
            total[m] += convolve1d(convolve1d(product, taps, axis=0), taps, axis=1)
    return total


@pytest.mark.parametrize("trace_weight", [0.0, 0.04])
@pytest.mark.parametrize("derivative", [(-0.5, 0.0, 0.5), (0.1, -0.8, 0.0, 0.8, -0.1)])
@pytest.mark.parametrize("count", [1, 3])
def test_corner_response_equals_its_numpy_twin(trace_weight, derivative, count):
    channels = np.stack([texture(60, 83, seed).astype(np.float32) for seed in range(count)])
    taps, along = gaussian_taps(1.5), np.array(derivative, np.float32)
    found = corner_response(channels, along, taps, trace_weight)
    a, m, c = moments_twin(channels, along, taps)
    noble = (a * c - m * m) / (a + c + 1e-6)
    twin = a * c - m * m - trace_weight * (a + c) ** 2 if trace_weight else noble
    border = len(taps) // 2 + len(along) // 2
    inside = (slice(border, -border), slice(border, -border))
    assert np.abs(found[inside] - twin[inside]).max() < 1e-4 * np.abs(twin).max()
    assert not found[:border].any()
    assert not found[:, -border:].any()


def test_maxima_are_the_local_maxima_and_their_surfaces_have_their_top_there():
    # Without clipping at 255 no two neighbours are equal, so that every maximum is one.
    response = (
        gaussian_filter(np.random.default_rng(2).normal(size=(50, 70)), 1.5).astype(np.float32) * 500 + 130
    )
    xy, value = fit_maxima(response, 130.0)
    top = (maximum_filter(response, 3) == response) & (response > 130.0)
    top[0] = top[-1] = top[:, 0] = top[:, -1] = False
    assert len(xy) == top.sum()
    assert np.abs(xy[:, ::-1] - np.argwhere(top)).max() <= 1.0
    assert np.array_equal(value, response[top])
    b, a = np.mgrid[-1:2, -1:2]
    design = np.stack([a * a, a * b, b * b, a, b, np.ones((3, 3))], -1).reshape(9, 6)
    for (x, y), (row, column) in zip(xy, np.argwhere(top), strict=True):
        around = response[row - 1 : row + 2, column - 1 : column + 2].ravel()
        q = np.linalg.lstsq(design, around, rcond=None)[0]
        step = -np.linalg.solve([[2 * q[0], q[1]], [q[1], 2 * q[2]]], q[3:5])
        inside = q[0] < 0 and 4 * q[0] * q[2] > q[1] ** 2 and np.abs(step).max() <= 1.0
        assert np.abs(step * inside - (x - column, y - row)).max() < 1e-3


def test_patches_are_turned_and_clamped_at_the_border():
    row, column = np.mgrid[:80, :90].astype(np.float32)
    image, xy = 2.0 * column + row, np.array([[40.3, 35.7], [3.0, 4.0]])
    b, a = np.mgrid[:8, :8] - 3.5
    for angle in (0.0, 0.7):
        c, s = 4.0 * np.cos(angle), 4.0 * np.sin(angle)
        found = sample_patches(image, xy, np.full(2, angle, np.float32), 8, 4.0).reshape(2, 8, 8)
        for patch, (x, y) in zip(found, xy, strict=True):
            u, v = np.clip(x + c * a - s * b, 0, 89), np.clip(y + s * a + c * b, 0, 79)
            assert np.abs(patch - (2.0 * u + v)).max() < 1e-2
    assert sample_patches(image, xy[:0], np.zeros(0, np.float32), 8, 4.0).shape == (0, 64)


def test_selected_corners_are_apart_and_none_is_dropped_without_reason():
    xy = np.random.default_rng(6).uniform(0, 100, (400, 2))
    kept = enforce_spacing(xy, np.arange(400), 6.0)
    distance = np.linalg.norm(xy[:, None] - xy[kept][None], axis=2)
    assert (np.sort(distance[kept], axis=1)[:, 1] >= 6.0).all()
    for dropped in np.setdiff1d(np.arange(400), kept):
        assert (distance[dropped, kept < dropped] < 6.0).any()
