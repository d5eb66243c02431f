"""Focals from fundamental matrices: exact closed form, honest uncertainty, and what is named as open."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.selfcalibration.test_direct_methods import adjusted, prior_for
from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.selfcalibration.candidates import square_pixel_calibrations
from thesisrecon.selfcalibration.focals_from_fundamental import (
    FocalsFromFundamental,
    _dual_with_changes,
    _independence_factor,
    _kruppa_chi_square,
    _kruppa_whitening,
    bougnoux_focals,
    focal_posterior,
    pair_focals,
)
from thesisrecon.selfcalibration.frame import normalized_frame
from thesisrecon.selfcalibration.kruppa import (
    PairGeometry,
    _fit_fundamental,
    _kruppa_cost,
    dual_conics,
    kruppa_residuals,
    pair_geometries,
)
from thesisrecon.selfcalibration.unknowns import weak_focal_prior


def random_pair(seed):
    """F of two cameras in general position, and their K."""
    rng = np.random.default_rng(seed)
    K = []
    for f in rng.uniform(0.6, 3.0, 2):
        K.append(np.diag([f, f, 1.0]))
    R = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)).as_matrix()
    t = rng.normal(size=3)
    F = np.linalg.inv(K[1]).T @ cross_matrix(t) @ R @ np.linalg.inv(K[0])
    return F / np.linalg.norm(F), K[0], K[1]


@settings(max_examples=100, derandomize=True, deadline=None)
@given(seed=st.integers(0, 100_000), scale=st.sampled_from([-3.0, 1e-4, 1.0]))
def test_the_closed_form_is_exact_at_any_scale_and_sign(seed, scale):
    F, K1, K2 = random_pair(seed)
    np.testing.assert_allclose(bougnoux_focals(scale * F), [K1[0, 0] ** 2, K2[0, 0] ** 2], rtol=1e-6)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_the_kruppa_equations_hold_at_the_truth_and_not_beside_it(seed):
    F, K1, K2 = random_pair(seed)
    residual = kruppa_residuals(F[None], dual_conics(K1)[None, None], dual_conics(K2)[None, None])
    assert np.abs(residual).max() < 1e-10
    wrong = K1 @ np.diag([1.3, 1.3, 1.0])
    assert (
        np.abs(kruppa_residuals(F[None], dual_conics(wrong)[None, None], dual_conics(K2)[None, None])).max()
        > 1e-4
    )


@settings(max_examples=30, derandomize=True, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_kruppa_residuals_bear_full_calibrations(seed):
    rng = np.random.default_rng(seed)
    K = [np.array([[1.3, 0.05, 0.1], [0.0, 1.4, -0.2], [0.0, 0.0, 1.0]]), np.diag([0.7, 0.8, 1.0])]
    R = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)).as_matrix()
    F = np.linalg.inv(K[1]).T @ cross_matrix(rng.normal(size=3)) @ R @ np.linalg.inv(K[0])
    residual = kruppa_residuals(F[None], dual_conics(K[0])[None, None], dual_conics(K[1])[None, None])
    assert np.abs(residual).max() < 1e-9


def test_an_f_of_the_pairs_own_matches_has_an_honest_covariance():
    chi = []
    for seed in range(12):
        scene = make_scene(views=4, sigma_px=1.0, seed=seed)
        frame = normalized_frame(projective_reconstruction(scene, seed=seed), prior_for(scene))
        pairs = pair_geometries(frame, projective_reconstruction(scene, seed=seed))
        log_f = np.log(scene.K[:1, 0, 0] / 1536.0)
        chi.append(_kruppa_chi_square(pairs, log_f, log_f, cell=0.0, principal_std=0.0)[:, 0])
    chi = np.concatenate(chi)
    # Chi-square of two degrees of freedom: median 1.39, 95 % below 5.99.
    assert 0.9 < np.median(chi) < 2.0
    assert np.mean(chi < 5.99) > 0.85


def test_the_std_of_a_pair_predicts_its_error():
    z, finite = [], []
    for seed in range(10):
        scene = make_scene(views=5, sigma_px=0.7, seed=seed)
        frame = normalized_frame(projective_reconstruction(scene, seed=seed), prior_for(scene))
        pairs = pair_geometries(frame, projective_reconstruction(scene, seed=seed))
        for F, covariance in zip(pairs.F, pairs.covariance, strict=True):
            focal, std = pair_focals(F, covariance)
            sure = np.isfinite(std)
            finite.append(sure.mean())
            z += list(np.log(focal[sure] * 1536.0 / scene.K[0, 0, 0]) / std[sure])
    assert np.mean(finite) > 0.7
    assert 0.5 < np.sqrt(np.median(np.square(z))) < 1.1


def test_pairs_with_intersecting_axes_are_undetermined_not_wrong():
    scene = make_scene(views=6, sigma_px=0.5, seed=3)
    R, t = [], []
    for centre in scene.centres:
        z = -centre / np.linalg.norm(centre)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        R.append(np.array([x, np.cross(z, x), z]))
        t.append(-R[-1] @ centre)
    fixating = replace(scene, R=np.array(R), t=np.array(t))
    x = np.einsum("kab,kb->ka", fixating.R[scene.tracks.view_index], scene.X[scene.tracks.point_index])
    pixel = np.einsum("kab,kb->ka", scene.K[scene.tracks.view_index], x + fixating.t[scene.tracks.view_index])
    rng = np.random.default_rng(0)
    noisy = pixel[:, :2] / pixel[:, 2:] + rng.normal(0.0, 0.5, (len(pixel), 2))
    fixating = replace(fixating, tracks=replace(scene.tracks, xy=noisy))
    rec = projective_reconstruction(fixating, seed=3)
    pairs = pair_geometries(normalized_frame(rec, prior_for(scene)), rec)
    std = np.array([pair_focals(F, C)[1] for F, C in zip(pairs.F, pairs.covariance, strict=True)])
    assert np.isinf(std).mean() > 0.9


def test_a_camera_without_supporting_pairs_is_named():
    scene = make_scene(views=5, sigma_px=0.5, zoom=0.2, seed=4)
    tracks = scene.tracks
    # The last view keeps 12 observations: no pair of it has enough.
    keep = (tracks.view_index != 4) | (np.cumsum(tracks.view_index == 4) <= 12)
    fewer = replace(
        tracks, view_index=tracks.view_index[keep], point_index=tracks.point_index[keep], xy=tracks.xy[keep]
    )
    scene = replace(scene, tracks=fewer)
    answer = FocalsFromFundamental().calibrate(
        adjusted(scene, 4), prior=prior_for(scene, shared=False), rng=np.random.default_rng(0)
    )
    assert not answer.identifiable
    assert any("do not determine" in reason and "#4" in reason for reason in answer.reasons)
    assert answer.K_std[4, 0, 0] / answer.K[4, 0, 0] > 0.5
    error = np.abs(answer.K[:4, 0, 0] / scene.K[:4, 0, 0] - 1.0)
    assert (error < 5.0 * answer.K_std[:4, 0, 0] / answer.K[:4, 0, 0]).all()


def test_wrong_pairs_do_not_carry_the_vote():
    scene = make_scene(views=8, sigma_px=0.5, seed=5)
    rec = projective_reconstruction(scene, seed=5)
    frame = normalized_frame(rec, prior_for(scene))
    pairs = pair_geometries(frame, rec)
    F = pairs.F.copy()
    for m in range(0, len(F), 4):
        F[m] = random_pair(m)[0]
    wrong = PairGeometry(pairs.i, pairs.j, F, pairs.covariance)
    prior = weak_focal_prior(np.array([np.nan]), np.array([np.inf]))
    vote = focal_posterior(wrong, frame.group, np.linspace(-2.0, 4.0, 151), prior=prior)
    assert abs(vote.log_f[0] - np.log(scene.K[0, 0, 0] / 1536.0)) < 0.05


def test_pairs_share_observations_and_count_accordingly():
    empty = np.zeros((0, 3, 3))
    three = PairGeometry(np.array([0, 0, 1]), np.array([1, 2, 2]), empty, empty)
    assert _independence_factor(three) == 1.0
    i, j = np.triu_indices(10, 1)
    assert _independence_factor(PairGeometry(i, j, empty, empty)) == pytest.approx(17 / 45)


def test_whitened_residuals_square_to_the_chi_square():
    scene = make_scene(views=4, sigma_px=1.0, seed=6)
    rec = projective_reconstruction(scene, seed=6)
    frame = normalized_frame(rec, prior_for(scene))
    pairs = pair_geometries(frame, rec)
    log_f = np.full(4, 0.1)
    root = _kruppa_whitening(pairs, log_f, principal_std=0.01)
    w = dual_conics(square_pixel_calibrations(log_f))[None]
    g = kruppa_residuals(pairs.F, w[:, pairs.i], w[:, pairs.j])[0]
    white = np.einsum("mab,mb->ma", root, g)
    chi = _kruppa_chi_square(pairs, log_f[:1], log_f[:1], cell=0.0, principal_std=0.01)[:, 0]
    np.testing.assert_allclose(np.sum(white**2, axis=1), chi, rtol=1e-6)


def test_fit_starts_anywhere_near_and_does_not_raise_the_cost():
    scene = make_scene(views=3, sigma_px=0.5, seed=7)
    rec = projective_reconstruction(scene, seed=7)
    pairs = pair_geometries(normalized_frame(rec, prior_for(scene)), rec, refit=False)
    fitted = pair_geometries(normalized_frame(rec, prior_for(scene)), rec)
    assert (np.abs(np.linalg.det(fitted.F)) < 1e-12).all()
    assert (np.abs(np.abs(np.einsum("mab,mab->m", pairs.F, fitted.F)) - 1.0) < 1e-3).all()
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 30, 2))
    F, covariance = _fit_fundamental(random_pair(1)[0], x[0], x[1])
    assert np.isfinite(F).all()
    assert (np.linalg.eigvalsh(covariance) > -1e-6 * np.trace(covariance)).all()


def test_the_changes_of_the_dual_conic_are_its_derivatives():
    def dual(log_f, x, y):
        K = np.array([[np.exp(log_f), 0.0, x], [0.0, np.exp(log_f), y], [0.0, 0.0, 1.0]])
        return K @ K.T

    log_f, h = np.array([0.3, -0.5]), 1e-6
    found = _dual_with_changes(log_f)
    for one, value in zip(found, log_f, strict=True):
        np.testing.assert_allclose(one[0], dual(value, 0.0, 0.0))
        for n, step in enumerate(h * np.eye(3)):
            up, down = dual(value + step[0], *step[1:]), dual(value - step[0], *-step[1:])
            np.testing.assert_allclose(one[1 + n], (up - down) / (2.0 * h), atol=1e-8)


def test_the_kruppa_cost_is_the_square_of_small_residuals_and_linear_in_large_ones():
    F, K1, K2 = random_pair(7)
    pairs = PairGeometry(np.array([0]), np.array([1]), F[None], np.zeros((1, 9, 9)))
    wrong = np.stack([K1 @ np.diag([1.2, 1.2, 1.0]), K2])[None]
    size = np.linalg.norm(kruppa_residuals(F[None], *(dual_conics(wrong)[:, k : k + 1] for k in (0, 1))))
    assert size > 1e-3
    np.testing.assert_allclose(_kruppa_cost(pairs, wrong, loss_scale=1e3 * size), [size**2], rtol=1e-5)
    np.testing.assert_allclose(
        _kruppa_cost(pairs, wrong, loss_scale=1e-3 * size), [2e-3 * size**2], rtol=2e-3
    )
