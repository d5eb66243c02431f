"""A camera that sees few points of the model is registered only if its other matches confirm the pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesisrecon import Camera, Tracks
from thesisrecon.arrays import rows_of_views
from thesisrecon.metric import _resection
from thesisrecon.metric._model import MetricEstimate
from thesisrecon.metric._resection import FEWEST_POINTS, MIN_MATCHES, confirmed_pose
from thesisrecon.optimize.bundle.projection import MetricCameras

SIZE, NOISE_PX, FOCAL = (640, 480), 0.3, 700.0
K = np.array([[FOCAL, 0, 319.5], [0, FOCAL, 239.5], [0, 0, 1]])
MODEL, MATCHES, DRAWS = 80, 60, 20


def camera(x, angles=(0, 0, 0)):
    R = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return Camera(K, R, -R @ [x, 0, 0], SIZE)


CAMERAS = [camera(-2), camera(-1, (4, -3, 8)), camera(0, (-3, 2, -5)), camera(2, (2, -4, 10))]


def model(points=8, matches=MATCHES, seed=0, *, points_from=CAMERAS[3], matches_from=CAMERAS[3]):
    """Three registered cameras; the last one sees a few points and has matches to its neighbour only."""
    rng = np.random.default_rng(seed)
    X = rng.uniform([-1.5, -1.5, 5], [1.5, 1.5, 8], (MODEL + matches, 3))
    total = MODEL + matches
    seen = np.zeros((4, total), dtype=bool)
    seen[:3, :MODEL], seen[3, :points], seen[2:, MODEL:] = True, True, True
    point, view = np.nonzero(seen.T)
    pixels = np.array([c.project(X) for c in CAMERAS])
    pixels[3] = np.concatenate([points_from.project(X[:MODEL]), matches_from.project(X[MODEL:])])
    tracks = Tracks(view, point, pixels[view, point] + rng.normal(0, NOISE_PX, (len(view), 2)), 4, total)
    R, t = np.array([c.R for c in CAMERAS]), np.array([c.t for c in CAMERAS])
    R[3], t[3] = np.eye(3), 0.0
    row = np.array([[FOCAL, 1, 0, *K[:2, 2], 0, 0, 0]])
    cameras = MetricCameras(R, t, row, np.zeros(4, np.int64), np.zeros((1, 8), np.int64))
    valid = np.arange(total) < MODEL
    there = np.arange(4) < 3
    inlier = valid[point] & there[view]
    sizes = np.tile(SIZE, (4, 1))
    return MetricEstimate(tracks, sizes, cameras, there, X * valid[:, None], valid, inlier, NOISE_PX)


def pose_of(found, seed=0):
    rows = rows_of_views(found.tracks.view_index, 4)[3]
    return confirmed_pose(found, 3, rows, np.random.default_rng(seed))


def with_random_pixels(found, which, seed):
    rng, t = np.random.default_rng(seed), found.tracks
    k = np.flatnonzero((t.view_index == 3) & which(t.point_index))
    t.xy[k] = rng.uniform(0, SIZE, (len(k), 2))
    return found


@pytest.mark.parametrize("points", [FEWEST_POINTS, 8, 14])
def test_few_points_and_other_matches_determine_the_pose(points):
    R, t = pose_of(model(points))
    assert np.degrees(np.linalg.norm(Rotation.from_matrix(R @ CAMERAS[3].R.T).as_rotvec())) < 0.2
    assert np.linalg.norm(-R.T @ t - CAMERAS[3].centre) < 0.05


def test_wrong_matches_and_wrong_points_among_them_do_not_matter():
    found = with_random_pixels(model(10), lambda point: point < 3, 0)
    found = with_random_pixels(found, lambda point: point >= MODEL + 0.7 * MATCHES, 1)
    R, t = pose_of(found)
    assert np.linalg.norm(-R.T @ t - CAMERAS[3].centre) < 0.05


@pytest.mark.parametrize(("points", "matches"), [(FEWEST_POINTS - 1, MATCHES), (8, MIN_MATCHES - 1)])
def test_fewer_points_or_matches_are_not_enough(points, matches):
    assert pose_of(model(points, matches)) is None


@pytest.mark.parametrize(("first", "last"), [(0, MODEL), (MODEL, MODEL + MATCHES), (0, MODEL + MATCHES)])
def test_random_points_or_matches_or_both_are_never_accepted(first, last):
    for seed in range(DRAWS):
        found = with_random_pixels(model(8, seed=seed), lambda point: (first <= point) & (point < last), seed)
        assert pose_of(found, seed) is None


def test_an_image_of_a_similar_place_is_never_accepted():
    """Points from one place and matches from another that looks like it have each a camera, not the same."""
    rng = np.random.default_rng(0)
    for seed in range(DRAWS):
        other = camera(rng.uniform(-3, 3), rng.normal(0, 8, 3))
        assert pose_of(model(12, seed=seed, points_from=other), seed) is None
        assert pose_of(model(12, seed=seed, matches_from=other), seed) is None


def test_the_metric_stage_registers_it():
    every = np.ones(4, dtype=bool)
    for points, reasons in ((8, {}), (0, {3: ""})):
        found = model(8, MATCHES if points else 0)
        rows = rows_of_views(found.tracks.view_index, 4)
        grown, rejected = _resection.register_next(found, np.random.default_rng(0), every, rows)
        assert bool(grown.registered[3]) == bool(points)
        assert rejected == reasons
