"""Section 3.6.3: the trifocal tensor of cameras, its constraints, transfers and linear estimate."""

import numpy as np
import pytest

from tests.geometry.properties import gap, holds_for_every, random_camera
from thesisrecon.geometry import three_view
from thesisrecon.geometry.camera_matrix import camera_centre, project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, unit_normals
from thesisrecon.geometry.strata import transform
from thesisrecon.geometry.two_view import symmetric_residuals
from validation.scenes.rigs import random_transform


def three_cameras(rng):
    return np.stack([random_camera(rng)[0] for _ in range(3)])


def seen_points(P, rng, n):
    X = rng.uniform(-1.5, 1.5, (n, 3))
    return np.stack([project(camera, X) for camera in P])


def seen_segments(P, rng, m):
    """Pieces of lines of space, other pieces in every view."""
    A, B = rng.uniform(-1.5, 1.5, (2, m, 3))
    share = rng.uniform((-0.2, 0.7), (0.3, 1.2), (3, m, 2))[..., None]
    ends = A[:, None] + share * (B - A)[:, None]
    return np.stack(
        [project(camera, e.reshape(-1, 3)).reshape(m, 2, 2) for camera, e in zip(P, ends, strict=True)]
    )


def lines_of(segments):
    return unit_normals(np.cross(homogenize(segments[..., 0, :]), homogenize(segments[..., 1, :])))


@holds_for_every()
def test_tensor_of_cameras_in_any_frame_of_one_centre_and_of_canonical_ones(rng):
    P = three_cameras(rng)
    G = random_transform("projective", rng)
    scales = rng.uniform(0.5, 2.0, 3) * rng.choice([-1.0, 1.0], 3)
    moved = scales[:, None, None] * transform(G, P, "cameras")
    assert gap(three_view.tensor_from_cameras(*moved), three_view.tensor_from_cameras(*P)) < 1e-6
    centre = rng.normal(size=3)
    P = rng.normal(size=(3, 3, 3)) @ np.column_stack([np.eye(3), -centre])
    assert not three_view.tensor_from_cameras(*P).any()
    P[2] = rng.normal(size=(3, 3)) @ np.column_stack([np.eye(3), -centre - 1e-6])
    assert np.linalg.norm(three_view.tensor_from_cameras(*P)) == pytest.approx(1.0)
    P2, P3 = rng.normal(size=(2, 3, 4))
    T = np.einsum("ji,k->ijk", P2[:, :3], P3[:, 3]) - np.einsum("j,ki->ijk", P2[:, 3], P3[:, :3])
    np.testing.assert_allclose(
        three_view.tensor_from_cameras(np.eye(3, 4), P2, P3), T / np.linalg.norm(T), atol=1e-12
    )


@holds_for_every()
def test_trifocal_constraints_of_points_and_lines(rng):
    P = three_cameras(rng)
    T = three_view.tensor_from_cameras(*P)
    x = np.einsum("vab,nb->vna", P, homogenize(rng.uniform(-1.5, 1.5, (6, 3))))
    l = lines_of(seen_segments(P, rng, 6))
    x, l = (a / np.linalg.norm(a, axis=-1, keepdims=True) for a in (x, l))
    # Two lines through each point span all others: four independent equations; two points span a line.
    on_first, l2, l3 = (np.linalg.svd(a[:, None])[2][:, 1:] for a in (l[0], x[1], x[2]))
    for first, second, third in (
        (x[0][:, None, None], l2[:, :, None], l3[:, None]),
        (on_first, l[1][:, None], l[2][:, None]),
    ):
        right, wrong = (
            np.abs(np.einsum("...i,...j,...k,ijk->...", first, second, lines, T)).max()
            for lines in (third, np.roll(third, 1, axis=0))
        )
        assert right < 1e-9
        assert wrong > 1e3 * right


@holds_for_every()
def test_figures_3_14_and_3_15_points_and_lines_are_transferred_to_the_third_view(rng):
    P = three_cameras(rng)
    xy = seen_points(P, rng, 12)
    T = three_view.tensor_from_cameras(*P)
    assert np.abs(three_view.transfer_points(T, xy[0], xy[1]) - xy[2]).max() < 1e-3
    P = three_cameras(rng)
    l = lines_of(seen_segments(P, rng, 6))
    found = unit_normals(three_view.transfer_lines(three_view.tensor_from_cameras(*P), l[0], l[1]))
    assert max(gap(a, b) for a, b in zip(found, l[2], strict=True)) < 1e-5


@holds_for_every()
def test_figure_3_14_the_tensor_serves_the_trifocal_plane(rng):
    P = three_cameras(rng)
    X = rng.dirichlet(np.ones(3), 8) @ dehomogenize(np.stack([camera_centre(camera) for camera in P]))
    xy = np.stack([project(camera, X) for camera in P])
    found = three_view.transfer_points(three_view.tensor_from_cameras(*P), xy[0], xy[1])
    assert np.median(np.abs(found - xy[2]).max(axis=1) / np.abs(xy).max(axis=(0, 2))) < 1e-6


@holds_for_every()
def test_epipoles_and_fundamental_matrices_from_the_tensor(rng):
    P = three_cameras(rng)
    T, xy = three_view.tensor_from_cameras(*P), seen_points(P, rng, 10)
    centre = camera_centre(P[0])
    e2, e3 = three_view.tensor_epipoles(T)
    assert gap(e2, P[1] @ centre) < 1e-6
    assert gap(e3, P[2] @ centre) < 1e-6
    F21, F31 = three_view.fundamentals_from_tensor(T)
    assert symmetric_residuals(F21, xy[0], xy[1]).max() < 1e-3
    assert symmetric_residuals(F31, xy[0], xy[2]).max() < 1e-3


@pytest.mark.parametrize("t2", [(0.3, 1.0, 0.4), (0.0, 1.0, 0.0), (-2.0, 0.0, 0.0)])
@pytest.mark.parametrize("K", [np.eye(3), np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])])
def test_views_that_are_rectified_to_the_first_have_their_epipoles_and_cameras(K, t2):
    P = K @ np.stack([np.column_stack([np.eye(3), t]) for t in (np.zeros(3), t2, (1.0, 0.0, 0.0))])
    X = np.random.default_rng(0).uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 6.0], (10, 3))
    for second, third in ((1, 2), (2, 1)):
        order = [0, second, third]
        T, xy = three_view.tensor_from_cameras(*P[order]), np.stack([project(P[k], X) for k in order])
        for found, k in zip(three_view.tensor_epipoles(T), order[1:], strict=True):
            assert gap(found, P[k][:, 3]) < 1e-12
        assert gap(three_view.tensor_from_cameras(*three_view.cameras_from_tensor(T)), T) < 1e-10
        np.testing.assert_allclose(three_view.transfer_points(T, xy[0], xy[1]), xy[2], atol=1e-8)
