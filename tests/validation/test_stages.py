"""What the stages of a report compute: depth, views, points of two models, F without an answer."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.validation.test_metrics import N, _reconstruction, _truth
from thesisrecon.records import Image
from validation.runs.records import Outcome
from validation.runs.tables import log_ticks
from validation.scenes.real import Scene
from validation.scenes.real_pairs import RealPair
from validation.stages.cameras import COLMAP, MATCHES, _costs
from validation.stages.clouds import Clouds, _icp_metrics, _same_points, common_frame, same_points
from validation.stages.features import in_original_pixels
from validation.stages.fundamental import MINIMAL, OURS, VARIANTS, _metrics


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
    scene = Scene("made up", (), *truth)
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
    other[:120] += 0.5
    (alone,) = _icp_metrics("made up", "COLMAP", clouds, Outcome(tmp_path))
    assert alone.name == "ICP to COLMAP: inliers", "the motion of a part says nothing of the cloud"


def test_memory_and_time_of_a_mapper_are_from_images_to_cameras(tmp_path):
    outcomes = {
        MATCHES: Outcome(tmp_path, cpu_s=30.0, peak_mb=900.0),
        "ours": Outcome(tmp_path, cpu_s=20.0, peak_mb=300.0),
        COLMAP: Outcome(tmp_path, cpu_s=5.0, peak_mb=100.0),
    }
    time, memory = _costs("made up", outcomes)
    assert time.values == {"ours": 20.0, COLMAP: 35.0}
    assert memory.values == {"ours": 300.0, COLMAP: 900.0}


@pytest.mark.parametrize("values", [(0.97, 1.02), (0.4, 1.3), (3.0, 40.0), (1e-6, 2.0), (5.0,)])
def test_a_logarithmic_axis_has_three_round_ticks(values):
    ticks = log_ticks([*values, 0.0, math.inf])
    if "tickvals" in ticks:
        shown = np.array(ticks["tickvals"])
        reach = 0.1 * max(values)
        assert np.sum((shown >= min(values) - reach) & (shown <= max(values) + reach)) >= 3
        assert shown.min() > 0.0
    else:
        per_decade = {"D2": 3, 1: 1}[ticks["dtick"]]
        assert per_decade * np.log10(max(values) / min(values)) >= 1.8


def test_a_method_without_any_fundamental_matrix_has_the_largest_errors_and_no_rank():
    xy = np.random.default_rng(0).uniform(0.0, 500.0, (20, 2))
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    pairs = [RealPair("a pair", xy, xy, truth=np.hstack([xy, xy]), F=F)]
    found = {"F": F[None, None], "inliers": np.full((1, 1), 20.0), "seconds": np.ones((1, 1))}
    nothing = found | {"F": np.full((1, 1, 3, 3), np.nan), "inliers": np.zeros((1, 1))}
    answers = dict.fromkeys((OURS, *VARIANTS), found) | {"COLMAP": nothing, MINIMAL: nothing}
    errors = {name: np.array([[99.0 if a is nothing else 0.0]]) for name, a in answers.items()}
    rows = {row.name: row for row in _metrics("a scene", pairs, answers, errors)}
    assert rows["failed"].values == {name: 100.0 * (a is nothing) for name, a in answers.items()}
    assert rows["epipole angle"].values["COLMAP"] == 90.0
    rank = rows[f"{MINIMAL}: rank"].values[OURS]
    assert rank is not None
    assert np.isnan(rank)


def test_matrices_of_reduced_images_are_judged_in_original_pixels():
    rng = np.random.default_rng(0)
    F, xy = rng.normal(size=(3, 3)), rng.uniform(0.0, 300.0, (2, 5, 2))
    images = [Image("", np.zeros((30, 40, 3), np.uint8), size) for size in ((80, 60), (120, 90))]
    original = [(x + 0.5) / image.scale - 0.5 for x, image in zip(xy, images, strict=True)]
    here, there = (np.column_stack([x, np.ones(5)]) for x in xy)
    first, second = (np.column_stack([x, np.ones(5)]) for x in original)
    expected = np.einsum("na,ab,nb->n", there, F, here)
    found = np.einsum("na,ab,nb->n", second, in_original_pixels(F, *images), first)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
