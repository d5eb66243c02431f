"""Figures, drawings and the three-dimensional scene of the report."""

import base64
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PillowImage
from scipy.spatial.transform import Rotation

from tests.report.synthetic import made_up_cameras, made_up_run
from thesisrecon.lens import lens_row
from thesisrecon.records import HeldOut, IntrinsicInterval
from thesisrecon.report import _figures as figures


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


@pytest.mark.parametrize(("lens", "degrees"), [("radial", 0.0), ("fisheye", 150.0)])
def test_the_lens_is_drawn_with_its_intervals_and_the_straight_image_unfolded(lens, degrees):
    data = made_up_run(points=300)
    f = 240.0 / np.radians(degrees / 2.0) if degrees else 520.0
    row = lens_row("fisheye", np.zeros(4)) if degrees else np.array([-0.03, 0.0, 0.0])
    r, image = data.metric.reconstruction, data.images[2]
    K = np.array([[f, 0.0, 239.5], [0.0, f, 159.5], [0.0, 0.0, 1.0]])
    poses = np.linalg.solve(np.where(r.registered[:, None, None], r.K, np.eye(3)), r.P)
    lenses = np.tile(row, (len(r.P), 1))
    r = replace(r, P=K @ poses, K=np.tile(K, (len(r.P), 1, 1)), distortion=lenses)
    angles = {
        "angle_of_view_deg": IntrinsicInterval(1.0, 0.3, ""),
        "corner_deg": IntrinsicInterval(1, 0.2, ""),
    }
    known = tuple(view | angles if view else view for view in data.metric.intrinsics)
    data = replace(data, metric=replace(data.metric, reconstruction=r, intrinsics=known))
    assert list(data.bent) == [data.images[0].name]
    figure = figures.lens_figure(data.bent)
    json.dumps(figure, allow_nan=False)
    curve, pinhole, ends = figure["data"]
    camera = data.bent[data.images[0].name]
    assert camera.lens == lens
    np.testing.assert_allclose(curve["y"][-1], camera.angles_of_view[1], atol=0.01)
    np.testing.assert_allclose(ends["y"], np.array(camera.angles_of_view) * [0.5, 1.0])
    np.testing.assert_allclose(ends["error_y"]["array"], 1.96 * np.array([0.15, 0.2]))
    # A fisheye lens images wider angles than a pinhole camera of its focal length; so does a barrel.
    assert pinhole["y"][-1] < curve["y"][-1]
    original, straight = figures.draw_straight(image, r, 2)
    assert (original.width, original.height) == (480, 320)
    shown = np.asarray(opened(straight.uri), dtype=float)
    # The middle of the front view is that of the image.
    middle = image.rgb[157:163, 237:243].mean(axis=(0, 1))
    y, x = (side // 2 for side in shown.shape[:2])
    np.testing.assert_allclose(shown[y - 3 : y + 3, x - 3 : x + 3].mean(axis=(0, 1)), middle, atol=12.0)


def opened(uri):
    head, text = uri.split(",", 1)
    assert head == "data:image/jpeg;base64"
    return PillowImage.open(io.BytesIO(base64.b64decode(text)))


def lightness(rgb):
    """CIE L* (...) of sRGB (..., 3)."""
    v = rgb / 255.0
    linear = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return np.asarray(116.0 * np.cbrt(linear @ (0.2126, 0.7152, 0.0722)) - 16.0)


def test_a_depth_map_is_bright_where_it_is_near_and_grey_where_unknown():
    depth = np.tile(np.linspace(2.0, 6.0, 300, dtype=np.float32), (200, 1))
    depth[:, 200:250] = np.nan
    depth[0, 0] = 1e4  # a stray takes none of the scale
    drawn = figures.draw_depth(depth, side=360)
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
    assert np.abs(pixels[100, 210:240] - figures.UNKNOWN).max() < 8
    for value in (np.nan, 3.0):
        drawn = figures.draw_depth(np.full((30, 40), value, dtype=np.float32), side=360)
        assert drawn.share == float(np.isfinite(value))
        np.testing.assert_equal((drawn.near, drawn.far), (value, value))


def test_the_comparison_shows_the_differences():
    real = np.full((300, 400, 3), 120, dtype=np.uint8)
    rendered, compared = real.copy(), np.ones((300, 400), dtype=bool)
    rendered[:, 200:] += np.uint8(figures.DIFFERENCE_LIMIT)
    compared[200:] = False
    pictures = figures.draw_held_out(HeldOut(0, real, rendered, compared, 20.0, 0.9))
    photo, model, apart = (np.asarray(opened(p.uri)).astype(float) for p in pictures)
    assert np.abs(photo - 120).max() < 4
    assert np.abs(model[:190, 210:] - 184).max() < 4
    for picture in (model, apart):
        assert np.abs(picture[210:] - figures.UNKNOWN).max() < 8
    assert lightness(apart[100, 100]) < 20
    assert lightness(apart[100, 300]) > 90
    large = HeldOut(0, *[np.zeros((900, 1200, 3), np.uint8)] * 2, np.ones((900, 1200), bool), 0.0, 0.0)
    assert figures.draw_held_out(large)[2].width == 640


def test_up_is_found_in_any_frame_for_rings_and_for_parallel_cameras():
    rotations, _ = made_up_cameras(7)
    turn = Rotation.from_rotvec([0.5, -1.7, 1.2]).as_matrix()
    upright = figures.upright_rotation(rotations @ turn.T)
    assert np.allclose(upright @ upright.T, np.eye(3))
    assert np.isclose(np.linalg.det(upright), 1)
    # In the made-up world y points down and the wall is along +z.
    assert (upright @ turn @ [0, -1, 0])[2] > 0.99
    assert (upright @ turn @ [0, 0, 1])[1] > 0.99
    tilted = Rotation.from_euler("XY", [[-0.4, angle] for angle in np.linspace(0, 2 * np.pi, 9)[:-1]])
    ahead = np.tile(np.eye(3), (4, 1, 1))
    for rotations in (tilted.as_matrix(), ahead):
        assert (figures.upright_rotation(rotations) @ [0, -1, 0])[2] > 0.999
    assert (figures.upright_rotation(ahead[:1]) @ [0, 0, 1])[1] > 0.999


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
