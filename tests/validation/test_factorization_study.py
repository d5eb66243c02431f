"""The study of factorisation in small: what its tables claim holds."""

import numpy as np
import pytest

from validation.scenes.rigs import cube_rig, noisy_tracks, projective_from_truth
from validation.studies.factorization import (
    AFFINE,
    GROWN,
    ITERATED,
    PLAIN,
    check_noise,
    complete_tracks,
    projective_error_pct,
    residual_rms_px,
)


@pytest.mark.parametrize("sigma_px", [0.0, 1.0])
def test_iterations_come_near_the_optimum_and_every_start_leads_there(sigma_px):
    residual, apart, after, reached = check_noise(sigma_px, trials=2)
    assert reached.verdict == "reached"
    for row in (residual, apart):
        assert set(row.values) == {PLAIN, ITERATED, AFFINE, GROWN}
        assert row.values[ITERATED] <= row.values[PLAIN] + 1e-9
    assert residual.values[ITERATED] <= 1.15 * after.values[ITERATED] + 1e-6


def test_the_error_in_space_does_not_know_the_frame():
    rng = np.random.default_rng(0)
    rig = cube_rig().subset(np.array([4, 10, 13, 16, 22]))
    model = projective_from_truth(rig, noisy_tracks(rig, 0.0, rng), rng)
    seen = model.valid
    assert projective_error_pct(model.X[seen], rig.X[seen]) < 1e-6
    assert residual_rms_px(model) < 1e-6
    moved = rig.X[seen] + rng.normal(0.0, 0.01, (int(seen.sum()), 3))
    assert 0.3 < projective_error_pct(model.X[seen], moved) < 3.0


def test_only_points_of_every_view_are_in_a_complete_table():
    rig = cube_rig().subset(np.array([0, 4, 13]))
    tracks = noisy_tracks(rig, 0.5, np.random.default_rng(0))
    xy, seen = complete_tracks(tracks)
    assert xy.shape == (3, int(seen.sum()), 2)
    assert np.isfinite(xy).all()
