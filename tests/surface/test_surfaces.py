"""Surfaces of depth maps, one by one and fused, against shapes that are known."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from tests.conftest import refuses
from tests.constants import with_constants
from tests.surface.sphere import SHAPE, K, looking_at_origin, ring_of, sphere_map
from thesisrecon.camera import Camera
from thesisrecon.errors import StageFailure
from thesisrecon.imaging.raster import rasterize
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface import fusion
from thesisrecon.surface._mesh import connected_parts, face_areas, remove_small_parts, surface_from_depth
from thesisrecon.surface.bspline import BSplineSurface
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


def test_the_fused_sphere_is_round_closed_and_outward(ring):
    mesh = VolumetricFusion(tolerance=0.0).fuse(ring)
    footprint = 2.5 / 150.0
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.quantile(np.abs(radius - 1.0), 0.995) < footprint
    assert np.abs(radius - 1.0).max() < 4.0 * footprint  # where it is seen along the surface only
    assert np.median(np.abs(radius - 1.0)) < 0.1 * footprint
    assert np.quantile(outward(mesh), 0.002) > 0.3
    assert np.median(outward(mesh)) > 0.99
    seen = np.abs(mesh.vertices[:, 1]) < 0.8
    assert seen.mean() > 0.5
    # In the zone that all views cover no face lacks a neighbour across any of its sides.
    sides = np.sort(
        np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1
    )
    inner = sides[seen[sides].all(axis=1)]
    _, count = np.unique(inner, axis=0, return_counts=True)
    assert (count == 2).mean() > 0.999
    assert face_areas(mesh.vertices, mesh.faces).sum() == pytest.approx(4 * np.pi, rel=0.05)


def test_fusion_averages_noise(ring):
    noise = 0.01
    noisy = [sphere_map(m.view, m.P, noise=noise) for m in ring]
    mesh = VolumetricFusion().fuse(noisy)
    error = np.linalg.norm(mesh.vertices, axis=1) - 1.0
    assert np.sqrt(np.mean(error**2)) < 0.5 * noise
    assert abs(np.mean(error)) < 0.2 * noise


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


def test_memory_is_kept_by_larger_voxels(ring):
    fine = VolumetricFusion().fuse(ring[:2])
    coarse = with_constants(VolumetricFusion, max_blocks=150)().fuse(ring[:2])
    assert 0 < len(coarse.faces) < 0.5 * len(fine.faces)


@pytest.mark.parametrize("setting", [{"voxel_px": 0.0}, {"voxel_px": np.nan}, {"tolerance": -0.1}])
def test_settings_under_which_voxels_would_grow_for_ever_are_refused(setting):
    refuses(ValueError, "must be", VolumetricFusion, **setting)


def test_voxels_stop_growing_with_as_few_blocks_as_there_may_be(ring):
    refuses(StageFailure, "no surface", with_constants(VolumetricFusion, max_blocks=8)().fuse, ring[:1])


def test_seen_through_points_are_removed(ring):
    """A wrong blob in one view, in empty space that the others see the sphere through."""
    depth = ring[0].depth.copy()
    depth[50:60, 70:80] -= 0.3
    spoiled = DepthMap(0, ring[0].P, depth, ring[0].std, ring[0].views)
    alone, beside = VolumetricFusion(), sphere_map(8, looking_at_origin(0.25, 1.5, 3.5))
    assert (np.linalg.norm(alone.fuse([spoiled]).vertices, axis=1) > 1.1).mean() > 0.01
    mesh = alone.fuse([spoiled, beside])
    assert (np.linalg.norm(mesh.vertices, axis=1) > 1.1).mean() < 1e-3


def test_hopeless_maps_are_refused(ring):
    empty = DepthMap(0, ring[0].P, np.full(SHAPE, np.nan, np.float32), ring[0].std, ring[0].views)
    for maps in ([], [empty], [empty, empty]):
        refuses(StageFailure, "no surface", DepthSheets().fuse, maps)
    refuses(StageFailure, "no surface", VolumetricFusion().fuse, [empty])
    refuses(ValueError, "must be", DepthSheets, step=0)
    vague = DepthMap(0, ring[0].P, ring[0].depth, np.full(SHAPE, 10.0, np.float32), ring[0].views)
    refuses(StageFailure, "no surface", VolumetricFusion().fuse, [vague])


def test_the_surface_of_one_map_passes_its_points_and_breaks_at_edges():
    P = looking_at_origin(0.3, 0.0, 3.5)
    given = sphere_map(0, P)
    behind = np.where(np.isnan(given.depth), np.float32(6.0), given.depth)
    mesh = surface_from_depth(DepthMap(0, P, behind, given.std, given.views))
    xyz = mesh.vertices @ P[:, :3].T + P[:, 3]
    x, y = np.rint(xyz[:, 0] / xyz[:, 2]).astype(int), np.rint(xyz[:, 1] / xyz[:, 2]).astype(int)
    np.testing.assert_allclose(xyz[:, 2], behind[y, x], rtol=1e-6)
    on_sphere = np.linalg.norm(mesh.vertices, axis=1) < 1.01
    mixed = on_sphere[mesh.faces].any(axis=1) & ~on_sphere[mesh.faces].all(axis=1)
    assert not mixed.any()
    # Seen by the camera every face is anticlockwise: its normal looks back.
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    centre = -np.linalg.solve(P[:, :3], P[:, 3])
    assert ((np.cross(b - a, c - a) * (centre - a)).sum(1) > 0).all()
    part = connected_parts(mesh.faces, len(mesh.vertices))
    assert len(np.unique(part)) == 2


def test_holes_stay_holes_and_steps_thin_out():
    P = looking_at_origin(0.0, 0.0, 3.5)
    given = sphere_map(0, P)
    full, coarse = surface_from_depth(given), surface_from_depth(given, step=3)
    assert len(coarse.faces) == pytest.approx(len(full.faces) / 9, rel=0.15)
    depth = given.depth.copy()
    depth[55:65, 75:85] = np.nan
    holed = surface_from_depth(DepthMap(0, P, depth, given.std, given.views))
    assert len(full.faces) - len(holed.faces) == 2 * 11 * 11 - 4  # the corners keep a half


def test_crumbs_are_dropped():
    grid = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    vertices = np.concatenate([grid, 0.01 * grid + 5.0])
    faces = np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]])
    mesh = remove_small_parts(
        TexturedMesh(vertices, faces, colors=np.arange(24, dtype=np.uint8).reshape(8, 3))
    )
    assert len(mesh.vertices) == 4
    np.testing.assert_array_equal(mesh.faces, faces[:2])
    assert mesh.colors is not None
    np.testing.assert_array_equal(mesh.colors, np.arange(12).reshape(4, 3))
    empty = TexturedMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert remove_small_parts(empty) is empty


def test_sheets_show_each_place_once(ring):
    mesh = DepthSheets(step=1).fuse(ring)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - 1.0).max() < 1e-3
    assert (outward(mesh) > 0.0).all()
    # The sphere but for its outline in each view, with some overlap and no more.
    assert 0.9 * 4 * np.pi < face_areas(mesh.vertices, mesh.faces).sum() < 1.25 * 4 * np.pi
    one, two = (DepthSheets(step=3).fuse(ring, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one.vertices, two.vertices)
    assert len(one.faces) == pytest.approx(len(mesh.faces) / 9, rel=0.25)


def test_the_model_uses_fitted_surfaces_on_request():
    noise = 0.01
    noisy = [sphere_map(m.view, m.P, noise=noise) for m in ring_of()[:3]]
    off = []
    for surface in (LinearSurface(), BSplineSurface()):
        mesh = SurfaceModel(surface=surface, fusion=DepthSheets()).surface_of(noisy)
        off.append(np.median(np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1.0)))
    assert off[1] < off[0] / 2.5


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
