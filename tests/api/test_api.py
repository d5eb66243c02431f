"""The front doors of single stages."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

import thesisrecon
from tests.conftest import refuses
from tests.epipolar.pairs import make_pair
from tests.pipeline import fake_stages as fakes
from tests.synthetic import reconstruction_of, texture
from thesisrecon.api.pairs import epipolar_lines
from thesisrecon.camera import compose_camera
from thesisrecon.config import ImageOptions, PipelineConfig
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import fundamental_from_cameras, plane_homography
from thesisrecon.io._images import read_image
from thesisrecon.pipeline.run import stream
from thesisrecon.records import Image, Tracks
from thesisrecon.report._data import point_colors

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "images"


def small_reconstruction():
    """Two points seen by two views of which the second is of another size."""
    view, point = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])
    xy = np.array([[1.0, 2.0], [3.2, 0.4], [0.0, 0.0], [90.0, 90.0]])
    return reconstruction_of(
        np.stack([fakes.scene_camera(0), fakes.scene_camera(1)]), [[96, 80], [48, 40]],
        X=fakes.scene_points()[:3], tracks=Tracks(view, point, xy, 2, 3), stratum="projective",
        sigma_px=1.0, valid=np.array([True, True, False]), inlier=np.array([True, True, True, False]),
    )  # fmt: skip


def test_matches_of_files_and_arrays_are_pixels_of_these_and_those_of_records_of_the_records():
    paths = sorted(COURTYARD.iterdir())[:2]
    config = PipelineConfig(images=ImageOptions(max_size_px=512))
    cameras = list(thesisrecon.read_cameras(COURTYARD.parent / "cameras.json").values())[:2]
    records = [read_image(path, max_size_px=512).images[0] for path in paths]
    half = thesisrecon.match_pair(*records, config=config)
    whole = thesisrecon.match_pair(*paths, config=config)
    mixed = thesisrecon.match_pair(records[0], np.asarray(PIL.Image.open(paths[1])), config=config)
    assert half.xy1.max() < 512 < whole.xy1.max()
    for found, one, two in ((whole, 2, 2), (half, 1, 1), (mixed, 1, 2)):
        np.testing.assert_allclose(found.xy1, (half.xy1 + 0.5) * one - 0.5)
        np.testing.assert_allclose(found.xy2, (half.xy2 + 0.5) * two - 0.5)
        np.testing.assert_allclose(found.sigma_px, half.sigma_px * np.sqrt((one**2 + two**2) / 2))
        np.testing.assert_allclose(found.affine, half.affine * two / one)
        P = [camera.scaled(scale / 2).P for camera, scale in zip(cameras, (one, two), strict=True)]
        X = thesisrecon.triangulate(np.array(P), np.array([found.xy1, found.xy2]))
        exact = [dehomogenize(X @ p.T) for p in P]
        lines = thesisrecon.epipolar_lines(found.F, exact[0])
        distance = np.abs(np.sum(homogenize(exact[1]) * lines, axis=1))
        assert np.median(distance) < 0.3 * two


def test_impossible_images_reconstructions_and_seeds_are_refused(tmp_path):
    (tmp_path / "a.jpg").write_text("no picture")
    noise = [np.random.default_rng(k).integers(0, 256, (200, 200, 3), dtype=np.uint8) for k in range(2)]
    refuses(StageFailure, r"a\.jpg is not an image", thesisrecon.match_pair, tmp_path / "a.jpg", noise[0])
    refuses(StageFailure, "do not match", thesisrecon.match_pair, *noise)
    metric = replace(small_reconstruction(), stratum="metric")
    for stage in (thesisrecon.self_calibrate, thesisrecon.upgrade_affine):
        refuses(ValueError, "takes a projective reconstruction; got metric", stage, metric)
    for seed in (np.random.default_rng(0), -1, 0.5, True):
        refuses(ValueError, "the seed must be a whole number of at least 0; got", stream, seed, "matches")
    assert stream(np.int64(3), "matches").integers(1000) == stream(3, "matches").integers(1000)


def test_self_calibration_groups_views_by_size_and_takes_a_prior():
    heard = []

    class Listening(fakes.FakeCalibrator):
        def calibrate(self, reconstruction, *, prior, rng):
            heard.append(prior)
            return super().calibrate(reconstruction, prior=prior, rng=rng)

    config = fakes.fake_config(selfcalibration=Listening())
    thesisrecon.self_calibrate(small_reconstruction(), config=config)
    options = IntrinsicsOptions(focal_px=50.0, focal_std_rel=0.1, cameras="per-image")
    thesisrecon.self_calibrate(small_reconstruction(), config=replace(config, intrinsics=options))
    assert heard[0].group.tolist() == [0, 1]
    assert not heard[0].focal_known.any()
    assert heard[1].focal_known.all()
    assert heard[1].mean[:, 0].tolist() == [50.0, 50.0]


def test_points_take_the_mean_colour_of_where_they_are_seen():
    images = []
    for width, height in ((96, 80), (48, 40)):
        rgb = np.zeros((height, width, 3), np.uint8)
        rgb[..., 0], rgb[..., 1] = np.arange(width)[None, :], np.arange(height)[:, None]
        images.append(Image("x", rgb, (width, height)))
    colours = point_colors(small_reconstruction(), tuple(images))
    assert colours.tolist() == [[2, 1, 0], [0, 0, 0], [128, 128, 128]]


def test_a_rectified_pair_is_matched_from_arrays_and_files(tmp_path):
    rng = np.random.default_rng(0)
    wall = np.asarray(PIL.Image.fromarray(rng.integers(0, 256, (20, 40), dtype=np.uint8)).resize((160, 80)))
    left, right = (np.repeat(wall[:, a:b, None], 3, axis=2) for a, b in ((0, 150), (6, 156)))
    found = thesisrecon.match_rectified(left, right, max_disparity_px=12)
    inner = found.disparity[8:-8, 20:-8]
    assert np.isfinite(inner).mean() > 0.9
    assert np.nanmedian(np.abs(inner - 6.0)) < 0.2
    for name, image in (("left", left), ("right", right)):
        PIL.Image.fromarray(image).save(tmp_path / f"{name}.png")
    again = thesisrecon.match_rectified(tmp_path / "left.png", tmp_path / "right.png", max_disparity_px=12)
    np.testing.assert_array_equal(again.disparity, found.disparity)
    deep = [side.astype(np.uint16) * 257 for side in (left, right)]
    again = thesisrecon.match_rectified(*deep, max_disparity_px=12)
    np.testing.assert_allclose(again.disparity, found.disparity, atol=1e-3)
    for error, words, *images in (
        (UsageError, "nothing", tmp_path / "nothing.png", right),
        (ValueError, "same shape", left, right[:-2]),
    ):
        refuses(error, words, thesisrecon.match_rectified, *images, max_disparity_px=12)


def test_a_pair_is_rectified_and_matched_from_arrays():
    """A plane in front of two turned cameras: rows correspond, and disparities are those of the matches."""
    K = np.array([[300.0, 0.0, 127.5], [0.0, 300.0, 95.5], [0.0, 0.0, 1.0]])
    R, t = Rotation.from_rotvec([0.02, -0.06, 0.1]).as_matrix(), np.array([-0.4, 0.05, 0.02])
    P1, P2 = compose_camera(K, np.eye(3), np.zeros(3)), compose_camera(K, R, t)
    H = plane_homography(P1, P2, np.array([0.1, 0.0, -1.0, 4.0]))
    wall = texture(192, 256)
    y, x = np.mgrid[:192.0, :256.0]
    back = dehomogenize(homogenize(np.stack([x, y], axis=2).reshape(-1, 2)) @ np.linalg.inv(H).T)
    right = map_coordinates(wall, back[:, ::-1].T, order=3, mode="nearest").reshape(192, 256)
    left, right = (np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in (wall, right))
    rng = np.random.default_rng(0)
    X = np.column_stack([rng.uniform(-1.2, 1.2, (60, 2)), rng.uniform(3.0, 6.0, 60)])
    xy1, xy2 = project(P1, X), project(P2, X)
    F = fundamental_from_cameras(P1, P2)
    pair = thesisrecon.rectify(left, right, F, xy1, xy2)
    places = [pair.rectified_from_original(side, xy) for side, xy in enumerate((xy1, xy2))]
    np.testing.assert_allclose(places[0][:, 1], places[1][:, 1], atol=1e-6)
    disparity = places[0][:, 0] - places[1][:, 0]
    assert disparity.min() >= 0.0
    assert disparity.max() <= pair.max_disparity_px
    np.testing.assert_allclose(pair.original_from_rectified(1, places[1]), xy2, atol=1e-6)
    found = thesisrecon.match_rectified(pair.left, pair.right, max_disparity_px=pair.max_disparity_px)
    rows, columns = np.nonzero(np.isfinite(found.disparity))
    at = np.column_stack([columns, rows]).astype(float)
    moved = pair.original_from_rectified(1, at - np.outer(found.disparity[rows, columns], [1.0, 0.0]))
    true = dehomogenize(homogenize(pair.original_from_rectified(0, at)) @ H.T)
    assert len(at) > 0.3 * left.size
    assert np.median(np.linalg.norm(moved - true, axis=1)) < 0.3
    refuses(ValueError, r"finite F \(3, 3\)", thesisrecon.rectify, left, right, np.zeros((3, 3)), xy1, xy2)


def test_epipolar_lines_pass_through_the_matches(tmp_path):
    pair = make_pair(5, np.random.default_rng(0))
    S = np.diag([5.0, 5.0, 1.0])
    F, xy1, xy2 = S @ pair.F @ S, 0.2 * pair.xy1, 0.2 * pair.xy2
    gray = np.full((192, 256), 128, np.uint8)
    PIL.Image.fromarray(np.tile(np.arange(256, dtype=np.uint8), (192, 1))).save(tmp_path / "a.png")
    for image in (gray, tmp_path / "a.png"):
        drawn = thesisrecon.draw_epipolar_lines(image, image, F, xy1[:1], xy2[:1])
        for side, (canvas, xy) in enumerate(zip(drawn, (xy1, xy2), strict=True)):
            # More red than background: a line covers parts of pixels.
            rows, columns = np.nonzero(canvas[:, :, 0] > canvas[:, :, 1] + 127.0)
            line = (epipolar_lines(F, xy1) if side else epipolar_lines(F.T, xy2))[0]
            off = np.abs(np.column_stack([columns, rows, np.ones(len(rows))]) @ line)
            near = np.hypot(*(np.column_stack([columns, rows]) - xy[0]).T) < 6.0
            assert off[~near].max() < 1.0
            assert (~near).sum() > 100
    refuses(ValueError, "needs F", thesisrecon.draw_epipolar_lines, gray, gray, F, xy1, xy2[:2])
