"""Depth maps, surface and texture of known cameras without tracks, against true depth; bad input."""

import re
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

import thesisrecon
from tests.conftest import refuses
from tests.stereo.depth_scenes import RADIAL, SIZE, make_walled, on_arc
from thesisrecon import Camera, PipelineConfig, depth_maps, fuse_depth_maps, texture, write_mesh
from thesisrecon.api.cameras import reconstruction_from_cameras
from thesisrecon.camera import decompose_camera
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.io._images import read_pixels
from thesisrecon.results import SparseModel, SparseView
from thesisrecon.stereo.depth import MultiViewStereo
from thesisrecon.surface.fusion import DepthSheets, VolumetricFusion
from thesisrecon.surface.model import SurfaceModel
from validation.scenes.real import load_fixture_depth

ROOT = Path(__file__).parents[2]
ANGLES = (-14.0, -5.0, 4.0, 13.0)


def example(title):
    """Return the code of docs/recipes/plain-arrays.md that begins with this title."""
    page = ROOT / "docs" / "recipes" / "plain-arrays.md"
    blocks = re.findall(r"```python\n# example: (.*?)```", page.read_text("utf-8"), re.DOTALL)
    return next("#" + block for block in blocks if block.startswith(title))


def _cameras(lens=(0.0, 0.0, 0.0)):
    return [Camera(*decompose_camera(P), SIZE, np.array(lens)) for P in on_arc(ANGLES)]


@pytest.fixture(scope="module")
def walled():
    return make_walled(on_arc(ANGLES), lens=RADIAL)


def _errors(maps, scene):
    """Relative errors of all known depths, and the share of known pixels."""
    off = np.array([one.depth / depth - 1.0 for one, depth in zip(maps, scene.depth, strict=True)])
    return np.abs(off[np.isfinite(off)]), float(np.isfinite(off).mean())


@pytest.mark.parametrize("given", [None, (4.0, 9.0)])
def test_depth_of_known_cameras_is_true_without_points(walled, given):
    images = [image.rgb for image in walled.images]
    maps = depth_maps(images, _cameras(RADIAL), depth_range=given)
    error, known = _errors(maps, walled)
    assert np.median(error) < 0.003
    assert np.mean(error < 0.02) > 0.97
    assert known > 0.6
    if given is not None:
        assert all(given[0] <= np.nanmin(one.depth) <= np.nanmax(one.depth) <= given[1] for one in maps)


def test_arrays_of_cameras_and_reconstructions_give_the_same_maps(tmp_path):
    scene = make_walled(on_arc(ANGLES[:3]))
    images, cameras = [image.rgb for image in scene.images], _cameras()[:3]
    one = depth_maps(images, cameras, depth_range=(4.0, 9.0), max_size=120)
    arrays = [np.array([getattr(camera, name) for camera in cameras]) for name in ("K", "R", "t")]
    model = reconstruction_from_cameras(*arrays, sizes=SIZE)
    for given, sizes in ((tuple(arrays), SIZE), (model, None)):
        same = depth_maps(images, given, sizes=sizes, depth_range=np.array([[4.0, 9.0]] * 3), max_size=120)
        assert same[0].depth.shape == (90, 120)
        np.testing.assert_allclose(same[1].P, one[1].P, rtol=0, atol=1e-9)
        # The last digits of the cameras change depths within their noise.
        assert np.nanmedian(np.abs(same[1].depth - one[1].depth)) < 0.01
    # Points that no image observes give neither range nor neighbours.
    lidar = reconstruction_from_cameras(*arrays, sizes=SIZE, X=scene.reconstruction.X[:, :3])
    alike = [depth_maps(images, given, max_size=120) for given in (lidar, model)]
    np.testing.assert_array_equal(alike[0][1].depth, alike[1][1].depth)
    assert np.isfinite(alike[0][1].depth).any()
    # Of a folder, images without a camera (not registered) are left out.
    for n, image in enumerate(images):
        PIL.Image.fromarray(image).save(tmp_path / f"{n}.png")
    found = depth_maps(tmp_path, {"0.png": cameras[0], "1.png": cameras[1]}, depth_range=(4, 9), max_size=120)
    assert len(found) == 2
    # With points, these give the range.
    error, known = _errors(depth_maps(scene.images, scene.reconstruction), scene)
    assert np.median(error) < 0.003
    assert known > 0.5


def test_a_surface_of_plain_depths_has_them(walled):
    cameras = _cameras()
    depths = [np.where(np.isfinite(depth), depth, np.nan) for depth in walled.depth]
    mesh = fuse_depth_maps(depths, cameras)
    seen = thesisrecon.render(mesh, cameras[1])
    off = np.abs(seen.depth / depths[1] - 1.0)
    assert np.nanmedian(off) < 0.002
    assert np.isfinite(off).mean() > 0.9
    small = fuse_depth_maps([depth[::2, ::2] for depth in depths], cameras)
    assert np.nanmedian(np.abs(thesisrecon.render(small, cameras[1]).depth / depths[1] - 1.0)) < 0.01


@pytest.mark.parametrize("fusion", [VolumetricFusion(), DepthSheets()], ids=["volumetric", "sheets"])
def test_infinite_depths_of_a_renderer_are_unknown(fusion):
    """Renderers give infinity where no surface is."""
    K = np.array([[200.0, 0, 119.5], [0, 200, 89.5], [0, 0, 1]])
    cameras = [Camera(K, np.eye(3), np.array([-x, 0.0, 0.0]), SIZE) for x in (0.0, 0.2)]
    config = replace(PipelineConfig(), model=SurfaceModel(fusion=fusion))
    found = []
    for empty in (np.nan, np.inf):
        depth = np.full(SIZE[::-1], 3.0)
        depth[:, SIZE[0] // 2 :] = empty
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found.append(fuse_depth_maps([depth, depth], cameras, config=config))
    assert len(found[0].faces)
    for name in ("vertices", "faces"):
        np.testing.assert_array_equal(getattr(found[1], name), getattr(found[0], name))


@pytest.fixture
def given(monkeypatch):
    """The views that a texture is made of."""
    found = []

    def color(self, surface, views, *, threads=1):  # noqa: ARG001
        found.extend(views)

    monkeypatch.setattr(SurfaceModel, "color", color)
    return found


def test_observations_are_in_the_pixels_of_the_reduced_images(monkeypatch, walled):
    """A depth estimator of your own may use them."""
    seen = []

    def prepare(*given, **_):
        seen.append(given[2])
        raise StageFailure("seen")

    monkeypatch.setattr(MultiViewStereo, "prepare", prepare)
    cameras = _cameras()
    X = np.column_stack([*np.random.default_rng(0).uniform(-0.8, 0.8, (2, 60)), np.full(60, 6.0)])
    xy = np.stack([camera.project(X) for camera in cameras])
    xy[~((xy >= 0.0) & (xy <= np.array(SIZE) - 1.0)).all(axis=2)] = np.nan
    arrays = (np.stack([getattr(camera, name) for camera in cameras]) for name in ("K", "R", "t"))
    given = reconstruction_from_cameras(*arrays, sizes=SIZE, X=X, xy=xy)
    refuses(StageFailure, "seen", depth_maps, [image.rgb for image in walled.images], given, max_size=120)
    (reduced,) = seen
    tracks = reduced.tracks
    assert len(tracks.xy) > 100
    for i, P in enumerate(reduced.P):
        here = tracks.view_index == i
        off = project(P, reduced.X[tracks.point_index[here]]) - tracks.xy[here]
        np.testing.assert_allclose(off, 0.0, atol=1e-9)


@pytest.mark.parametrize(("max_size", "side"), [(None, 1600), (1700, 1700), (400, 400)])
def test_a_texture_is_made_of_images_of_the_requested_size(given, max_size, side):
    image = np.random.default_rng(0).integers(0, 256, (300, 1800, 3), dtype=np.uint8)
    K = np.array([[900.0, 0, 899.5], [0, 900, 149.5], [0, 0, 1]])
    camera = Camera(K, np.eye(3), np.zeros(3), (1800, 300), np.array([-0.01, 0, 0]))
    mesh = thesisrecon.TexturedMesh(np.eye(3), np.array([[0, 1, 2]]))
    texture(mesh, [image], [camera], max_size=max_size)
    assert given[0].rgb.shape[1] == side


def test_images_with_cameras_of_a_colmap_model_are_used_as_stored(tmp_path, given):
    """A half turn by EXIF keeps the size of an image: only the camera tells which pixels are meant."""
    pixels = np.random.default_rng(0).integers(0, 256, (90, 120, 3), dtype=np.uint8)
    exif = PIL.Image.Exif()
    exif[0x0112] = 3
    (tmp_path / "images").mkdir()
    PIL.Image.fromarray(pixels).save(tmp_path / "images" / "a.png", exif=exif)
    K = np.array([[100.0, 0, 59.5], [0, 100, 44.5], [0, 0, 1]])
    upright = Camera(K, np.eye(3), np.zeros(3), (120, 90))
    view = SparseView("a.png", upright.R, upright.t, K, upright.size, np.zeros(3))
    thesisrecon.export(SparseModel([view]), tmp_path / "colmap", to="colmap")
    mesh = thesisrecon.TexturedMesh(np.eye(3), np.array([[0, 1, 2]]))
    of_colmap = thesisrecon.read_cameras(tmp_path / "colmap")
    for cameras, expected in ((of_colmap, pixels), ({"a.png": upright}, pixels[::-1, ::-1])):
        texture(mesh, tmp_path / "images", cameras)
        np.testing.assert_array_equal(given.pop().rgb, expected)
    turned = {"a.png": of_colmap["a.png"].scaled(0.5)}
    refuses(ValueError, "without EXIF rotation, as in COLMAP", texture, mesh, tmp_path / "images", turned)


def test_the_example_makes_a_glb_of_the_courtyard(tmp_path, monkeypatch):
    source = ROOT / "fixtures" / "courtyard"
    (tmp_path / "images").mkdir()
    for name in ("0004.jpg", "0005.jpg", "0006.jpg"):
        shutil.copy(source / "images" / name, tmp_path / "images")
    shutil.copy(source / "cameras.json", tmp_path)
    monkeypatch.chdir(tmp_path)
    made = {}
    exec(example("depth to GLB"), made)
    assert (tmp_path / "model.glb").read_bytes()[:4] == b"glTF"
    depth, _ = load_fixture_depth(5)
    # A pixel of the quarter image covers 4 x 4 pixels, 2 x 2 samples of the true depth.
    true = depth.reshape(192, 2, 256, 2).mean(axis=(1, 3))
    off = np.abs(made["view"].depth / true - 1.0)
    assert np.nanmedian(off) < 0.005
    assert np.isfinite(off).mean() > 0.6
    # The rendered view is the image.
    (image,) = read_pixels(source / "images" / "0005.jpg")
    small = image.reshape(192, 4, 256, 4, 3).mean(axis=(1, 3))
    apart = np.abs(made["view"].color.astype(float) - small)[made["view"].valid]
    assert np.median(apart) < 12.0


def test_wrong_input_gets_one_sentence(walled, tmp_path):
    images, cameras = [image.rgb for image in walled.images], _cameras()
    turned = [Camera(c.K, c.R, c.t, SIZE[::-1]) for c in cameras]
    ones = np.ones((180, 240))
    sizes = r"has \(width, height\) \(240, 180\), its camera is for \(180, 240\)"
    for words, call, *given in (
        ("needs a camera per image; got 3 and 4", depth_maps, images, cameras[:3]),
        (sizes, depth_maps, images, turned),
        ("no camera for", depth_maps, images, {"a.jpg": cameras[0]}),
        ("needs the cameras", fuse_depth_maps, [ones]),
        ("needs a camera of its shape", fuse_depth_maps, [ones[:100]], cameras[:1]),
    ):
        refuses(ValueError, words, call, *given)
    refuses(ValueError, "0 < nearest < farthest", depth_maps, images, cameras, depth_range=(4.0, 2.0))
    first, second = cameras[:2]
    away = [first, Camera(second.K, np.diag([-1.0, 1, -1]) @ second.R, second.t, SIZE)]
    refuses(StageFailure, "no depth was found", depth_maps, images[:2], away)
    refuses(StageFailure, "no depths", fuse_depth_maps, [np.full((180, 240), np.nan)], cameras[:1])
    mesh = fuse_depth_maps([ones], cameras[:1])
    refuses(UsageError, r"ending \.glb", write_mesh, tmp_path / "model.ply", mesh)
