"""An image that joins known cameras may see points that leave two poses possible: the other one is named."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesisrecon.metric.given_cameras import GivenCameras, metric_from_given
from thesisrecon.records import IntrinsicsPrior, Tracks

ROW = np.array([800.0, 1.0, 0.0, 320.0, 240.0, 0.0])
AROUND = Rotation.from_euler("xyz", [[25, 0, 0], [-25, 0, 0], [0, 25, 0], [0, -25, 0]], degrees=True)


def located(X, distance, rng):
    """Turn (3,) and deviations (3,) in degrees of an image of X (N, 3), known from four cameras; warnings."""
    n, turn = len(X), Rotation.from_euler("xyz", rng.uniform([25, -20, -20], [50, 20, 20]), degrees=True)
    R = np.concatenate([AROUND.as_matrix(), turn.as_matrix()[None]])
    t = np.array([[0.0, 0.0, 3.0]] * 4 + [[0.0, 0.0, distance]])
    Y = np.einsum("vab,nb->nva", R, X) + t
    xy = 800.0 * Y[:, :, :2] / Y[:, :, 2:] + [320.0, 240.0] + 0.3 * rng.normal(size=(n, 5, 2))
    tracks = Tracks(np.tile(np.arange(5), n), np.repeat(np.arange(n), 5), xy.reshape(-1, 2), 5, n)
    rows = np.tile(np.append(ROW, [0.0, 0.0]), (5, 1))
    given = GivenCameras(np.arange(5) < 4, R, t, rows, ({},) * 5, of_images=True)
    prior = IntrinsicsPrior.unshared(np.tile(ROW, (5, 1)), np.zeros((5, 6)))
    sizes = np.tile([640, 480], (5, 1))
    found = metric_from_given(given, tracks, sizes, noise_px=0.3, prior=prior, rng=rng)
    P = found.reconstruction.P[4]
    pose = np.linalg.solve(found.reconstruction.K[4], P)
    pose /= np.cbrt(np.linalg.det(pose[:, :3]))
    off = Rotation.from_matrix(pose[:, :3] @ R[4].T).as_rotvec()
    return np.degrees(off), np.degrees(found.pose_std[4, :3]), found.warnings


def points(kind, rng):
    grid = np.linspace(-0.5, 0.5, 7)
    X = np.column_stack([*(axis.ravel() for axis in np.meshgrid(grid, grid)), np.zeros(49)])
    if kind == "plane":
        X[:, :2] = rng.uniform(-0.5, 0.5, (49, 2))
    if kind == "cube":
        X = rng.uniform(-0.5, 0.5, (49, 3))
    return X


@pytest.mark.parametrize(
    ("kind", "distance"), [("board", 60.0), ("plane", 60.0), ("board", 4.0), ("cube", 20.0)]
)
def test_the_mirrored_pose_of_a_distant_plane_is_named_and_within_the_deviations(kind, distance):
    named, wrong = 0, 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        off, std, warnings = located(points(kind, rng), distance, rng)
        assert np.abs(off / std).max() < 4.0
        named += any(warning.code == "competing-pose" for warning in warnings)
        wrong += np.linalg.norm(off) > 20.0
    assert (named, wrong > 0) == ((8, True) if distance == 60.0 else (0, False))
