"""Self-calibration from a core of well-connected views."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metric.test_metric_refinement import centre_error
from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.config.intrinsics import prior_for
from thesisrecon.errors import StageFailure
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.pipeline.large_sets import (
    CORE_VIEWS,
    MAX_CORES,
    calibrate_with_core,
    calibrated_part,
    restrict_views,
)
from thesisrecon.records import SelfCalibration
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement


class OfFewViews:
    """A method that fails for more than ``most`` views and notes those it was given."""

    def __init__(self, most, *, identifiable=True):
        self.most, self.identifiable, self.given = most, identifiable, []

    def calibrate(self, projective, **_):
        self.given.append(projective.registered)
        if projective.registered.sum() > self.most:
            raise StageFailure("self-calibration failed", f"{projective.registered.sum()} views", "fewer")
        K = projective.registered[:, None, None] * np.eye(3)
        return SelfCalibration(np.eye(4), K, np.zeros_like(K), self.identifiable, ())


def bent_scene():
    """Eleven views of which the last three are in another projective frame than the rest."""
    scene = make_scene(views=11, points=400, sigma_px=0.2, seed=2)
    projective = projective_reconstruction(scene)
    P = projective.P.copy()
    rng = np.random.default_rng(0)
    P[8:] = P[8:] @ (np.eye(4) + 0.5 * rng.normal(size=(4, 4)))
    # They are tied to the others by fewer points.
    inlier = projective.inlier & (
        (projective.tracks.view_index < 8) | (rng.random(len(projective.inlier)) < 0.5)
    )
    return scene, replace(projective, P=P, inlier=inlier)


def test_a_core_calibrates_what_a_bent_reconstruction_cannot_and_the_metric_stage_adds_the_rest():
    scene, projective = bent_scene()
    prior, method = prior_for(projective), HypothesesAndRefinement()
    with pytest.raises(StageFailure):
        method.calibrate(projective, prior=prior, rng=np.random.default_rng(0))
    calibration = calibrate_with_core(method, projective, prior=prior, rng=np.random.default_rng(0))
    used = calibration.K[:, 0, 0] > 0
    assert used.sum() == CORE_VIEWS
    assert not used[8:].any()
    part = calibrated_part(projective, calibration)
    result = MetricRefinement().refine(part, calibration, prior=prior, rng=np.random.default_rng(0))
    assert result.trusted, result.failed_checks
    assert result.reconstruction.registered.all()
    np.testing.assert_allclose(result.reconstruction.K[:, 0, 0], 1500.0, rtol=5e-3)
    assert centre_error(result, scene) < 0.01


def test_all_views_are_used_where_they_have_a_solution():
    projective = projective_reconstruction(make_scene())
    method = OfFewViews(8)
    calibration = calibrate_with_core(method, projective, prior=prior_for(projective), rng=None)
    assert len(method.given) == 1
    assert calibrated_part(projective, calibration) is projective


def test_the_first_core_that_determines_the_calibration_is_taken_and_tries_are_limited():
    projective = projective_reconstruction(make_scene(views=12))
    prior = prior_for(projective)
    for method, tries in ((OfFewViews(5), 2), (OfFewViews(5, identifiable=False), 1 + MAX_CORES)):
        calibration = calibrate_with_core(method, projective, prior=prior, rng=None)
        assert len(method.given) == tries
        assert len({views.tobytes() for views in method.given}) == tries
        assert (calibration.K[:, 0, 0] > 0).tolist() == method.given[1].tolist()
    with pytest.raises(StageFailure, match="12 views"):
        calibrate_with_core(OfFewViews(4), projective, prior=prior, rng=None)


def test_a_part_keeps_the_points_that_two_of_its_views_see():
    projective = projective_reconstruction(make_scene())
    views = np.arange(8) < 3
    part = restrict_views(projective, views)
    t = part.tracks
    seen = np.bincount(t.point_index[part.inlier], minlength=t.n_points)
    assert set(np.unique(t.view_index[part.inlier])) == {0, 1, 2}
    assert ((seen >= 2) == part.valid).all()
    assert (part.P[3:] == 0).all()
    assert (part.X[~part.valid] == 0).all()
