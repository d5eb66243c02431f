"""Arrays that no decomposition takes are refused by a sentence that names the function."""

import numpy as np
import pytest

from thesisrecon.geometry import strata
from thesisrecon.geometry.camera_matrix import back_project, decompose_camera, normalize_camera
from thesisrecon.geometry.conics import (
    curvature_sign,
    dual,
    image_of_absolute_conic,
    intersect_line,
    plane_at_infinity,
    tangents_from,
)
from thesisrecon.geometry.homogeneous import normalizing_transform
from thesisrecon.geometry.homographies import infinite_homography, plane_homography
from thesisrecon.geometry.optimal_triangulation import correct_matches
from thesisrecon.geometry.resection import resect_linear
from thesisrecon.geometry.similarity import estimate_similarity
from thesisrecon.geometry.three_view import (
    fundamentals_from_tensor,
    tensor_from_cameras,
    transfer_lines,
    transform_tensor,
)
from thesisrecon.geometry.two_view import (
    canonical_cameras,
    enforce_rank_two,
    epipoles,
    estimate_homography,
    fundamental_from_cameras,
)

RNG = np.random.default_rng(0)
P, OTHER = RNG.normal(size=(2, 3, 4))
F = fundamental_from_cameras(P, OTHER)
XY = RNG.uniform(0.0, 100.0, (8, 2))
T = tensor_from_cameras(P, OTHER, RNG.normal(size=(3, 4)))
CONIC, LINE = np.diag([1.0, 1.0, -1.0]), np.array([1.0, 2.0, 3.0])


def spoilt(array, value):
    array = np.array(array, dtype=np.float64)
    array.flat[array.size // 2] = value
    return array


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(
    "call",
    [
        lambda v: decompose_camera(spoilt(P, v)),
        lambda v: back_project(spoilt(P, v), XY),
        lambda v: fundamental_from_cameras(P, spoilt(OTHER, v)),
        lambda v: epipoles(spoilt(F, v)),
        lambda v: enforce_rank_two(spoilt(F, v)),
        lambda v: estimate_homography(spoilt(XY, v), XY),
        lambda v: normalizing_transform(spoilt(XY, v)),
        lambda v: infinite_homography(P, spoilt(OTHER, v)),
        lambda v: plane_homography(P, OTHER, spoilt(np.ones(4), v)),
        lambda v: correct_matches(F, spoilt(XY, v), XY),
        lambda v: resect_linear(RNG.normal(size=(8, 4)), spoilt(XY, v)),
        lambda v: tensor_from_cameras(P, spoilt(OTHER, v), P),
        lambda v: fundamentals_from_tensor(spoilt(T, v)),
        lambda v: transfer_lines(T, LINE, spoilt(LINE, v)),
        lambda v: dual(spoilt(CONIC, v)),
        lambda v: tangents_from(CONIC, spoilt(LINE, v)),
        lambda v: plane_at_infinity(spoilt(np.eye(4), v)),
        lambda v: estimate_similarity(spoilt(RNG.normal(size=(5, 3)), v), RNG.normal(size=(5, 3))),
        lambda v: strata.affine_transform(spoilt(np.eye(3), v), np.zeros(3)),
        lambda v: strata.transform_cameras(spoilt(np.eye(4), v), P),
        lambda v: image_of_absolute_conic(spoilt(np.eye(3), v)),
    ],
)
def test_numbers_that_are_not_finite(call, value):
    with pytest.raises(ValueError, match="needs finite"):
        call(value)


@pytest.mark.parametrize(
    "call",
    [
        lambda: decompose_camera(np.zeros((3, 4))),
        lambda: normalize_camera(np.zeros((3, 4))),
        lambda: back_project(np.ones((3, 4)), XY),
        lambda: fundamental_from_cameras(np.zeros((3, 4)), P),
        lambda: fundamental_from_cameras(np.ones((3, 4)), P),
        lambda: plane_homography(np.ones((3, 4)), P, np.ones(4)),
        lambda: plane_homography(P, OTHER, np.zeros(4)),
        lambda: tensor_from_cameras(P, np.zeros((3, 4)), P),
        lambda: correct_matches(np.zeros((3, 3)), XY, XY),
        lambda: transform_tensor(T, np.ones((3, 3)), np.eye(3), np.eye(3)),
        lambda: strata.transform_cameras(np.ones((4, 4)), P),
        lambda: strata.transform_planes(np.zeros((4, 4)), np.ones(4)),
        lambda: strata.transform_conics(np.zeros((4, 4)), np.eye(4)),
        lambda: image_of_absolute_conic(np.ones((3, 3))),
        lambda: intersect_line(CONIC, np.zeros(3), LINE),
        lambda: curvature_sign(np.zeros((4, 4))),
        lambda: epipoles(np.eye(4)),
        lambda: canonical_cameras(np.zeros((2, 3))),
    ],
)
def test_singular_and_empty_arrays(call):
    with pytest.raises(ValueError, match=r"needs .*(invertible|zero|finite camera|\(3, 3\))") as refusal:
        call()
    assert not isinstance(refusal.value, np.linalg.LinAlgError)
