"""Rendering: what an image must show, and how similar two images are."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.surface.sphere import looking_at_origin, photograph, sphere_map
from thesisrecon.api.views import render
from thesisrecon.camera import Camera
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.records import RenderedView, TexturedMesh
from thesisrecon.surface._mesh import surface_from_depth
from thesisrecon.views import render as module
from thesisrecon.views.render import (
    GREY,
    _ssim_map,
    covered_pixels,
    match_exposure,
    psnr_db,
    ssim,
)

K = np.array([[60.0, 0.0, 31.3], [0.0, 62.0, 22.7], [0.0, 0.0, 1.0]])


SIZE = (64, 48)


CAMERA = Camera(K, np.eye(3), np.zeros(3), SIZE)


def corners(width, height):
    """The corners (4, 2) of a picture."""
    return np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5


def wall(**more):
    """A wall at depth 2 that fills the picture, its corners at the picture's."""
    vertices = 2.0 * homogenize(corners(64, 48)) @ np.linalg.inv(K).T
    return TexturedMesh(vertices, np.array([[0, 2, 1], [0, 3, 2]]), **more)


def textured_wall(texture):
    return wall(texture=texture, uv=corners(*texture.shape[1::-1])[np.array([[0, 2, 1], [0, 3, 2]])])


def test_a_texture_is_shown_texel_for_pixel_a_finer_one_averaged_and_colours_run_between_corners():
    texture = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    seen = render(textured_wall(texture), CAMERA, samples=1)
    assert seen.valid.all()
    np.testing.assert_allclose(seen.depth, 2.0, rtol=1e-6)
    assert np.abs(seen.color.astype(int) - texture).max() <= 1
    board = (np.indices((96, 128)).sum(axis=0) % 2 * 255).astype(np.uint8)
    seen = render(textured_wall(np.repeat(board[..., None], 3, axis=2)), CAMERA, samples=2)
    assert np.abs(seen.color.astype(int) - 128).max() <= 2
    colors = np.array([[0, 0, 0], [255, 0, 0], [255, 255, 0], [0, 255, 0]], dtype=np.uint8)
    seen = render(wall(colors=colors), CAMERA).color.astype(float)
    assert np.abs(seen[20, :, 0] - (np.arange(64) + 0.5) / 64 * 255).max() < 1.0
    assert (seen[..., 2] == 0).all()


@pytest.mark.parametrize("samples", [1, 2])
def test_an_image_is_rasterised_in_parts_without_effect_on_it(monkeypatch, samples):
    colors = np.random.default_rng(0).integers(0, 256, (4, 3), dtype=np.uint8)
    camera = Camera(K, np.eye(3), np.array([0.3, -0.2, 0.1]), SIZE)
    options = {"samples": samples}
    whole = render(wall(colors=colors), camera, **options)
    bare = render(wall(), camera, **options)
    monkeypatch.setattr(module, "PART_SAMPLES", 64 * samples * samples * 7)
    for threads in (1, 3):
        parts = render(wall(colors=colors), camera, **options, threads=threads)
        for name in ("color", "depth", "valid"):
            np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
        lit = render(wall(), camera, **options, threads=threads)
        np.testing.assert_array_equal(lit.color, bare.color)
    # Colour, depth and validity take 8 bytes per pixel, and the samples of all pixels at one time 20 or 80.
    large = Camera(np.diag([20.0, 20.0, 1.0]) @ K, np.eye(3), np.zeros(3), (1280, 960))
    tracemalloc.start()
    render(wall(colors=colors), large, samples=samples)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 * 1280 * 960


@pytest.mark.parametrize(
    ("lens", "k", "focal"),
    [("fisheye", [-0.02, 0.001], 38.0), ("fisheye", [], 60.0), ("radial", [-0.2, 0.04], 70.0),
     ("brown", [0.1, -0.02, 0.003, -0.002], 90.0), ("division", [-0.3], 60.0)],
)  # fmt: skip
def test_a_camera_with_a_lens_sees_what_its_rays_meet(lens, k, focal):
    # A box around the camera, with a lid inside it; colours are linear in space.
    corner = np.array([[x, y, z] for x in (-2, 3) for y in (-1.5, 2) for z in (-2, 4)], dtype=np.float64)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    sheet = np.array([[-1, -0.8, 2.0], [1.2, -0.8, 2.5], [1.2, 0.9, 2.5], [-1, 0.9, 2.0]])
    faces = np.array([f for a, b, c, d in [*sides, (8, 9, 10, 11)] for f in ((a, b, c), (a, c, d))])
    vertices = np.concatenate([corner, sheet])
    mesh = TexturedMesh(vertices, faces, colors=np.clip(vertices * 30.0 + 120.0, 0, 255).astype(np.uint8))
    R = Rotation.from_euler("xyz", [20, -35, 10], degrees=True).as_matrix()
    K = np.array([[focal, 0, 62.0], [0, focal, 45.0], [0, 0, 1]])
    camera = Camera(K, R, -R @ [0.3, 0.1, 0.2], (120, 90), np.array(k), lens=lens)
    view = render(mesh, camera, samples=1)
    xy = np.stack(np.meshgrid(np.arange(120.0), np.arange(90.0)), axis=-1).reshape(-1, 2)
    rays = camera.unproject(xy)
    hit = np.isfinite(rays).all(axis=1)
    assert view.valid.reshape(-1)[hit].all()
    assert not view.valid.reshape(-1)[~hit].any()
    # Each ray ends at the first of the planes, within the sheet for the last two.
    a, b, c = (vertices[faces[:, n]] for n in range(3))
    M = np.stack([np.broadcast_to(-rays[hit][:, None], (hit.sum(), len(faces), 3)),
                  np.broadcast_to(b - a, (hit.sum(), len(faces), 3)),
                  np.broadcast_to(c - a, (hit.sum(), len(faces), 3))], axis=-1)  # fmt: skip
    solved = np.linalg.solve(M + 1e-12 * np.eye(3), (camera.centre - a)[None, :, :, None])[..., 0]
    inside = (solved[..., 0] > 0) & (solved[..., 1:] > -1e-7).all(-1) & (solved[..., 1:].sum(-1) < 1 + 1e-7)
    first = np.where(inside, solved[..., 0], np.inf).min(axis=1)
    X = camera.centre + first[:, None] * rays[hit]
    depth = ((X - camera.centre) @ R.T)[:, 2]
    found = view.depth.reshape(-1)[hit]
    # At the rim of the sheet the face is that of the nearest pixel of a pinhole view.
    same = np.abs(found - depth) < 1e-4
    assert same.mean() > 0.98
    colour = X * 30.0 + 120.0
    assert np.abs(view.color.reshape(-1, 3)[hit][same] - colour[same]).max() < 1.6


def test_light_on_a_bare_surface_falls_by_the_cosine():
    seen = render(wall(), CAMERA).color
    rays = homogenize(np.argwhere(np.ones((48, 64)))[:, ::-1]) @ np.linalg.inv(K).T
    cosine = 1.0 / np.linalg.norm(rays, axis=1).reshape(48, 64)
    assert np.abs(seen - (60.0 + 160.0 * cosine)[..., None]).max() <= 1.0


def test_nothing_is_seen_where_nothing_is():
    empty = TexturedMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    seen = render(empty, CAMERA, background=(1, 2, 3))
    assert not seen.valid.any()
    assert np.isnan(seen.depth).all()
    assert (seen.color == [1, 2, 3]).all()
    away = Camera(K, np.diag([-1.0, 1.0, -1.0]), np.zeros(3), SIZE)
    assert not render(wall(), away).valid.any()
    needle = TexturedMesh(np.array([[0.0, 0, 2], [1, 0, 2], [2, 0, 2]]), np.array([[0, 1, 2], [0, 0, 1]]))
    assert render(needle, CAMERA).valid.sum() <= 64


@pytest.mark.parametrize("far", [1e9, np.inf, np.nan])
def test_vertices_that_no_face_uses_have_no_effect(far):
    more = replace(wall(), vertices=np.vstack([wall().vertices, [[0.0, 0.0, far]]]))
    np.testing.assert_array_equal(render(more, CAMERA).depth, render(wall(), CAMERA).depth)


def test_light_does_not_depend_on_the_origin():
    """In metres of a map grid single precision has steps of half a metre."""
    size = 30
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-2.0, 2.0, size)]))
    vertices = np.column_stack([x, y, 4.0 + 0.3 * np.sin(3.0 * x)])
    at = np.arange(size * size).reshape(size, size)
    a, b, c, d = (q.ravel() for q in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    seen = []
    for shift in (np.zeros(3), np.array([5e5, 5e6, 100.0])):
        camera = Camera(K, np.eye(3), -shift, SIZE)
        seen.append(render(TexturedMesh(vertices + shift, faces), camera).color.astype(int))
    assert np.ptp(seen[0]) > 100
    assert np.abs(seen[0] - seen[1]).max() <= 1


def test_wrong_calls_are_refused():
    texture, uv = np.zeros((2, 2, 3), np.uint8), np.zeros((2, 3, 2))
    hole = np.where(np.arange(4)[:, None] == 2, np.nan, wall().vertices)
    for words, mesh in (
        ("a run until 'metric' has no mesh", None),
        ("vertices that do not exist", TexturedMesh(np.zeros((2, 3)), np.array([[0, 1, 2]]))),
        ("uv must be", wall(uv=uv[:1], texture=texture)),
        (r"colors \(4, 3\)", wall(colors=np.zeros((1, 3), np.uint8))),
        ("vertices of faces must be finite", replace(wall(), vertices=hole)),
        ("uv must be finite", wall(uv=np.full_like(uv, np.nan), texture=texture)),
    ):
        refuses(ValueError, words, render, mesh, CAMERA)
    refuses(ValueError, "at least 1 as samples", render, wall(), CAMERA, samples=0)


SPHERE_SIZE = (160, 120)


def textured_surface(depth_map):
    """The surface of a depth map with each pixel's place in the photograph as its place in the texture."""
    mesh = surface_from_depth(depth_map)
    uv = project(depth_map.P, mesh.vertices)[mesh.faces]
    return replace(mesh, uv=uv, texture=photograph(depth_map).rgb)


@settings(max_examples=15, deadline=None)
@given(angle=st.floats(-3.1, 3.1), height=st.floats(-2.0, 2.0), distance=st.floats(2.8, 5.0))
def test_from_its_own_camera_the_surface_shows_the_photograph_and_its_depth(angle, height, distance):
    depth_map = sphere_map(0, looking_at_origin(angle, height, distance))
    seen = render(textured_surface(depth_map), Camera.from_matrix(depth_map.P, SPHERE_SIZE), samples=1)
    known = np.isfinite(depth_map.depth)
    assert not (seen.valid & ~known).any()
    assert (seen.valid & known).sum() > 0.9 * known.sum()  # but a rim of grazing rays
    np.testing.assert_allclose(seen.depth[seen.valid], depth_map.depth[seen.valid], rtol=1e-4)
    apart = np.abs(seen.color.astype(int) - photograph(depth_map).rgb)[seen.valid]
    assert apart.max() <= 1


def pictures():
    rng = np.random.default_rng(0)
    y, x = np.indices((40, 50))
    clean = 128 + 60 * np.sin(x / 4.0) * np.cos(y / 5.0)
    real = np.repeat(clean[..., None], 3, axis=2) + np.array([0, 10, -10])
    return real.round().astype(np.uint8), (real + rng.normal(0, 12, real.shape)).round().astype(np.uint8)


def test_ssim_is_that_of_its_windows():
    real, noisy = pictures()
    y, x = 17, 21
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(taps, taps) / taps.sum() ** 2
    pair = np.stack([(image @ GREY)[y - 5 : y + 6, x - 5 : x + 6].ravel() for image in (real, noisy)])
    mean = pair @ window.ravel()
    (spread, common), (_, other) = np.cov(pair, aweights=window.ravel(), ddof=0)
    c1, c2 = 2.55**2, 7.65**2
    value = (2 * mean.prod() + c1) / (mean @ mean + c1) * (2 * common + c2) / (spread + other + c2)
    everything = np.ones(real.shape[:2], bool)
    assert _ssim_map(real, noisy, everything)[y, x] == pytest.approx(value, abs=1e-3)
    assert ssim(real, real, everything) == pytest.approx(1.0)
    assert 0.3 < ssim(real, noisy, everything) < 0.95
    # Pixels that are not compared take no part.
    mask = np.hypot(*(np.indices((40, 50)) - np.array([y, x])[:, None, None])) < 9
    spoiled = np.where(mask[..., None], noisy, 0).astype(np.uint8)
    assert ssim(real, spoiled, mask) == pytest.approx(ssim(real, noisy, mask))


def test_psnr_is_that_of_its_formula_and_exposure_is_made_alike():
    real, noisy = pictures()
    mask = np.zeros((40, 50), bool)
    mask[5:20, 3:40] = True
    wanted = 10 * np.log10(255**2 / np.mean((real[mask].astype(float) - noisy[mask]) ** 2))
    assert psnr_db(real, noisy, mask) == pytest.approx(wanted)
    assert psnr_db(real, real, mask) == float("inf")
    darker = np.rint(real * [0.5, 0.8, 1.0]).astype(np.uint8)
    assert psnr_db(real, match_exposure(real, darker, mask), mask) > 45.0
    # Pixels at the rim are not whole.
    rim = RenderedView(real, np.zeros((40, 50), np.float32), mask)
    np.testing.assert_array_equal(covered_pixels(rim), binary_erosion(mask, np.ones((3, 3))))
