"""Chapter 7 from plain arrays: each method against the true camera, and its answer if it cannot be right."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import thesisrecon
from tests.conftest import refuses
from tests.synthetic import make_scene
from thesisrecon.api.calibrate import METHODS
from thesisrecon.api.cameras import reconstruction_from_cameras
from thesisrecon.camera import compose_camera
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.two_view import fundamental_from_cameras

G = np.eye(4) + 0.3 * np.random.default_rng(5).normal(size=(4, 4))
TRUE_PLANE = G[3] / np.linalg.norm(G[3])
SPHERE = np.radians([[0, -30, 5], [25, -15, 0], [-5, 0, 20], [15, 15, 0], [-20, 25, 5], [5, 40, -15]])


def pixels(scene):
    """All observations as (V, N, 2), NaN where not seen."""
    t = scene.tracks
    xy = np.full((t.n_views, t.n_points, 2), np.nan)
    xy[t.view_index, t.point_index] = t.xy
    return xy


def cameras_on_a_sphere():
    """Six cameras of 800 px that look at the centre of a sphere from its surface."""
    K = np.array([[800.0, 0, 319.5], [0, 800, 239.5], [0, 0, 1]])
    R = Rotation.from_euler("xyz", SPHERE).as_matrix()
    return compose_camera(np.tile(K, (6, 1, 1)), R, np.tile([0.0, 0, 5], (6, 1)))


def fundamentals(P):
    return np.stack([fundamental_from_cameras(P[i], P[j]) for i, j in combinations(range(len(P)), 2)])


@pytest.mark.parametrize("method", sorted(set(METHODS) - {"linear-quadric"}))
def test_every_method_is_exact_on_plain_cameras_and_close_under_noise(method):
    for sigma, most in ((0.0, 1e-6), (0.3, 0.03)):
        scene = make_scene(sigma_px=sigma, seed=1)
        xy, sizes = pixels(scene), scene.sizes[0]
        found = thesisrecon.self_calibrate(scene.P @ G, sizes, xy=xy, method=method)
        assert np.abs(found.K[:, 0, 0] / 1500.0 - 1.0).max() < most
        assert found.identifiable
        assert found.reasons == ()
        plane = thesisrecon.plane_at_infinity(scene.P @ G, sizes, xy=xy, method=method)
        assert np.abs(plane * np.sign(plane @ TRUE_PLANE) - TRUE_PLANE).max() < 1e-4


@pytest.mark.parametrize("method", ["nonlinear", "linear"])
def test_the_quadric_projects_to_the_calibrations(method):
    scene = make_scene(seed=1)
    found = thesisrecon.self_calibrate(scene.P @ G, scene.sizes, method=f"{method}-quadric")
    w = scene.P @ G @ found.Q @ (scene.P @ G).swapaxes(1, 2)
    w /= w[:, 2:, 2:]
    assert np.linalg.matrix_rank(found.Q, tol=1e-9) == 3
    if method == "nonlinear":
        np.testing.assert_allclose(w, scene.K @ scene.K.swapaxes(1, 2), rtol=1e-6)
        assert (found.identifiable, found.reasons) == (True, ())


def test_a_biased_focal_length_is_not_reported_without_a_reason():
    P = cameras_on_a_sphere()
    found = thesisrecon.self_calibrate(P @ G, (640, 480), method="linear-quadric")
    assert abs(found.K[0, 0, 0] / 800.0 - 1.0) > 0.1
    assert len(found.reasons) == 1
    assert "from that of bundle adjustment, 800 px" in found.reasons[0]


def test_cameras_without_points_are_checked_for_critical_motions():
    rng = np.random.default_rng(0)
    K = np.tile(np.array([[800.0, 0, 319.5], [0, 800, 239.5], [0, 0, 1]]), (6, 1, 1))
    t = rng.normal([0.0, 0.0, 5.0], 1.0, (6, 3))
    P = compose_camera(K, np.tile(np.eye(3), (6, 1, 1)), t)
    found = thesisrecon.self_calibrate(P @ G, (640, 480), method="nonlinear-quadric")
    assert not found.identifiable
    assert "pure translation" in found.reasons[0]
    words, given = "the cameras come without points; give xy", {"method": "stratified"}
    refuses(StageFailure, words, thesisrecon.self_calibrate, P @ G, (640, 480), **given)


@pytest.mark.parametrize("views", [3, 8])
def test_the_kruppa_equations_take_fundamental_matrices_alone(views):
    # With the prior that the principal point is near the middle of the image.
    shift, near = ((20.0, -12.0), 6.0) if views == 8 else ((0.0, 0.0), 1e-4)
    scene = make_scene(views=views, seed=1, principal_shift=shift)
    scale = np.random.default_rng(0).uniform(-2.0, 2.0, (views * (views - 1) // 2, 1, 1))
    K = thesisrecon.kruppa(scale * fundamentals(scene.P), scene.sizes)
    np.testing.assert_allclose(K, scene.K[0], rtol=1e-6, atol=near)


def test_kruppa_says_if_the_focal_length_is_undetermined():
    """Cameras on a sphere that look at its centre satisfy them with any focal length (Sturm 2000)."""
    P, text = cameras_on_a_sphere(), "do not determine the focal length; 15 pairs of views agree with any"
    refuses(StageFailure, text, thesisrecon.kruppa, fundamentals(P), (640, 480))
    refuses(StageFailure, text, thesisrecon.self_calibrate, P @ G, (640, 480), method="kruppa-equations")
    F = fundamentals(P)
    refuses(ValueError, "images of the same size", thesisrecon.kruppa, F, [(640, 480), (480, 640)])
    refuses(ValueError, "each of rank 2", thesisrecon.kruppa, np.ones((3, 3)), (640, 480))
    refuses(ValueError, r"kruppa needs F \(M, 3, 3\)", thesisrecon.kruppa, np.ones((4, 4)), (640, 480))


@pytest.mark.parametrize("views", [2, 5])
def test_vanishing_points_give_the_plane_at_infinity(views):
    scene = make_scene(views=views, seed=3)
    # The last one is at infinity in the first image.
    directions = np.vstack([np.random.default_rng(0).normal(size=(4, 3)), scene.R[0, 0]])
    v = np.einsum("vij,dj->vdi", scene.P[:, :, :3], directions)
    v[0, 4, 2] = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        places = v[..., :2] / v[..., 2:]
    for given in (v, np.where(np.isfinite(places), places, np.nan)):
        plane = thesisrecon.plane_at_infinity(scene.P @ G, scene.sizes, vanishing_points=given)
        assert np.abs(plane * np.sign(plane @ TRUE_PLANE) - TRUE_PLANE).max() < 1e-7
    v[1:, 2:] = np.nan
    flat = np.einsum("vij,dj->vdi", scene.P[:, :, :3], [[1.0, 0, 0], [0, 1, 0], [1, 1, 0]])
    locate, given = thesisrecon.plane_at_infinity, (scene.P @ G, scene.sizes)
    refuses(StageFailure, "three directions of parallel lines; 2 have", locate, *given, vanishing_points=v)
    refuses(StageFailure, "lie in one plane", locate, *given, vanishing_points=flat)


def test_vanishing_points_without_a_baseline_are_refused():
    scene = make_scene(views=3, seed=3)
    v = np.einsum("vij,dj->vdi", scene.P[:, :, :3], np.eye(3))
    C = -np.einsum("vji,vj->vi", scene.R, scene.t)
    along = np.einsum("vij,dj->vdi", scene.P[:2, :, :3], [[1.0, 0, 0], [0, 1, 0], C[1] - C[0]])
    turned = scene.K @ np.concatenate([scene.R, np.zeros((3, 3, 1))], axis=2)
    locate, sizes = thesisrecon.plane_at_infinity, scene.sizes
    two = scene.P[:2] @ G, sizes[:2]
    refuses(StageFailure, "2 have .* not parallel", locate, *two, vanishing_points=along)
    for P in (turned, turned @ G):
        refuses(StageFailure, "take images from different positions", locate, P, sizes, vanishing_points=v)
    refuses(StageFailure, "different positions", locate, scene.P[:1] @ G, sizes[:1], vanishing_points=v[:1])


def test_a_reconstruction_of_arrays_has_their_cameras_and_points():
    scene = make_scene(seed=4)
    xy = pixels(scene)
    metric = reconstruction_from_cameras(-2.0 * scene.P, sizes=scene.sizes, xy=xy)
    np.testing.assert_allclose(metric.K, scene.K, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(metric.P, scene.P, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(metric.X[:, :3], scene.X, atol=1e-6)
    np.testing.assert_array_equal(metric.tracks.xy, scene.tracks.xy)
    of_parts = reconstruction_from_cameras(scene.K[0], scene.R, scene.t, sizes=(1536, 1024), X=scene.X)
    np.testing.assert_allclose(of_parts.P, scene.P)
    assert len(of_parts.tracks.xy) == 0
    build = reconstruction_from_cameras
    refuses(ValueError, r"sizes are \(width, height\)", build, scene.P, sizes=scene.sizes[:, ::-1], xy=xy)
    refuses(ValueError, "needs P, or K, R and t", build, scene.K, scene.R, sizes=scene.sizes)
    refuses(ValueError, r"sizes \(V, 2\) or \(2,\)", build, scene.P, sizes=scene.sizes[:3])
    for K, R, words in (
        (scene.K[0].T, scene.R, "K upper triangular"),
        (scene.K[0], 2.0 * scene.R, "needs a rotation R; R'R deviates"),
        (scene.K[0], -scene.R, "got a reflection"),
    ):
        refuses(ValueError, words, build, K, R, scene.t, sizes=scene.sizes)


def test_cameras_without_points_are_identifiable_in_any_frame():
    """Without points some of the worlds are mirrored: the optical axes then meet behind the cameras."""
    K, target = np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]), np.array([0.0, 0, 6])
    P, rng = [], np.random.default_rng(0)
    for centre in rng.uniform(-2, 2, (6, 3)):
        z = (target - centre) / np.linalg.norm(target - centre)
        x = np.cross([0.1 * rng.normal(), 1, 0], z)
        R = np.stack([x / np.linalg.norm(x), np.cross(z, x / np.linalg.norm(x)), z])
        P.append(K @ np.column_stack([R, -R @ centre]))
    for seed in range(6):
        H = np.random.default_rng(seed).normal(size=(4, 4))
        found = thesisrecon.self_calibrate(np.array(P) @ H, (640, 480), method="nonlinear-quadric")
        assert found.identifiable, found.reasons
        assert found.K[0, 0, 0] == pytest.approx(900, rel=0.01)


def test_the_way_out_of_a_wrong_call_is_named():
    scene = make_scene(seed=4)
    metric = reconstruction_from_cameras(scene.P, sizes=scene.sizes)
    way_out = "its calibration is its field K already; .* result.projective"
    refuses(ValueError, way_out, thesisrecon.self_calibrate, metric)
    refuses(ValueError, "needs the sizes", thesisrecon.self_calibrate, scene.P)
    refuses(ValueError, "stratum='projective'", thesisrecon.upgrade_affine, scene.P)
    words = "unknown method 'kruppa-equation'; did you mean kruppa-equations"
    refuses(ValueError, words, thesisrecon.self_calibrate, scene.P, scene.sizes, method="kruppa-equation")


def test_kruppa_under_noise_is_close():
    scene = make_scene(sigma_px=0.3, seed=2)
    xy = pixels(scene)
    F = []
    for i, j in combinations(range(8), 2):
        both = np.isfinite(xy[i] + xy[j]).all(axis=1)
        F.append(thesisrecon.estimate_fundamental(xy[i, both], xy[j, both], method="gold-standard").F)
    assert abs(thesisrecon.kruppa(np.stack(F), scene.sizes)[0, 0] / 1500.0 - 1.0) < 0.03
