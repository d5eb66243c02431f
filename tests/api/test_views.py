"""Views between and beside photographs: the front door, what is refused, and the command."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest

import thesisrecon
from tests.conftest import refuses
from tests.synthetic import texture
from thesisrecon.api import views as between
from thesisrecon.api.views import prepare_trilinear_views
from thesisrecon.config import ImageOptions, PipelineConfig
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.records import DisparityMap, Image
from thesisrecon.stereo.correspondence import RectifiedPair
from thesisrecon.stereo.depth import MultiViewStereo
from thesisrecon.stereo.rectification import PlanarRectification
from thesisrecon.views.tensor import VirtualCamera, camera_at
from validation.scenes.real import load_fixture_scene

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "images"
SHIFT = 6


@pytest.fixture(scope="module")
def wall():
    """A textured wall from two places, ``SHIFT`` px apart."""
    rgb = np.stack([texture(90, 170, seed) for seed in (0, 1, 2)], axis=-1).astype(np.uint8)
    return rgb[:, :160], np.ascontiguousarray(rgb[:, SHIFT : 160 + SHIFT])


def known_map(d):
    return DisparityMap(d, np.ones(d.shape, np.float32), 0.0)


def photograph(seed, size=(40, 30)):
    rgb = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    return Image(f"{seed}.jpg", rgb, size)


def test_a_view_between_comes_from_arrays_and_files_with_and_without_disparities(wall, tmp_path):
    left, right = wall
    expected = np.roll(left, -SHIFT // 2, axis=1)[:, 10:-20].astype(int)
    d = np.full(left.shape[:2], SHIFT, dtype=np.float32)
    for known in (None, d, (d, d), (known_map(d), known_map(d))):
        view = thesisrecon.interpolate_view(left, right, 0.5, disparity=known)
        assert view.dtype == np.uint8
        assert view.shape == left.shape
        assert np.abs(view[:, 10:-20] - expected).mean() < 2.0
    for name, image in (("left", left), ("right", right)):
        PIL.Image.fromarray(image).save(tmp_path / f"{name}.png")
    again = thesisrecon.interpolate_view(tmp_path / "left.png", tmp_path / "right.png", 0.5, disparity=d)
    np.testing.assert_array_equal(again, thesisrecon.interpolate_view(left, right, 0.5, disparity=d))
    np.testing.assert_array_equal(thesisrecon.interpolate_view(left, right, 1, disparity=d), right)
    grey = thesisrecon.interpolate_view(left[..., 0], right[..., 0], 0.5, disparity=d)
    assert grey.shape == left.shape


def test_photographs_without_a_view_between_them_are_refused_in_a_sentence(monkeypatch):
    a, b = photograph(0), photograph(1)
    copy, small = Image("copy.jpg", a.rgb.copy(), a.size), photograph(2, (40, 20))
    sizes = r"the same size; 0\.jpg is 40 x 30 and 2\.jpg is 40 x 20 px"
    refuses(UsageError, r"0\.jpg and copy\.jpg are the same image", between.prepare_pair, a, copy)
    refuses(UsageError, sizes, between.prepare_pair, a, small)
    # Forward motion: both epipoles at (21, 14).
    e, rng = np.array([21.0, 14.0]), np.random.default_rng(0)
    xy = rng.uniform((0.0, 0.0), (40.0, 30.0), (100, 2))
    ahead = e + rng.uniform(1.05, 1.3, (100, 1)) * (xy - e)
    pair = SimpleNamespace(F=cross_matrix(np.append(e, 1.0)), xy1=xy, xy2=ahead)
    monkeypatch.setattr(between, "match_pair", lambda *_, **__: pair)
    words = r"moved towards the scene or away from it; .*\(21, 14\) px, inside 0\.jpg"
    refuses(StageFailure, words, between.prepare_pair, a, b)
    # An image and its copy: any F fits.
    pair.xy2 = xy + rng.normal(0.0, 0.01, xy.shape)
    refuses(StageFailure, "no parallax", between.prepare_pair, a, b)


def sideways(monkeypatch, match_two_views):
    """Matches of a sideways motion, and this dense matcher."""
    pair = SimpleNamespace(
        F=cross_matrix(np.array([1.0, 0.0, 0.0])), xy1=np.zeros((0, 2)), xy2=np.zeros((0, 2))
    )
    monkeypatch.setattr(between, "match_pair", lambda *_, **__: pair)
    monkeypatch.setattr(MultiViewStereo, "match_two_views", match_two_views)


@pytest.mark.parametrize(
    ("advice", "words"),
    [
        ("rectify in polar coordinates", r"^too distorted; a number; take the images side by side"),
        ("take another image", r"^too distorted; a number; take another image\.$"),
    ],
)
def test_pairs_that_cannot_be_rectified_are_reported(monkeypatch, advice, words):
    def match_two_views(*_, **__):
        raise StageFailure("too distorted", "a number", advice)

    sideways(monkeypatch, match_two_views)
    refuses(StageFailure, words, between.prepare_pair, photograph(0), photograph(1))


@pytest.mark.parametrize(
    ("degrees", "possible"), [(0.0, True), (-80.0, True), (100.0, False), (180.0, False)]
)
def test_images_that_are_rolled_against_each_other_have_no_views_between(monkeypatch, degrees, possible):
    """Halfway between an image and one upside down the frame of the view would be a point."""
    c, s, middle = np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), np.array([19.5, 14.5])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turn[:2, 2] = middle - turn[:2, :2] @ middle
    known = DisparityMap(np.zeros((30, 40), np.float32), np.ones((30, 40), np.float32), 0.2)
    frame = PlanarRectification(np.stack([np.eye(3), turn]), (40, 30))
    dense = RectifiedPair(frame, (known.disparity,) * 2, np.ones(3), known, known)
    sideways(monkeypatch, lambda *_, **__: dense)
    if possible:
        assert between.prepare_pair(photograph(0), photograph(1)).view(0.5).shape == (30, 40, 3)
        return
    words = f"rolled against each other; by {degrees:.0f} degrees"
    refuses(StageFailure, words, between.prepare_pair, photograph(0), photograph(1))


SCENE = load_fixture_scene()
SMALL = PipelineConfig(images=ImageOptions(max_size_px=512))


TWO = SCENE.image_paths[6], SCENE.image_paths[7]


@pytest.fixture(scope="module")
def guessed():
    return prepare_trilinear_views(*TWO, config=SMALL)


def _photograph(k):
    with PIL.Image.open(SCENE.image_paths[k]) as image:
        return np.asarray(image.resize((512, 384), PIL.Image.Resampling.BOX))


def _psnr(a, b):
    return 10.0 * np.log10(255.0**2 / np.mean((a.astype(np.float64) - b) ** 2))


def test_calibrated_photographs_show_a_third_one_and_themselves(guessed):
    views = prepare_trilinear_views(*TWO, K=SCENE.K[6], config=SMALL)
    R, C = SCENE.R, SCENE.C
    baseline = np.linalg.norm(C[7] - C[6])
    np.testing.assert_allclose(views.pair.t, R[7] @ (C[6] - C[7]) / baseline, atol=0.01)
    np.testing.assert_allclose(views.pair.K1[0], [454.3, 0.0, 264.2], atol=0.06)
    camera = VirtualCamera(R[8] @ R[7].T, R[8] @ (C[7] - C[8]) / baseline, views.pair.K2, views.sizes[1])
    picture, truth = views.render(camera), _photograph(8)
    gain = truth[100:300, 130:400].mean() / picture[100:300, 130:400].mean()
    inner = (slice(60, -60), slice(80, -80))
    assert _psnr(gain * picture[inner], truth[inner]) > _psnr(_photograph(7)[inner], truth[inner]) + 3.0
    np.testing.assert_allclose(guessed.pair.K1[0], [512.0, 0.0, 255.5])
    reported = replace(SMALL, intrinsics=IntrinsicsOptions(focal="known", focal_px=900.0))
    assert prepare_trilinear_views(*TWO, config=reported).pair.K1[0, 0] == 450.0
    first, second = (guessed.render(camera_at(guessed.pair, s, sizes=guessed.sizes)) for s in (0.0, 1.0))
    assert np.mean(second != guessed.levels[1][..., :3]) < 1e-3
    # Rounding leaves a corner to its neighbours.
    assert np.mean(first != guessed.levels[0][..., :3]) < 1e-3


def test_a_view_between_photographs_has_no_ghost_of_either():
    pair = between.prepare_pair(*(COURTYARD / f"000{k}.jpg" for k in (6, 7)), config=SMALL)
    frames = [pair.view(s).astype(float) for s in (0.0, 0.5, 1.0)]
    # Mixtures of two photographs are dull.
    contrast = [np.abs(np.diff(frame, axis=1)).mean() for frame in frames]
    assert contrast[1] > 0.8 * min(contrast[0], contrast[2])


def test_the_front_door_refuses_wrong_motions_before_it_reads_anything():
    refuses(
        ValueError, "det R = -1", thesisrecon.synthesize_view, "no.jpg", "file.jpg", -np.eye(3), np.zeros(3)
    )
    given = thesisrecon.synthesize_view, "no.jpg", "file.jpg", np.eye(3)
    refuses(ValueError, r"t \(3\)", *given, [0.0, 1.0])
    refuses(ValueError, "K must be", *given, np.zeros(3), K=np.eye(4))
    unknown = np.where(np.eye(3) > 0.0, 1.0, np.nan)
    for wrong in (unknown, 2.0 * np.eye(3), [np.eye(3), unknown]):
        words = r"view synthesis needs (finite numbers|K upper triangular)"
        refuses(ValueError, words, *given, np.zeros(3), K=wrong)
    refuses(UsageError, r"there is no image file no\.jpg", *given, np.zeros(3))


def test_the_front_door_makes_a_picture_and_the_same_one_again(guessed):
    motion = np.eye(3), np.array([0.1, 0.0, 0.0])
    picture = thesisrecon.synthesize_view(*TWO, *motion, config=SMALL)
    assert picture.shape == (384, 512, 3)
    assert picture.dtype == np.uint8
    camera = VirtualCamera(*motion, guessed.pair.K2, guessed.sizes[1])
    np.testing.assert_array_equal(picture, guessed.render(camera, threads=2))


def test_cameras_in_one_place_are_refused():
    """As of one camera with another principal point."""
    picture = _photograph(6)
    halves, words = [picture[:, :-32].copy(), picture[:, 32:].copy()], "no parallax: the camera only rotated"
    refuses(StageFailure, words, prepare_trilinear_views, *halves, config=SMALL)
