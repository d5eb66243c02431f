"""A model made of a photograph and its true depth, rendered from where the photograph was taken, is the
photograph."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.surface.sphere import looking_at_origin, paint, photograph, points_of, sphere_map
from thesisrecon.camera import Camera
from thesisrecon.surface.linear import surface_from_depth
from thesisrecon.surface.texture_atlas import TextureAtlas
from thesisrecon.surface.texture_views import color_vertices
from thesisrecon.views.render import render

SIZE = (160, 120)


def textured(depth_map):
    """The surface of a depth map with each pixel's place in the photograph as its place in the texture."""
    mesh = surface_from_depth(depth_map)
    xyz = np.column_stack([mesh.vertices, np.ones(len(mesh.vertices))]) @ depth_map.P.T
    return replace(mesh, uv=(xyz[:, :2] / xyz[:, 2:])[mesh.faces], texture=photograph(depth_map).rgb)


@settings(max_examples=15, deadline=None)
@given(angle=st.floats(-3.1, 3.1), height=st.floats(-2.0, 2.0), distance=st.floats(2.8, 5.0))
def test_from_its_own_camera_the_surface_shows_the_photograph_and_its_depth(angle, height, distance):
    depth_map = sphere_map(0, looking_at_origin(angle, height, distance))
    seen = render(textured(depth_map), Camera.from_matrix(depth_map.P, SIZE), samples=1)
    known = np.isfinite(depth_map.depth)
    assert not (seen.valid & ~known).any()
    assert (seen.valid & known).sum() > 0.9 * known.sum()  # but a rim of grazing rays
    np.testing.assert_allclose(seen.depth[seen.valid], depth_map.depth[seen.valid], rtol=1e-4)
    apart = np.abs(seen.color.astype(int) - photograph(depth_map).rgb)[seen.valid]
    assert apart.max() <= 1


def test_averaged_pixels_are_those_of_the_photograph_but_for_its_finest_detail():
    depth_map = sphere_map(0, looking_at_origin(0.3, -1.0, 3.5))
    seen = render(textured(depth_map), Camera.from_matrix(depth_map.P, SIZE), samples=2)
    inside = np.isfinite(depth_map.depth)
    for _ in range(3):
        inside[1:-1, 1:-1] &= inside[:-2, 1:-1] & inside[2:, 1:-1] & inside[1:-1, :-2] & inside[1:-1, 2:]
    apart = np.abs(seen.color.astype(int) - photograph(depth_map).rgb)[inside]
    assert np.mean(apart) < 1.0


@pytest.mark.parametrize("kind", ["texture", "vertex colours"])
def test_from_between_two_photographs_the_model_has_the_colours_of_the_scene(kind):
    maps = [sphere_map(k, looking_at_origin(a, -1.0, 3.5)) for k, a in enumerate((-0.2, 0.2))]
    views = [photograph(m) for m in maps]
    mesh = surface_from_depth(maps[0])
    mesh = TextureAtlas().texture(mesh, views) if kind == "texture" else color_vertices(mesh, views)
    between = sphere_map(2, looking_at_origin(0.0, -0.9, 3.5))
    seen = render(mesh, Camera.from_matrix(between.P, SIZE))
    inside = seen.valid & np.isfinite(between.depth)
    assert inside.mean() > 0.15
    apart = np.abs(seen.color - paint(points_of(between)))[inside]
    assert np.median(apart) < 2.5
    assert np.mean(apart) < 6.0
