"""Points of two models brought together: those that are one, and how far apart they are."""

from dataclasses import replace

import numpy as np
import pytest

from tests.validation.test_metrics import N, _reconstruction, _truth
from validation.runs.records import Outcome
from validation.scenes.real import Scene
from validation.stages.clouds import Clouds, _icp_metrics, _same_points, common_frame, same_points


def test_points_seen_at_one_position_are_merged_in_any_order():
    ours = _reconstruction(_truth())
    order = np.random.default_rng(0).permutation(N)
    tracks = ours.tracks
    folder = np.argsort(order)
    theirs = replace(ours, X=ours.X[order], tracks=replace(tracks, point_index=folder[tracks.point_index]))
    pairs = same_points(ours, theirs)
    assert len(pairs) == N
    np.testing.assert_array_equal(order[pairs[:, 1]], pairs[:, 0])


def test_a_shift_of_the_points_is_reported_in_per_cent_of_their_distance():
    truth = _truth()
    ours = _reconstruction(truth)
    scene = Scene("made up", (), truth.K, truth.R, truth.C)
    frame = common_frame(scene, ours, ours)
    assert frame is not None
    shifted = frame._replace(mine=frame.mine + np.array([0.01 * frame.unit, 0.0, 0.0]))
    rows = _same_points("made up", "COLMAP", ours, ours, shifted)
    np.testing.assert_allclose([row.values["ours"] for row in rows[1:]], 1.0)
    assert rows[0].values["ours"] == N


def test_the_motion_of_icp_depends_on_its_matrix_alone(tmp_path):
    rng = np.random.default_rng(1)
    mine = rng.normal(size=(200, 3))
    c, s = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    transform = np.eye(4)
    transform[:2, :2], transform[:3, 3] = [[c, -s], [s, c]], [0.1, 0.0, 0.0]
    other = mine @ transform[:3, :3].T + transform[:3, 3]
    other[:50] += 0.5
    np.savez(tmp_path / "COLMAP.npz", transform=transform)
    clouds = Clouds(mine, other, 10.0)
    turn, shift, share = _icp_metrics("made up", "COLMAP", clouds, Outcome(tmp_path))
    assert turn.values["ours"] == pytest.approx(2.0)
    middle = np.median(mine, axis=0)
    moved = transform[:3, :3] @ middle + transform[:3, 3] - middle
    assert shift.values["ours"] == pytest.approx(100.0 * np.linalg.norm(moved) / 10.0)
    assert share.values["ours"] == pytest.approx(75.0, abs=1.0)
    assert _icp_metrics("made up", "COLMAP", clouds, Outcome(tmp_path, "Open3D is missing")) == []
