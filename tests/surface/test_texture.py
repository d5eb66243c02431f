"""Texture from photographs: what is seen, which photograph is taken, seams, and what nobody sees."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tests.surface.sphere import looking_at_origin, paint, photograph, points_of, ring_of, sphere_map
from thesisrecon.camera import Camera
from thesisrecon.errors import StageFailure
from thesisrecon.surface.color_correction import SingleView
from thesisrecon.surface.fusion import VolumetricFusion
from thesisrecon.surface.mesh import face_neighbours
from thesisrecon.surface.texture_atlas import TextureAtlas, pack_rectangles
from thesisrecon.surface.texture_blending import BlendedViews
from thesisrecon.surface.texture_views import charts_of, choose_views, color_vertices, face_quality
from thesisrecon.views.render import render

GAINS = (1.0, 0.85, 1.1, 0.95, 1.05, 0.9, 1.0, 1.1)


@pytest.fixture(scope="module")
def sphere():
    return VolumetricFusion().fuse(ring_of())


def difference(mesh):
    """Rendered less painted colours (N, 3) of the sphere from where no photograph was taken, off its rim."""
    truth = sphere_map(0, looking_at_origin(0.4, 0.3, 3.2))
    seen = render(mesh, Camera.from_matrix(truth.P, (160, 120)))
    points = points_of(truth)
    centre = -np.linalg.solve(truth.P[:, :3], truth.P[:, 3])
    facing = (points * (centre - points)).sum(-1) / np.linalg.norm(centre - points, axis=-1)
    where = seen.valid & (np.nan_to_num(facing) > 0.35)
    return seen.color[where] - paint(points)[where]


def test_a_new_view_shows_the_painted_sphere(sphere):
    mesh = TextureAtlas().texture(sphere, [photograph(m) for m in ring_of()])
    assert mesh.uv is not None
    assert mesh.texture is not None
    assert mesh.untextured is not None
    assert mesh.untextured.mean() < 0.05
    assert np.sqrt(np.mean(difference(mesh) ** 2)) < 6.0
    colored = color_vertices(sphere, [photograph(m) for m in ring_of()])
    assert np.sqrt(np.mean(difference(colored) ** 2)) < 12.0


@pytest.mark.parametrize("kind", [SingleView, BlendedViews])
def test_exposures_are_levelled(sphere, kind):
    views = [photograph(m, gain) for m, gain in zip(ring_of(), GAINS, strict=True)]
    rough = TextureAtlas(painter=SingleView(level=False)).texture(sphere, views)
    level = TextureAtlas(painter=kind(level=True)).texture(sphere, views)
    jump = [seam_jumps(mesh) for mesh in (rough, level)]
    assert np.median(jump[0]) > 8.0
    assert np.median(jump[1]) < 0.3 * np.median(jump[0])


def seam_jumps(mesh):
    """Difference of colour across every side of the mesh whose faces are not of one chart."""
    assert mesh.uv is not None
    assert mesh.texture is not None
    neighbours = face_neighbours(mesh.faces)
    face, side = np.nonzero(neighbours >= 0)
    other = neighbours[face, side]
    textured = ~mesh.untextured[face] & ~mesh.untextured[other]
    face, side, other = face[textured], side[textured], other[textured]
    vertex = mesh.faces[face, side]
    at = np.argmax(mesh.faces[other] == vertex[:, None], axis=1)
    here, there = mesh.uv[face, side], mesh.uv[other, at]
    apart = np.abs(here - there).max(axis=1) > 1e-6
    planes = [mesh.texture[..., k].astype(float) for k in range(3)]
    a, b = (
        np.stack([map_coordinates(plane, p[apart].T[::-1], order=1) for plane in planes], axis=1)
        for p in (here, there)
    )
    return np.abs(a - b).mean(axis=1)


def test_what_is_hidden_or_cut_off_is_not_seen(sphere):
    view = photograph(ring_of()[0])
    quality = face_quality(sphere, [view])[:, 0]
    middle = sphere.vertices[sphere.faces].mean(axis=1)
    centre = -np.linalg.solve(view.P[:, :3], view.P[:, 3])
    towards = (middle * (centre - middle)).sum(1) / np.linalg.norm(centre - middle, axis=1)
    assert quality[towards < -0.25].max() == 0.0
    assert (quality[towards > 0.3] > 0.0).mean() > 0.97
    half = replace(view, seen=np.arange(160)[None, :].repeat(120, axis=0) < 80)
    xy = middle @ view.P[:, :3].T + view.P[:, 3]
    right = xy[:, 0] / xy[:, 2] > 82
    assert face_quality(sphere, [half])[right, 0].max() == 0.0


def test_charts_are_large_and_take_what_sees_them(sphere):
    views = [photograph(m) for m in ring_of()]
    quality = face_quality(sphere, views)
    neighbours = face_neighbours(sphere.faces)
    label = choose_views(quality, neighbours)
    seen = quality.max(axis=1) > 0.0
    np.testing.assert_array_equal(label >= 0, seen)
    assert (quality[seen, label[seen]] > 0.0).all()
    assert np.median(quality[seen, label[seen]] / quality[seen].max(axis=1)) > 0.8
    patchwork = np.where(seen, quality.argmax(axis=1), -1)
    charts, before = (len(np.unique(charts_of(x, neighbours)[seen])) for x in (label, patchwork))
    assert charts < 0.5 * before
    assert charts < 40


def test_rectangles_do_not_overlap():
    sizes = np.random.default_rng(0).integers(0, 40, (200, 2))
    places, (width, height) = pack_rectangles(sizes)
    taken = np.zeros((height, width), dtype=int)
    for (x, y), (w, h) in zip(places, sizes, strict=True):
        taken[y : y + h, x : x + w] += 1
        assert x + w <= width
        assert y + h <= height
    assert taken.max() == 1
    assert width * height < 1.5 * sizes.prod(axis=1).sum()


def test_the_atlas_is_no_larger_than_allowed_and_the_same_for_any_threads(sphere):
    views = [photograph(m) for m in ring_of()]
    one, two = (TextureAtlas(max_texels=20_000).texture(sphere, views, threads=n) for n in (1, 2))
    assert one.texture is not None
    assert two.texture is not None
    assert one.texture.shape[0] * one.texture.shape[1] < 40_000  # with the patches of unseen faces
    np.testing.assert_array_equal(one.texture, two.texture)
    assert np.sqrt(np.mean(difference(one) ** 2)) < 20.0


def test_an_atlas_that_cannot_be_as_small_as_asked_is_refused(sphere):
    views = [photograph(m) for m in ring_of()]
    with pytest.raises(StageFailure, match=r"too large; \d+ pieces take \d+ texels, allowed are 40"):
        TextureAtlas(max_texels=40).texture(sphere, views)
    with pytest.raises(ValueError, match="max_texels >= 1"):
        TextureAtlas(max_texels=0)


@pytest.mark.parametrize("setting", [{"power": -1.0}, {"scatter": 0.0}, {"feather_px": 0.0}])
def test_blending_settings_without_a_meaning_are_refused(setting):
    with pytest.raises(ValueError, match="needed"):
        BlendedViews(**setting)


def test_unseen_faces_take_the_colour_of_their_surroundings(sphere):
    red = [replace(v, rgb=np.full_like(v.rgb, [200, 30, 20])) for v in map(photograph, ring_of()[:3])]
    mesh = TextureAtlas().texture(sphere, red)
    assert mesh.untextured is not None
    assert 0.2 < mesh.untextured.mean() < 0.8
    seen = render(mesh, Camera.from_matrix(looking_at_origin(np.pi, 0.0, 3.5), (160, 120)))
    assert (
        np.abs(seen.color[seen.valid & (seen.color.sum(axis=2) > 230)].astype(int) - [200, 30, 20]).max() <= 2
    )


def test_a_surface_that_nobody_sees_is_refused(sphere):
    away = photograph(ring_of()[0])
    away = replace(away, seen=np.zeros_like(away.seen))
    with pytest.raises(StageFailure, match="no texture"):
        TextureAtlas().texture(sphere, [away])
