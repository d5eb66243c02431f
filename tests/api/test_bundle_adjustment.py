"""Bundle adjustment in one call: truth within its covariance, shared or own cameras, priors, bad input."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.api.test_dense_model import example
from tests.conftest import refuses
from tests.synthetic import reconstruction_of
from thesisrecon import Camera, Tracks, bundle_adjust

NOISE = 0.4


def _scene(seed=0, focals=(900.0,) * 6):
    """True cameras, points, and noisy pixels (V, N, 2) of which every fifth is missing."""
    rng = np.random.default_rng(seed)
    angles = [[a, 0.3 * np.sin(5 * a), a] for a in np.linspace(-0.7, 0.7, 6)]
    R, t = Rotation.from_euler("yxz", angles).as_matrix(), np.array([0.1, 0, 6])
    K = [np.array([[f, 0, 325.0], [0, f, 236], [0, 0, 1]]) for f in focals]
    cameras = [Camera(k, r, t, (640, 480), np.array([0.03])) for k, r in zip(K, R, strict=True)]
    X = rng.uniform(-1.2, 1.2, (120, 3))
    xy = np.stack([camera.project(X) for camera in cameras]) + NOISE * rng.normal(size=(6, 120, 2))
    xy[rng.random((6, 120)) < 0.2] = np.nan
    return cameras, X, xy


def _start(cameras, X, seed=1):
    """The scene moved off the truth, and without distortion."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(0.01 * rng.normal(size=(len(cameras), 3))).as_matrix()
    K = cameras[0].K * np.array([[1.03], [1.03], [1.0]])
    moves = zip(cameras, turn, strict=True)
    moved = [Camera(K, r @ c.R, c.t + 0.02 * rng.normal(size=3), c.size) for c, r in moves]
    return moved, X + 0.02 * rng.normal(size=X.shape)


def test_truth_lies_within_the_stated_covariance():
    scores = []
    for seed in range(6):
        cameras, X, xy = _scene(seed)
        found = bundle_adjust(*_start(cameras, X), xy, free=("focal", "principal_point", "k1"))
        assert found.sigma_px == pytest.approx(NOISE, rel=0.1)
        assert len({camera.K[0, 0] for camera in found.cameras}) == 1
        one = found.cameras[0]
        off = [one.K[0, 0] - 900.0, one.K[0, 2] - 325.0, one.K[1, 2] - 236.0, one.distortion[0] - 0.03]
        stds = [one.std[name] for name in ("focal_px", "principal_x_px", "principal_y_px", "k1")]
        scores += (np.array(off) / stds).tolist()
        assert one.std["aspect"] == 0.0
        assert one.K[1, 1] == pytest.approx(one.K[0, 0])
        assert 0.5 * NOISE < np.nanstd(found.residual_px) < NOISE
        assert (np.isnan(found.residual_px) == np.isnan(xy)).all()
        axis = found.cameras[3].R[2]
        depth_variance = axis @ found.centre_covariance[3] @ axis
        assert depth_variance == pytest.approx(found.pose_covariance[3, 5, 5])
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.4


@pytest.mark.parametrize(("lens", "k", "free"), [
    ("brown", [-0.1, 0.03, 0.002, -0.003], ("k1", "k2", "p1", "p2")), ("division", [-0.2], ("k1",)),
    ("fisheye", [-0.03, 0.01, 0.002, -0.001], ("k1", "k2", "k3", "k4")),
    ("thin-prism-fisheye", [-0.03, 0.01, 0.002, -0.003], ("k1", "k2", "p1", "p2")),
])  # fmt: skip
def test_every_lens_is_within_its_covariance(lens, k, free):
    rng, names = np.random.default_rng(3), ("focal_px", "principal_x_px", "principal_y_px", *free)
    K, scores = np.array([[330.0, 0, 325.0], [0, 330.0, 236], [0, 0, 1]]), []
    near = K * [[1.01], [1.01], [1.0]]
    for _ in range(4):
        R = Rotation.from_rotvec(rng.normal(0.0, 0.5, (8, 3))).as_matrix()
        R = np.concatenate([R, R @ Rotation.from_euler("y", 180, degrees=True).as_matrix()])
        true = [Camera(K, r, 0.3 * rng.normal(size=3), (640, 480), np.array(k), lens=lens) for r in R]
        X = rng.normal(size=(800, 3))
        X *= rng.uniform(2.0, 4.0, (800, 1)) / np.linalg.norm(X, axis=1, keepdims=True)
        xy = np.stack([camera.project(X) for camera in true])
        ahead = np.stack([(X @ c.R.T + c.t)[:, 2] > 0.3 for c in true])
        seen = ahead & (xy > 0.0).all(axis=2) & (xy < [639.0, 479.0]).all(axis=2)
        xy = np.where(seen[..., None], xy + NOISE * rng.normal(size=xy.shape), np.nan)
        start = [Camera(near, c.R, c.t, c.size, 0.8 * np.array(k), lens=lens) for c in true]
        found = bundle_adjust(start, X, xy, free=("focal", "principal_point", *free))
        assert found.converged
        assert found.sigma_px == pytest.approx(NOISE, rel=0.1)
        one = found.cameras[0]
        assert one.lens == lens
        off = [*(one.K - K)[[0, 0, 1], [0, 2, 2]], *(one.distortion[: len(k)] - k)]
        scores.append(np.array(off) / [one.std[name] for name in names])
        assert found.intrinsics_covariance.shape == (16, 11, 11)
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6


def test_coefficients_that_a_lens_lacks_are_refused():
    cameras, X, xy = _scene()
    refuses(ValueError, "k4 is a coefficient of fisheye", bundle_adjust, cameras, X, xy, free=("k4",))
    bent = [Camera(c.K, c.R, c.t, c.size, np.array([-0.1]), lens="division") for c in cameras]
    refuses(ValueError, "a division lens has k1 only", bundle_adjust, bent, X, xy, free=("k2",))
    prism = np.array([0, 0, 0, 0, 0, 0, 0.01, 0.0])
    thin = [Camera(c.K, c.R, c.t, c.size, prism, lens="thin-prism-fisheye") for c in cameras]
    refuses(ValueError, "takes lenses with k1 to k4, p1 and p2", bundle_adjust, thin, X, xy)


def test_cameras_are_shared_by_size_or_number_or_not_at_all():
    focals = (900.0, 900.0, 900.0, 700.0, 700.0, 700.0)
    cameras, X, xy = _scene(focals=focals)
    start = [Camera(c.K, c.R, c.t, c.size) for c in cameras]
    for shared in (False, np.array([4, 4, 4, 1, 1, 1])):
        found = bundle_adjust(start, X, xy, shared=shared, loss="squared")
        got = [camera.K[0, 0] for camera in found.cameras]
        assert np.abs(np.array(got) - focals).max() < 6.0
        assert len(set(got)) == (6 if shared is False else 2)
        assert found.sigma_px == pytest.approx(NOISE, rel=0.1)
    assert bundle_adjust(start, X, xy).sigma_px > 2.0 * NOISE
    held = bundle_adjust(start, X, xy, shared=False, prior={"focal": 1e-6, "k1": 1e-6})
    assert np.abs([camera.K[0, 0] for camera in held.cameras] - np.array(focals)).max() < 0.01
    assert held.cameras[0].std["focal_px"] == pytest.approx(900.0 * 1e-6, rel=0.01)


def test_the_prior_of_a_shared_value_is_about_the_mean_of_the_given_cameras():
    focals = (800.0, 840.0) * 3
    cameras, X, xy = _scene(focals=(820.0,) * 6)
    found = []
    for given in (focals, focals[::-1]):
        K = [c.K * [[f / 820.0], [f / 820.0], [1.0]] for c, f in zip(cameras, given, strict=True)]
        start = [Camera(k, c.R, c.t, c.size) for k, c in zip(K, cameras, strict=True)]
        found.append(bundle_adjust(start, X, xy, prior={"focal": 1e-5}).cameras[0])
    assert found[0].K[0, 0] == pytest.approx(np.sqrt(800.0 * 840.0), rel=1e-4)
    assert found[1].K[0, 0] == pytest.approx(found[0].K[0, 0], rel=1e-6)


def test_a_view_without_observations_keeps_its_pose_without_certainty():
    cameras, X, xy = _scene()
    xy[3] = np.nan
    found = bundle_adjust(cameras, X, xy)
    np.testing.assert_array_equal(found.cameras[3].R, cameras[3].R)
    np.testing.assert_array_equal(found.cameras[3].t, cameras[3].t)
    for covariance in (found.pose_covariance, found.centre_covariance):
        finite = np.isfinite(covariance).all(axis=(1, 2))
        assert finite.tolist() == [True, True, True, False, True, True]
        assert np.isinf(np.diag(covariance[3])).all()
        assert not np.isnan(covariance).any()


def test_arrays_lists_of_observations_and_reconstructions_give_the_same():
    cameras, X, xy = _scene()
    start, X0 = _start(cameras, X)
    found = bundle_adjust(start, X0, xy)
    arrays = tuple(np.array([getattr(camera, name) for camera in start]) for name in ("K", "R", "t"))
    point, view = np.nonzero(np.isfinite(xy[:, :, 0]).T)
    tracks = Tracks(view, point, xy[view, point], 6, 120)
    P, Xh = np.array([c.P for c in start]), np.column_stack([X0, np.ones(120)])
    model = reconstruction_of(P, [640, 480], X=Xh, tracks=tracks, sigma_px=1.0, K=arrays[0])
    for again in (
        bundle_adjust((arrays[0][0], *arrays[1:]), X0, xy, sizes=(640, 480)),
        bundle_adjust(start, X0, tracks),
        bundle_adjust(model),
    ):
        np.testing.assert_allclose(again.X, found.X, rtol=0, atol=1e-7)
        np.testing.assert_allclose(again.point_covariance, found.point_covariance, rtol=1e-4, atol=1e-12)


def test_the_example_states_the_standard_deviations(capsys):
    cameras, X, xy = _scene()
    K, R, t = (np.array([getattr(camera, name) for camera in cameras]) for name in ("K", "R", "t"))
    given = {"K": K[0], "R": R, "t": t, "X": X, "xy": xy}
    exec(example("bundle adjustment"), given)
    assert capsys.readouterr().out.startswith("focal length 9")
    seen = np.isfinite(xy[:, :, 0]).sum(axis=0)
    assert 0.0 < given["point_std"][seen > 2].max() < 0.1
    assert (np.isinf(given["point_std"]) == (seen < 2)).all()
    assert 0.0 < given["centre_std"].min() < given["centre_std"].max() < 0.1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"free": ("focus",)}, "focal"), ({"prior": {"k2": 0.1}}, "not among the free intrinsics"),
        ({"prior": {"focal": 0.0}}, "must be above 0"), ({"sigma_px": 0.0}, "must be positive"),
        ({"loss": "l1"}, "huber, squared"), ({"shared": [0, 1]}, "camera number per view"),
        ({"xy": np.zeros((6, 119, 2))}, r"needs xy \(6, 120, 2\)"),
        ({"X": np.full((120, 3), np.nan)}, "finite"),
        ({"xy": np.full((6, 120, 2), np.nan)}, "0 views give 0 equations"),
        ({"cameras": (np.eye(3), np.zeros((6, 3, 3)), np.zeros((6, 3)))}, "needs sizes"),
        ({"cameras": "inverse"}, "R is world to camera"),
        ({"cameras": "run/out"}, "there is no run/out; give the folder of a run"),
        ({"cameras": (np.eye(3) * 0, np.zeros((6, 3, 3)), np.zeros((6, 3))), "sizes": (9, 9)}, "K upper"),
        ({"cameras": "turned"}, r"sizes are \(width, height\)"),
        ({"fixed_cameras": [7]}, "fixed_cameras must be numbers from 0 to 5"),
        ({"covariances": np.ones(3)}, "covariances must have the shape"),
        ({"covariances": np.zeros((6, 120))}, "positive"), ({"gauge": "first"}, "inner, two-cameras"),
        ({"positions": np.zeros((3, 3))}, r"positions must have the shape \(6, 3\)"),
        ({"positions": np.zeros((6, 3)), "position_std": 0.0}, "must be above 0"),
        ({"gauge": "two-cameras", "fixed_points": [1]}, "without fixed or known"),
        ({"prior": {"focal": np.ones(3)}}, "a number or one per camera"),
    ],
)  # fmt: skip
def test_wrong_input_gets_one_sentence(change, says):
    cameras, X, xy = _scene()
    given = {"cameras": cameras, "X": X, "xy": xy} | change
    if given["cameras"] == "turned":
        given["cameras"] = [Camera(c.K, c.R, c.t, c.size[::-1]) for c in cameras]
    if given["cameras"] == "inverse":
        given["cameras"] = [Camera(c.K, c.R, c.centre, c.size) for c in cameras]
        given["X"] = X - np.array([0.0, 0, 20])
    refuses(ValueError, says, bundle_adjust, **given)
