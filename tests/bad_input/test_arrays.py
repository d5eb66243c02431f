"""Arrays that cannot be decomposed are rejected with a message that names the function."""

import re

import numpy as np

from thesisrecon.camera import decompose_camera
from thesisrecon.geometry import camera_matrix, strata, three_view, two_view
from thesisrecon.geometry.conditioning import normalizing_transform
from thesisrecon.geometry.polynomial_triangulation import correct_matches
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.geometry.triangulation import resect_linear
from thesisrecon.geometry.two_view import homography_linear

RNG = np.random.default_rng(0)
P, OTHER = RNG.normal(size=(2, 3, 4))
F = two_view.fundamental_from_cameras(P, OTHER)
XY = RNG.uniform(0.0, 100.0, (8, 2))
T = three_view.tensor_from_cameras(P, OTHER, RNG.normal(size=(3, 4)))
CONIC, LINE = np.diag([1.0, 1.0, -1.0]), np.array([1.0, 2.0, 3.0])


def accepted(calls, words):
    """Return the calls (function, argument, ...) that raise no ValueError with these words."""
    found = []
    for function, *arguments in calls:
        try:
            function(*arguments)
        except ValueError as error:
            if re.search(words, str(error)) and not isinstance(error, np.linalg.LinAlgError):
                continue
        found.append((function.__name__, arguments))
    return found


def spoilt(array, value):
    array = np.array(array, dtype=np.float64)
    array.flat[array.size // 2] = value
    return array


def test_numbers_that_are_not_finite_are_rejected():
    for v in (np.nan, np.inf):
        calls = [
            (decompose_camera, spoilt(P, v)),
            (two_view.fundamental_from_cameras, P, spoilt(OTHER, v)), (two_view.epipoles, spoilt(F, v)),
            (two_view.enforce_rank_two, spoilt(F, v)), (homography_linear, spoilt(XY, v), XY),
            (normalizing_transform, spoilt(XY, v)), (two_view.infinite_homography, P, spoilt(OTHER, v)),
            (two_view.plane_homography, P, OTHER, spoilt(np.ones(4), v)),
            (correct_matches, F, spoilt(XY, v), XY),
            (resect_linear, RNG.normal(size=(8, 4)), spoilt(XY, v)),
            (three_view.tensor_from_cameras, P, spoilt(OTHER, v), P),
            (three_view.fundamentals_from_tensor, spoilt(T, v)),
            (three_view.transfer_lines, T, LINE, spoilt(LINE, v)), (strata.dual, spoilt(CONIC, v)),
            (estimate_similarity, spoilt(RNG.normal(size=(5, 3)), v), RNG.normal(size=(5, 3))),
            (strata.transform, spoilt(np.eye(4), v), P, "cameras"),
            (strata.image_of_absolute_conic, spoilt(np.eye(3), v)),
        ]  # fmt: skip
        assert accepted(calls, "needs finite") == []


def test_singular_and_empty_arrays_are_rejected():
    calls = [
        (decompose_camera, np.zeros((3, 4))),
        (camera_matrix.normalize_camera, np.zeros((3, 4))),
        (two_view.fundamental_from_cameras, np.zeros((3, 4)), P),
        (two_view.fundamental_from_cameras, np.ones((3, 4)), P),
        (two_view.plane_homography, np.ones((3, 4)), P, np.ones(4)),
        (two_view.plane_homography, P, OTHER, np.zeros(4)),
        (three_view.tensor_from_cameras, P, np.zeros((3, 4)), P),
        (correct_matches, np.zeros((3, 3)), XY, XY), (strata.transform, np.ones((4, 4)), P, "cameras"),
        (strata.transform, np.zeros((4, 4)), np.eye(4), "conics"),
        (strata.image_of_absolute_conic, np.ones((3, 3))),
        (strata.intersect_line, CONIC, np.zeros(3), LINE), (strata.curvature_sign, np.zeros((4, 4))),
        (two_view.epipoles, np.eye(4)), (two_view.canonical_cameras, np.zeros((2, 3))),
    ]  # fmt: skip
    assert accepted(calls, r"needs .*(invertible|zero|finite camera|\(3, 3\))") == []
