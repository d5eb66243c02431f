import numpy as np
import pytest
from scipy.ndimage import convolve1d, correlate1d, gaussian_filter, maximum_filter
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
from scipy.special import erf

from tests.conftest import refuses
from tests.constants import with_constants
from tests.synthetic import photograph, texture
from thesisrecon.features import harris, multiscale
from thesisrecon.imaging.resampling import gaussian_taps

HARRIS = harris.CornerMeasure(formula="harris", integration_sigma_px=1.0)
VARIANTS = [
    harris.HarrisCorners(),
    multiscale.MultiScaleCorners(),
    harris.HarrisCorners(selection="spread", measure=HARRIS),
    multiscale.MultiScaleCorners(measure=HARRIS),
]


def chessboard(dx, dy):
    """Four quadrants meeting at (60 + dx, 50 + dy); an edge is the integral of a Gaussian of sigma 0.4."""
    x, y = np.arange(120) - 60 - dx, np.arange(100) - 50 - dy
    return photograph(128 + 90 * erf(x / 0.57)[None] * erf(y / 0.57)[:, None])


@pytest.mark.parametrize(
    "variant", [harris.HarrisCorners(), with_constants(multiscale.MultiScaleCorners, upsample_below_px=0)()]
)
@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.3, -0.2), (-0.45, 0.4)])
def test_a_corner_is_found_between_the_pixels(variant, dx, dy):
    features = variant.detect(chessboard(dx, dy))
    distance = np.linalg.norm(features.xy - (60 + dx, 50 + dy), axis=1)
    assert distance.min() < 0.25


@pytest.mark.parametrize(
    "variant", [with_constants(multiscale.MultiScaleCorners, upsample_below_px=0)(), VARIANTS[1]]
)
def test_corners_of_every_size_are_right_on_average(variant):
    errors = {}
    for place in np.random.default_rng(0).uniform(-0.5, 0.5, (36, 2)):
        found = variant.detect(chessboard(*place))
        for scale in np.unique(found.scale):
            error = found.xy[found.scale == scale] - (60, 50) - place
            errors.setdefault(scale, []).append(error[np.linalg.norm(error, axis=1).argmin()])
    assert len(errors) == 2
    for off in errors.values():
        assert (np.abs(np.mean(off, axis=0)) < 4.0 * np.std(off, axis=0) / np.sqrt(36)).all()


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


def test_thesis_corners_keep_their_distance_their_number_and_the_strongest():
    image = photograph(texture(300, 400))
    xy = with_constants(harris.HarrisCorners, spacing_rel=0.02)(max_corners=150).detect(image).xy
    assert len(xy) == 150
    assert pdist(xy).min() >= 0.02 * 400
    everything = with_constants(harris.HarrisCorners, spacing_rel=0.0)(10**6, 0.0).detect(image).xy
    for selection in ("spacing", "spread"):
        xy = harris.HarrisCorners(max_corners=100, selection=selection).detect(image).xy
        assert len(xy) == 100 < len(everything)
        assert np.array_equal(xy[0], everything[0])


def test_corners_that_are_spread_cover_the_image_though_one_side_is_faint():
    gray = texture(400, 1100)
    gray[:, 550:] = 128 + 0.15 * (gray[:, 550:] - 128)
    features = multiscale.MultiScaleCorners(full_corners=600, half_corners=300).detect(photograph(gray))
    assert (features.xy[:, 0] > 560).mean() > 0.1
    strongest = multiscale.MultiScaleCorners(full_corners=600, half_corners=0, spread=False).detect(
        photograph(gray)
    )
    assert set(strongest.scale.tolist()) == {1.0}
    assert (strongest.xy[:, 0] > 560).mean() < 0.05


@pytest.mark.parametrize(("width", "scales"), [(420, {0.5, 1.0}), (1040, {1.0, 2.0})])
def test_two_sizes_and_seeds_twice_in_the_pixels_of_the_photograph(width, scales):
    features = multiscale.MultiScaleCorners().detect(photograph(texture(300, width)))
    assert set(features.scale.tolist()) == scales
    seeds = features.seeds
    assert seeds is not None
    assert seeds.patches.dtype == np.float32
    assert np.abs(np.linalg.norm(seeds.patches, axis=1) - 1).max() < 1e-4
    assert (seeds.angle == 0).mean() == pytest.approx(0.5, abs=0.01)
    assert (seeds.xy <= (width - 1, 299)).all()


def test_turned_patches_turn_with_the_photograph():
    gray = texture(301, 301, 8)
    one, two = (multiscale.MultiScaleCorners().detect(photograph(g)).seeds for g in (gray, np.rot90(gray)))
    first, second = one.angle != 0, two.angle != 0
    # np.rot90 takes pixel (x, y) to (y, width - 1 - x).
    moved = np.stack([one.xy[first, 1], 300 - one.xy[first, 0], one.scale[first]], 1)[::7]
    distance, m = cKDTree(np.column_stack([two.xy, two.scale])[second]).query(moved)
    agreement = np.sum(one.patches[first][::7] * two.patches[second][m], axis=1)[distance < 0.2]
    assert len(agreement) > 50
    assert np.median(agreement) > 0.95


def test_patches_are_their_low_frequencies_whatever_the_exposure():
    rows = np.random.default_rng(0).normal(100, 20, (5, 64)).astype(np.float32)
    flat = np.full((1, 64), 70.0, np.float32)
    patches, structured = multiscale._normalize_patches(np.concatenate([rows, 0.5 * rows + 30, flat]))
    assert structured.tolist() == [True] * 10 + [False]
    assert patches[:5] == pytest.approx(patches[5:10], abs=1e-5)
    waves = multiscale._low_frequencies()
    assert waves.T @ waves == pytest.approx(np.eye(multiscale.PATCH_VALUES), abs=1e-6)
    checkerboard = (-1.0) ** np.add(*np.indices((8, 8))).ravel()
    assert np.abs(checkerboard @ waves).max() < 0.2 * np.linalg.norm(checkerboard)


@pytest.mark.parametrize("formula", ["noble", "harris"])
def test_both_formulas_find_the_same_corner_and_no_edge(formula):
    measure = harris.CornerMeasure(formula=formula)
    xy, response = measure._find(chessboard(0.3, -0.2).gray)
    # det - k trace^2 has the flatter top.
    assert np.linalg.norm(xy[0] - (60.3, 49.8)) < (0.25 if formula == "noble" else 0.5)
    assert (response[1:] < 0.01 * response[0]).all()


def test_surface_fits_find_nearer_corners():
    error = {False: [], True: []}
    for corner in np.random.default_rng(1).uniform(-0.5, 0.5, (12, 2)):
        for subpixel, reported in error.items():
            xy, _ = harris.CornerMeasure(subpixel=subpixel)._find(chessboard(*corner).gray)
            assert subpixel or not (xy % 1.0).any()
            reported.append(np.linalg.norm(xy[0] - (60, 50) - corner))
    assert np.mean(error[True]) < 0.5 * np.mean(error[False])


def test_a_detector_or_measure_that_cannot_be_is_refused():
    for kind, field, value in (
        (harris.HarrisCorners, "max_corners", 0), (harris.HarrisCorners, "threshold_rel", 2.0),
        (harris.HarrisCorners, "threshold_rel", np.nan), (multiscale.MultiScaleCorners, "full_corners", -1),
        (multiscale.MultiScaleCorners, "levels", 0), (multiscale.MultiScaleCorners, "levels", 2),
        (harris.CornerMeasure, "integration_sigma_px", 0.0),
    ):  # fmt: skip
        refuses(ValueError, field, kind, **{field: value})


@pytest.mark.parametrize("enlargement", [1.0, 2.0])
def test_a_simulated_view_shows_each_pixel_where_it_says(enlargement):
    y, x = np.mgrid[:90, :140]
    blob = 200.0 * np.exp(-((x - 85.3) ** 2 + (y - 40.6) ** 2) / 18.0)
    view = multiscale.simulate_view(blob.astype(np.float32), 2.0, 0.7, enlargement)
    row, column = np.mgrid[: view.gray.shape[0], : view.gray.shape[1]]
    middle = np.array([(column * view.gray).sum(), (row * view.gray).sum()]) / view.gray.sum()
    assert np.abs(middle - (view.to_view @ [85.3, 40.6] + view.offset)).max() < 0.05
    assert np.linalg.det(view.to_view) == pytest.approx(0.5 * enlargement**2)


@pytest.mark.parametrize("trace_weight", [0.0, 0.04])
def test_corner_response_is_that_of_the_smoothed_moments(trace_weight):
    gray = texture(60, 83, 0).astype(np.float32)
    taps = gaussian_taps(1.5)
    found = harris.corner_response(gray, 1.5, trace_weight)
    gx, gy = (correlate1d(gray.astype(np.float64), (-0.5, 0.0, 0.5), axis=axis) for axis in (1, 0))
    a, m, c = (
        convolve1d(convolve1d(product, taps, axis=0), taps, axis=1) for product in (gx * gx, gx * gy, gy * gy)
    )
    noble = (a * c - m * m) / (a + c + 1e-6)
    twin = a * c - m * m - trace_weight * (a + c) ** 2 if trace_weight else noble
    border = len(taps) // 2 + 1
    inside = (slice(border, -border), slice(border, -border))
    assert np.abs(found[inside] - twin[inside]).max() < 1e-4 * np.abs(twin).max()
    assert not found[:border].any()
    assert not found[:, -border:].any()


def test_maxima_are_the_local_maxima_and_their_surfaces_have_their_top_there():
    # Without clipping at 255 no two neighbours are equal, so that every maximum is one.
    response = (
        gaussian_filter(np.random.default_rng(2).normal(size=(50, 70)), 1.5).astype(np.float32) * 500 + 130
    )
    xy, value = harris.fit_maxima(response, 130.0)
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


def test_selected_corners_are_apart_or_spread():
    xy = np.random.default_rng(6).uniform(0, 100, (400, 2))
    kept = harris.enforce_spacing(xy, 6.0)
    assert pdist(xy[kept]).min() >= 6.0
    for dropped in np.setdiff1d(np.arange(400), kept):
        assert np.linalg.norm(xy[kept[kept < dropped]] - xy[dropped], axis=1).min() < 6.0
    # Corners that keep longest as the circle around each shrinks that no clearly stronger one may enter.
    rng = np.random.default_rng(5)
    xy, response = rng.uniform(0, 300, (68, 2)), np.sort(rng.exponential(size=68))[::-1]
    distance = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    radius = np.where(0.9 * response[None] > response[:, None], distance, np.inf).min(axis=1)
    kept = harris.select_spread(xy, response.astype(np.float32), 40)
    assert set(kept.tolist()) == set(np.argsort(-radius, kind="stable")[:40].tolist())
    assert (np.diff(kept) > 0).all()
