"""The study of interpolated views: exact cameras, and targets reached on real images."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.synthetic import texture
from thesisrecon.geometry.camera_matrix import camera_from_centre, project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.records import DisparityMap
from thesisrecon.stereo._epipolar_pair import pair_of_cameras
from thesisrecon.stereo._planar import minimum_distortion
from thesisrecon.views.interpolation import InterpolatedPair, original_from_rectified
from validation.studies.interpolation import (
    best_homography,
    camera_between,
    camera_centre_of,
    nearest_place,
    turned,
)

SIZE = (160, 120)


@pytest.fixture(scope="module")
def pair():
    """Two turned cameras, rectified; their photographs do not matter."""
    rng = np.random.default_rng(0)
    K = np.array([[150.0, 0.0, 82.0], [0.0, 150.0, 57.0], [0.0, 0.0, 1.0]])
    centres = np.array([[-0.5, 0.1, 0.0], [0.5, 0.0, 0.1]])
    turns = [Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix() for _ in range(2)]
    first, second = (camera_from_centre(K, R, C) for R, C in zip(turns, centres, strict=True))
    frame = minimum_distortion(pair_of_cameras(first, second, SIZE, SIZE))
    image, nothing = (
        np.zeros((SIZE[1], SIZE[0], 3), np.uint8),
        DisparityMap(np.zeros((9, 9), np.float32), np.ones((9, 9), np.float32), 0.0),
    )
    return InterpolatedPair((image, image), frame.H, nothing, nothing), (first, second), centres


def test_points_are_seen_where_the_camera_between_sees_them(pair):
    X = np.random.default_rng(1).uniform([-2, -2, 4], [2, 2, 9], (100, 3))
    found, P, centres = pair
    for s in (0.0, 0.2, 0.5, 1.0):
        ends = (dehomogenize(homogenize(project(p, X)) @ H.T) for p, H in zip(P, found.H, strict=True))
        between = sum(weight * x for weight, x in zip((1.0 - s, s), ends, strict=True))
        G = original_from_rectified(found.H, SIZE, s)
        expected = dehomogenize(homogenize(between) @ G.T)
        np.testing.assert_allclose(project(camera_between(found, P, s), X), expected, atol=1e-7)
        C = camera_centre_of(found, P, s)
        along = (C - centres[0]) @ (centres[1] - centres[0]) / np.sum((centres[1] - centres[0]) ** 2)
        assert 0.0 <= along <= 1.0 or abs(along - round(along)) < 1e-9
        np.testing.assert_allclose(C, centres[0] + along * (centres[1] - centres[0]), atol=1e-9)
    assert nearest_place(found, P, centres[1]) == 1.0
    assert nearest_place(found, P, camera_centre_of(found, P, 0.37)) == pytest.approx(0.37)


def test_pictures_are_turned_as_their_points_are():
    rng = np.random.default_rng(2)
    H = np.array([[1.02, 0.01, 3.0], [-0.02, 0.99, -2.0], [1e-5, 2e-5, 1.0]])
    xy = rng.uniform(0, 100, (80, 2))
    xh = np.column_stack([xy, np.ones(80)]) @ H.T
    there = xh[:, :2] / xh[:, 2:]
    there[:5] += 30.0
    found = best_homography(xy, there)
    np.testing.assert_allclose(found / found[2, 2], H, atol=1e-6)
    picture = np.repeat(texture(120, 160)[:, :, None], 3, axis=2).astype(np.uint8)
    back, kept = turned(turned(picture, H)[0], np.linalg.inv(H))
    inner = kept.copy()
    inner[:10], inner[-10:], inner[:, :10], inner[:, -10:] = False, False, False, False
    assert inner.mean() > 0.5
    assert np.abs(back.astype(float) - picture)[inner].mean() < 4.0
