"""Impossible matches and arrays: every function returns finite numbers or raises a named error."""

import re
from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from tests.epipolar.pairs import make_pair, spoil
from thesisrecon.api.pairs import estimate_fundamental
from thesisrecon.camera import decompose_camera
from thesisrecon.epipolar.ransac import ThesisRansac, estimate_eight_point, estimate_seven_point
from thesisrecon.epipolar.refinement import refine_fundamental
from thesisrecon.epipolar.verification import classify_configuration
from thesisrecon.errors import StageFailure
from thesisrecon.geometry import camera_matrix, strata, three_view, two_view
from thesisrecon.geometry.homogeneous import normalizing_transform
from thesisrecon.geometry.polynomial_triangulation import correct_matches
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.geometry.triangulation import resect_linear
from thesisrecon.geometry.two_view import homography_linear
from validation.metrics.fundamental_precision import epipolar_distance_interval, epipoles_of

PAIR = make_pair(60, np.random.default_rng(0))
GOOD1, GOOD2, _ = spoil(PAIR, np.random.default_rng(1), sigma=0.4, outliers=0.0)
T = np.linspace(0.0, 1.0, 60)[:, None]
LINE = 500.0 * T * [1.0, 0.7] + 5.0
NOISE = np.random.default_rng(2).normal(size=(60, 2))
EVEN = np.random.default_rng(3).uniform(0.0, 1000.0, (2, 60, 2))

HOSTILE = {
    "empty": (GOOD1[:0], GOOD2[:0]), "six": (GOOD1[:6], GOOD2[:6]), "seven": (GOOD1[:7], GOOD2[:7]),
    "eight": (GOOD1[:8], GOOD2[:8]), "nine exact": (PAIR.xy1[:9], PAIR.xy2[:9]),
    "exact": (PAIR.xy1, PAIR.xy2), "equal": (np.full((60, 2), 3.3), np.full((60, 2), 7.7)),
    "equal in one image": (GOOD1, np.full((60, 2), 1e8 + 0.1)),
    "all but two equal": (np.r_[np.ones((58, 2)), GOOD1[:2]], np.r_[np.ones((58, 2)), GOOD2[:2]]),
    "collinear": (LINE, 2.0 * LINE[:, ::-1]), "nearly collinear": (LINE + 1e-6 * NOISE, GOOD2),
    "all but one collinear": (np.r_[LINE[:-1], GOOD1[:1]], GOOD2),
    "four places": (np.tile(GOOD1[:4], (15, 1)), np.tile(GOOD2[:4], (15, 1))),
    "eight places": (np.tile(GOOD1[:8], (8, 1)), np.tile(GOOD2[:8], (8, 1))), "wrong": (EVEN[0], EVEN[1]),
    "same image": (GOOD1, GOOD1), "shifted": (GOOD1.round(), GOOD1.round() + 5.0),
    "one to many": (np.tile(GOOD1[:1], (60, 1)), GOOD2), "huge": (1e8 * GOOD1, 1e8 * GOOD2),
    "tiny": (1e-8 * GOOD1, 1e-8 * GOOD2), "vanishing": (1e-150 * GOOD1, 1e-150 * GOOD2),
    "subnormal": (5e-324 * GOOD1, 5e-324 * GOOD2), "far from the origin": (GOOD1 + 1e10, GOOD2 + 1e10),
    "far from each other": (GOOD1 + 1e5, GOOD2), "farther from each other": (GOOD1 + 1e8, GOOD2),
    "of two sizes": (1e-8 * GOOD1, GOOD2),
    "one wild match": (np.r_[GOOD1, [[1e12, 5.0]]], np.r_[GOOD2, [[5.0, 1e12]]]),
}  # fmt: skip


def rng():
    return np.random.default_rng(0)


def default_with_all_it_says(xy1, xy2):
    fit = estimate_fundamental(xy1, xy2)
    e1, e2 = epipoles_of(fit)
    interval = epipolar_distance_interval(fit, xy1, xy2)
    return fit, fit.degeneracy, interval, e1.direction, e2.direction, e1.covariance


FUNCTIONS = {
    "default": default_with_all_it_says,
    "thesis": lambda a, b: ThesisRansac(samples=30).estimate(a, b, rng()),
    "eight-point": estimate_eight_point,
    "seven-point": lambda a, b: estimate_seven_point(a[:7], b[:7]),
    "gradient": lambda a, b: refine_fundamental(PAIR.F, a, b),
    "epipolar distance": lambda a, b: refine_fundamental(PAIR.F, a, b, "epipolar-distance"),
    "reprojection": lambda a, b: refine_fundamental(PAIR.F, a, b, "reprojection"),
    "configuration": lambda a, b: classify_configuration(PAIR.F, a, b),
}


def holds_nan(answer):
    """NaN anywhere in an answer."""
    if is_dataclass(answer):
        return any(holds_nan(getattr(answer, f.name)) for f in fields(answer))
    if isinstance(answer, tuple):
        return any(map(holds_nan, answer))
    return isinstance(answer, float | np.ndarray) and bool(np.isnan(answer).any())


def answer_or_refusal(function, xy1, xy2):
    try:
        return function(xy1, xy2), None
    except (StageFailure, ValueError) as refusal:
        return None, refusal


@pytest.mark.parametrize("name", FUNCTIONS)
def test_hostile_matches_give_numbers_or_a_named_failure(name):
    """LinAlgError is a ValueError, too, and warnings are errors here."""
    for kind, (xy1, xy2) in HOSTILE.items():
        answer, refusal = answer_or_refusal(FUNCTIONS[name], xy1, xy2)
        assert not isinstance(refusal, np.linalg.LinAlgError), kind
        assert refusal is None or len(str(refusal)) > 20, kind
        assert not holds_nan(answer), kind


RNG = np.random.default_rng(0)
P, OTHER = RNG.normal(size=(2, 3, 4))
F = two_view.fundamental_from_cameras(P, OTHER)
XY = RNG.uniform(0.0, 100.0, (8, 2))
TENSOR = three_view.tensor_from_cameras(P, OTHER, RNG.normal(size=(3, 4)))
CONIC, LINE3 = np.diag([1.0, 1.0, -1.0]), np.array([1.0, 2.0, 3.0])


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
            (three_view.fundamentals_from_tensor, spoilt(TENSOR, v)),
            (three_view.transfer_lines, TENSOR, LINE3, spoilt(LINE3, v)), (strata.dual, spoilt(CONIC, v)),
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
        (strata.intersect_line, CONIC, np.zeros(3), LINE3),
        (two_view.epipoles, np.eye(4)), (two_view.canonical_cameras, np.zeros((2, 3))),
    ]  # fmt: skip
    assert accepted(calls, r"needs .*(invertible|zero|finite camera|\(3, 3\))") == []
