"""Texture atlas, view selection and blending."""

import weakref
from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import refuses
from tests.surface.sphere import (
    fused_sphere,
    looking_at_origin,
    paint,
    photograph,
    points_of,
    ring_of,
    sphere_map,
)
from thesisrecon.api.export import write_mesh
from thesisrecon.api.views import render
from thesisrecon.camera import Camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.imaging.raster import rasterize, vertex_normals
from thesisrecon.records import TexturedMesh
from thesisrecon.surface import _texture_blending as blending
from thesisrecon.surface import model as texture_atlas
from thesisrecon.surface._mesh import face_neighbours
from thesisrecon.surface.model import MAX_TEXELS, SurfaceModel, _pack_rectangles, texture_mesh

GAINS = (1.0, 0.85, 1.1, 0.95, 1.05, 0.9, 1.0, 1.1)


@pytest.fixture(scope="module")
def sphere():
    return fused_sphere()


def difference(mesh):
    """Rendered less painted colours (N, 3) of the sphere from where no photograph was taken, off its rim."""
    truth = sphere_map(0, looking_at_origin(0.4, 0.3, 3.2))
    seen = render(mesh, Camera.from_matrix(truth.P, (160, 120)))
    points = points_of(truth)
    centre = -np.linalg.solve(truth.P[:, :3], truth.P[:, 3])
    facing = (points * (centre - points)).sum(-1) / np.linalg.norm(centre - points, axis=-1)
    where = seen.valid & (np.nan_to_num(facing) > 0.35)
    return seen.color[where] - paint(points)[where]


def quality_of(mesh, views):
    return texture_atlas.face_quality(mesh, views, blending.depth_buffers(mesh, views))


def prepared_views(mesh, views):
    return blending.prepare_views(mesh, views, blending.depth_buffers(mesh, views))


def test_a_new_view_shows_the_painted_sphere(sphere):
    mesh = texture_mesh(sphere, [photograph(m) for m in ring_of()])
    assert mesh.untextured.mean() < 0.05
    assert np.sqrt(np.mean(difference(mesh) ** 2)) < 6.0


def test_colours_are_those_of_the_projected_places_and_smaller_images_keep_waves_but_alias_none(sphere):
    y, x = np.indices((120, 160))
    view = photograph(ring_of()[0])
    view = replace(view, rgb=np.stack([x, y, x + y], axis=-1).clip(0, 255).astype(np.uint8))
    surface, count = prepared_views(sphere, [view])[0], len(sphere.vertices)
    weight, color = np.zeros(count, np.float32), np.zeros((count, 3), np.float32)
    blending.observe_points(sphere.vertices, vertex_normals(sphere), surface, weight, color)
    np.testing.assert_allclose(color[weight > 0, :2], project(view.P, sphere.vertices)[weight > 0], atol=1e-3)
    for period, least, most in ((16.0, 0.9, 1.01), (3.0, 0.0, 0.3)):
        waves = np.rint(128.0 + 100.0 * np.cos(2.0 * np.pi * x / period)).astype(np.uint8)
        smaller = texture_atlas._reduced(replace(view, rgb=np.repeat(waves[:, :, None], 3, axis=2)), 0.5)
        inner = smaller.rgb[:, 10:-10].astype(float)
        assert least < np.sqrt(2.0) * inner.std() / 100.0 < most


def test_a_model_of_noisy_depths_is_a_small_file(tmp_path):
    views = ring_of()
    noisy = [sphere_map(m.view, m.P, noise=0.01) for m in views]
    mesh = SurfaceModel().build(noisy, [photograph(m) for m in views])
    write_mesh(tmp_path / "model.glb", mesh)
    # 12 bytes for the corners of a face, 20 for a vertex (a sixth are repeated on seams), and the texture.
    assert len(mesh.faces) < 4300
    assert (tmp_path / "model.glb").stat().st_size < 28 * len(mesh.faces)


def test_hidden_and_cut_off_points_are_not_visible(sphere):
    view = photograph(ring_of()[0])
    quality = quality_of(sphere, [view])[:, 0]
    middle = sphere.vertices[sphere.faces].mean(axis=1)
    centre = -np.linalg.solve(view.P[:, :3], view.P[:, 3])
    towards = (middle * (centre - middle)).sum(1) / np.linalg.norm(centre - middle, axis=1)
    assert quality[towards < -0.25].max() == 0.0
    assert (quality[towards > 0.3] > 0.0).mean() > 0.97
    half = replace(view, seen=np.arange(160)[None, :].repeat(120, axis=0) < 80)
    assert quality_of(sphere, [half])[project(view.P, middle)[:, 0] > 82, 0].max() == 0.0


def test_charts_are_large_and_use_views_that_see_them(sphere):
    views, neighbours = [photograph(m) for m in ring_of()], face_neighbours(sphere.faces)
    quality = quality_of(sphere, views)
    label = texture_atlas.choose_views(sphere, views, blending.depth_buffers(sphere, views), neighbours)
    seen = quality.max(axis=1) > 0.0
    np.testing.assert_array_equal(label >= 0, seen)
    chosen = quality[seen, label[seen]]
    assert (chosen > 0.0).all()
    assert np.median(chosen / quality[seen].max(axis=1)) > 0.8
    patchwork = np.where(seen, quality.argmax(axis=1), -1)
    charts, before = (
        len(np.unique(texture_atlas.label_charts(x, neighbours)[seen])) for x in (label, patchwork)
    )
    assert charts < min(0.5 * before, 40)


def test_rectangles_do_not_overlap_in_an_atlas_no_larger_than_allowed(sphere):
    sizes = np.random.default_rng(0).integers(0, 40, (200, 2))
    places, (width, height) = _pack_rectangles(sizes)
    taken = np.zeros((height, width), dtype=int)
    for (x, y), (w, h) in zip(places, sizes, strict=True):
        taken[y : y + h, x : x + w] += 1
        assert x + w <= width
        assert y + h <= height
    assert taken.max() == 1
    assert width * height < 1.5 * sizes.prod(axis=1).sum()
    mesh = texture_mesh(sphere, [photograph(m) for m in ring_of()], max_texels=20_000)
    assert mesh.texture.shape[0] * mesh.texture.shape[1] < 40_000  # with the patches of unseen faces
    assert np.sqrt(np.mean(difference(mesh) ** 2)) < 20.0


def test_what_cannot_be_textured_is_rejected(sphere):
    views = [photograph(m) for m in ring_of()]
    away = replace(views[0], seen=np.zeros_like(views[0].seen))
    camera = blending.view_camera(views[0])
    square = np.array(
        [[-100.0, -100.0, 4.0], [100.0, -100.0, 4.0], [100.0, 100.0, 4.0], [-100.0, 100.0, 4.0]]
    )
    wall = TexturedMesh(square @ camera.R + camera.centre, np.array([[0, 2, 1], [0, 3, 2]]))
    for words, most, mesh, some in (
        (r"too large; \d+ charts need \d+ texels, the limit is 40", 40, sphere, views),
        ("no texture; no image shows the outside of a face", MAX_TEXELS, sphere, [away]),
        ("shows the outside of a face completely", MAX_TEXELS, wall, views[:1]),
    ):
        refuses(StageFailure, words, texture_mesh, mesh, some, max_texels=most)


def test_unseen_faces_take_the_colour_of_their_surroundings(sphere):
    red = [replace(v, rgb=np.full_like(v.rgb, [200, 30, 20])) for v in map(photograph, ring_of()[:3])]
    mesh = texture_mesh(sphere, red)
    assert 0.2 < mesh.untextured.mean() < 0.8
    seen = render(mesh, Camera.from_matrix(looking_at_origin(np.pi, 0.0, 3.5), (160, 120)))
    inner = seen.color[seen.valid & (seen.color.sum(axis=2) > 230)].astype(int)
    assert np.abs(inner - [200, 30, 20]).max() <= 2


def test_gains_are_found_and_those_of_views_that_share_nothing_stay(sphere):
    views = [photograph(m, gain) for m, gain in zip(ring_of(), GAINS, strict=True)]
    found = [view.gain for view in prepared_views(sphere, views)]
    wanted = np.exp(np.log(GAINS).mean()) / np.array(GAINS)
    np.testing.assert_allclose(found, np.repeat(wanted[:, None], 3, axis=1), atol=0.025)
    weight = np.array([[1, 1, 1, 0, 0], [1, 1, 1, 0, 0], [0, 0, 0, 1, 1]], dtype=np.float32)
    color = np.full((3, 5, 3), 100, dtype=np.float32)
    color[1] = 144.0
    found = blending._equalizing_gains(weight, color)[:, 0]
    np.testing.assert_allclose(found, [1.2, 1 / 1.2, 1.0], rtol=1e-4)


def test_depths_that_one_image_contradicts_are_removed(sphere, monkeypatch):
    views = [photograph(m) for m in ring_of(24)]
    spoiled = views[0].rgb.copy()
    spoiled[40:80, 60:100] = [255, 0, 255]
    views[0] = replace(views[0], rgb=spoiled)
    towards = sphere.vertices @ views[0].P[:, :3].T + views[0].P[:, 3]
    x, y = (towards[:, :2] / towards[:, 2:]).T
    facing = (sphere.vertices @ np.linalg.solve(views[0].P[:, :3], views[0].P[:, 3])) < 0
    hit = facing & (np.abs(x - 80) < 15) & (np.abs(y - 60) < 15)
    prepared, error = prepared_views(sphere, views), []
    for scatter in (1e6, 20.0):
        monkeypatch.setattr(blending, "SCATTER", scatter)
        color = blending.blend_colors(prepared, sphere.vertices, vertex_normals(sphere))[0]
        error.append(float(np.sqrt(np.mean((color - paint(sphere.vertices))[hit] ** 2))))
    assert error[0] > 12.0
    assert error[1] < 0.3 * error[0]


def test_combine_colors_matches_its_twin():
    rng = np.random.default_rng(2)
    weight = rng.random((5, 60)).astype(np.float32)
    weight[rng.random(weight.shape) < 0.4] = 0.0
    weight[:, 0] = 0.0
    color = (255 * rng.random((5, 60, 3))).astype(np.float32)
    out = np.full((60, 3), 7.0, np.float32)
    blending.combine_colors(weight, color, 2.0, 30.0, out)
    np.testing.assert_array_equal(out[0], 7.0)
    for n in np.flatnonzero(weight.any(axis=0)):
        w, c = weight[:, n].astype(float), color[:, n].astype(float)
        w, c = w[w > 0] / w.max(), c[w > 0]
        middle = np.empty(3)
        for k in range(3):
            order = np.argsort(c[:, k], kind="stable")
            middle[k] = c[order[np.searchsorted(np.cumsum(w[order]), 0.5 * w.sum())], k]
        final = w**2 / (1 + ((c - middle) ** 2).mean(axis=1) / 30.0**2) ** 2
        np.testing.assert_allclose(out[n], final @ c / final.sum(), rtol=1e-4)


def test_of_many_views_those_of_the_largest_weights_are_blended():
    rng = np.random.default_rng(5)
    weight, color = rng.random((50, 40)).astype(np.float32), np.full((50, 40, 3), 90, np.float32)
    weight[rng.random(weight.shape) < 0.2] = 0.0
    weight[:, :20] = np.ceil(4.0 * weight[:, :20])  # many are equal: the first ones stay
    few = np.sort(np.argsort(-weight, axis=0, kind="stable")[: blending.MAX_BLENDED], axis=0)
    color += rng.normal(0, 9, color.shape).astype(np.float32)
    out, wanted = np.zeros((2, 40, 3), np.float32)
    kept, kept_color = weight[: blending.MAX_BLENDED].copy(), color[: blending.MAX_BLENDED].copy()
    for view in range(blending.MAX_BLENDED, 50):
        blending.keep_largest(weight[view], color[view], kept, kept_color)
    blending.combine_colors(kept, kept_color, 2.0, 30.0, out)
    best = np.take_along_axis(weight, few, axis=0)
    np.testing.assert_array_equal(kept, best)
    blending.combine_colors(best, np.take_along_axis(color, few[..., None], axis=0), 2.0, 30.0, wanted)
    np.testing.assert_array_equal(out, wanted)


@pytest.mark.parametrize("max_texels", [4096 * 4096, 20_000])
def test_the_texture_is_the_same_bytes_within_any_memory_and_for_any_threads(sphere, monkeypatch, max_texels):
    views, rastered = [photograph(m) for m in ring_of(40)], []

    def counted(*given):
        rastered.append(0)
        return rasterize(*given)

    monkeypatch.setattr(blending, "rasterize", counted)
    whole = texture_mesh(sphere, views, max_texels=max_texels)
    once = len(rastered)
    assert once == (40 if max_texels > 1e6 else 80)
    for name in ("BUFFER_BYTES", "SURFACE_BYTES"):
        monkeypatch.setattr(blending, name, 0)
    monkeypatch.setattr(texture_atlas, "REDUCED_BYTES", 0)
    monkeypatch.setattr(blending, "LARGE_PART_TEXELS", 3000)
    monkeypatch.setattr(blending, "CHUNK_POINTS", 500)
    for threads in (1, 2):
        rastered.clear()
        within = texture_mesh(sphere, views, max_texels=max_texels, threads=threads)
        assert within.texture.tobytes() == whole.texture.tobytes()
        assert within.uv.tobytes() == whole.uv.tobytes()
        assert len(rastered) > 2 * once


@pytest.mark.parametrize("count", [12, 36])
def test_views_in_memory_during_texturing_do_not_grow_with_their_number(sphere, monkeypatch, count):
    alive, most, prepare = [], [0], blending._prepared

    def followed(view, depth):
        surface = prepare(view, depth)
        alive[:] = [one for one in alive if one() is not None] + [weakref.ref(surface.trust)]
        most[0] = max(most[0], len(alive))
        return surface

    monkeypatch.setattr(blending, "_prepared", followed)
    monkeypatch.setattr(blending, "BUFFER_BYTES", 0)
    monkeypatch.setattr(blending, "SURFACE_BYTES", 3 * 11 * 160 * 120)
    texture_mesh(sphere, [photograph(m) for m in ring_of(count)], threads=2)
    # Those that are kept, those of one batch, and those that two threads are making.
    assert most[0] <= 3 + blending.BATCH_VIEWS + 2


def test_a_part_of_the_surface_uses_no_view_away_from_it_and_each_one_that_shows_it():
    rng, camera = np.random.default_rng(6), Camera.from_matrix(looking_at_origin(0.4, 0.3, 3.2), (160, 120))
    used = 0
    for _ in range(300):
        points = rng.normal(scale=3.0, size=3) + rng.uniform(0.0, 1.0, 3) * rng.uniform(-0.5, 0.5, (20, 3))
        x = points @ camera.P[:, :3].T + camera.P[:, 3]
        ahead = x[:, 2] > 0
        inside = ((x[:, :2] >= 0) & (x[:, :2] <= np.array([159, 119]) * x[:, 2:])).all(axis=1)
        may = blending._may_contain(camera, points.min(axis=0), points.max(axis=0))
        assert may or not (ahead & inside).any()
        used += may
    assert 20 < used < 150


def test_faces_are_continued_by_a_texel():
    corners = np.array([[[2.2, 2.1, 1.0], [8.3, 2.4, 1.0], [2.5, 8.2, 1.0]]])
    face = np.full((12, 12), -1)
    face[3:5, 3:6] = 0
    weights = np.zeros((12, 12, 2), np.float32)
    blending.continue_faces(corners, 4.0, face, weights)
    wanted = np.full((12, 12), -1)
    wanted[3:5, 2:7] = 0
    wanted[2:6, 3:6] = 0
    np.testing.assert_array_equal(face, wanted)
    for y, x in np.argwhere(face >= 0):
        if not (3 <= y < 5 and 3 <= x < 6):
            found = np.linalg.solve(corners[0].T, [x, y, 1.0])
            np.testing.assert_allclose(weights[y, x], found[1:], atol=1e-6)
    face = np.full((12, 12), -1)
    face[3, 3] = 0
    blending.continue_faces(corners, 0.1, face, weights)
    assert (face >= 0).sum() < 5
