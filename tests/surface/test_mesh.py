"""Upkeep of meshes: fewer triangles for the same surface."""

from dataclasses import replace

import numpy as np
import pytest

from tests.surface.sphere import ring_of
from thesisrecon.records import TexturedMesh
from thesisrecon.surface.fusion import VolumetricFusion
from thesisrecon.surface.mesh import coarser, face_areas


@pytest.fixture(scope="module")
def sphere():
    return VolumetricFusion().fuse(ring_of())


def sheet(steps, height=0.0, *, flip=False):
    """The unit square at a height in 2 steps^2 triangles that look up, or down if flipped."""
    x, y = np.meshgrid(np.linspace(0, 1, steps + 1), np.linspace(0, 1, steps + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    n = (np.arange(steps)[:, None] * (steps + 1) + np.arange(steps)).ravel()
    up = np.stack([n, n + 1, n + steps + 2], axis=1), np.stack([n, n + steps + 2, n + steps + 1], axis=1)
    faces = np.concatenate(up)
    return TexturedMesh(vertices, faces[:, ::-1] if flip else faces)


def joined(*meshes):
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    return TexturedMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def normals(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def cycles(faces):
    """Faces with their smallest corner first, in order."""
    turned = np.stack([np.roll(face, -int(np.argmin(face))) for face in faces])
    return turned[np.lexsort(turned.T)]


@pytest.mark.parametrize("most", [12_000, 3_000, 500])
def test_a_coarser_sphere_is_still_the_sphere(sphere, most):
    assert len(sphere.faces) > 12_000
    small = coarser(sphere, most)
    assert 0.6 * most < len(small.faces) <= most
    side = np.sqrt(4 * np.pi / most)
    radius = np.linalg.norm(small.vertices, axis=1)
    # A vertex where its planes meet stands off a sphere by about the square of its cell over eight.
    assert np.sqrt(np.mean((radius - 1.0) ** 2)) < 0.3 * side**2 + 0.003
    middle = small.vertices[small.faces].mean(axis=1)
    outward = (normals(small) * middle).sum(axis=1) / np.linalg.norm(middle, axis=1)
    assert (outward > 0).mean() > 0.99
    assert face_areas(small.vertices, small.faces).sum() == pytest.approx(4 * np.pi, rel=0.08)


def test_no_face_is_degenerate_or_told_twice(sphere):
    small = coarser(sphere, 2_000)
    assert (np.diff(np.sort(small.faces, axis=1), axis=1) > 0).all()
    assert len(np.unique(cycles(small.faces), axis=0)) == len(small.faces)
    assert set(np.unique(small.faces)) == set(range(len(small.vertices)))


def test_a_flat_sheet_stays_flat_and_looks_the_same_way():
    for flip, sign in ((False, 1.0), (True, -1.0)):
        small = coarser(sheet(40, flip=flip), 300)
        assert 100 < len(small.faces) <= 300
        np.testing.assert_allclose(small.vertices[:, 2], 0.0, atol=1e-12)
        np.testing.assert_allclose(normals(small)[:, 2], sign)


def test_the_two_sides_of_a_thin_wall_stay_apart():
    wall = joined(sheet(40, 0.01), sheet(40, 0.0, flip=True))
    small = coarser(wall, 400)
    assert sorted(np.unique(small.vertices[:, 2].round(9)).tolist()) == [0.0, 0.01]
    up = normals(small)[:, 2] > 0
    heights = small.vertices[small.faces][..., 2]
    np.testing.assert_allclose(heights[up], 0.01)
    np.testing.assert_allclose(heights[~up], 0.0, atol=1e-12)


def test_a_ridge_stays_sharp():
    roof = sheet(60)
    height = 0.5 - np.abs(roof.vertices[:, 0] - 0.5)
    roof = replace(roof, vertices=np.column_stack([roof.vertices[:, :2], height]))
    small = coarser(roof, 400)
    off = np.abs(small.vertices[:, 2] - (0.5 - np.abs(small.vertices[:, 0] - 0.5)))
    assert off.max() < 1e-6


def test_what_is_small_enough_is_left_alone_and_colours_are_averaged(sphere):
    assert coarser(sphere, len(sphere.faces)) is sphere
    high = sphere.vertices[:, 1] > 0
    colors = np.where(high[:, None], (200, 40, 90), (20, 60, 10)).astype(np.uint8)
    uv = np.zeros((len(sphere.faces), 3, 2))
    small = coarser(replace(sphere, colors=colors, uv=uv), 1_000)
    assert small.uv is None
    assert small.colors is not None
    assert small.colors.shape == small.vertices.shape
    assert (small.colors[small.vertices[:, 1] > 0.2] == (200, 40, 90)).all()
    assert (small.colors[small.vertices[:, 1] < -0.2] == (20, 60, 10)).all()


def test_the_same_mesh_gives_the_same_bytes(sphere):
    one, two = coarser(sphere, 800), coarser(sphere, 800)
    assert one.vertices.tobytes() == two.vertices.tobytes()
    assert one.faces.tobytes() == two.faces.tobytes()


def test_a_mesh_of_nothing_but_one_place_becomes_empty():
    point = TexturedMesh(np.zeros((9, 3)), np.arange(9).reshape(3, 3))
    assert len(coarser(point, 2).faces) <= 2
    with pytest.raises(ValueError, match="max_faces"):
        coarser(point, 0)
