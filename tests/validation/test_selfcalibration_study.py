"""The scenes of the self-calibration task are what they say, and its bound behaves as one."""

from dataclasses import replace

import numpy as np
import pytest

from thesisrecon.geometry.camera_matrix import project
from validation.ablation.tasks.calibration import Cell, assumptions, focal_bound, make_rig
from validation.scenes.rigs import cube_rig, make_cloud, noisy_tracks, projective_from_truth


@pytest.mark.parametrize("scene", ["cube", "cloud"])
@pytest.mark.parametrize("mode", ["constant", "zooming"])
def test_projective_cameras_of_exact_pixels_reproject_exactly(scene, mode):
    rng = np.random.default_rng(0)
    rig = make_rig(Cell(scene, mode, 0.0, 6), rng)
    rec = projective_from_truth(rig, noisy_tracks(rig, 0.0, rng), rng)
    assert rec.registered.all()
    for v in range(6):
        mine = rec.inlier & (rec.tracks.view_index == v)
        seen = project(rec.P[v], rec.X[rec.tracks.point_index[mine]])
        np.testing.assert_allclose(seen, rec.tracks.xy[mine], atol=1e-5)
    focals = rig.K[:, 0, 0]
    assert (np.ptp(focals) > 1.0) == (mode == "zooming")
    assert assumptions(rig, mode).group.max() == (5 if mode == "zooming" else 0)


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
