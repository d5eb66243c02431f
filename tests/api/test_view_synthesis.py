"""Views without a model from two photographs."""

import json
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest

import thesisrecon
from tests.conftest import refuses
from thesisrecon.api.views import match_images, prepare_trilinear_views
from thesisrecon.cli.view_files import interpolate_images, trilinear_sequence
from thesisrecon.config import ImageOptions, PipelineConfig
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.views.tensor import VirtualCamera, camera_at
from validation.scenes.real import load_fixture_scene

SCENE = load_fixture_scene()
SMALL = PipelineConfig(images=ImageOptions(max_size_px=512))


@pytest.fixture(scope="module")
def found():
    return match_images(SCENE.image_paths[6], SCENE.image_paths[7], config=SMALL)


def _photograph(k):
    with PIL.Image.open(SCENE.image_paths[k]) as image:
        return np.asarray(image.resize((512, 384), PIL.Image.Resampling.BOX))


def _psnr(a, b):
    return 10.0 * np.log10(255.0**2 / np.mean((a.astype(np.float64) - b) ** 2))


def test_calibrated_photographs_show_a_third_one_and_themselves(found):
    views = prepare_trilinear_views(found, K=SCENE.K[6], config=SMALL)
    R, C = SCENE.R, SCENE.C
    baseline = np.linalg.norm(C[7] - C[6])
    np.testing.assert_allclose(views.pair.t, R[7] @ (C[6] - C[7]) / baseline, atol=0.01)
    np.testing.assert_allclose(views.pair.K1[0], [454.3, 0.0, 264.2], atol=0.06)
    camera = VirtualCamera(R[8] @ R[7].T, R[8] @ (C[7] - C[8]) / baseline, views.pair.K2, views.sizes[1])
    picture, truth = views.render(camera), _photograph(8)
    gain = truth[100:300, 130:400].mean() / picture[100:300, 130:400].mean()
    inner = (slice(60, -60), slice(80, -80))
    assert _psnr(gain * picture[inner], truth[inner]) > _psnr(_photograph(7)[inner], truth[inner]) + 3.0
    guessed = prepare_trilinear_views(found, config=SMALL)
    np.testing.assert_allclose(guessed.pair.K1[0], [512.0, 0.0, 255.5])
    reported = replace(SMALL, intrinsics=IntrinsicsOptions(focal="known", focal_px=900.0))
    assert prepare_trilinear_views(found, config=reported).pair.K1[0, 0] == 450.0
    first, second = (guessed.render(camera_at(guessed.pair, s, sizes=guessed.sizes)) for s in (0.0, 1.0))
    assert np.mean(second != found.images[1].rgb) < 1e-3
    # Rounding leaves a corner to its neighbours.
    assert np.mean(first != found.images[0].rgb) < 1e-3


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


def test_the_front_door_makes_a_picture_and_the_same_one_again(found):
    motion = np.eye(3), np.array([0.1, 0.0, 0.0])
    picture = thesisrecon.synthesize_view(SCENE.image_paths[6], SCENE.image_paths[7], *motion, config=SMALL)
    assert picture.shape == (384, 512, 3)
    assert picture.dtype == np.uint8
    views = prepare_trilinear_views(found, config=SMALL)
    camera = VirtualCamera(*motion, views.pair.K2, views.sizes[1])
    np.testing.assert_array_equal(picture, views.render(camera, threads=2))


def test_cameras_in_one_place_and_one_image_twice_are_refused(found):
    """As of one camera with another principal point."""
    picture = _photograph(6)
    halves, words = [picture[:, :-32].copy(), picture[:, 32:].copy()], "no parallax: the camera only rotated"
    refuses(StageFailure, words, match_images, *halves, config=SMALL)
    twice = found.images[:1] * 2
    refuses(UsageError, "the same image", trilinear_sequence, twice, 5, config=SMALL, seed=0, threads=1)


def test_the_command_goes_from_before_the_first_to_beyond_the_second(tmp_path):
    paths = tuple(SCENE.image_paths[6:8])
    made = interpolate_images(tmp_path / "film", paths, method="tensor", frames=5, max_size_px=320)
    reported = json.loads((tmp_path / "film" / "frames.json").read_text(encoding="utf-8"))
    assert [frame["baselines"] for frame in reported["frames"]] == [-0.5, 0.0, 0.5, 1.0, 1.5]
    assert reported["images"] == ["0006.jpg", "0007.jpg"]
    assert "5 frames of 320 x 240 px" in made
    pictures = []
    for path in sorted((tmp_path / "film").glob("frame-*.png")):
        with PIL.Image.open(path) as image:
            pictures.append(np.asarray(image))
    with PIL.Image.open(SCENE.image_paths[7]) as image:
        second = np.asarray(image.resize((320, 240), PIL.Image.Resampling.BOX))
    likeness = [_psnr(picture, second) for picture in pictures]
    assert np.argmax(likeness) == 3
