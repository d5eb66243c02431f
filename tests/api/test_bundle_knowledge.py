"""Bundle adjustment with fixed parts, covariances, priors, losses and gauges; poses of other conventions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon import Camera, bundle_adjust
from thesisrecon.optimize.bundle.knowledge import LOSSES

K = np.array([[700.0, 0, 319.5], [0, 700, 239.5], [0, 0, 1]])
NOISE = 0.5
GL = np.diag([1.0, -1, -1])


def _scene(seed=0, views=4, points=18):
    rng = np.random.default_rng(seed)
    angles = np.column_stack([np.linspace(-0.6, 0.6, views), rng.uniform(-0.3, 0.3, (views, 2))])
    R, depth = Rotation.from_euler("yxz", angles).as_matrix(), rng.uniform(5, 6, views)
    true = [Camera(K, r, np.array([0.1, 0, d]), (640, 480)) for r, d in zip(R, depth, strict=True)]
    X = rng.uniform(-1, 1, (points, 3))
    xy = np.stack([camera.project(X) for camera in true]) + NOISE * rng.normal(size=(views, points, 2))
    xy[0, :3], xy[2, 4] = np.nan, np.nan
    return true, X, xy, rng


def _oracle(found, given, loss, sigma):
    """Residuals of the found solution as a function of steps (w, d) of all poses, log f, k1 and points."""
    cameras, V, N = found.cameras, len(found.cameras), len(found.X)

    def residuals(x):
        pose, q, X = x[: 6 * V].reshape(V, 6), x[6 * V : 6 * V + 2], found.X + x[6 * V + 2 :].reshape(N, 3)
        parts = []
        for i, camera in enumerate(cameras):
            turn = Rotation.from_rotvec(pose[i, :3]).as_matrix()
            one = Camera(
                camera.K * np.exp([[q[0]], [q[0]], [0.0]]) + [[0, 0, camera.K[0, 2] * (1 - np.exp(q[0]))],
                [0, 0, camera.K[1, 2] * (1 - np.exp(q[0]))], [0, 0, 0]], turn @ camera.R,
                turn @ camera.t + pose[i, 3:], camera.size, np.array([camera.distortion[0] + q[1]]),
            )  # fmt: skip
            seen = np.isfinite(given["xy"][i, :, 0])
            root = np.linalg.inv(np.linalg.cholesky(given["covariances"][i][seen]))
            e = np.einsum("kij,kj->ki", root, (one.project(X) - given["xy"][i])[seen]) / sigma
            u = np.sum(e**2, axis=1)
            rho = LOSSES[loss][0](u / given["width"] ** 2)[0] * given["width"] ** 2
            parts.append((e * np.sqrt(rho / u)[:, None]).ravel())
            if np.isfinite(given["positions"][i, 0]):
                parts.append((one.centre - given["positions"][i]) / given["position_std"])
        known = np.isfinite(given["control_points"][:, 0])
        parts.append(((X - given["control_points"]) / given["control_std"])[known].ravel())
        return np.concatenate(parts)

    return residuals


@pytest.mark.parametrize("loss", ["squared", "huber", "cauchy", "geman-mcclure", "tukey"])
def test_minimum_and_covariance_are_those_of_the_cost_as_written(loss):
    true, X, xy, rng = _scene()
    half = rng.normal(size=(4, 18, 2, 2))
    given = {
        "xy": xy, "covariances": half @ np.swapaxes(half, 2, 3) + 0.2 * np.eye(2),
        "positions": np.array([c.centre for c in true]) + 0.02 * rng.normal(size=(4, 3)),
        "position_std": np.array([0.01, 0.02, 0.03]), "control_std": 0.01,
        "control_points": np.where(np.arange(18)[:, None] < 2, X + 0.01 * rng.normal(size=X.shape), np.nan),
    }  # fmt: skip
    given["positions"][1] = np.nan
    found = bundle_adjust(
        true, X + 0.02 * rng.normal(size=X.shape), loss=loss, sigma_px=0.5, loss_px=1.5, fixed_cameras=[3],
        fixed_points=np.arange(18) == 7, max_iterations=400, joint=True, **given,
    )  # fmt: skip
    given["width"] = 3.0
    free = np.ones(6 * 4 + 2 + 3 * 18, dtype=bool)
    free[18:24] = free[26 + 21 : 26 + 24] = False
    assert found.X[7].tolist() != X[7].tolist()  # the start is held, not the truth
    residuals, zero = _oracle(found, given, loss, 0.5), np.zeros(len(free))

    def jacobian(sigma):
        make = _oracle(found, given, loss, sigma)
        steps = 1e-6 * np.eye(len(free))[free]
        return np.stack([(make(step) - make(-step)) / 2e-6 for step in steps], axis=1)

    J, e = jacobian(0.5), residuals(zero)
    gradient = J.T @ e
    assert found.cost == pytest.approx(0.5 * e @ e, rel=1e-9)
    assert np.sqrt(gradient @ np.linalg.solve(J.T @ J, gradient)) < 2e-3
    if loss == "squared":
        C = np.linalg.inv(jacobian(found.sigma_px).T @ jacobian(found.sigma_px))
        np.testing.assert_allclose(found.pose_covariance[:3], [C[s : s + 6, s : s + 6] for s in (0, 6, 12)],
                                   rtol=1e-4, atol=1e-12)  # fmt: skip
        np.testing.assert_allclose(found.point_covariance[4], C[32:35, 32:35], rtol=1e-4, atol=1e-12)
        focal = found.cameras[0].std["focal_px"] / found.cameras[0].K[0, 0]
        assert focal**2 == pytest.approx(C[18, 18], rel=1e-4)
        assert not found.pose_covariance[3].any()
        whole, K = found.joint_covariance, found.cameras[0].K
        n = (len(whole) - 24) // 4
        for view in range(4):
            moves = [*range(18), 24 + n * view, 24 + n * view + 5]
            units = np.append(np.ones(18), [K[0, 0], 1.0])
            expected = C[:20, :20] * units * units[:, None]
            np.testing.assert_allclose(whole[np.ix_(moves, moves)], expected, rtol=1e-3, atol=1e-9)
        assert not whole[18:24].any()
        assert not found.point_covariance[7].any()


def test_what_is_fixed_keeps_its_bytes_and_the_gauge_is_as_asked():
    true, X, xy, rng = _scene(1, 6, 60)
    start = X + 0.02 * rng.normal(size=X.shape)
    inner = bundle_adjust(true, start, xy)
    held = bundle_adjust(true, start, xy, gauge="two-cameras")
    centres = [np.array([camera.centre for camera in cameras]) for cameras in (true, held.cameras)]
    far = int(np.linalg.norm(centres[0] - centres[0][0], axis=1).argmax())
    apart = [np.linalg.norm(c[far] - c[0]) for c in centres]
    assert apart[1] == pytest.approx(apart[0], rel=1e-5)
    np.testing.assert_array_equal(held.cameras[0].t, true[0].t)
    assert held.cameras[0].K[0, 0] == pytest.approx(inner.cameras[0].K[0, 0], rel=1e-5)
    assert held.cameras[0].std["focal_px"] == pytest.approx(inner.cameras[0].std["focal_px"], rel=5e-3)
    line = (centres[0][far] - centres[0][0]) / apart[0]
    assert line @ held.centre_covariance[far] @ line < 1e-10
    # Truth within the covariances of a network without freedom: points fixed at the truth.
    fixed = bundle_adjust(
        true, np.where(np.arange(60)[:, None] < 40, X, start), xy, fixed_points=np.arange(40), shared=False,
        prior={"focal": np.array([0.0, 0, 0, np.inf, np.inf, np.inf])},
    )  # fmt: skip
    np.testing.assert_array_equal(fixed.X[:40], X[:40])
    held = [abs(camera.K[0, 0] - 700.0) < 1e-9 for camera in fixed.cameras]
    assert held == [camera.std["focal_px"] == 0.0 for camera in fixed.cameras] == [True] * 3 + [False] * 3
    off = np.array([camera.centre for camera in fixed.cameras]) - centres[0]
    scores = [d @ np.linalg.solve(C, d) / 3 for d, C in zip(off, fixed.centre_covariance, strict=True)]
    assert 0.4 < np.mean(scores) < 2.0
    one = bundle_adjust(true[:1], X, xy[:1], fixed_points=np.arange(60), free=())
    assert np.linalg.norm(one.cameras[0].centre - centres[0][0]) < 0.02


def test_known_positions_give_the_frame_and_its_uncertainty():
    true, X, xy, rng = _scene(2, 6, 60)
    turn = Rotation.from_rotvec([0.3, 2.0, -0.4]).as_matrix()
    centres = np.array([c.centre for c in true])
    known = 7.0 * centres @ turn.T + [1000.0, -500, 30] + 0.05 * rng.normal(size=(6, 3))
    known[4] = np.nan
    found = bundle_adjust(true, X, xy, positions=known, position_std=0.05)
    off = found.X - (7.0 * X @ turn.T + [1000.0, -500, 30])
    scores = [d @ np.linalg.solve(C, d) / 3 for d, C in zip(off, found.point_covariance, strict=True)]
    assert 0.1 < np.mean(scores) < 3.0
    assert np.sqrt(np.trace(found.centre_covariance[4])) < 0.15


def test_an_outlier_is_left_out_named_or_without_influence():
    true, X, xy, rng = _scene(4, 4, 40)
    start = X + 0.02 * rng.normal(size=X.shape)
    right = bundle_adjust(true, start, xy).cameras[0].K[0, 0]
    xy[1, 11] = [-70.0, 240.0]
    with pytest.warns(UserWarning, match=r"1 observation far outside .* point 11 in view 1 at \(-70, 240\)"):
        found = bundle_adjust(true, start, xy, covariances=np.ones((4, 40)))
    assert found.cameras[0].K[0, 0] == pytest.approx(right, rel=0.02)
    xy[1, 11] = [5.0, 470.0]
    for loss in ("huber", "cauchy", "geman-mcclure", "tukey"):
        found = bundle_adjust(true, start, xy, loss=loss)
        assert found.cameras[0].K[0, 0] == pytest.approx(right, rel=0.02)
        assert loss == "huber" or found.sigma_px == pytest.approx(NOISE, rel=0.2)
    with pytest.warns(UserWarning, match="focal length of camera 0 moved to"):
        bundle_adjust(true, start, xy, loss="squared")


@pytest.mark.parametrize(
    ("convert", "says"),
    [
        (lambda R, t: (R.T, -R.T @ t), "R and t are camera to world"),
        (lambda R, t: (R, -R.T @ t), "t is the camera centre"),
        (lambda R, t: (R.T, t), "R is camera to world"),
        (lambda R, t: (GL @ R, GL @ t), "behind|axes are those of OpenGL"),
    ],
)  # fmt: skip
def test_poses_of_another_convention_are_named(convert, says):
    true, X, xy, _ = _scene(5)
    shift = np.array([0.5, -0.3, 4.0])
    moved = [convert(c.R, c.t - c.R @ shift) for c in true]
    R, t = (np.array(part) for part in zip(*moved, strict=True))
    refuses(ValueError, says, bundle_adjust, (K, R, t), X + shift, xy, sizes=(640, 480))
