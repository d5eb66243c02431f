"""One image and decompositions: properties against the truth, and OpenCV where it has the function."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import thesisrecon as tr

K = np.array([[800.0, 0, 321], [0, 820, 243], [0, 0, 1]])
RNG = np.random.default_rng(0)


def seen(P, X):
    x = np.column_stack([X, np.ones(len(X))]) @ P.T
    return x[:, :2] / x[:, 2:]


def room(rng):
    """A camera that looks at a floor with z up."""
    R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    R = Rotation.from_euler("xyz", [*rng.uniform(-0.2, 0.2, 2) + 0.15, 0.1]).as_matrix() @ R
    return K @ np.column_stack([R, -R @ [0.3, -6.0, 1.7]])


def parallel(P, direction, rng, n):
    start = rng.uniform([-2, -1, 0], [2, 3, 2], (n, 3))
    return np.stack([seen(P, start), seen(P, start + rng.uniform(0.7, 1.5, (n, 1)) * direction)], axis=1)


def test_vanishing_points_lie_within_their_covariance():
    z, sigmas = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        P = room(rng)
        groups = [parallel(P, axis, rng, n) for axis, n in zip(np.eye(3), (30, 25, 20), strict=True)]
        clutter = rng.uniform(0, 600, (10, 1, 2)) + rng.uniform(-40, 40, (10, 2, 2))
        segments = np.concatenate([*groups, clutter]) + rng.normal(0, 0.4, (85, 2, 2))
        found = tr.vanishing_points(segments, threshold_px=1.2, seed=seed)
        sigmas.append(found.sigma_px)
        for v, C in zip(found.v, found.covariance, strict=True):
            truth = P[:, :3] / np.linalg.norm(P[:, :3], axis=0)
            off = min((s * t - v for t in truth.T for s in (1, -1)), key=np.linalg.norm)
            z.append(off @ np.linalg.pinv(C, rcond=1e-12, hermitian=True) @ off)
    assert len(z) == 90
    assert 0.9 < np.median(z) < 2.1  # 1.39 for two freedoms
    # Clutter and segments of two groups that point alike are among the members.
    assert 0.36 < np.mean(sigmas) < 0.55


def test_a_plane_is_rectified_by_parallels_and_right_angles():
    rng = np.random.default_rng(3)
    P = room(rng)
    G = P[:, [0, 1, 3]]

    def image(segments):
        x = np.concatenate([segments, np.ones((*segments.shape[:-1], 1))], axis=-1) @ G.T
        return x[..., :2] / x[..., 2:]

    start = rng.uniform(-2, 2, (2, 3, 2))
    groups = [
        image(np.stack([s, s + d], axis=1)) for s, d in zip(start, ([1.0, 0.2], [0.3, 1.0]), strict=True)
    ]
    turns = Rotation.from_euler("z", [[0.2], [0.9], [1.3]]).as_matrix()[:, :2, :2]
    pairs = image(np.stack([np.stack([np.zeros((3, 2)), t], 1) for t in (turns[:, 0], turns[:, 1])], axis=1))
    affine = tr.rectify_plane(groups).H @ G
    assert np.abs(affine[2, :2] / affine[2, 2]).max() < 1e-9
    found = tr.rectify_plane(groups, pairs)
    similar = found.H @ G
    similar = similar[:2, :2] / similar[2, 2]
    np.testing.assert_allclose(similar.T @ similar / np.linalg.norm(similar) ** 2 * 2, np.eye(2), atol=1e-8)
    horizon = np.cross(P[:, 0], P[:, 1])
    np.testing.assert_allclose(
        np.cross(found.vanishing_line, horizon / np.linalg.norm(horizon)), 0, atol=1e-9
    )
    with pytest.raises(tr.StageFailure, match="do not determine the plane"):
        tr.rectify_plane([groups[0], groups[0]])


def test_heights_are_those_of_the_scene_within_their_deviation():
    rng = np.random.default_rng(4)
    P = room(rng)
    base = np.column_stack([rng.uniform(-2, 2, 50), rng.uniform(-1, 3, 50), np.zeros(50)])
    z = rng.uniform(0.5, 2.5, 50)
    top = base + np.outer(z, [0, 0, 1])
    ends, tops = seen(P, base), seen(P, top)
    given = {"vertical": P[:, 2], "horizon": np.cross(P[:, 0], P[:, 1])}
    found = tr.single_view_heights(base=ends, top=tops, reference=[ends[0], tops[0]], height=z[0], **given)
    np.testing.assert_allclose(found.height, z, rtol=1e-9)
    noisy = [ends + rng.normal(0, 0.5, (50, 2)), tops + rng.normal(0, 0.5, (50, 2))]
    found = tr.single_view_heights(
        base=noisy[0], top=noisy[1], reference=[ends[0], tops[0]], height=z[0], sigma_px=0.5, **given
    )
    assert 0.6 < np.sqrt(np.mean(((found.height - z) / found.std) ** 2)) < 1.4


def board_images(rng, n, sigma):
    x, y = np.meshgrid(np.arange(9.0), np.arange(6.0))
    board = np.column_stack([x.ravel(), y.ravel()])
    R = Rotation.from_euler("xyz", rng.uniform(-0.6, 0.6, (n, 3))).as_matrix()
    t = np.column_stack([rng.uniform(-4.5, -2.5, (n, 2)) + np.array([0.0, 0.5]), rng.uniform(22, 26, n)])
    X = np.column_stack([board, np.zeros(len(board))])
    xy = np.stack([seen(K @ np.column_stack([r, s]), X) for r, s in zip(R, t, strict=True)])
    return board, xy + sigma * rng.normal(size=xy.shape), R


def test_a_printed_board_calibrates_the_camera_as_in_opencv():
    board, xy, R = board_images(np.random.default_rng(5), 8, 0.2)
    H = [tr.estimate_homography(board, one, threshold_px=None).H for one in xy]
    start = tr.calibrate_from_homographies(H, (640, 480))
    np.testing.assert_allclose(start[0].K[[0, 1], [0, 1]], [800, 820], rtol=0.02)
    found = tr.calibrate_from_homographies(H, (640, 480), board=board, xy=xy)
    assert found[0].std is not None
    assert abs(found[0].K[0, 0] - 800) < 4 * found[0].std["focal_px"] < 20
    assert all((np.trace(a.R.T @ b) - 1) / 2 > np.cos(0.02) for a, b in zip(found, R, strict=True))
    cv2 = pytest.importorskip("cv2", reason="OpenCV is in the extra validation")
    points = [np.column_stack([board, 0 * board[:, :1]]).astype(np.float32)] * len(xy)
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    reference = cv2.calibrateCamera(points, list(xy.astype(np.float32)), (640, 480), None, None, flags=flags)[
        1
    ]
    np.testing.assert_allclose(found[0].K, reference, atol=0.05)
    with pytest.raises(tr.StageFailure, match="do not determine the camera"):
        tr.calibrate_from_homographies([H[0]] * 3, (640, 480))


def test_a_camera_and_its_deviations_follow_from_its_matrix():
    rng = np.random.default_rng(6)
    R = Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix()
    X = rng.uniform(-1, 1, (60, 3)) + np.array([0, 0, 6])
    P = K @ np.column_stack([R, [0.1, 0.2, 0.4]])
    z = []
    for _ in range(40):
        fit = tr.resect(X, seen(P, X) + rng.normal(0, 0.3, (60, 2)), threshold_px=None)
        parts = tr.decompose_camera(fit.P, covariance=fit.covariance)
        off = parts.centre + R.T @ [0.1, 0.2, 0.4]
        z.append(off @ np.linalg.solve(parts.centre_covariance, off))
        np.testing.assert_allclose(parts.K @ np.column_stack([parts.R, parts.t]) / fit.P, 1 / fit.P[2, 2] * (
            parts.K @ np.column_stack([parts.R, parts.t]))[2, 2], rtol=1e-6)  # fmt: skip
    assert 1.5 < np.median(z) < 3.6  # 2.37 for three freedoms


def test_essential_matrices_of_fundamental_ones_and_their_four_poses():
    rng = np.random.default_rng(7)
    R, t = Rotation.from_rotvec([0.1, 0.3, -0.2]).as_matrix(), np.array([0.8, 0.1, 0.2])
    X = rng.uniform(-2, 2, (80, 3)) + np.array([0, 0, 7])
    exact = seen(K @ np.eye(3, 4), X), seen(K @ np.column_stack([R, t]), X)
    truth = tr.estimate_essential(*exact, K).E
    z = []
    for _ in range(30):
        xy = [x + rng.normal(0, 0.3, x.shape) for x in exact]
        fit = tr.estimate_fundamental(*xy, method="gold-standard")
        found = tr.essential_from_fundamental(fit.F, K, covariance=fit.covariance)
        E = found.E * np.sign(np.sum(found.E * truth))
        off = (E - truth).ravel()
        z.append(off @ np.linalg.pinv(found.covariance, rcond=1e-7, hermitian=True) @ off)
        np.testing.assert_allclose(np.linalg.svd(E)[1], [np.sqrt(0.5)] * 2 + [0], atol=1e-12)
    assert 2.5 < np.median(z) < 8.0  # 4.35 for five freedoms
    poses = tr.decompose_essential(truth, *exact, K)
    assert poses.in_front.tolist()[:2] == [1.0, 0.0]
    np.testing.assert_allclose(poses.R[0], R, atol=1e-9)
    np.testing.assert_allclose(poses.t[0], t / np.linalg.norm(t), atol=1e-9)
    cv2 = pytest.importorskip("cv2", reason="OpenCV is in the extra validation")
    R1, R2, _ = cv2.decomposeEssentialMat(truth)
    assert all(min(np.abs(r - one).max() for r in poses.R) < 1e-9 for one in (R1, R2))


@pytest.mark.parametrize("orthographic", [False, True])
def test_factorisation_finds_points_up_to_a_similarity(orthographic):
    rng = np.random.default_rng(8)
    X = rng.uniform(-1, 1, (60, 3))
    R = Rotation.from_euler("xyz", rng.uniform(-0.6, 0.6, (8, 3))).as_matrix()
    scale = np.full(8, 100.0) if orthographic else rng.uniform(80, 120, 8)
    xy = X @ R[:, :2].swapaxes(1, 2) * scale[:, None, None] + rng.uniform(200, 400, (8, 1, 2))
    noisy = xy + rng.normal(0, 0.5, xy.shape)
    found = tr.factorize_affine(noisy, orthographic=orthographic)
    assert found.sigma_px == pytest.approx(0.5, rel=0.1)
    centred = X - X.mean(axis=0)
    U, D, Vt = np.linalg.svd(found.X.T @ centred)
    moved = found.X @ (U @ Vt) * (D.sum() / np.sum(found.X**2))
    predicted = np.sqrt(np.trace(found.point_covariance)) * D.sum() / np.sum(found.X**2)
    assert 0.8 < np.sqrt(np.mean(np.sum((moved - centred) ** 2, axis=1))) / predicted < 1.3
    np.testing.assert_allclose(np.einsum("vi,vi->v", found.M[:, 0], found.M[:, 1]), 0, atol=0.02)
    with pytest.raises(tr.StageFailure, match="no metric frame"):
        tr.factorize_affine(X[:, :2] @ rng.normal(size=(8, 2, 2)))


def test_a_turning_camera_is_stitched():
    whole = Image.open(tr.sample() / "images" / "0002.jpg").reduce(2)
    pixels, images = np.asarray(whole, np.float64), []
    k = np.array([[500.0, 0, 255], [0, 500, 191], [0, 0, 1]])
    small = np.array([[500.0, 0, 119], [0, 500, 119], [0, 0, 1]])
    for angle in (-0.2, 0.0, 0.2):
        H = k @ Rotation.from_euler("y", angle).as_matrix() @ np.linalg.inv(small)
        y, x = np.mgrid[:240, :240]
        at = np.stack([x, y, np.ones_like(x)], axis=-1) @ H.T
        u, v = at[..., 0] / at[..., 2], at[..., 1] / at[..., 2]
        i, j = np.clip(v.astype(int), 0, 382), np.clip(u.astype(int), 0, 510)
        a, b = (v - i)[..., None], (u - j)[..., None]
        near = pixels[i, j] * (1 - b) + pixels[i, j + 1] * b
        images.append(near * (1 - a) + (pixels[i + 1, j] * (1 - b) + pixels[i + 1, j + 1] * b) * a)
    found = tr.stitch([np.rint(np.clip(one, 0, 255)).astype(np.uint8) for one in images])
    # The homographies between neighbours are those of the rotation.
    turn = small @ Rotation.from_euler("y", -0.2).as_matrix() @ np.linalg.inv(small)
    G = np.linalg.inv(found.H[1]) @ found.H[0]
    corners = np.array([[0.0, 0, 1], [239, 0, 1], [0, 239, 1], [239, 239, 1]])
    ours, true = corners @ G.T, corners @ turn.T
    assert np.abs(ours[:, :2] / ours[:, 2:] - true[:, :2] / true[:, 2:]).max() < 0.5
    assert found.seen.mean() > 0.8
