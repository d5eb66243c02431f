"""Exact matches of a facade agree with its F, and shifted ones do not; a flat one is a plane."""

import numpy as np
import pytest

from thesisrecon.geometry.two_view import estimate_homography, homography_residuals, sampson_residuals
from validation.scenes.facade import FacadeMaker


def test_exact_matches_agree_with_f_and_the_others_do_not():
    facade = FacadeMaker(sigma_px=0.5).make(np.random.default_rng(0))
    assert len(facade.xy1) == len(facade.right) > 100
    assert len(facade.exact1) == facade.right.sum()
    assert np.abs(sampson_residuals(facade.F, facade.exact1, facade.exact2)).max() < 1e-6
    noise = sampson_residuals(facade.F, facade.xy1[facade.right], facade.xy2[facade.right])
    assert np.std(noise) == pytest.approx(0.5, rel=0.2)
    wrong = np.abs(sampson_residuals(facade.F, facade.xy1[~facade.right], facade.xy2[~facade.right]))
    assert np.median(wrong) > 2.0


def test_a_flat_facade_is_a_plane_and_says_so():
    flat = FacadeMaker(relief=0.0, off_plane=0.0).make(np.random.default_rng(1))
    assert flat.off_plane == 0
    H = estimate_homography(flat.exact1, flat.exact2)
    assert homography_residuals(H, flat.exact1, flat.exact2).max() < 1e-6
    deep = FacadeMaker(relief=0.03, off_plane=0.1).make(np.random.default_rng(1))
    assert deep.off_plane > 10


def test_drawn_facades_are_the_same_for_the_same_seed():
    first, second = (
        FacadeMaker.drawn(rng).make(rng) for rng in (np.random.default_rng(5), np.random.default_rng(5))
    )
    np.testing.assert_array_equal(first.xy2, second.xy2)
