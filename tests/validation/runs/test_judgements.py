"""Judgements of the stages from incomplete and from reduced answers."""

import numpy as np

from thesisrecon.records import Image
from validation.scenes.real_pairs import RealPair
from validation.stages.features import in_original_pixels
from validation.stages.fundamental import MINIMAL, OURS, VARIANTS, _metrics


def test_a_method_without_any_fundamental_matrix_has_the_largest_errors_and_no_rank():
    xy = np.random.default_rng(0).uniform(0.0, 500.0, (20, 2))
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    pairs = [RealPair("a pair", xy, xy, truth=np.hstack([xy, xy]), F=F)]
    found = {"F": F[None, None], "inliers": np.full((1, 1), 20.0), "seconds": np.ones((1, 1))}
    nothing = found | {"F": np.full((1, 1, 3, 3), np.nan), "inliers": np.zeros((1, 1))}
    answers = dict.fromkeys((OURS, *VARIANTS), found) | {"COLMAP": nothing, MINIMAL: nothing}
    errors = {name: np.array([[99.0 if a is nothing else 0.0]]) for name, a in answers.items()}
    rows = {row.name: row for row in _metrics("a scene", pairs, answers, errors)}
    assert rows["failed"].values == {name: 100.0 * (a is nothing) for name, a in answers.items()}
    assert rows["epipole angle"].values["COLMAP"] == 90.0
    rank = rows[f"{MINIMAL}: rank"].values[OURS]
    assert rank is not None
    assert np.isnan(rank)


def test_matrices_of_reduced_images_are_judged_in_original_pixels():
    rng = np.random.default_rng(0)
    F, xy = rng.normal(size=(3, 3)), rng.uniform(0.0, 300.0, (2, 5, 2))
    images = [Image("", np.zeros((30, 40, 3), np.uint8), size) for size in ((80, 60), (120, 90))]
    original = [(x + 0.5) / image.scale - 0.5 for x, image in zip(xy, images, strict=True)]
    here, there = (np.column_stack([x, np.ones(5)]) for x in xy)
    first, second = (np.column_stack([x, np.ones(5)]) for x in original)
    expected = np.einsum("na,ab,nb->n", there, F, here)
    found = np.einsum("na,ab,nb->n", second, in_original_pixels(F, *images), first)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
