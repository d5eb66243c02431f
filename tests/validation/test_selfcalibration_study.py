"""The scenes of the self-calibration task are what they say, and its bound behaves as one."""

from dataclasses import replace

import numpy as np
import pytest

from validation.ablation.tasks.calibration import focal_bound
from validation.scenes.rigs import cube_rig, make_cloud, noisy_tracks, projective_from_truth


def test_cameras_of_one_face_are_left_out_of_the_projective_stage():
    rng, rig = np.random.default_rng(0), cube_rig()
    rec = projective_from_truth(rig, noisy_tracks(rig, 1.0, rng), rng)
    assert rig.flat is not None
    assert rig.flat.sum() == 6
    np.testing.assert_array_equal(rec.registered, ~rig.flat)
    assert rec.sigma_px == pytest.approx(0.9, abs=0.1)


def test_the_bound_grows_with_noise_and_shrinks_with_cameras_and_priors():
    rig = make_cloud(9, np.random.default_rng(1), points=80)
    std = focal_bound(rig, 1.0, zooming=False, principal_std_px=15.0)
    np.testing.assert_allclose(std, std[0])
    # With what is known of the principal point scaled along, twice the noise is twice the deviation.
    np.testing.assert_allclose(
        focal_bound(rig, 2.0, zooming=False, principal_std_px=30.0), 2.0 * std, rtol=1e-4
    )
    assert focal_bound(rig.subset(np.arange(4)), 1.0, zooming=False, principal_std_px=15.0)[0] > 1.2 * std[0]
    assert (focal_bound(rig, 1.0, zooming=True, principal_std_px=15.0) > std[0]).all()
    assert focal_bound(rig, 1.0, zooming=False, principal_std_px=0.1)[0] <= std[0]
    scaled = replace(rig, X=3.0 * rig.X, C=3.0 * rig.C)
    np.testing.assert_allclose(focal_bound(scaled, 1.0, zooming=False, principal_std_px=15.0), std, rtol=1e-4)
