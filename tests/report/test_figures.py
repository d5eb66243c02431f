import dataclasses
import json

import numpy as np

from tests.report.synthetic import made_up_run
from thesisrecon.report import figures as figures_module
from thesisrecon.report.figures import build_scene, histogram_path, pair_matrix_figure, scene_figure


def test_the_scene_is_valid_json_with_escaped_names():
    data = made_up_run(names=["<b>one</b>.jpg", "two&.jpg", "three.jpg"], points=200)
    assert data.metric is not None
    scene = build_scene(data.metric.reconstruction)
    assert scene is not None
    figure = scene_figure(scene, [p.name for p in data.photographs], data.colours)
    json.dumps(figure, allow_nan=False)
    points, lines, marks = figure["data"]
    assert len(points["x"]) == len(points["marker"]["color"]) == len(scene.points)
    assert lines["x"].count(None) == 6 * len(scene.views)
    assert marks["text"] == ["1 · &lt;b&gt;one&lt;/b&gt;.jpg", "2 · two&amp;.jpg"]


def test_the_matrix_is_symmetric_and_tells_refused_pairs_apart():
    data = made_up_run(points=300)
    figure = pair_matrix_figure(data.pairs, [p.name for p in data.photographs])
    json.dumps(figure, allow_nan=False)
    accepted, refused = figure["data"]
    pair, bad = data.pairs[0], next(p for p in data.pairs if not p.accepted)
    for p, trace in ((pair, accepted), (bad, refused)):
        assert trace["customdata"][p.i][p.j] == trace["customdata"][p.j][p.i] == p.inliers
    assert accepted["customdata"][bad.i][bad.j] is None
    assert accepted["customdata"][0][0] is None
    assert refused["text"][bad.i][bad.j] == f"× {bad.inliers}"


def test_many_views_are_shown_in_blocks_of_neighbours(monkeypatch):
    data = made_up_run(points=300)
    monkeypatch.setattr(figures_module, "MAX_MATRIX", 3)
    figure = pair_matrix_figure(data.pairs, [p.name for p in data.photographs])
    accepted = figure["data"][0]
    assert accepted["x"] == ["views 1–3", "views 4–6", "views 7–9"]
    inside = max(p.inliers for p in data.pairs if p.j < 3)
    assert accepted["customdata"][0][0] == inside


def test_a_pair_without_matches_has_a_colour():
    data = made_up_run(points=100)
    empty = dataclasses.replace(data.pairs[0], xy1=np.zeros((0, 2)), xy2=np.zeros((0, 2)))
    figure = pair_matrix_figure([empty], ["a", "b"])
    assert figure["data"][0]["z"][0][1] == 0.0


def test_histogram_bars_stand_on_the_ground():
    path = histogram_path(np.array([0.5, 0.0, 1.0, 0.25]), 1.0, width=40, height=10)
    assert path.count("M") == 3
    assert path.startswith("M0.0 10.0v-5.0")
    assert "M20.0 10.0v-10.0" in path
