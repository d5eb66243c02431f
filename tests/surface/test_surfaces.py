"""Surfaces of depth maps, one by one, fused and simplified, against shapes that are known."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from tests.conftest import refuses
from tests.constants import with_constants
from tests.surface.sphere import SHAPE, K, fused_sphere, looking_at_origin, ring_of, sphere_map
from thesisrecon.camera import Camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.imaging.raster import rasterize
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface import _mesh, _simplification, fusion
from thesisrecon.surface._simplification import reduce_faces, simplify_surface
from thesisrecon.surface.bspline import BSplineSurface, _basis, _energies
from thesisrecon.surface.fusion import DepthSheets, VolumetricFusion, _incidence_cosines
from thesisrecon.surface.model import LinearSurface, SurfaceModel


@pytest.fixture(scope="module")
def ring():
    return ring_of()


def outward(mesh):
    """Cosine between each face's normal and the direction from the origin."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    middle = (a + b + c) / 3.0
    return (normal * middle).sum(1) / np.linalg.norm(normal, axis=1) / np.linalg.norm(middle, axis=1)


def test_the_fused_sphere_is_round_closed_and_outward_and_averages_noise(ring):
    mesh = fused_sphere()
    footprint = 2.5 / 150.0
    off = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1.0)
    assert np.quantile(off, 0.995) < footprint
    assert off.max() < 4.0 * footprint  # where it is seen along the surface only
    assert np.median(off) < 0.1 * footprint
    assert np.quantile(outward(mesh), 0.002) > 0.3
    assert np.median(outward(mesh)) > 0.99
    seen = np.abs(mesh.vertices[:, 1]) < 0.8
    assert seen.mean() > 0.5
    # In the zone that all views cover no face lacks a neighbour across any of its sides.
    sides = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(sides[seen[sides].all(axis=1)], axis=0, return_counts=True)
    assert (count == 2).mean() > 0.999
    assert _mesh.face_areas(mesh.vertices, mesh.faces).sum() == pytest.approx(4 * np.pi, rel=0.05)
    mesh = VolumetricFusion().fuse([sphere_map(m.view, m.P, noise=0.01) for m in ring])
    error = np.linalg.norm(mesh.vertices, axis=1) - 1.0
    assert np.sqrt(np.mean(error**2)) < 0.5 * 0.01
    assert abs(np.mean(error)) < 0.2 * 0.01


def test_a_surface_is_the_same_slab_by_slab_and_needs_the_memory_of_its_faces(ring, monkeypatch):
    whole = VolumetricFusion(voxel_px=0.6, tolerance=0.0).fuse(ring)
    monkeypatch.setattr(fusion, "SLAB_BLOCKS", 256)
    monkeypatch.setattr(fusion, "TASK_BLOCKS", 60)
    slabs = VolumetricFusion(voxel_px=0.6, tolerance=0.0).fuse(ring)
    np.testing.assert_array_equal(slabs.vertices, whole.vertices)
    np.testing.assert_array_equal(slabs.faces, whole.faces)
    tracemalloc.start()
    try:
        VolumetricFusion(voxel_px=0.6).fuse(ring, threads=2)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # It is 129 bytes a face, and 172 with all voxels in memory.
    assert peak < 140 * len(whole.faces)


def test_memory_is_kept_by_larger_voxels_and_hopeless_maps_are_refused(ring):
    fine = VolumetricFusion().fuse(ring[:2])
    coarse = with_constants(VolumetricFusion, max_blocks=150)().fuse(ring[:2])
    assert 0 < len(coarse.faces) < 0.5 * len(fine.faces)
    # They stop growing with as few blocks as there may be.
    refuses(StageFailure, "no surface", with_constants(VolumetricFusion, max_blocks=8)().fuse, ring[:1])
    empty = replace(ring[0], depth=np.full(SHAPE, np.nan, np.float32))
    vague = replace(ring[0], std=np.full(SHAPE, 10.0, np.float32))
    for kind, maps in (
        (DepthSheets, []), (DepthSheets, [empty]), (DepthSheets, [empty, empty]),
        (VolumetricFusion, [empty]), (VolumetricFusion, [vague]),
    ):  # fmt: skip
        refuses(StageFailure, "no surface", kind().fuse, maps)
    refuses(ValueError, "must be", DepthSheets, step=0)
    for setting in ({"voxel_px": 0.0}, {"voxel_px": np.nan}, {"tolerance": -0.1}):
        refuses(ValueError, "must be", VolumetricFusion, **setting)


def test_seen_through_points_are_removed(ring):
    """A wrong blob in one view, in empty space that the others see the sphere through."""
    depth = ring[0].depth.copy()
    depth[50:60, 70:80] -= 0.3
    spoiled, beside = replace(ring[0], depth=depth), sphere_map(8, looking_at_origin(0.25, 1.5, 3.5))
    alone, together = (
        (np.linalg.norm(VolumetricFusion().fuse(maps).vertices, axis=1) > 1.1).mean()
        for maps in ([spoiled], [spoiled, beside])
    )
    assert alone > 0.01
    assert together < 1e-3


def test_the_surface_of_one_map_passes_its_points_and_keeps_edges_and_holes_without_crumbs():
    P = looking_at_origin(0.3, 0.0, 3.5)
    given = sphere_map(0, P)
    behind = np.where(np.isnan(given.depth), np.float32(6.0), given.depth)
    mesh = _mesh.surface_from_depth(replace(given, depth=behind))
    x, y = np.rint(project(P, mesh.vertices)).astype(int).T
    np.testing.assert_allclose(mesh.vertices @ P[2, :3] + P[2, 3], behind[y, x], rtol=1e-6)
    on_sphere = (np.linalg.norm(mesh.vertices, axis=1) < 1.01)[mesh.faces]
    assert (on_sphere.any(axis=1) == on_sphere.all(axis=1)).all()
    # Seen by the camera every face is anticlockwise: its normal looks back.
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    centre = -np.linalg.solve(P[:, :3], P[:, 3])
    assert ((np.cross(b - a, c - a) * (centre - a)).sum(1) > 0).all()
    assert len(np.unique(_mesh.connected_parts(mesh.faces, len(mesh.vertices)))) == 2
    given = sphere_map(0, looking_at_origin(0.0, 0.0, 3.5))
    full, coarse = _mesh.surface_from_depth(given), _mesh.surface_from_depth(given, step=3)
    assert len(coarse.faces) == pytest.approx(len(full.faces) / 9, rel=0.15)
    depth = given.depth.copy()
    depth[55:65, 75:85] = np.nan
    holed = _mesh.surface_from_depth(replace(given, depth=depth))
    assert len(full.faces) - len(holed.faces) == 2 * 11 * 11 - 4  # the corners keep a half
    grid = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    vertices, colors = np.concatenate([grid, 0.01 * grid + 5.0]), np.arange(24, dtype=np.uint8).reshape(8, 3)
    faces = np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]])
    mesh = _mesh.remove_small_parts(TexturedMesh(vertices, faces, colors=colors))
    assert len(mesh.vertices) == 4
    np.testing.assert_array_equal(mesh.faces, faces[:2])
    np.testing.assert_array_equal(mesh.colors, colors[:4])
    empty = TexturedMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert _mesh.remove_small_parts(empty) is empty


def test_sheets_show_each_place_once(ring):
    mesh = DepthSheets(step=1).fuse(ring)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - 1.0).max() < 1e-3
    assert (outward(mesh) > 0.0).all()
    # The sphere but for its outline in each view, with some overlap and no more.
    assert 0.9 * 4 * np.pi < _mesh.face_areas(mesh.vertices, mesh.faces).sum() < 1.25 * 4 * np.pi
    one, two = (DepthSheets(step=3).fuse(ring, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one.vertices, two.vertices)
    assert len(one.faces) == pytest.approx(len(mesh.faces) / 9, rel=0.25)


def test_the_model_uses_fitted_surfaces_on_request():
    noisy = [sphere_map(m.view, m.P, noise=0.01) for m in ring_of()[:3]]
    linear, fitted = (
        SurfaceModel(surface=surface, fusion=DepthSheets()).surface_of(noisy).vertices
        for surface in (LinearSurface(), BSplineSurface())
    )
    off, less = (np.median(np.abs(np.linalg.norm(X, axis=1) - 1.0)) for X in (linear, fitted))
    assert less < off / 2.5


def slanted(degrees):
    """A plane that rays in the middle of the picture meet at this angle."""
    y = np.indices(SHAPE)[0]
    rise = (y - K[1, 2]) / K[1, 1]
    depth = (np.tan(np.radians(degrees)) / (np.tan(np.radians(degrees)) + rise)).astype(np.float32)
    depth[(depth <= 0.2) | (depth > 3.0)] = np.nan
    std = np.full(SHAPE, 1e-4, np.float32)
    return DepthMap(0, np.column_stack([K, np.zeros(3)]), depth, std, np.ones(SHAPE, np.uint8))


@pytest.mark.parametrize("degrees", [90.0, 40.0, 15.0])
def test_how_far_rays_come_off_a_plane(degrees):
    depth = slanted(degrees).depth if degrees < 90.0 else np.ones(SHAPE, np.float32)
    found = _incidence_cosines(depth, K)
    normal = np.array([0.0, np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    rays = np.stack([*np.indices(SHAPE)[::-1], np.ones(SHAPE)], axis=-1) @ np.linalg.inv(K).T
    inner = np.isfinite(depth)
    inner[[0, 1, -2, -1]] = False
    inner &= np.roll(inner, 2, axis=0) & np.roll(inner, -2, axis=0)
    np.testing.assert_allclose(found[inner], (rays @ normal)[inner], rtol=2e-3)


def test_ground_seen_at_a_slant_has_no_holes():
    ground = slanted(8.0)
    mesh = VolumetricFusion().fuse([ground])
    camera = Camera.from_matrix(ground.P, (SHAPE[1], SHAPE[0]))
    seen = rasterize(mesh.vertices, mesh.faces, camera).depth
    inner = binary_erosion(np.isfinite(ground.depth) & (ground.depth < 1.5), np.ones((3, 3)), iterations=2)
    inner[-10:] = False  # the nearest row of voxels has no neighbours
    assert inner.sum() > 3000
    assert np.isfinite(seen[inner]).mean() > 0.99
    assert np.median(np.abs(seen / ground.depth - 1.0)[inner]) < 0.004


def test_holes_of_a_sheet_are_closed_by_another():
    first, second = (sphere_map(k, looking_at_origin(0.2 * k, 0.3, 3.5)) for k in (0, 1))
    depth = first.depth.copy()
    depth[60, 80] = np.nan  # four squares of the sheet, one pixel of the map
    depth[40:43, 70:73] = np.nan
    part = np.where(np.arange(SHAPE[1]) < 50, np.float32(np.nan), second.depth)  # fewer: it comes later
    mesh = DepthSheets(step=2).fuse([replace(first, depth=depth), replace(second, depth=part)])
    seen = mesh.vertices[mesh.faces].mean(axis=1) @ first.P[:, :3].T + first.P[:, 3]
    x, y = (seen[:, :2] / seen[:, 2:]).T
    near = seen[:, 2] < 3.5  # not the far side of the sphere
    for row, column in ((60, 80), (41, 71)):
        assert ((np.abs(x - column) < 1.0) & (np.abs(y - row) < 1.0) & near).any()


def test_the_basis_is_that_of_cubic_splines_and_energies_are_integrals():
    u = np.linspace(0.0, 0.999, 7)
    for derivative in (0, 1, 2):
        for k in range(4):
            spline = BSpline.basis_element(np.arange(-3.0, 2.0) + k, extrapolate=False)
            expected = (spline.derivative(derivative) if derivative else spline)(u)
            np.testing.assert_allclose(_basis(u, derivative)[:, k], np.nan_to_num(expected), atol=1e-12)
    rng = np.random.default_rng(2)
    c = rng.normal(size=16)
    u = (np.arange(200) + 0.5) / 200
    f = {(i, j): _basis(u, i) @ c.reshape(4, 4) @ _basis(u, j).T for i in range(3) for j in range(3)}
    bending, gradient = _energies()
    assert c @ bending @ c == pytest.approx(np.mean(f[2, 0] ** 2 + 2 * f[1, 1] ** 2 + f[0, 2] ** 2), rel=1e-4)
    assert c @ gradient @ c == pytest.approx(np.mean(f[1, 0] ** 2 + f[0, 1] ** 2), rel=1e-4)
    plane = (2.0 + 0.3 * np.arange(4)[:, None] - 0.7 * np.arange(4)).ravel()
    assert abs(plane @ bending @ plane) < 1e-12


def test_the_surface_is_halved_into_compact_parts_of_bounded_size():
    sphere = fused_sphere()
    size = np.random.default_rng(4).integers(0, 9, len(sphere.faces))
    size[7] = 5000  # one face is not cut
    part = _mesh.halve_surface(sphere, size, 900)
    sums, middle = np.bincount(part, size), sphere.vertices[sphere.faces].mean(axis=1)
    assert (np.sort(sums)[:-1] <= 900).all()
    assert sums[part[7]] >= 5000
    assert len(sums) < 4 * size.sum() / 900
    spread = [np.ptp(middle[part == k], axis=0).max(initial=0.0) for k in range(len(sums))]
    assert np.median(spread) < 0.6 * np.ptp(middle, axis=0).max()
    assert _mesh.halve_surface(sphere, size, 10**9).max() == 0
    together = replace(sphere, vertices=np.zeros_like(sphere.vertices))
    assert np.bincount(_mesh.halve_surface(together, np.ones(len(size), int), 100)).max() <= 100


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
    area = _mesh.face_areas(mesh.vertices, mesh.faces)
    corners = mesh.vertices[mesh.faces[rng.choice(len(area), count, p=area / area.sum())]]
    return (corners * rng.dirichlet([1, 1, 1], count)[:, :, None]).sum(axis=1)


def test_a_plane_keeps_its_outline_and_few_faces():
    plane = grid(lambda x, y: 0.3 * x + 0.2 * y)
    small = simplified(plane, 1e-4)
    assert len(small.faces) < 0.05 * len(plane.faces)
    area, before = (_mesh.face_areas(mesh.vertices, mesh.faces).sum() for mesh in (small, plane))
    assert area == pytest.approx(before, abs=4e-4)
    np.testing.assert_allclose(small.vertices @ [0.3, 0.2, -1.0], 0.0, atol=1e-6)
    corners = np.array([[0, 0, 0], [1, 0, 0.3], [0, 1, 0.2], [1, 1, 0.5]])
    assert cKDTree(small.vertices).query(corners)[0].max() < 1e-3
    ends = small.vertices[small.faces]
    assert np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).max() < 0.3 + 1e-9


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


def test_density_follows_curvature_and_faces_lie_on_both_sides():
    roof = grid(lambda x, y: 0.2 * np.abs(x - 0.5) + 0.0 * y)
    small = simplified(roof, 1e-4)
    ridge = np.abs(small.vertices[:, 0] - 0.5) < 0.02
    assert np.abs(small.vertices[ridge, 2]).max() < 1e-3
    noise = grid(lambda x, y: 0.002 * np.random.default_rng(0).normal(size=(x + y).shape))
    limits = np.where(noise.vertices[:, 0] < 0.5, 1e-4, 0.01)
    uneven = simplify_surface(noise, limits, longest=0.3)
    left = uneven.vertices[:, 0] < 0.5
    assert left.sum() > 5 * (~left).sum()
    bowl = grid(lambda x, y: x**2 + y**2, 80)
    small = simplified(bowl, 2e-3)
    x, y, z = points_on(small).T
    inner = (np.abs(x - 0.5) < 0.45) & (np.abs(y - 0.5) < 0.45)
    above = (z - x**2 - y**2)[inner]
    assert len(small.faces) < 0.05 * len(bowl.faces)
    assert abs(above.mean()) < 0.1 * np.sqrt(np.mean(above**2))


def thin_wall(thickness, steps=60):
    """Two unit squares whose outsides look away from each other."""
    front, back = (grid(lambda x, y, z=z: 0.0 * x * y + z, steps) for z in (0.0, thickness))
    faces = np.concatenate([front.faces[:, ::-1], back.faces + len(front.vertices)])
    return TexturedMesh(np.concatenate([front.vertices, back.vertices]), faces)


def test_thin_walls_keep_both_sides_and_merged_faces_are_distinct():
    small = simplified(thin_wall(0.02), 1e-3)
    # The eight sides recede by less than half the limit.
    assert _mesh.face_areas(small.vertices, small.faces).sum() == pytest.approx(2.0, abs=8 * 0.5e-3)
    assert set(np.round(small.vertices[:, 2] / 0.02, 2)) == {0.0, 1.0}
    small = reduce_faces(thin_wall(0.01, 40), 400)
    assert 8 <= len(small.faces) <= 400
    assert (np.diff(np.sort(small.faces, axis=1), axis=1) > 0).all()
    assert set(np.unique(small.faces)) == set(range(len(small.vertices)))
    a, b, c = (small.vertices[small.faces[:, k]] for k in range(3))
    up = np.cross(b - a, c - a)[:, 2] > 0
    np.testing.assert_allclose(a[up, 2], 0.01, rtol=1e-6)
    np.testing.assert_allclose(a[~up, 2], 0.0, atol=1e-9)
    point = TexturedMesh(np.zeros((9, 3)), np.arange(9).reshape(3, 3))
    assert len(reduce_faces(point, 2).faces) <= 2


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


def test_closed_surfaces_keep_their_volume_and_noise_costs_no_faces():
    ball, rng = fused_sphere(), np.random.default_rng(1)
    shaken = replace(ball, vertices=ball.vertices + 1e-3 * rng.normal(size=ball.vertices.shape))
    small = simplified(shaken, 5e-3)
    assert len(small.faces) < 0.1 * len(ball.faces)
    before, after = (np.linalg.det(mesh.vertices[mesh.faces]).sum() for mesh in (ball, small))
    assert after == pytest.approx(before, rel=5e-3)
    before, after = ((sides(mesh.faces)[1] == 1).sum() for mesh in (ball, small))
    assert after <= before
    noisy = [sphere_map(m.view, m.P, noise=0.01) for m in ring_of()]
    fine, small = (VolumetricFusion(tolerance=t).fuse(noisy) for t in (0.0, 0.25))
    assert len(small.faces) < 0.4 * len(fine.faces)
    before, after = (np.abs(np.linalg.norm(points_on(mesh), axis=1) - 1.0) for mesh in (fine, small))
    assert np.median(after) < 1.05 * np.median(before)
    assert np.quantile(after, 0.99) < 1.1 * np.quantile(before, 0.99)


@pytest.mark.parametrize("most", [3_000, 1_000])
def test_a_number_of_faces_goes_to_the_details(most):
    def height(x, y):
        return 0.01 * np.sin(40 * x) * np.cos(40 * y) * (x + y < 0.7)

    relief = grid(height, 90)
    off = []
    for mesh in (reduce_faces(relief, most), grid(height, int(np.sqrt(most / 2)))):
        x, y, z = points_on(mesh).T
        off.append(np.sqrt(np.mean((z - height(x, y)) ** 2)))
        assert len(mesh.faces) <= most
    assert off[0] < off[1]
    assert reduce_faces(relief, len(relief.faces)) is relief
