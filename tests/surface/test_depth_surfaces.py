"""Surfaces of single depth maps: linear and fitted, against shapes that are known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_erosion

from tests.conftest import refuses
from tests.surface.sphere import looking_at_origin, sphere_map
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.records import DepthMap
from thesisrecon.surface._mesh import connected_parts, surface_from_depth
from thesisrecon.surface.bspline import BSplineSurface
from thesisrecon.surface.model import LinearSurface

SHAPE = (60, 80)
P = camera_from_centre(
    np.diag([75.0, 75.0, 1.0]) + np.outer([39.5, 29.5, 0.0], [0, 0, 1.0]), np.eye(3), np.zeros(3)
)


def map_of(rho, deviation, *, known=None):
    """Depths of inverse depths with a deviation."""
    depth = np.where(True if known is None else known, 1.0 / rho, np.nan)
    std = (deviation / rho**2).astype(np.float32)
    return DepthMap(0, P, depth.astype(np.float32), std, np.ones(rho.shape, dtype=np.uint8))


def polynomial(*c):
    """Inverse depth (H, W) c0 + c1 u + c2 v + c3 u^2 + c4 u v + c5 v^2 of u, v in long sides."""
    v, u = np.indices(SHAPE) / 80.0 - 0.5
    a = (*c, *(0.0,) * (6 - len(c)))
    return a[0] + a[1] * u + a[2] * v + a[3] * u**2 + a[4] * u * v + a[5] * v**2


@settings(max_examples=6, deadline=None)
@given(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_planes_are_exact_everywhere(a, b):
    rho = polynomial(0.2, a, b)
    fitted = BSplineSurface().smooth(map_of(rho, 1e-4)).depth
    np.testing.assert_allclose(1.0 / fitted, rho, rtol=1e-6)  # depths are float32


def test_quadrics_are_reproduced():
    rho = polynomial(0.2, 0.03, -0.02, 0.05, 0.04, -0.06)
    fitted = BSplineSurface().smooth(map_of(rho, 1e-5)).depth
    assert np.abs(1.0 / fitted / rho - 1.0).max() < 1e-4


def test_nothing_is_reported_beyond_the_depths():
    hole = np.ones(SHAPE, dtype=bool)
    hole[20:40, 30:50] = False
    hole[:, 70:] = False
    found = BSplineSurface().smooth(map_of(polynomial(0.2, 0.05), 1e-4, known=hole)).depth
    np.testing.assert_array_equal(np.isfinite(found), hole)
    nothing = BSplineSurface().smooth(map_of(np.full(SHAPE, 0.2), 1e-4, known=np.zeros(SHAPE, dtype=bool)))
    assert np.isnan(nothing.depth).all()
    assert len(surface_from_depth(nothing).faces) == 0


def errors(surface, noisy, clean):
    """Relative errors of depths off the outline of the sphere, where it slopes away."""
    inner = binary_erosion(np.isfinite(clean.depth), iterations=5)
    return np.asarray(surface.smooth(noisy).depth / clean.depth - 1.0)[inner]


def test_noise_is_averaged_where_the_surface_is_smooth():
    camera = looking_at_origin(0.3, 0.2, 3.5)
    clean, noisy = sphere_map(0, camera), sphere_map(0, camera, noise=0.01)
    linear, fitted = (errors(s, noisy, clean) for s in (LinearSurface(), BSplineSurface()))
    rms = [float(np.sqrt(np.mean(e**2))) for e in (linear, fitted)]
    assert rms[1] < rms[0] / 3.5
    assert abs(fitted.mean()) < 0.05 * rms[0]


def test_wrong_standard_deviations_change_little():
    camera = looking_at_origin(0.3, 0.2, 3.5)
    clean, noisy = sphere_map(0, camera), sphere_map(0, camera, noise=0.01)
    rms = []
    for factor in (0.3, 1.0, 3.0):
        reported = replace(noisy, std=np.float32(factor) * noisy.std)
        rms.append(float(np.sqrt(np.mean(errors(BSplineSurface(), reported, clean) ** 2))))
    assert max(rms) < 1.3 * min(rms)


@pytest.mark.parametrize("size", [0.03, 1.0], ids=["near", "gross"])
def test_a_fifth_of_wrong_depths_is_outvoted(size):
    camera = looking_at_origin(0.3, 0.2, 3.5)
    clean, noisy = sphere_map(0, camera), sphere_map(0, camera, noise=0.004)
    rng = np.random.default_rng(2)
    wrong = rng.random(noisy.depth.shape) < 0.2
    spoilt = noisy.depth + np.where(wrong, rng.uniform(-size, size, wrong.shape), 0.0).astype(np.float32)
    fitted = errors(BSplineSurface(), replace(noisy, depth=spoilt), clean)
    without = errors(BSplineSurface(), noisy, clean)
    assert np.sqrt(np.nanmean(fitted**2)) < 2.0 * np.sqrt(np.mean(without**2))
    assert np.isfinite(fitted).mean() > 0.999
    linear = errors(LinearSurface(), replace(noisy, depth=spoilt), clean)
    assert np.sqrt(np.mean(linear**2)) > 5.0 * np.sqrt(np.nanmean(fitted**2))


@pytest.mark.parametrize("slant", [0.0, 0.02])
def test_an_edge_is_not_smeared(slant):
    """Half the picture is nearer: pixels next to the edge are as exact as others."""
    near, far = polynomial(0.5, slant, 0.01), polynomial(0.2, -slant, 0.02)
    y, x = np.indices(SHAPE)
    front = x < 33 + (y // 7) % 4
    truth = np.where(front, near, far)
    noise = 5e-4
    rho = truth + noise * np.random.default_rng(0).normal(size=SHAPE)
    fitted = BSplineSurface().smooth(map_of(rho, noise))
    error = 1.0 / fitted.depth - truth
    assert np.abs(error).max() < 2.5 * noise
    assert np.sqrt(np.mean(error**2)) < noise / 3.0
    mesh = surface_from_depth(fitted)
    assert len(np.unique(connected_parts(mesh.faces, len(mesh.vertices)))) == 2


def test_a_cut_may_end_within_the_surface():
    """A step that fades out: apart where it is large, one surface where it ends, exact on both sides."""
    y, x = np.indices(SHAPE)
    step = np.clip((45.0 - y) / 45.0, 0.0, 1.0) * 0.1
    truth = 0.2 + 0.5 * step * np.where(x < 40, 1.0, -1.0)
    noise = 2e-4
    rho = truth + noise * np.random.default_rng(0).normal(size=SHAPE)
    fitted = BSplineSurface().smooth(map_of(rho, noise))
    error = np.abs(1.0 / fitted.depth - truth)
    near_the_end = (np.abs(y - 42) < 8) & (np.abs(x - 39.5) < 8)
    assert error[~near_the_end].max() < 5.0 * noise
    mesh = surface_from_depth(fitted)
    assert len(np.unique(connected_parts(mesh.faces, len(mesh.vertices)))) == 1


def test_small_pieces_become_the_surface_about_them_or_nothing():
    rho = np.full(SHAPE, 0.2)
    known = np.zeros(SHAPE, dtype=bool)
    known[:, :60] = True
    known[10:13, 70:73] = True  # alone
    rho[30:33, 30:33] = 0.5  # before the wall
    found = BSplineSurface().smooth(map_of(rho, 1e-4, known=known)).depth
    np.testing.assert_allclose(found[:, :60], 5.0, rtol=1e-4)
    assert np.isnan(found[:, 60:]).all()


def test_the_same_map_gives_the_same_bytes():
    noisy = sphere_map(0, looking_at_origin(0.3, 0.2, 3.5), noise=0.01)
    one, two = (BSplineSurface().smooth(noisy).depth for _ in range(2))
    assert one.tobytes() == two.tobytes()


def test_cells_of_one_pixel_are_refused():
    refuses(ValueError, "must be", BSplineSurface, knot_px=1)
