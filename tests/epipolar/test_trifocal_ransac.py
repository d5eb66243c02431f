"""Three views with wrong tracks: the six-point solver, its distances, the search, what it refuses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.epipolar.test_trifocal_estimation import (
    DATA,
    _read,
    line_transfer_px,
    matches,
    point_transfer_px,
    three_cameras,
)
from tests.geometry.properties import holds_for_every
from thesisrecon.epipolar.six_point import (
    SAMPLE,
    _score,
    draw_samples,
    search_trifocal,
    six_point,
    three_view_distances,
)
from thesisrecon.epipolar.trifocal_estimation import (
    NO_POINTS,
    NO_SEGMENTS,
    _off_principal_planes,
    estimate_trifocal,
    refine_trifocal,
)
from thesisrecon.epipolar.trifocal_ransac import TrifocalRansac, _line_distances_px, _track_noise
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_from_centre, decompose_camera, project
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.three_view import tensor_from_cameras
from thesisrecon.geometry.triangulation import triangulate_linear
from thesisrecon.numerics.levenberg_marquardt import minimize_residuals

SCALE = 1.0 / 300.0


def tracks(points):
    """Rows of six in a frame of one scale."""
    offsets = points - points.mean(axis=1, keepdims=True)
    return np.ascontiguousarray((SCALE * offsets).swapaxes(0, 1).reshape(-1, 6))


def distances(P, track):
    out = np.empty(len(track))
    three_view_distances(P, track, out)
    return out


def six_point_numpy(track):
    """The solver in plain NumPy: X6 from the pencil of (5.2) with a polynomial fitted to its determinant."""
    to_pixels, rows = [], [np.ones(6)]
    places = [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    fives, sixes = [], []
    for v in range(3):
        x = homogenize(track[:, 2 * v : 2 * v + 2])
        B = x[:3].T * np.linalg.solve(x[:3].T, x[3])
        five, six = np.linalg.solve(B, x[4]), np.linalg.solve(B, x[5])
        rows.append(np.array([six[i] * five[j] for i, j in places]) / np.linalg.norm(np.outer(six, five)))
        to_pixels.append(B)
        fives.append(five)
        sixes.append(six)
    family = np.zeros((2, 3, 3))
    for basis, null in zip(family, np.linalg.svd(np.array(rows))[2][4:], strict=True):
        for value, (i, j) in zip(null, places, strict=True):
            basis[i, j] = value
    at = np.array([0.0, 1.0, -1.0, 2.0])
    cubic = np.polyfit(at, [np.linalg.det(family[0] + a * family[1]) for a in at], 3)
    found = []
    for root in np.roots(cubic):
        if abs(root.imag) > 1e-9:
            continue
        G = family[0] + root.real * family[1]
        left, right = np.linalg.svd(G.T)[2][2], np.linalg.svd(G)[2][2]
        W, m, _ = np.linalg.svd(np.column_stack([right, -left * right, -left]))[2][2]
        X = np.append(W - m * left, W)
        P = []
        for B, five, six in zip(to_pixels, fives, sixes, strict=True):
            s, d, _ = np.linalg.svd(np.column_stack([five * X[:3], X[3] - X[:3], -six]))[2][2]
            camera = B @ np.column_stack([np.diag(s * five - d), np.full(3, d)])
            P.append(camera / np.linalg.norm(camera))
        found.append(np.stack(P))
    return found


@holds_for_every()
def test_six_tracks_determine_the_cameras_up_to_three_solutions(rng):
    P = three_cameras(rng)
    track = tracks(matches(P, rng, 30, 0, 0.0)[0])
    answers = np.empty((3, 3, 3, 4))
    count = six_point(track, np.arange(SAMPLE), answers)
    assert 1 <= count <= 3
    for answer in answers[:count]:
        assert distances(answer, track[:SAMPLE]).max() < 1e-6
    assert min(distances(answer, track).max() for answer in answers[:count]) < 1e-5


@holds_for_every(examples=20)
def test_the_compiled_solver_equals_numpy(rng):
    track = tracks(matches(three_cameras(rng), rng, SAMPLE, 0, 2.0)[0])
    answers, plain = np.empty((3, 3, 3, 4)), six_point_numpy(track)
    for answer in answers[: six_point(track, np.arange(SAMPLE), answers)]:
        T = tensor_from_cameras(*answer)
        nearest = max(abs(np.sum(T * tensor_from_cameras(*P))) for P in plain)
        assert nearest == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize("kind", ["equal", "two equal", "collinear"])
def test_degenerate_samples_have_no_or_finite_solutions(kind):
    rng = np.random.default_rng(0)
    track = tracks(matches(three_cameras(rng), rng, SAMPLE, 0, 0.0)[0])
    if kind == "equal":
        track[:] = track[0]
    if kind == "two equal":
        track[3] = track[1]
    if kind == "collinear":
        track[:3] = np.linspace(0.0, 1.0, 3)[:, None] * [1.0, 0.5, 0.3, 0.2, 1.0, 0.1]
    answers = np.empty((3, 3, 3, 4))
    count = six_point(track, np.arange(SAMPLE), answers)
    assert np.isfinite(answers[:count]).all()
    assert count == 0 or kind == "two equal"


def test_distances_are_those_of_the_least_reprojection_error():
    rng = np.random.default_rng(1)
    P = three_cameras(rng)
    points = matches(P, rng, 40, 0, 1.0)[0]
    track = tracks(points)
    H = np.tile(np.eye(3) * SCALE, (3, 1, 1))
    H[:, 2, 2], H[:, :2, 2] = 1.0, -SCALE * points.mean(axis=1)
    cameras = H @ P
    cameras /= np.linalg.norm(cameras, axis=(1, 2), keepdims=True)
    found = distances(cameras, track)
    X = triangulate_linear(P, points)
    for k in range(0, 40, 8):
        start = X[k, :3] / X[k, 3]

        def off(x, k=k):
            return (np.stack([project(camera, x[None])[0] for camera in P]) - points[:, k]).ravel()

        best = minimize_residuals(off, start).x
        assert found[k] / SCALE == pytest.approx(np.linalg.norm(off(best)), rel=1e-4)
    squared = (found / 0.01) ** 2
    plain = np.mean([np.maximum(0.0, 1.0 - squared / w**2).sum() for w in (1.0, 2.0, 4.0)])
    assert _score(cameras, track, 1e4, 0.0) == pytest.approx(plain, rel=1e-9)
    assert _score(cameras, track, 1e4, plain + 1.0) == 0.0


def test_the_search_keeps_the_best_model():
    rng = np.random.default_rng(2)
    track = tracks(matches(three_cameras(rng), rng, 60, 0, 0.3)[0])
    best, samples = np.zeros((3, 3, 4)), draw_samples(rng.random((50, SAMPLE)), 60)
    found = search_trifocal(track, samples, track, 2.0 * SCALE, 0.0, best)
    assert found == pytest.approx(_score(best, track, 1.0 / (2.0 * SCALE) ** 2, 0.0))
    assert search_trifocal(track, samples, track, 2.0 * SCALE, 60.0, np.zeros((3, 3, 4))) == 60.0


@pytest.mark.parametrize("sigma", [0.1, 0.5, 2.0])
def test_the_noise_of_tracks_is_found_among_wrong_ones(sigma):
    rng = np.random.default_rng(3)
    right = sigma * np.linalg.norm(rng.normal(size=(300, 3)), axis=1)
    wrong = 600.0 * rng.random(300) ** (1.0 / 3.0)
    assert _track_noise(np.append(right, wrong), 2.0, 600.0) == pytest.approx(sigma, rel=0.08)
    assert _track_noise(np.zeros(20), 2.0, 600.0) < 1e-4


def planted(rng, n, share, sigma):
    """Cameras, tracks with a share of them put anywhere, which they are."""
    P = three_cameras(rng)
    points = matches(P, rng, n, 0, sigma)[0]
    wrong = rng.random(n) < share
    low, high = points.min(axis=1, keepdims=True), points.max(axis=1, keepdims=True)
    points[:, wrong] = rng.uniform(low, high, (3, n, 2))[:, wrong]
    return P, points, wrong


@pytest.mark.parametrize("share", [0.3, 0.5])
@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_wrong_tracks_do_not_change_the_result_of_right_ones(share, sigma):
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        P, points, wrong = planted(rng, 80, share, sigma)
        exact = matches(P, rng, 100, 0, 0.0)[0]
        found = TrifocalRansac().estimate(points, rng=rng)
        alone = refine_trifocal(tensor_from_cameras(*P), points[:, ~wrong], NO_SEGMENTS, loss_px=3.0 * sigma)
        errors.append([np.median(point_transfer_px(T, exact)) for T in (found.fit.T, alone.T)])
        assert not (found.inliers & wrong).any()
        assert (found.inliers & ~wrong).sum() >= 0.9 * (~wrong).sum()
    ours, theirs = np.mean(errors, axis=0)
    assert ours <= 1.1 * theirs


def test_lines_that_agree_join_the_tracks():
    rng = np.random.default_rng(4)
    P = three_cameras(rng)
    points, segments = matches(P, rng, 60, 40, 0.3)
    points[1, :25] = rng.uniform(200.0, 1000.0, (25, 2))
    segments[2, :10] = segments[2, 9::-1]
    found = TrifocalRansac().estimate(points, segments)
    assert found.line_inliers[10:].mean() > 0.95
    assert found.line_inliers[:10].sum() <= 1
    assert not found.inliers[:25].any()
    assert found.inliers[25:].mean() > 0.95
    assert found.fit.lines.shape[0] == found.line_inliers.sum()
    np.testing.assert_allclose(_line_distances_px(P, matches(P, rng, 0, 9, 0.0)[1]), 0.0, atol=1e-6)


def test_same_generator_same_bytes():
    points = planted(np.random.default_rng(5), 60, 0.4, 0.5)[1]
    one, two = (TrifocalRansac().estimate(points, rng=np.random.default_rng(7)) for _ in range(2))
    assert one.fit.T.tobytes() == two.fit.T.tobytes()


@pytest.mark.parametrize("kind", ["plane", "rotation", "line", "chance", "equal", "few"])
def test_tracks_that_cannot_work_are_named(kind):
    rng = np.random.default_rng(6)
    P, X = three_cameras(rng), rng.uniform(-2.0, 2.0, (60, 3))
    if kind == "plane":
        X[:, 2] = 0.3 * X[:, 0]
    if kind == "line":
        X = np.outer(np.linspace(-2.0, 2.0, 60), [1.0, 0.3, 0.2])
    if kind == "rotation":
        P = np.stack([camera_from_centre(*decompose_camera(p)[:2], np.array([0.0, 0.0, -8.0])) for p in P])
    for sigma in (0.0, 0.5):
        points = np.stack([project(camera, X) for camera in P])
        points = points + sigma * rng.normal(size=points.shape)
        if kind == "chance":
            points = rng.uniform(0.0, 1000.0, points.shape)
        if kind == "equal":
            points[:] = 3.0
        with pytest.raises(StageFailure) as caught:
            TrifocalRansac(max_samples=2000).estimate(points[:, :8] if kind == "few" else points)
        assert "; " in str(caught.value)


@pytest.mark.parametrize("off", [0, 12])
def test_a_plane_among_wrong_tracks_is_named_and_a_tenth_off_it_is_enough(off):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        P, X = three_cameras(rng), rng.uniform(-2.0, 2.0, (120, 3))
        X[off:, 2] = 0.3 * X[off:, 0]
        points = np.stack([project(camera, X) for camera in P])
        points += rng.normal(0.0, 0.5, points.shape)
        wrong = np.arange(120) >= 90
        points[:, wrong] = rng.uniform(200.0, 1000.0, (3, 30, 2))
        if not off:
            with pytest.raises(StageFailure, match="do not determine"):
                TrifocalRansac().estimate(points, rng=rng)
            continue
        found = TrifocalRansac().estimate(points, rng=rng)
        assert np.median(point_transfer_px(found.fit.T, matches(P, rng, 50, 0, 0.0)[0])) < 1.5


def test_wrong_calls():
    for wrong in (np.ones((3, 8)), np.full((3, 12, 2), np.nan), np.ones((2, 12, 2))):
        with pytest.raises(ValueError, match=r"needs points|finite"):
            TrifocalRansac().estimate(wrong)
    for bad in ({"threshold_px": 0.0}, {"confidence": 1.0}, {"max_samples": 0}, {"threshold_px": np.nan}):
        with pytest.raises(ValueError, match="threshold_px"):
            TrifocalRansac(**bad)


KINDS = ["scene", "integers", "huge", "tiny", "few places", "one view still", "line", "duplicates", "nan"]


def _strange(rng, kind, n, m):
    points, segments = matches(three_cameras(rng), rng, n, m, float(rng.choice([0.0, 0.5])))
    if kind == "integers":
        points, segments = rng.integers(0, 4, points.shape) * 1.0, rng.integers(0, 4, segments.shape) * 1.0
    if kind in ("huge", "tiny"):
        factor = 1e9 if kind == "huge" else 1e-9
        points, segments = factor * points, factor * segments
    if kind == "few places" and n:
        points = points[:, rng.integers(0, min(n, 4), n)]
    if kind == "one view still" and n:
        points[1] = points[1, :1]
    if kind == "line":
        points[..., 1], segments[..., 1] = 2.0 * points[..., 0], 2.0 * segments[..., 0]
    if kind == "duplicates":
        points[1:], segments[1:] = points[0], segments[0]
    if kind == "nan" and points.size:
        points.flat[rng.integers(points.size)] = np.nan
    return points, segments


def _outcome(attempt):
    try:
        return None, attempt()
    except (ValueError, StageFailure) as failure:
        return failure, None


@given(st.integers(0, 10**6), st.sampled_from(KINDS), st.integers(0, 20), st.integers(0, 20))
@settings(max_examples=120, deadline=None, derandomize=True, database=None)
def test_any_input_gives_numbers_or_a_named_failure(seed, kind, n, m):
    rng = np.random.default_rng(seed)
    points, segments = _strange(rng, kind, n, m)
    for attempt in (
        lambda: estimate_trifocal(points, segments, max_iterations=10),
        lambda: TrifocalRansac(max_samples=100).estimate(points, segments).fit,
    ):
        failure, fit = _outcome(attempt)
        assert not isinstance(failure, np.linalg.LinAlgError)
        if fit is None:
            assert str(failure)
            continue
        for array in (fit.T, fit.P, fit.X, fit.lines, fit.covariance, fit.point_residuals_px):
            assert np.isfinite(array).all()
        assert np.isfinite([fit.sigma_px, fit.relative_std]).all()


@pytest.mark.parametrize("kind", ["plane", "rotation", "parallel"])
@pytest.mark.parametrize("sigma", [0.0, 0.2, 1.0, 2.0])
def test_noisy_lines_that_leave_the_tensor_free_are_named(kind, sigma):
    for seed, m in enumerate((13, 20, 60)):
        rng = np.random.default_rng(seed)
        P, A, B = three_cameras(rng), rng.uniform(-2.0, 2.0, (m, 3)), rng.uniform(-2.0, 2.0, (m, 3))
        if kind == "plane":
            A[:, 2], B[:, 2] = 0.3 * A[:, 0], 0.3 * B[:, 0]
        if kind == "parallel":
            B = A + np.array([1.5, 0.3, 0.2])
        if kind == "rotation":
            turned = [decompose_camera(p)[:2] for p in P]
            P = np.stack([camera_from_centre(*parts, np.array([0.0, 0.0, -8.0])) for parts in turned])
        segments = np.stack([np.stack([project(c, A), project(c, B)], axis=1) for c in P])
        with pytest.raises(StageFailure, match="do not determine"):
            estimate_trifocal(NO_POINTS, segments + sigma * rng.normal(size=segments.shape))


@pytest.mark.real
@pytest.mark.skipif(not (DATA / "merton1").is_dir(), reason="the photographs of merton1 are not here")
@pytest.mark.parametrize("share", [0.0, 0.3, 0.5])
def test_merton_college_with_wrong_tracks(share):
    points, segments = _read("corners"), _read("lines").reshape(3, -1, 2, 2)
    rng = np.random.default_rng(int(10 * share))
    given_points, n = points.copy(), points.shape[1]
    wrong = np.zeros(n, dtype=bool)
    wrong[rng.permutation(n)[: int(share * n)]] = True
    given_points[:, wrong] = rng.uniform((0.0, 0.0), (1024.0, 768.0), (3, n, 2))[:, wrong]
    found = TrifocalRansac().estimate(given_points, rng=rng)
    assert not (found.inliers & wrong).any()
    assert found.inliers[~wrong].mean() > 0.95
    assert np.median(point_transfer_px(found.fit.T, points)) <= 1.0
    assert np.median(line_transfer_px(found.fit.T, segments)) <= 1.0


def test_a_start_on_a_principal_plane_does_not_divide_by_zero():
    P = np.stack([np.eye(3, 4), *np.random.default_rng(0).normal(size=(2, 3, 4))])
    X = _off_principal_planes(np.array([[1.0, 2.0, 0.0, 0.5], [1.0, 2.0, 3.0, 0.5]]), P)
    assert (np.einsum("va,na->nv", P[:, 2], X) != 0.0).all()
    np.testing.assert_allclose(X[1], np.array([1.0, 2.0, 3.0, 0.5]) / np.linalg.norm([1.0, 2.0, 3.0, 0.5]))
    rng = np.random.default_rng(928)
    for few in rng.integers(0, 4, (15, 3, 8, 2)) * 1.0:
        failure, fit = _outcome(lambda few=few: estimate_trifocal(few, max_iterations=5))
        assert failure is not None or np.isfinite(fit.T).all()
    with pytest.raises(ValueError, match="beyond"):
        estimate_trifocal(np.full((3, 8, 2), 1e20) * rng.random((3, 8, 2)))
