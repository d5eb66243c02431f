"""Points of two models brought together: those that are one, and how far apart they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.validation.test_cameras import N, _reconstruction, _truth
from validation.harness.stages.clouds import _common_frame, _same_points, same_points
from validation.scenes.real import Scene


def test_points_seen_at_one_place_are_one_whatever_their_order() -> None:
    ours = _reconstruction(_truth())
    order = np.random.default_rng(0).permutation(N)
    tracks = ours.tracks
    place = np.argsort(order)
    theirs = replace(ours, X=ours.X[order], tracks=replace(tracks, point_index=place[tracks.point_index]))
    pairs = same_points(ours, theirs)
    assert len(pairs) == N
    np.testing.assert_array_equal(order[pairs[:, 1]], pairs[:, 0])


def test_a_shift_of_the_points_is_told_in_per_cent_of_their_distance() -> None:
    truth = _truth()
    ours = _reconstruction(truth)
    scene = Scene("made up", (), truth.K, truth.R, truth.C)
    frame = _common_frame(scene, ours, ours)
    assert frame is not None
    mine, other, unit = frame
    shift = np.array([0.01 * unit, 0.0, 0.0])
    rows = _same_points("made up", "COLMAP", ours, ours, (mine + shift, other, unit))
    np.testing.assert_allclose([row.values["ours"] for row in rows[1:]], 1.0)
    assert rows[0].values["ours"] == N
