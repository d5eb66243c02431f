"""Essential matrices by five points, poses, and homographies taken apart, against truth and OpenCV."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon import Camera, StageFailure, decompose_homography, estimate_essential, recover_pose
from thesisrecon.geometry.relative_pose import essential_five_points, essential_from_pose

K = np.array([[800.0, 0, 319.5], [0, 780, 239.5], [0, 0, 1]])


def _pair(seed, n=300, wrong=0.0, noise=0.5, lens=None):
    """Two cameras, matches of which some are wrong, and the true R and t."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(0.2 * rng.normal(size=3)).as_matrix()
    t = rng.normal(size=3)
    t /= np.linalg.norm(t)
    X = rng.uniform(-1.5, 1.5, (n, 3)) + np.array([0.0, 0, 6])
    poses = ((np.eye(3), np.zeros(3)), (R, t))
    cameras = [Camera(K, *pose, (640, 480), lens) for pose in poses]
    xy1, xy2 = (camera.project(X) + noise * rng.normal(size=(n, 2)) for camera in cameras)
    xy2[: int(wrong * n)] = rng.uniform(0, [640, 480], (int(wrong * n), 2))
    return cameras, xy1, xy2, R, t


def _off_deg(R, t, R_true, t_true):
    turn = np.linalg.norm(Rotation.from_matrix(R @ R_true.T).as_rotvec())
    return np.degrees(max(turn, np.arccos(np.clip(t.ravel() @ t_true, -1, 1))))


def test_five_points_give_the_true_matrix_and_only_essential_ones():
    rng, n = np.random.default_rng(0), 100
    R, t = Rotation.from_rotvec(0.3 * rng.normal(size=(n, 3))).as_matrix(), rng.normal(size=(n, 3))
    X = rng.uniform(-1, 1, (n, 5, 3)) + np.array([0.0, 0, 4])
    Y = np.einsum("bij,bnj->bni", R, X) + t[:, None]
    found = essential_five_points(X / X[..., 2:], Y / Y[..., 2:])
    true = essential_from_pose(R, t / np.linalg.norm(t, axis=1, keepdims=True)) / np.sqrt(2)
    apart = [np.abs(true[:, None] + sign * found[None]).max(axis=(2, 3)).min(axis=1) for sign in (1, -1)]
    assert np.sort(np.minimum(*apart))[-3] < 1e-8
    size = np.linalg.svd(found, compute_uv=False)
    assert np.abs(np.sort(size[:, 0] - size[:, 1]))[: -len(size) // 50].max() < 1e-6
    assert size[:, 2].max() < 1e-6


@pytest.mark.parametrize("wrong", [0.0, 0.6])
def test_pose_of_matches_lies_within_its_covariance(wrong):
    scores = []
    for seed in range(8):
        cameras, xy1, xy2, R, t = _pair(seed, wrong=wrong, lens=np.array([-0.1, 0.02]))
        fit = estimate_essential(xy1, xy2, cameras[0], cameras[1])
        assert fit.sigma_px == pytest.approx(0.5, rel=0.3)
        assert fit.inliers[int(wrong * 300) :].mean() > 0.95
        assert fit.inliers[: int(wrong * 300)].sum() <= 0.15 * wrong * 300
        scores.append(_score(fit, R, t))
        E = essential_from_pose(R, t)
        pose = recover_pose(-3.0 * E, xy1[fit.inliers], xy2[fit.inliers], *cameras)
        assert _off_deg(pose.R, pose.t, R, t) < 1e-5
        assert np.median(pose.depths[:, 0]) == pytest.approx(6.0, abs=0.5)
    # Among many wrong matches a few agree by chance, and count as right ones.
    assert wrong or 0.6 < np.mean(scores) < 1.6
    assert 0.4 < np.median(scores) < 5.0


def _score(fit, R, t):
    """Squared error of the pose in units of its covariance, by degree of freedom."""
    turn = Rotation.from_matrix(R @ fit.R.T).as_rotvec()
    off = np.concatenate([turn, t - fit.t - np.cross(turn, fit.t)])
    return off @ np.linalg.pinv(fit.covariance, rcond=1e-9) @ off / 5


def test_wrong_matches_do_not_make_the_covariance_too_small():
    """A wrong match near its epipolar line has any parallax: one of them moved poses by 13 deviations."""
    scores = []
    for seed in range(60):
        _, xy1, xy2, R, t = _pair(seed, wrong=0.3)
        fit = estimate_essential(xy1, xy2, K)
        assert fit.inliers[90:].mean() > 0.93
        scores.append(_score(fit, R, t))
    # The squares of five normal numbers have a mean of 1 and a 90 % quantile of 1.85.
    assert 0.75 < np.mean(scores) < 1.5
    assert np.quantile(scores, 0.9) < 2.6


def test_exact_matches_give_the_exact_pose_and_noisy_ones_that_of_least_sampson_distance():
    _, xy1, xy2, R, t = _pair(3, wrong=0.4, noise=0.0)
    exact = estimate_essential(xy1, xy2, K)
    assert _off_deg(exact.R, exact.t, R, t) < 1e-5
    assert exact.inliers[120:].all()
    _, xy1, xy2, R, t = _pair(3)
    fit = estimate_essential(xy1, xy2, K, threshold_px=None)
    a, b = (np.column_stack([xy, np.ones(300)]) for xy in (xy1, xy2))

    def sampson(x):
        E = essential_from_pose(Rotation.from_rotvec(x[:3]).as_matrix() @ R, (t + x[3:]))
        F = np.linalg.inv(K).T @ E @ np.linalg.inv(K)
        slope = np.hypot(*(a @ F.T)[:, :2].T) ** 2 + np.hypot(*(b @ F)[:, :2].T) ** 2
        return np.sum(a @ F.T * b, axis=1) / np.sqrt(slope)

    best = least_squares(sampson, np.zeros(6), x_scale="jac", xtol=1e-12, ftol=1e-14)
    moved = t + best.x[3:]
    turned = Rotation.from_rotvec(best.x[:3]).as_matrix() @ R
    assert _off_deg(fit.R, fit.t, turned, moved / np.linalg.norm(moved)) < 1e-3
    assert fit.sigma_px == pytest.approx(np.sqrt(2 * best.cost / 295), rel=1e-6)


def test_normalised_coordinates_agree_and_random_matches_are_refused():
    _, xy1, xy2, _, _ = _pair(7, wrong=0.3)
    rays = [((np.column_stack([xy, np.ones(300)])) @ np.linalg.inv(K).T)[:, :2] for xy in (xy1, xy2)]
    pixels = estimate_essential(xy1, xy2, K)
    normalised = estimate_essential(*rays, np.eye(3), threshold_px=1 / 790)
    assert _off_deg(normalised.R, normalised.t, pixels.R, pixels.t) < 0.3
    assert abs(int(normalised.inliers.sum()) - int(pixels.inliers.sum())) < 8
    for seed in range(4):
        rng = np.random.default_rng(seed)
        random = rng.uniform(0, 480, (2, 40, 2))
        refuses(StageFailure, "chance|agree", estimate_essential, *random, K, max_samples=500)
    refuses(ValueError, "estimate_essential needs xy1", estimate_essential, xy1, xy2[1:], K)
    refuses(ValueError, "K upper triangular", estimate_essential, xy1, xy2, K.T)
    refuses(StageFailure, "6 different", estimate_essential, xy1[:5], xy2[:5], K)


@pytest.mark.parametrize("noise", [0.0, 1e-6, 0.3])
def test_one_of_the_two_poses_of_a_plane_is_the_true_one_and_other_scenes_have_one(noise):
    found = []
    for seed in range(12):
        _, xy1, xy2, _, _ = _pair(seed, noise=noise)
        assert not len(estimate_essential(xy1, xy2, K).competing_poses)
        rng = np.random.default_rng(seed)
        X = np.c_[rng.uniform(-1.0, 1.0, (80, 2)), np.zeros(80)]
        R = Rotation.from_euler("xyz", rng.uniform([20, -20, -20], [50, 20, 20], (2, 3)), True).as_matrix()
        t = np.c_[rng.uniform(-0.3, 0.3, (2, 2)), [5.0, 6.0]]
        poses = zip(R, t, strict=True)
        xy1, xy2 = (
            Camera(K, *pose, (640, 480)).project(X) + noise * rng.normal(size=(80, 2)) for pose in poses
        )
        turn = R[1] @ R[0].T
        move = t[1] - turn @ t[0]
        fit = estimate_essential(xy1, xy2, K)
        poses = [(fit.R, fit.t), *((pose[:, :3], pose[:, 3]) for pose in fit.competing_poses)]
        found.append(len(poses))
        off = min(_off_deg(*pose, turn, move / np.linalg.norm(move)) for pose in poses)
        assert off < (5.0 if noise > 0.1 else 1e-3)
    assert min(found) == 2


@pytest.mark.references
@pytest.mark.parametrize("wrong", [0.0, 0.5])
def test_poses_are_as_accurate_as_those_of_opencv(wrong):
    cv2 = pytest.importorskip("cv2")
    ours, theirs = [], []
    for seed in range(6):
        _, xy1, xy2, R, t = _pair(seed, wrong=wrong)
        fit = estimate_essential(xy1, xy2, K)
        ours.append(_off_deg(fit.R, fit.t, R, t))
        E, mask = cv2.findEssentialMat(xy1, xy2, K, cv2.RANSAC, 0.9999, 1.0)
        _, R_cv, t_cv, _ = cv2.recoverPose(E, xy1, xy2, K, mask=mask.copy())
        theirs.append(_off_deg(R_cv, t_cv, R, t))
        pose = recover_pose(E, xy1[mask.ravel() > 0], xy2[mask.ravel() > 0], K)
        np.testing.assert_allclose(pose.R, R_cv, atol=1e-9)
        np.testing.assert_allclose(pose.t, t_cv.ravel(), atol=1e-9)
    assert np.median(ours) <= np.median(theirs)
    assert np.max(ours) <= np.max(theirs)


def test_homographies_come_apart_into_the_true_plane_and_pose():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        R, t = Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix(), 0.3 * rng.normal(size=3)
        t[2] += seed  # the farther the camera goes back, the more a wrong sign of t is seen
        n = np.array([0.3, -0.2, 1.0]) * rng.choice([0.5, 1.0], 3)
        n /= np.linalg.norm(n)
        K2 = np.diag([1.1, 1.1, 1.0]) @ K
        H = K2 @ (R + np.outer(t, n)) @ np.linalg.inv(K)
        found = decompose_homography(-2.0 * H, K, K2)
        apart = np.abs(found.R - R).max((1, 2)) + np.abs(found.t - t).max(1) + np.abs(found.normal - n).max(1)
        assert len(found.R) == 4
        assert apart.min() < 1e-8
        seen = decompose_homography(H, K, K2, xy1=rng.uniform(100, 400, (20, 2)))
        assert 1 <= len(seen.R) <= 2
        apart = np.abs(seen.R - R).max((1, 2)) + np.abs(seen.t - t).max(1) + np.abs(seen.normal - n).max(1)
        assert apart.min() < 1e-8
        for one in zip(found.R, found.t, found.normal, strict=True):
            np.testing.assert_allclose(one[0] + np.outer(one[1], one[2]), R + np.outer(t, n), atol=1e-8)
    turned = decompose_homography(K @ R @ np.linalg.inv(K), K)
    assert len(turned.R) == 1
    np.testing.assert_allclose(turned.R[0], R, atol=1e-7)
    assert not turned.t.any()
    refuses(ValueError, "singular", decompose_homography, np.ones((3, 3)), K)
