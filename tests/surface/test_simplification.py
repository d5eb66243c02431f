"""Simplified meshes stay near the faces they replace."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.surface.sphere import ring_of, sphere_map
from thesisrecon.records import TexturedMesh
from thesisrecon.surface import _simplification
from thesisrecon.surface._mesh import face_areas
from thesisrecon.surface._simplification import _merge_in_cells, reduce_faces, simplify_surface
from thesisrecon.surface.fusion import VolumetricFusion


def grid(height, steps=60):
    """The unit square in 2 steps^2 triangles at z = height(x, y), anticlockwise from above."""
    x, y = np.meshgrid(np.linspace(0, 1, steps + 1), np.linspace(0, 1, steps + 1))
    vertices = np.stack([x.ravel(), y.ravel(), height(x, y).ravel()], axis=1)
    n = (np.arange(steps)[:, None] * (steps + 1) + np.arange(steps)).ravel()
    up = np.stack([n, n + 1, n + steps + 2], axis=1), np.stack([n, n + steps + 2, n + steps + 1], axis=1)
    return TexturedMesh(vertices, np.concatenate(up))


def simplified(mesh, limit, *, longest=0.3, threads=1):
    limits = np.full(len(mesh.vertices), limit)
    return simplify_surface(mesh, limits, longest=longest, threads=threads)


def sides(faces):
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(ends, axis=0, return_counts=True)


def points_on(mesh, count=20_000):
    """Random points of a mesh."""
    rng = np.random.default_rng(0)
    area = face_areas(mesh.vertices, mesh.faces)
    corners = mesh.vertices[mesh.faces[rng.choice(len(area), count, p=area / area.sum())]]
    return (corners * rng.dirichlet([1, 1, 1], count)[:, :, None]).sum(axis=1)


def test_a_plane_keeps_its_outline_and_few_faces():
    plane = grid(lambda x, y: 0.3 * x + 0.2 * y)
    small = simplified(plane, 1e-4)
    assert len(small.faces) < 0.05 * len(plane.faces)
    assert face_areas(small.vertices, small.faces).sum() == pytest.approx(
        face_areas(plane.vertices, plane.faces).sum(), abs=4e-4
    )
    np.testing.assert_allclose(small.vertices @ [0.3, 0.2, -1.0], 0.0, atol=1e-6)
    corners = np.array([[0, 0, 0], [1, 0, 0.3], [0, 1, 0.2], [1, 1, 0.5]])
    assert cKDTree(small.vertices).query(corners)[0].max() < 1e-3
    ends = small.vertices[small.faces]
    lengths = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2)
    assert lengths.max() < 0.3 + 1e-9


@pytest.mark.parametrize("limit", [5e-4, 2e-3, 5e-3])
def test_waves_are_left_by_no_more_than_the_limit(limit):
    def height(x, y):
        return 0.05 * np.sin(9 * x) * np.cos(7 * y)

    waves = grid(height)
    small = simplified(waves, limit)
    assert len(small.faces) < 0.7 * len(waves.faces)
    x, y, z = points_on(small).T
    off = z - height(x, y)
    assert np.sqrt(np.mean(off**2)) < 1.2 * limit
    assert np.abs(off).max() < 6.0 * limit
    _, count = sides(small.faces)
    assert count.max() == 2


def test_density_follows_curvature_and_limit():
    roof = grid(lambda x, y: 0.2 * np.abs(x - 0.5) + 0.0 * y)
    small = simplified(roof, 1e-4)
    ridge = np.abs(small.vertices[:, 0] - 0.5) < 0.02
    assert np.abs(small.vertices[ridge, 2]).max() < 1e-3
    noise = grid(lambda x, y: 0.002 * np.random.default_rng(0).normal(size=(x + y).shape))
    limits = np.where(noise.vertices[:, 0] < 0.5, 1e-4, 0.01)
    uneven = simplify_surface(noise, limits, longest=0.3)
    left = uneven.vertices[:, 0] < 0.5
    assert left.sum() > 5 * (~left).sum()


def test_faces_lie_on_both_sides_of_a_curved_surface():
    bowl = grid(lambda x, y: x**2 + y**2, 80)
    small = simplified(bowl, 2e-3)
    x, y, z = points_on(small).T
    inner = (np.abs(x - 0.5) < 0.45) & (np.abs(y - 0.5) < 0.45)
    above = (z - x**2 - y**2)[inner]
    assert len(small.faces) < 0.05 * len(bowl.faces)
    assert abs(above.mean()) < 0.1 * np.sqrt(np.mean(above**2))


def test_thin_walls_keep_both_sides():
    front, back = (grid(lambda x, y, z=z: 0.0 * x * y + z) for z in (0.0, 0.02))
    faces = np.concatenate([front.faces[:, ::-1], back.faces + len(front.vertices)])
    wall = TexturedMesh(np.concatenate([front.vertices, back.vertices]), faces)
    small = simplified(wall, 1e-3)
    # The eight sides recede by less than half the limit.
    assert face_areas(small.vertices, small.faces).sum() == pytest.approx(2.0, abs=8 * 0.5e-3)
    assert set(np.round(small.vertices[:, 2] / 0.02, 2)) == {0.0, 1.0}


def test_blocks_and_threads_leave_no_seams(monkeypatch):
    monkeypatch.setattr(_simplification, "BLOCK_FACES", 900)
    waves = grid(lambda x, y: 0.05 * np.sin(9 * x) * np.cos(7 * y))
    one, two = (simplified(waves, 1e-3, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one.vertices, two.vertices)
    np.testing.assert_array_equal(one.faces, two.faces)
    ends, count = sides(one.faces)
    assert count.max() == 2
    x, y, _ = np.moveaxis(one.vertices[ends[count == 1]], -1, 0)
    assert ((x < 1e-2) | (x > 0.99) | (y < 1e-2) | (y > 0.99)).all()
    assert len(one.faces) < 2 * len(simplified(waves, 1e-3).faces)


def test_a_closed_surface_stays_closed_and_keeps_its_volume():
    rng = np.random.default_rng(1)
    ball = VolumetricFusion(tolerance=0.0).fuse(ring_of())
    shaken = replace(ball, vertices=ball.vertices + 1e-3 * rng.normal(size=ball.vertices.shape))
    small = simplified(shaken, 5e-3)
    assert len(small.faces) < 0.1 * len(ball.faces)

    def volume(mesh):
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        return (np.cross(a, b) * c).sum() / 6.0

    assert volume(small) == pytest.approx(volume(ball), rel=5e-3)
    before, after = ((sides(mesh.faces)[1] == 1).sum() for mesh in (ball, small))
    assert after <= before


def test_fused_noise_costs_no_faces_and_the_error_stays_below_it():
    noisy = [sphere_map(m.view, m.P, noise=0.01) for m in ring_of()]
    fine, small = (VolumetricFusion(tolerance=t).fuse(noisy) for t in (0.0, 0.25))
    assert len(small.faces) < 0.4 * len(fine.faces)
    errors = [np.abs(np.linalg.norm(points_on(mesh), axis=1) - 1.0) for mesh in (fine, small)]
    assert np.median(errors[1]) < 1.05 * np.median(errors[0])
    assert np.quantile(errors[1], 0.99) < 1.1 * np.quantile(errors[0], 0.99)


@pytest.mark.parametrize("most", [3_000, 1_000])
def test_a_number_of_faces_goes_to_the_details(most):
    def height(x, y):
        return 0.01 * np.sin(40 * x) * np.cos(40 * y) * (x + y < 0.7)

    relief = grid(height, 90)
    off = []
    for mesh in (reduce_faces(relief, most), _merge_in_cells(relief, most)):
        x, y, z = points_on(mesh).T
        off.append(np.sqrt(np.mean((z - height(x, y)) ** 2)))
        assert len(mesh.faces) <= most
    assert off[0] < off[1]
    assert reduce_faces(relief, len(relief.faces)) is relief


def test_merged_faces_are_distinct_and_both_sides_of_a_thin_wall_stay():
    front, back = (grid(lambda x, y, z=z: 0.0 * x * y + z, 40) for z in (0.0, 0.01))
    faces = np.concatenate([front.faces[:, ::-1], back.faces + len(front.vertices)])
    wall = TexturedMesh(np.concatenate([front.vertices, back.vertices]), faces)
    small = _merge_in_cells(wall, 400)
    assert 100 < len(small.faces) <= 400
    assert (np.diff(np.sort(small.faces, axis=1), axis=1) > 0).all()
    assert set(np.unique(small.faces)) == set(range(len(small.vertices)))
    a, b, c = (small.vertices[small.faces[:, k]] for k in range(3))
    up = np.cross(b - a, c - a)[:, 2] > 0
    np.testing.assert_allclose(a[up, 2], 0.01)
    np.testing.assert_allclose(a[~up, 2], 0.0, atol=1e-12)
    point = TexturedMesh(np.zeros((9, 3)), np.arange(9).reshape(3, 3))
    assert len(reduce_faces(point, 2).faces) <= 2
