import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tests.constants import with_constants
from tests.synthetic import disparity, photograph, stereo_scene, texture
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.matching._prepared import _corner_patches, prepare_image
from thesisrecon.matching.growth import _fit_local_affines, _match_guided
from thesisrecon.matching.strength import (
    _displacement_weight,
    _relative_difference_weight,
    _strength_of_match,
)
from thesisrecon.matching.track_alignment import _align_windows
from thesisrecon.matching.tracks import _chain_affines, _union_corners
from thesisrecon.records import Features, Image

RNG = np.random.default_rng(0)


def unit(window):
    centred = window - window.mean()
    return np.asarray(centred / np.linalg.norm(centred))


def prepared(gray):
    image = photograph(gray)
    return prepare_image(image, with_constants(HarrisCorners, spacing_rel=0.01)().detect(image))


def affine_twin(xy, near, xy1, xy2, prior):
    """One corner's local map by stacked least squares: rows are neighbours, the last four hold the prior."""
    d, a0 = xy1[near] - xy, prior[near].mean(axis=0)
    mean2 = (d**2).sum(axis=1).mean() + 1e-9
    rest, weight = xy2[near] - d @ a0.T, 1.0 / ((d**2).sum(axis=1) + mean2)
    w, scale2 = weight, 0.0
    for _ in range(3):
        design = np.vstack(
            [np.c_[d, np.ones(len(d))] * np.sqrt(w)[:, None], np.eye(3)[:2] * np.sqrt(0.05 * w.sum() * mean2)]
        )
        z = np.linalg.lstsq(design, np.vstack([rest * np.sqrt(w)[:, None], np.zeros((2, 2))]), rcond=None)[0]
        residual2 = ((rest - d @ z[:2] - z[2]) ** 2).sum(axis=1)
        scale2 = np.median(residual2)
        w = weight / (1.0 + residual2 / (scale2 + 1e-9))
    return a0 + z[:2].T, z[2], float(np.sqrt(scale2))


def test_local_affines_equal_their_numpy_twin():
    xy, xy1 = RNG.uniform(0, 100, (12, 2)), RNG.uniform(0, 100, (80, 2))
    xy2 = xy1 @ np.array([[1.1, 0.2], [-0.1, 0.9]]).T + (20, -7) + RNG.normal(size=(80, 2))
    prior = np.tile(np.eye(2), (80, 1, 1)) + 0.05 * RNG.normal(size=(80, 2, 2))
    near = np.linalg.norm(xy[:, None] - xy1[None], axis=2).argsort(axis=1)[:, :10]
    affine, place, spread = _fit_local_affines(xy, near, xy1, xy2, prior)
    for n in range(12):
        a, t, s = affine_twin(xy[n], near[n], xy1, xy2, prior)
        assert np.abs(affine[n] - a).max() < 1e-7
        assert np.abs(place[n] - t).max() < 1e-6
        assert spread[n] == pytest.approx(s, abs=1e-6)


def test_corner_patches_equal_their_numpy_twin_at_every_level():
    view = prepared(texture(120, 150))
    xy = np.array([[60.3, 50.6], [70.0, 64.5], [3.0, 60.0]])
    scale = np.array([1.0, 2.0, 1.0], np.float32)
    pixels, levels, base = view.pyramid
    found = _corner_patches(pixels, levels, base, xy, scale)
    b, a = np.mgrid[-7:8, -7:8]
    for n in range(2):
        offset, height, width = levels[n]
        gray = pixels[offset : offset + height * width].reshape(height, width)
        x, y = (xy[n] + 0.5) / scale[n] - 0.5
        twin = unit(map_coordinates(gray, [y + b, x + a], order=1).ravel())
        assert np.abs(found[n] - twin).max() < 1e-4
    # The third window leaves the image.
    assert not found[2].any()


def test_growth_equals_its_numpy_twin():
    images = stereo_scene(200, 260)
    one, two = (prepare_image(i, with_constants(HarrisCorners, spacing_rel=0.01)().detect(i)) for i in images)
    xy1, xy2 = one.features.xy, two.features.xy
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    affine, radius = np.tile(np.eye(2), (len(xy1), 1, 1)), np.full(len(xy1), 12.0)
    place = xy1 - (14.0, 0.0)
    index, score, second_best = _match_guided(
        one.pyramid, (xy1, one.features.scale), (affine, place, radius),
        (xy2, two.features.scale, two.patches), two.cells, (F, np.full(len(xy1), 1.5), 0.7),
    )  # fmt: skip
    correlation = one.patches @ two.patches.T
    allowed = np.linalg.norm(place[:, None] - xy2[None], axis=2) <= 12.0
    allowed &= np.abs(xy1[:, None, 1] - xy2[None, :, 1]) <= 1.5
    twin = np.where(allowed, correlation, -1.0)
    expected = np.where(twin.max(axis=1) > 0.7, twin.argmax(axis=1), -1)
    # A window that touches the border may be inside for one and outside for the other.
    inside = (np.minimum(xy1, np.array(one.size) - 1 - xy1) > 9).all(axis=1)
    assert (expected >= 0).sum() > 50
    assert np.array_equal(index[inside], expected[inside])
    assert np.abs(score[inside] - np.where(expected >= 0, twin.max(axis=1), 0.0)[inside]).max() < 1e-4
    elsewhere = allowed & (np.linalg.norm(xy2[expected][:, None] - xy2[None], axis=2) > 3.0)
    second = np.where(elsewhere & (expected >= 0)[:, None], correlation, -1.0).max(axis=1)
    assert np.abs(second_best[inside] - second[inside]).max() < 1e-4


@pytest.mark.parametrize("affine_std", [0.0, 0.1])
def test_alignment_finds_the_true_place_under_gain_and_bias(affine_std):
    left, right = stereo_scene()
    one, two = (prepare_image(i, MultiScaleCorners().detect(i)) for i in (left, right))
    xy2 = np.stack(np.meshgrid(np.arange(60, 360, 21), np.arange(40, 260, 21)), -1).reshape(-1, 2) + 0.37
    xy1 = xy2 + np.stack([disparity(xy2), np.zeros(len(xy2))], 1)
    start = xy2 + RNG.uniform(-0.8, 0.8, xy2.shape)
    slope = 1.0 / (1.0 + 5.0 / 60.0 * np.cos(xy2[:, 0] / 60.0))
    shear = 4.0 / 45.0 * np.sin(xy2[:, 1] / 45.0)
    affine = np.zeros((len(xy2), 2, 2))
    affine[:, 0, 0], affine[:, 0, 1], affine[:, 1, 1] = slope, shear * slope, 1.0
    found, maps, score = _align_windows(
        one.pyramid,
        two.pyramid,
        (xy1, np.ones(len(xy1), np.float32), start, affine),
        (12, affine_std, 3.0, 1.0),
    )
    error = np.linalg.norm(found - xy2, axis=1)
    assert (score > 0.9).mean() > 0.95
    assert np.median(error) < 0.05
    assert np.abs(np.linalg.det(maps[score > 0.9]) / slope[score > 0.9] - 1).mean() < 0.1


def test_alignment_recovers_an_unknown_affine_map():
    gray = texture(240, 240, 5)
    truth = np.array([[1.08, 0.06], [-0.05, 0.95]])
    y, x = np.mgrid[0:240, 0:240].astype(np.float64)
    back = np.linalg.inv(truth) @ np.stack([x.ravel() - 120, y.ravel() - 120]) + 120
    moved = map_coordinates(
        gray, [back[1].reshape(x.shape), back[0].reshape(x.shape)], order=3, mode="reflect"
    )
    one, two = prepared(gray), prepared(moved)
    xy1 = np.stack(np.meshgrid(np.arange(80, 160, 9.0), np.arange(80, 160, 9.0)), -1).reshape(-1, 2)
    xy2 = (xy1 - 120) @ truth.T + 120
    start = np.tile(np.eye(2), (len(xy1), 1, 1))
    found, maps, score = _align_windows(
        one.pyramid, two.pyramid, (xy1, np.ones(len(xy1), np.float32), xy2 + 0.4, start), (20, 0.1, 3.0, 1.0)
    )
    assert (score > 0.95).mean() > 0.9
    assert np.median(np.linalg.norm(found - xy2, axis=1)) < 0.05
    assert np.median(np.abs(maps - truth).max(axis=(1, 2))) < 0.03


def test_alignment_gives_up_on_blank_windows_and_outside():
    blank, rich = prepared(np.full((100, 100), 80.0)), prepared(texture(100, 100))
    xy = np.array([[50.0, 50.0], [2.0, 50.0], [np.nan, 50.0]])
    args = (xy, np.ones(3, np.float32), xy, np.tile(np.eye(2), (3, 1, 1)))
    for one, two in ((blank, rich), (rich, blank)):
        assert not _align_windows(one.pyramid, two.pyramid, args, (5, 0.1, 3.0, 1.0))[2].any()
    assert (_align_windows(rich.pyramid, rich.pyramid, args, (5, 0.1, 3.0, 1.0))[2] > 0.99).tolist() == [
        True,
        False,
        False,
    ]


def test_alignment_drops_patches_with_weak_gradients():
    rich, straight = texture(100, 100, 3), np.repeat(texture(1, 100, 3), 100, axis=0)
    noise = RNG.normal(scale=2.0, size=(2, 100, 100))
    xy = np.array([[50.0, 50.0]])
    args = (xy, np.ones(1, np.float32), xy, np.eye(2)[None])
    kept = []
    for gray in (rich, 128 + 0.05 * (straight - 128)):
        one, two = prepared(gray + noise[0]), prepared(gray + noise[1])
        kept.append(_align_windows(one.pyramid, two.pyramid, args, (12, 0.0, 3.0, 0.12))[2][0] > 0.0)
    assert kept == [True, False]


def product_twin(a, b, closeness):
    lengths = np.linalg.norm(a), np.linalg.norm(b)
    cosine = float(a @ b) / (lengths[0] * lengths[1]) if min(lengths) >= 1.0 else 1.0
    return max(cosine, 0.0) * max(min(lengths), 1.0) / max(*lengths, 1.0) * closeness


@pytest.mark.parametrize("tolerance", [0.0, 0.3])
def test_strength_of_match_equals_its_brute_force_twin(tolerance):
    xy1, xy2 = RNG.uniform(0, 60, (25, 2)), RNG.uniform(0, 60, (30, 2))
    correlation = RNG.uniform(-1, 1, (25, 30)).astype(np.float32)
    near1, near2 = (
        np.linalg.norm(xy[:, None] - xy[None], axis=2).argsort(axis=1)[:, 1:6] for xy in (xy1, xy2)
    )
    near1[3, 2:] = -1
    index, strength = _strength_of_match(correlation, (xy1, xy2), (near1, near2), (30.0, 4, 0.1), tolerance)

    def agreement(u, v, m, n):
        a, b, apart = xy2[v] - xy1[u], xy2[n] - xy1[m], float(np.linalg.norm(xy1[m] - xy1[u]))
        if tolerance:
            return float(np.exp(-0.5 * (np.linalg.norm(a - b) / (0.3 * apart + 1.0)) ** 2))
        return product_twin(a, b, 1 - apart / 30.0)

    for u in range(25):
        c = np.where(np.linalg.norm(xy2 - xy1[u], axis=1) <= 30.0, correlation[u], -1.0)
        best, expected = 0.0, -1
        for v in [v for v in np.argsort(-c)[:4] if c[v] > 0.1]:
            total = sum(
                max(max(float(correlation[m, n]), 0.0) * agreement(u, v, m, n) for n in near2[v])
                for m in near1[u][near1[u] >= 0]
            )
            if c[v] * total > best:
                best, expected = c[v] * total, v
        assert index[u] == expected
        assert strength[u] == pytest.approx(best, rel=1e-4)


def test_displacements_that_agree_weigh_one():
    a = np.array([10.0, 0.0])
    assert _displacement_weight(a, a, 1.0) == pytest.approx(1.0)
    assert _displacement_weight(a, 0.5 * a, 1.0) == pytest.approx(0.5)
    assert _displacement_weight(a, -a, 1.0) == 0.0
    assert _displacement_weight(a, np.array([10.0, 10.0]), 0.8) == pytest.approx(0.4)
    assert _displacement_weight(0.01 * a, -0.01 * a, 0.8) == pytest.approx(0.8)
    # A corner that stays has no direction that another could contradict.
    for still in (0.0 * a, 0.05 * a, -0.05 * a):
        for moved in (0.2 * a, -0.2 * a):
            expected = 0.8 / float(np.hypot(*moved))
            assert _displacement_weight(still, moved, 0.8) == pytest.approx(expected)
            assert _displacement_weight(moved, still, 0.8) == pytest.approx(expected)
    assert _relative_difference_weight(a, a, 5.0, 0.3) == 1.0
    assert _relative_difference_weight(a, -a, 5.0, 0.3) < 1e-6
    near, far = (_relative_difference_weight(a, a + 3.0, apart, 0.3) for apart in (5.0, 50.0))
    assert near < 0.5 < far


@pytest.mark.parametrize("colour", [False, True])
@pytest.mark.parametrize("side", [7, 15])
def test_products_of_corner_windows_are_normalised_cross_correlations(colour, side):
    """The formula of section 4.2.2, each colour by itself."""
    rng = np.random.default_rng(2)
    rgb = np.stack([texture(80, 90, seed) for seed in (1, 2, 3)], axis=2).astype(np.uint8)
    image = Image("a.png", rgb, (90, 80))
    xy = np.round(rng.uniform(20, 60, (12, 2)))
    features = Features(xy, np.ones(12, np.float32), np.ones(12, np.float32))
    found = prepare_image(image, features, window=side, colour=colour).patches
    planes = list(np.moveaxis(rgb.astype(np.float64), 2, 0)) if colour else [image.gray.astype(np.float64)]
    k = side // 2

    def window(plane, n):
        x, y = xy[n].astype(int)
        return plane[y - k : y + k + 1, x - k : x + k + 1]

    def correlation(a, b):
        return float(np.mean((a - a.mean()) * (b - b.mean())) / (a.std() * b.std()))

    for a, b in ((0, 1), (2, 2), (3, 7)):
        twin = np.mean([correlation(window(p, a), window(p, b)) for p in planes])
        assert found[a] @ found[b] == pytest.approx(twin, abs=1e-4)


def test_union_never_puts_two_corners_of_a_view_together():
    view_of = np.repeat(np.arange(5), 20)
    edges = RNG.integers(0, 100, (150, 2))
    root = _union_corners(edges, view_of, 5)
    member = [{n} for n in range(100)]
    for a, b in edges:
        together = member[a] | member[b]
        if len({view_of[n] for n in together}) == len(together):
            for n in together:
                member[n] = together
    for a, b in RNG.integers(0, 100, (500, 2)):
        assert (root[a] == root[b]) == (b in member[a])


def test_maps_chain_along_the_matches():
    a = np.array([[[1.1, 0.1], [0.0, 0.9]], [[0.8, 0.0], [0.2, 1.2]]])
    xy = np.array([[10.0, 10.0], [20.0, 12.0], [31.0, 13.0]])
    # Observation 1 is the middle: edge 0 leads from 0 to 1 (walked backwards), edge 1 from 1 to 2.
    edges = np.array([[0, 1], [1, 2]])
    xy1, xy2 = xy[:2], np.array([[20.5, 12.25], [31.2, 12.9]])
    place, maps = _chain_affines(edges, xy1, xy2, a, xy, np.array([1]))
    assert np.allclose(place[0], xy1[0] + np.linalg.inv(a[0]) @ (xy[1] - xy2[0]))
    assert np.allclose(place[1:], [xy[1], xy2[1]])
    assert np.allclose(maps, [np.linalg.inv(a[0]), np.eye(2), a[1]])
