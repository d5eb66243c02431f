"""Mesh operations and kernels of fusion and texture against their plain twins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tests.conftest import refuses
from tests.surface.sphere import ring_of
from thesisrecon.records import TexturedMesh
from thesisrecon.surface._bspline_pieces import Domain, evaluate_pixels, pieces_of, sum_squares
from thesisrecon.surface._mesh import face_areas, halve_surface, simplify_mesh
from thesisrecon.surface.bspline import _basis, _energies
from thesisrecon.surface.fusion import VolumetricFusion


@pytest.fixture(scope="module")
def sphere():
    return VolumetricFusion(tolerance=0.0).fuse(ring_of())


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
    small = simplify_mesh(sphere, most)
    assert 0.6 * most < len(small.faces) <= most
    side = np.sqrt(4 * np.pi / most)
    radius = np.linalg.norm(small.vertices, axis=1)
    # A vertex where its planes meet stands off a sphere by about the square of its cell over eight.
    assert np.sqrt(np.mean((radius - 1.0) ** 2)) < 0.3 * side**2 + 0.003
    middle = small.vertices[small.faces].mean(axis=1)
    outward = (normals(small) * middle).sum(axis=1) / np.linalg.norm(middle, axis=1)
    assert (outward > 0).mean() > 0.99
    assert face_areas(small.vertices, small.faces).sum() == pytest.approx(4 * np.pi, rel=0.08)


def test_no_face_is_degenerate_or_repeated(sphere):
    small = simplify_mesh(sphere, 2_000)
    assert (np.diff(np.sort(small.faces, axis=1), axis=1) > 0).all()
    assert len(np.unique(cycles(small.faces), axis=0)) == len(small.faces)
    assert set(np.unique(small.faces)) == set(range(len(small.vertices)))


def test_a_flat_sheet_stays_flat_and_looks_the_same_way():
    for flip, sign in ((False, 1.0), (True, -1.0)):
        small = simplify_mesh(sheet(40, flip=flip), 300)
        assert 100 < len(small.faces) <= 300
        np.testing.assert_allclose(small.vertices[:, 2], 0.0, atol=1e-12)
        np.testing.assert_allclose(normals(small)[:, 2], sign)


def test_the_two_sides_of_a_thin_wall_stay_apart():
    wall = joined(sheet(40, 0.01), sheet(40, 0.0, flip=True))
    small = simplify_mesh(wall, 400)
    assert sorted(np.unique(small.vertices[:, 2].round(9)).tolist()) == [0.0, 0.01]
    up = normals(small)[:, 2] > 0
    heights = small.vertices[small.faces][..., 2]
    np.testing.assert_allclose(heights[up], 0.01)
    np.testing.assert_allclose(heights[~up], 0.0, atol=1e-12)


def test_a_ridge_stays_sharp():
    roof = sheet(60)
    height = 0.5 - np.abs(roof.vertices[:, 0] - 0.5)
    roof = replace(roof, vertices=np.column_stack([roof.vertices[:, :2], height]))
    small = simplify_mesh(roof, 400)
    off = np.abs(small.vertices[:, 2] - (0.5 - np.abs(small.vertices[:, 0] - 0.5)))
    assert off.max() < 1e-6


def test_small_meshes_are_unchanged_and_colours_are_averaged(sphere):
    assert simplify_mesh(sphere, len(sphere.faces)) is sphere
    high = sphere.vertices[:, 1] > 0
    colors = np.where(high[:, None], (200, 40, 90), (20, 60, 10)).astype(np.uint8)
    uv = np.zeros((len(sphere.faces), 3, 2))
    small = simplify_mesh(replace(sphere, colors=colors, uv=uv), 1_000)
    assert small.uv is None
    assert small.colors is not None
    assert small.colors.shape == small.vertices.shape
    assert (small.colors[small.vertices[:, 1] > 0.2] == (200, 40, 90)).all()
    assert (small.colors[small.vertices[:, 1] < -0.2] == (20, 60, 10)).all()


def test_a_mesh_of_nothing_but_one_place_becomes_empty():
    point = TexturedMesh(np.zeros((9, 3)), np.arange(9).reshape(3, 3))
    assert len(simplify_mesh(point, 2).faces) <= 2
    refuses(ValueError, "max_faces", simplify_mesh, point, 0)


CELL = 4


def labels(count, start, stop):
    graph = coo_array((np.ones(len(start)), (start, stop)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


@pytest.fixture
def domain():
    rng = np.random.default_rng(0)
    covered = rng.random((21, 26)) < 0.85
    right = (rng.random((21, 25)) < 0.7) & covered[:, :-1] & covered[:, 1:]
    down = (rng.random((20, 26)) < 0.7) & covered[:-1] & covered[1:]
    return Domain(covered, covered, (down, right))


@pytest.fixture
def pieces(domain):
    return pieces_of(domain, CELL)


def edges(domain):
    number = np.arange(domain.covered.size).reshape(domain.covered.shape)
    start = np.concatenate([number[:, :-1][domain.joined[1]], number[:-1][domain.joined[0]]])
    stop = np.concatenate([number[:, 1:][domain.joined[1]], number[1:][domain.joined[0]]])
    return start, stop


def test_pieces_are_connected_within_a_cell(domain, pieces):
    y, x = np.indices(domain.covered.shape)
    cell = ((y // CELL) * pieces.shape[1] + x // CELL).ravel()
    start, stop = edges(domain)
    within = cell[start] == cell[stop]
    label = labels(cell.size, start[within], stop[within])
    covered = domain.covered.ravel()
    found = pieces.piece.ravel()
    assert (found[~covered] == -1).all()
    assert (
        len(set(zip(label[covered], found[covered], strict=True)))
        == len(set(label[covered]))
        == len(pieces.cell)
    )
    np.testing.assert_array_equal(pieces.cell[found[covered]], cell[covered])


def test_coefficients_are_shared_within_connected_parts(domain, pieces):
    start, stop = (pieces.piece.ravel()[k] for k in edges(domain))
    row, column = np.divmod(pieces.cell, pieces.shape[1])
    owners = set()
    for a in range(pieces.shape[0] + 3):
        for b in range(pieces.shape[1] + 3):
            near = (row >= a - 3) & (row <= a) & (column >= b - 3) & (column <= b)
            both = near[start] & near[stop]
            label = labels(len(row), start[both], stop[both])[near]
            at = 4 * (a - row[near]) + b - column[near]
            own = pieces.coefficient[near, at]
            assert len(set(zip(label, own, strict=True))) == len(set(label)) == len(set(own))
            assert not owners & set(own.tolist())
            owners |= set(own.tolist())
    assert owners == set(range(pieces.count))


def rows_of(pieces):
    """(pixels, coefficients) weights of the coefficients in each pixel of a piece."""
    y, x = np.nonzero(pieces.piece >= 0)
    tensor = _basis((y % CELL + 0.5) / CELL)[:, :, None] * _basis((x % CELL + 0.5) / CELL)[:, None, :]
    rows = np.zeros((len(y), pieces.count))
    np.add.at(
        rows, (np.arange(len(y))[:, None], pieces.coefficient[pieces.piece[y, x]]), tensor.reshape(-1, 16)
    )
    return rows


def test_values_and_sums_are_those_of_the_rows(pieces):
    rng = np.random.default_rng(1)
    rows, covered = rows_of(pieces), pieces.piece >= 0
    c, target = rng.normal(size=pieces.count), rng.normal(size=covered.shape)
    weight = rng.random(covered.shape) * (rng.random(covered.shape) < 0.9)
    along = _basis((np.arange(CELL) + 0.5) / CELL)
    value = np.empty(covered.shape)
    evaluate_pixels(pieces.piece, pieces.coefficient, c, along, CELL, value)
    np.testing.assert_allclose(value[covered], rows @ c, atol=1e-12)
    assert np.isnan(value[~covered]).all()
    matrix, right = np.zeros((len(pieces.cell), 16, 16)), np.zeros((len(pieces.cell), 16))
    sum_squares(pieces.piece, target, weight, along, CELL, matrix, right)
    full = np.zeros((pieces.count, pieces.count))
    upper = np.triu(np.ones((16, 16)), 1)[None] * matrix
    np.add.at(
        full, (pieces.coefficient[:, :, None], pieces.coefficient[:, None, :]), matrix + upper.swapaxes(1, 2)
    )
    w = weight[covered]
    np.testing.assert_allclose(full, rows.T @ (w[:, None] * rows), atol=1e-12)
    total = np.bincount(pieces.coefficient.ravel(), right.ravel(), pieces.count)
    np.testing.assert_allclose(total, rows.T @ (w * target[covered]), atol=1e-12)


def test_the_basis_is_that_of_cubic_splines():
    u = np.linspace(0.0, 0.999, 7)
    for derivative in (0, 1, 2):
        for k in range(4):
            spline = BSpline.basis_element(np.arange(-3.0, 2.0) + k, extrapolate=False)
            expected = (spline.derivative(derivative) if derivative else spline)(u)
            np.testing.assert_allclose(_basis(u, derivative)[:, k], np.nan_to_num(expected), atol=1e-12)


def test_energies_are_integrals():
    rng = np.random.default_rng(2)
    c = rng.normal(size=16)
    u = (np.arange(200) + 0.5) / 200
    f = {(i, j): _basis(u, i) @ c.reshape(4, 4) @ _basis(u, j).T for i in range(3) for j in range(3)}
    bending, gradient = _energies()
    assert c @ bending @ c == pytest.approx(np.mean(f[2, 0] ** 2 + 2 * f[1, 1] ** 2 + f[0, 2] ** 2), rel=1e-4)
    assert c @ gradient @ c == pytest.approx(np.mean(f[1, 0] ** 2 + f[0, 1] ** 2), rel=1e-4)
    plane = (2.0 + 0.3 * np.arange(4)[:, None] - 0.7 * np.arange(4)).ravel()
    assert abs(plane @ bending @ plane) < 1e-12


def test_the_surface_is_halved_into_compact_parts_of_bounded_size(sphere):
    size = np.random.default_rng(4).integers(0, 9, len(sphere.faces))
    size[7] = 5000  # one face is not cut
    part = halve_surface(sphere, size, 900)
    sums, middle = np.bincount(part, size), sphere.vertices[sphere.faces].mean(axis=1)
    assert (np.sort(sums)[:-1] <= 900).all()
    assert sums[part[7]] >= 5000
    assert len(sums) < 4 * size.sum() / 900
    spread = [np.ptp(middle[part == k], axis=0).max(initial=0.0) for k in range(len(sums))]
    assert np.median(spread) < 0.6 * np.ptp(middle, axis=0).max()
    assert halve_surface(sphere, size, 10**9).max() == 0
    together = replace(sphere, vertices=np.zeros_like(sphere.vertices))
    assert np.bincount(halve_surface(together, np.ones(len(size), int), 100)).max() <= 100
