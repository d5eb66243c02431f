"""Figures, drawings and the three-dimensional scene of the report."""

import base64
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PillowImage

from tests.report.synthetic import SIZE, made_up_cameras, made_up_run
from thesisrecon.records import HeldOut
from thesisrecon.report import _drawing as drawing
from thesisrecon.report import _figures as figures


def test_the_scene_is_valid_json_with_escaped_names():
    data = made_up_run(names=["<b>one</b>.jpg", "two&.jpg", "three.jpg"], points=200)
    scene = figures.build_scene(data.metric.reconstruction)
    figure = figures.scene_figure(scene, [p.name for p in data.images], data.colors)
    json.dumps(figure, allow_nan=False)
    points, lines, marks = figure["data"]
    assert len(points["x"]) == len(points["marker"]["color"]) == len(scene.points)
    assert lines["x"].count(None) == 6 * len(scene.views)
    assert marks["text"] == ["1 · &lt;b&gt;one&lt;/b&gt;.jpg", "2 · two&amp;.jpg"]


def test_the_matrix_is_symmetric_and_marks_rejected_pairs():
    data = made_up_run(points=300)
    figure = figures.pair_matrix_figure(data.pairs, [p.name for p in data.images])
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
    monkeypatch.setattr(figures, "MAX_MATRIX", 3)
    monkeypatch.setattr(figures, "MAX_CELLS", 3)
    figure = figures.pair_matrix_figure(data.pairs, [p.name for p in data.images])
    accepted = figure["data"][0]
    assert accepted["x"] == ["views 1–3", "views 4–6", "views 7–9"]
    inside = max(p.inliers for p in data.pairs if p.j < 3)
    assert accepted["customdata"][0][0] == inside


def opened(uri):
    head, text = uri.split(",", 1)
    assert head == "data:image/jpeg;base64"
    return PillowImage.open(io.BytesIO(base64.b64decode(text)))


def test_a_thumbnail_keeps_the_aspect_and_shrinks_when_there_are_many():
    image = made_up_run(points=50).images[0]
    few, many = drawing.thumbnail(image, 10), drawing.thumbnail(image, 2000)
    assert opened(few.uri).size == (few.width, few.height) == (360, 240)
    assert many.width < few.width / 3


def test_the_lines_pass_through_the_numbered_matches():
    data = made_up_run(points=400)
    pair = data.pairs[2]
    flat = [np.full((SIZE[1], SIZE[0], 3), 90, dtype=np.uint8)] * 2
    first, second = (replace(data.images[v], rgb=rgb) for v, rgb in zip((pair.i, pair.j), flat, strict=True))
    drawn = drawing.draw_pair(pair, first, second)
    pixels = np.asarray(opened(drawn.uri)).astype(int)
    s = 640 / max(SIZE)
    chosen = drawing._spread_matches(pair.xy1, len(drawing.HUES))
    for x, y in (pair.xy1[chosen] + 0.5) * s - 0.5:
        # A dot of the colour of its line: bright and coloured or at least far from the grey ground.
        spot = pixels[round(y), round(x)]
        assert np.abs(spot - 70).max() > 60
    # The second half holds lines as well: something coloured crosses it from side to side.
    right = pixels[:, 640 + 8 + 1 :]
    assert (np.ptp(right, axis=2) > 40).any(axis=0).mean() > 0.95


def test_a_pair_without_matches_is_no_error():
    data = made_up_run(points=100)
    empty = replace(data.pairs[0], xy1=np.zeros((0, 2)), xy2=np.zeros((0, 2)))
    assert figures.pair_matrix_figure([empty], ["a", "b"])["data"][0]["z"][0][1] == 0.0
    drawn = drawing.draw_pair(empty, data.images[0], data.images[1])
    assert opened(drawn.uri).size == (drawn.width, drawn.height)
    assert min(drawn.width, drawn.height) > 100


def lightness(rgb):
    """CIE L* (...) of sRGB (..., 3)."""
    v = rgb / 255.0
    linear = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return np.asarray(116.0 * np.cbrt(linear @ (0.2126, 0.7152, 0.0722)) - 16.0)


def test_a_depth_map_is_bright_where_it_is_near_and_grey_where_unknown():
    depth = np.tile(np.linspace(2.0, 6.0, 300, dtype=np.float32), (200, 1))
    depth[:, 200:250] = np.nan
    depth[0, 0] = 1e4  # a stray takes none of the scale
    drawn = drawing.draw_depth(depth, side=360)
    assert (drawn.picture.width, drawn.picture.height) == (300, 200)
    assert drawn.near == pytest.approx(2.0, abs=0.06)
    assert drawn.far == pytest.approx(6.0, abs=0.06)
    assert drawn.share == pytest.approx(250 / 300)
    pixels = np.asarray(opened(drawn.picture.uri)).astype(float)
    light = lightness(pixels[100])
    assert light[2] > 90
    assert light[190] < 55
    assert light[290] < 20
    assert (np.diff(light[5:190:20]) < -2).all()
    assert np.abs(pixels[100, 210:240] - drawing.UNKNOWN).max() < 8


@pytest.mark.parametrize("value", [np.nan, 3.0])
def test_depth_maps_without_depth_or_relief_are_accepted(value):
    drawn = drawing.draw_depth(np.full((30, 40), value, dtype=np.float32), side=360)
    assert drawn.share == float(np.isfinite(value))
    np.testing.assert_equal((drawn.near, drawn.far), (value, value))


def test_the_comparison_shows_the_differences():
    real = np.full((300, 400, 3), 120, dtype=np.uint8)
    rendered, compared = real.copy(), np.ones((300, 400), dtype=bool)
    rendered[:, 200:] += np.uint8(drawing.DIFFERENCE_LIMIT)
    compared[200:] = False
    pictures = drawing.draw_held_out(HeldOut(0, real, rendered, compared, 20.0, 0.9))
    photo, model, apart = (np.asarray(opened(p.uri)).astype(float) for p in pictures)
    assert np.abs(photo - 120).max() < 4
    assert np.abs(model[:190, 210:] - 184).max() < 4
    for picture in (model, apart):
        assert np.abs(picture[210:] - drawing.UNKNOWN).max() < 8
    assert lightness(apart[100, 100]) < 20
    assert lightness(apart[100, 300]) > 90
    large = [np.zeros((900, 1200, 3), dtype=np.uint8)] * 2
    assert (
        drawing.draw_held_out(HeldOut(0, *large, np.ones((900, 1200), dtype=bool), 0.0, 0.0))[2].width == 640
    )


def rotation(axis, angle):
    """Rodrigues' formula."""
    a = axis / np.linalg.norm(axis)
    A = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * A + (1 - np.cos(angle)) * A @ A)


def test_up_is_found_in_any_frame():
    rotations, _ = made_up_cameras(7)
    turn = rotation(np.array([0.3, -1.0, 0.7]), 2.1)
    upright = figures.upright_rotation(rotations @ turn.T)
    assert np.allclose(upright @ upright.T, np.eye(3))
    assert np.isclose(np.linalg.det(upright), 1)
    # In the made-up world y points down and the wall is along +z.
    assert (upright @ turn @ [0, -1, 0])[2] > 0.99
    assert (upright @ turn @ [0, 0, 1])[1] > 0.99


def test_up_of_a_ring_of_cameras_is_its_axis_and_parallel_cameras_have_one():
    level = [rotation(np.array([0.0, 1.0, 0.0]), angle) for angle in np.linspace(0, 2 * np.pi, 9)[:-1]]
    tilted = np.stack([rotation(np.array([1.0, 0.0, 0.0]), -0.4) @ R for R in level])
    ahead = np.tile(np.eye(3), (4, 1, 1))
    for rotations in (tilted, ahead):
        assert (figures.upright_rotation(rotations) @ [0, -1, 0])[2] > 0.999
    assert (figures.upright_rotation(ahead[:1]) @ [0, 0, 1])[1] > 0.999


def test_strays_are_left_out_and_many_points_are_thinned():
    data = made_up_run(points=600)
    before = data.metric.reconstruction
    X = before.X.copy()
    X[5, :3] = 1e5
    scene = figures.build_scene(replace(before, X=X), max_points=200)
    assert 150 <= len(scene.points) <= 200
    assert 5 not in scene.index
    assert (scene.high - scene.low).max() < 20


def test_the_pyramids_point_at_the_scene():
    data = made_up_run(points=300)
    scene = figures.build_scene(data.metric.reconstruction)
    assert scene.views.tolist() == list(range(8))
    gaze = scene.corners.mean(axis=1) - scene.centres
    towards = scene.points.mean(axis=0) - scene.centres
    cosine = np.sum(gaze * towards, axis=1) / np.linalg.norm(gaze, axis=1) / np.linalg.norm(towards, axis=1)
    assert (cosine > 0.95).all()
    # The first two corners are those of the upper edge, and up is z.
    assert (scene.corners[:, :2, 2].mean(axis=1) > scene.corners[:, 2:, 2].mean(axis=1)).all()


def test_a_scene_in_map_coordinates_is_drawn_about_its_middle():
    """WebGL draws in single precision, whose steps are half a metre there."""
    data, origin = made_up_run(points=300), np.array([5e5, 5e6, 100.0])
    scene = figures.build_scene(data.metric.reconstruction)
    names = {"points", "centres", "corners", "low", "high"}
    moved = replace(scene, **{name: getattr(scene, name) + origin for name in names})
    drawn = [figures.scene_figure(one, [p.name for p in data.images], None) for one in (scene, moved)]
    extent = float((scene.high - scene.low).max())
    for here, there in zip(*(figure["data"] for figure in drawn), strict=True):
        for axis in "xyz":
            one, other = (np.array(trace[axis], dtype=float) for trace in (here, there))
            assert np.nanmax(np.abs(other)) <= 0.5 * extent
            np.testing.assert_allclose(other, one, atol=2e-4 * extent)
    for axis in ("xaxis", "yaxis", "zaxis"):
        low, high = drawn[1]["layout"]["scene"][axis]["range"]
        assert abs(low + high) < 1e-6 * extent


@pytest.mark.parametrize("shrink", [1.0, 1e-2, 1e-6])
def test_the_pyramids_of_affine_cameras_do_not_hide_the_points(shrink):
    affine = made_up_run(points=200).affine
    wide = affine.P.copy()
    wide[:, :2] = np.diag([shrink, shrink]) @ wide[:, :2]
    scene = figures.build_scene(replace(affine, P=wide))
    edges = np.linalg.norm(scene.corners - scene.centres[:, None], axis=2)
    everything = np.concatenate([scene.points, scene.centres])
    assert edges.max() < 0.5 * np.linalg.norm(np.ptp(everything, axis=0))
