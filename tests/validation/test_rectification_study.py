"""The study of rectification: rows for OpenCV's homographies too, and a verdict where one belongs."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")

from tests.stereo.rectification_scenes import make_pair
from thesisrecon.stereo._epipolar_pair import pair_of_cameras, pair_of_fundamental
from thesisrecon.stereo._planar import PlanarRectification
from validation.references.opencv import opencv_calibrated, opencv_uncalibrated
from validation.studies import rectification
from validation.studies.rectification import (
    BEST_F,
    METHODS,
    OPENCV,
    RealPair,
    check_scene,
    measure,
    seen_by_other,
)


@pytest.fixture(scope="module")
def pair():
    scene = make_pair("parallel", np.random.default_rng(0), noise_px=0.1)
    return RealPair(
        "0-1",
        pair_of_fundamental(scene.F, scene.xy1, scene.xy2, *scene.sizes),
        pair_of_cameras(*scene.P, *scene.sizes, xy1=scene.xy1, xy2=scene.xy2),
    )


def test_rows_of_opencv_are_epipolar_lines():
    scene = make_pair("beside", np.random.default_rng(1))
    for found in (
        opencv_uncalibrated(scene.F, scene.xy1, scene.xy2, scene.sizes[0]),
        opencv_calibrated(*scene.P, scene.sizes[0]),
    ):
        assert found is not None
        left = found.rectified_from_original(0, scene.xy1, within=False)
        right = found.rectified_from_original(1, scene.xy2, within=False)
        assert np.abs(left - right)[:, 1].max() < 1e-3


def test_pixels_outside_the_other_image_do_not_count(pair):
    seen = seen_by_other(pair.metric, 0)
    # The second camera stands to the right, 1.5 off with a focal of 700: at depth 11 it sees from 95 px on.
    assert 50.0 < seen[:, 0].min() < 110.0
    assert seen[:, 0].max() > 620.0


def test_the_table_has_every_method_and_judges_the_choice(pair):
    rows = {row.name: row for row in check_scene("synthetic", [pair])}
    assert set(rows["done, of 1 pair"].values) == set(METHODS)
    judged = [row for row in rows.values() if row.target is not None]
    assert len(judged) == 5
    assert all(row.judged == BEST_F and row.verdict == "reached" for row in judged)
    assert rows["targets reached, share of all"].values[BEST_F] == 1.0
    for name in METHODS:
        measured = measure(pair, name)
        assert measured is not None
        # The noise of two coordinates that differ.
        assert measured.dy_px == pytest.approx(0.14, abs=0.03)


def test_a_frame_beside_all_matches_has_no_rows_and_ends_no_table(pair, monkeypatch):
    whole = opencv_calibrated(*pair.metric.cameras, pair.metric.pencil.sizes[0])
    beside = PlanarRectification(np.array([[1.0, 0, 5e3], [0, 1, 0], [0, 0, 1]]) @ whole.H, whole.size)
    monkeypatch.setitem(METHODS, OPENCV, (True, lambda _: beside))
    rows = {(row.name, row.unit): row for row in check_scene("synthetic", [pair])}
    assert rows["RMS |dy| of inliers, worst", "px of the image"].values[OPENCV] is None
    assert rows["kept of the common region, worst", ""].values[OPENCV] == 0.0
    assert rows["targets reached, share of all", ""].values[OPENCV] < 1.0


def test_a_refused_pair_and_rows_that_hold_no_match_are_no_success(pair, monkeypatch):
    good = measure(pair, BEST_F)
    assert good is not None
    assert not good.polar
    for made, name in (
        (None, "done, of 1 pair"),
        (replace(good, dy_px=np.nan), "RMS |dy| of inliers, worst"),
    ):
        monkeypatch.setattr(rectification, "measure", lambda *_, made=made: made)
        rows = check_scene("synthetic", [pair])
        assert {row.name: row.verdict for row in rows if row.target is not None}[name] == "missed"
    assert {row.name: row.values for row in rows}["targets reached, share of all"][BEST_F] == 0.75
