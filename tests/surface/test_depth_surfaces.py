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
def test_planes_are_exact_everywhere_and_quadrics_are_reproduced(a, b):
    rho = polynomial(0.2, a, b)
    fitted, again = (BSplineSurface().smooth(map_of(rho, 1e-4)).depth for _ in range(2))
    np.testing.assert_allclose(1.0 / fitted, rho, rtol=1e-6)  # depths are float32
    assert fitted.tobytes() == again.tobytes()
    rho = polynomial(0.2, 0.03, -0.02, 0.05, 0.04, -0.06)
    fitted = BSplineSurface().smooth(map_of(rho, 1e-5)).depth
    assert np.abs(1.0 / fitted / rho - 1.0).max() < 1e-4
    refuses(ValueError, "must be", BSplineSurface, knot_px=1)


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
    return (surface.smooth(noisy).depth / clean.depth - 1.0)[inner]


def rms(error):
    return np.sqrt(np.nanmean(error**2))


def sphere_with(noise):
    """The depths of the sphere, exact and with noise."""
    camera = looking_at_origin(0.3, 0.2, 3.5)
    return sphere_map(0, camera), sphere_map(0, camera, noise=noise)


def test_noise_is_averaged_where_the_surface_is_smooth_and_its_size_matters_little():
    clean, noisy = sphere_with(0.01)
    linear, fitted = (errors(s, noisy, clean) for s in (LinearSurface(), BSplineSurface()))
    assert rms(fitted) < rms(linear) / 3.5
    assert abs(fitted.mean()) < 0.05 * rms(linear)
    found = [rms(fitted)]
    for factor in (0.3, 3.0):
        reported = replace(noisy, std=np.float32(factor) * noisy.std)
        found.append(rms(errors(BSplineSurface(), reported, clean)))
    assert max(found) < 1.3 * min(found)


@pytest.mark.parametrize("size", [0.03, 1.0], ids=["near", "gross"])
def test_a_fifth_of_wrong_depths_is_outvoted(size):
    (clean, noisy), rng = sphere_with(0.004), np.random.default_rng(2)
    wrong = rng.random(noisy.depth.shape) < 0.2
    off = np.where(wrong, rng.uniform(-size, size, wrong.shape), 0.0).astype(np.float32)
    spoilt = replace(noisy, depth=noisy.depth + off)
    fitted = errors(BSplineSurface(), spoilt, clean)
    assert rms(fitted) < 2.0 * rms(errors(BSplineSurface(), noisy, clean))
    assert np.isfinite(fitted).mean() > 0.999
    assert rms(errors(LinearSurface(), spoilt, clean)) > 5.0 * rms(fitted)


def noisy_fit(truth, noise):
    """Errors of the fit to inverse depths with noise, and the number of pieces of its surface."""
    rho = truth + noise * np.random.default_rng(0).normal(size=SHAPE)
    fitted = BSplineSurface().smooth(map_of(rho, noise))
    mesh = surface_from_depth(fitted)
    return 1.0 / fitted.depth - truth, len(np.unique(connected_parts(mesh.faces, len(mesh.vertices))))


@pytest.mark.parametrize("slant", [0.0, 0.02])
def test_an_edge_is_not_smeared(slant):
    """Half the picture is nearer: pixels next to the edge are as exact as others."""
    y, x = np.indices(SHAPE)
    near, far = polynomial(0.5, slant, 0.01), polynomial(0.2, -slant, 0.02)
    noise = 5e-4
    error, pieces = noisy_fit(np.where(x < 33 + (y // 7) % 4, near, far), noise)
    assert np.abs(error).max() < 2.5 * noise
    assert rms(error) < noise / 3.0
    assert pieces == 2


def test_a_cut_may_end_within_the_surface_and_small_pieces_join_it():
    """A step that fades out: apart where it is large, one surface where it ends, exact on both sides."""
    y, x = np.indices(SHAPE)
    step = np.clip((45.0 - y) / 45.0, 0.0, 1.0) * 0.1
    noise = 2e-4
    error, pieces = noisy_fit(0.2 + 0.5 * step * np.where(x < 40, 1.0, -1.0), noise)
    near_the_end = (np.abs(y - 42) < 8) & (np.abs(x - 39.5) < 8)
    assert np.abs(error)[~near_the_end].max() < 5.0 * noise
    assert pieces == 1
    rho = np.full(SHAPE, 0.2)
    known = np.zeros(SHAPE, dtype=bool)
    known[:, :60] = True
    known[10:13, 70:73] = True  # alone
    rho[30:33, 30:33] = 0.5  # before the wall
    found = BSplineSurface().smooth(map_of(rho, 1e-4, known=known)).depth
    np.testing.assert_allclose(found[:, :60], 5.0, rtol=1e-4)
    assert np.isnan(found[:, 60:]).all()
