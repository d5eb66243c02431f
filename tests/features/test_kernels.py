import numpy as np
import pytest
from scipy.ndimage import convolve1d, correlate1d, gaussian_filter, maximum_filter

from tests.synthetic import texture
from thesisrecon.features import harris as kernels
from thesisrecon.features import multiscale
from thesisrecon.imaging.filters import gaussian_taps


def moments_twin(channels, derivative, taps):
    """(3, H, W): M11, M12, M22 by convolutions, summed over the channels."""
    total = np.zeros((3, *channels.shape[1:]))
    for channel in channels.astype(np.float64):
        gx, gy = (correlate1d(channel, derivative, axis=axis) for axis in (1, 0))
        for m, product in enumerate((gx * gx, gx * gy, gy * gy)):
            total[m] += convolve1d(convolve1d(product, taps, axis=0), taps, axis=1)
    return total


@pytest.mark.parametrize("trace_weight", [0.0, 0.04])
@pytest.mark.parametrize("derivative", [(-0.5, 0.0, 0.5), (0.1, -0.8, 0.0, 0.8, -0.1)])
@pytest.mark.parametrize("count", [1, 3])
def test_corner_response_equals_its_numpy_twin(trace_weight, derivative, count):
    channels = np.stack([texture(60, 83, seed).astype(np.float32) for seed in range(count)])
    taps, along = gaussian_taps(1.5), np.array(derivative, np.float32)
    found = kernels.corner_response(channels, along, taps, trace_weight)
    a, m, c = moments_twin(channels, along, taps)
    noble = (a * c - m * m) / (a + c + 1e-6)
    twin = a * c - m * m - trace_weight * (a + c) ** 2 if trace_weight else noble
    border = len(taps) // 2 + len(along) // 2
    inside = (slice(border, -border), slice(border, -border))
    assert np.abs(found[inside] - twin[inside]).max() < 1e-4 * np.abs(twin).max()
    assert not found[:border].any()
    assert not found[:, -border:].any()


def test_maxima_are_the_local_maxima_and_their_surfaces_have_their_top_there():
    # Without clipping at 255 no two neighbours are equal, so that every maximum is one.
    response = (
        gaussian_filter(np.random.default_rng(2).normal(size=(50, 70)), 1.5).astype(np.float32) * 500 + 130
    )
    xy, value = kernels.fit_maxima(response, 130.0)
    top = (maximum_filter(response, 3) == response) & (response > 130.0)
    top[0] = top[-1] = top[:, 0] = top[:, -1] = False
    assert len(xy) == top.sum()
    assert np.abs(xy[:, ::-1] - np.argwhere(top)).max() <= 1.0
    assert np.array_equal(value, response[top])
    b, a = np.mgrid[-1:2, -1:2]
    design = np.stack([a * a, a * b, b * b, a, b, np.ones((3, 3))], -1).reshape(9, 6)
    for (x, y), (row, column) in zip(xy, np.argwhere(top), strict=True):
        around = response[row - 1 : row + 2, column - 1 : column + 2].ravel()
        q = np.linalg.lstsq(design, around, rcond=None)[0]
        step = -np.linalg.solve([[2 * q[0], q[1]], [q[1], 2 * q[2]]], q[3:5])
        inside = q[0] < 0 and 4 * q[0] * q[2] > q[1] ** 2 and np.abs(step).max() <= 1.0
        assert np.abs(step * inside - (x - column, y - row)).max() < 1e-3


def test_suppression_radii_equal_their_numpy_twin():
    rng = np.random.default_rng(4)
    xy = rng.uniform(0, 500, (300, 2)).astype(np.float32)
    response = np.sort(rng.exponential(size=300).astype(np.float32))[::-1].copy()
    distance2 = ((xy[:, None] - xy[None]) ** 2).sum(-1)
    stronger = np.float32(0.9) * response[None] > response[:, None]
    twin = np.where(stronger, distance2, np.inf).min(axis=1)
    assert np.allclose(kernels.squared_suppression_radii(xy, response, 0.9), twin, rtol=1e-5)


def test_patches_are_turned_and_clamped_at_the_border():
    row, column = np.mgrid[:80, :90].astype(np.float32)
    image, xy = 2.0 * column + row, np.array([[40.3, 35.7], [3.0, 4.0]])
    b, a = np.mgrid[:8, :8] - 3.5
    for angle in (0.0, 0.7):
        c, s = 4.0 * np.cos(angle), 4.0 * np.sin(angle)
        found = multiscale.sample_patches(image, xy, np.full(2, angle, np.float32), 8, 4.0).reshape(2, 8, 8)
        for patch, (x, y) in zip(found, xy, strict=True):
            u, v = np.clip(x + c * a - s * b, 0, 89), np.clip(y + s * a + c * b, 0, 79)
            assert np.abs(patch - (2.0 * u + v)).max() < 1e-2
    assert multiscale.sample_patches(image, xy[:0], np.zeros(0, np.float32), 8, 4.0).shape == (0, 64)


def test_selected_corners_are_apart_and_none_is_dropped_without_reason():
    xy = np.random.default_rng(6).uniform(0, 100, (400, 2))
    kept = kernels.enforce_spacing(xy, np.arange(400), 6.0)
    distance = np.linalg.norm(xy[:, None] - xy[kept][None], axis=2)
    assert (np.sort(distance[kept], axis=1)[:, 1] >= 6.0).all()
    for dropped in np.setdiff1d(np.arange(400), kept):
        assert (distance[dropped, kept < dropped] < 6.0).any()
