import dataclasses

import numpy as np
import pytest

from tests.report.synthetic import NOISE_PX, made_up_run, projective_run
from thesisrecon.report.data import (
    BINS,
    common_limit_px,
    histogram_shares,
    reprojection_distances,
    summarize_distances,
    used_observations,
)


def test_the_residuals_are_the_noise_that_was_added():
    data = made_up_run(points=1500)
    assert data.metric is not None
    reconstruction = data.metric.reconstruction
    distances = reprojection_distances(reconstruction)
    assert len(distances[-1]) == 0  # the last view is not registered
    assert sum(map(len, distances)) == len(used_observations(reconstruction))
    summary = summarize_distances(np.concatenate(distances))
    assert summary is not None
    # Two independent coordinates make a Rayleigh distribution: RMS sqrt(2) sigma, median sigma sqrt(2 ln 2).
    assert summary.rms_px == pytest.approx(np.sqrt(2) * NOISE_PX, rel=0.03)
    assert summary.median_px == pytest.approx(np.sqrt(2 * np.log(2)) * NOISE_PX, rel=0.03)


def test_only_inliers_of_registered_views_and_valid_points_count():
    data = made_up_run(points=200)
    assert data.metric is not None
    before = data.metric.reconstruction
    after = dataclasses.replace(before, valid=np.arange(200) < 100)
    used = used_observations(after)
    assert before.inlier[used].all()
    assert before.registered[before.tracks.view_index[used]].all()
    assert (before.tracks.point_index[used] < 100).all()
    assert len(used_observations(dataclasses.replace(before, inlier=np.zeros_like(before.inlier)))) == 0


def test_without_distortion_the_projective_residuals_grow_by_what_it_moved():
    reconstruction = projective_run().reconstruction
    assert reconstruction is not None
    summary = summarize_distances(np.concatenate(reprojection_distances(reconstruction)))
    assert summary is not None
    assert summary.rms_px > 2 * NOISE_PX


def test_histogram_holds_every_distance():
    distances = np.array([0.0, 0.1, 0.49, 0.5, 7.0])
    shares = histogram_shares(distances, 0.5)
    assert len(shares) == BINS
    assert shares.sum() == pytest.approx(1.0)
    assert shares[-1] == pytest.approx(3 / 5)  # 0.49, 0.5 and the one beyond
    assert histogram_shares(np.zeros(0), 1.0).sum() == 0


def test_common_limit_is_round_and_covers_the_distances():
    assert common_limit_px(np.full(100, 0.31)) == 0.5
    assert common_limit_px(np.full(100, 250.2)) == 251.0
    assert common_limit_px(np.zeros(0)) == 1.0
    assert summarize_distances(np.zeros(0)) is None
