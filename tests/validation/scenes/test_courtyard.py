"""The courtyard: its files are what the code makes, and depth, cameras and colours agree between views."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from validation.scenes.courtyard import build_courtyard
from validation.scenes.fixtures import SIZE, courtyard_poses, encode_depth, render_photograph, versions
from validation.scenes.real import ROOT, load_fixture_depth, load_fixture_scene

FOLDER = ROOT / "fixtures" / "courtyard"


@pytest.fixture(scope="module")
def scene():
    return load_fixture_scene("courtyard")


def grey(scene, view):
    return np.asarray(Image.open(scene.image_paths[view]).convert("L"), dtype=float)


def lift(scene, view):
    """Pixels (N, 2) and space points (N, 3) of the true depth of a view."""
    depth, stride = load_fixture_depth(view)
    row, col = np.nonzero(~np.isnan(depth))
    xy = np.column_stack([col, row]) * float(stride)
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(scene.K[view]).T
    return xy, (rays * depth[row, col, None]) @ scene.R[view] + scene.C[view]


def look_up(a, xy):
    """Bilinear samples of a at xy, all inside."""
    c, r = np.floor(xy[:, 0]).astype(int), np.floor(xy[:, 1]).astype(int)
    fx, fy = xy[:, 0] - c, xy[:, 1] - r
    top = a[r, c] * (1 - fx) + a[r, c + 1] * fx
    return top * (1 - fy) + (a[r + 1, c] * (1 - fx) + a[r + 1, c + 1] * fx) * fy


def seen_in(scene, X, view):
    """Pixels and depth of X in a view, and which lie inside its image by a pixel or two."""
    x = (X - scene.C[view]) @ scene.R[view].T @ scene.K[view].T
    xy = x[:, :2] / x[:, 2:]
    inside = (xy > 2).all(axis=1) & (xy < np.array(SIZE) - 4).all(axis=1) & (x[:, 2] > 0)
    return xy, x[:, 2], inside


def test_the_set_is_what_was_promised(scene):
    assert len(scene.image_paths) >= 12
    assert sum(p.stat().st_size for p in FOLDER.rglob("*") if p.is_file()) < 8e6
    assert max(SIZE) == 1024
    for path in scene.image_paths:
        with Image.open(path) as image:
            assert image.size == SIZE
            assert not image.getexif()
    assert (scene.K[0] == scene.K).all()
    off = scene.K[0, :2, 2] - (np.array(SIZE) - 1) / 2
    assert (np.abs(off) > 12).all()
    assert scene.K[0, 0, 0] == scene.K[0, 1, 1]


def test_cameras_are_those_of_the_code(scene):
    poses = courtyard_poses()
    for field, values in (("K", scene.K), ("R", scene.R), ("C", scene.C)):
        np.testing.assert_allclose(values, [getattr(p, field) for p in poses], atol=1e-12)
    np.testing.assert_allclose(
        scene.R @ scene.R.transpose(0, 2, 1), np.tile(np.eye(3), (14, 1, 1)), atol=1e-13
    )


def test_the_motion_is_general(scene):
    turns = [b @ a.T for a, b in zip(scene.R[:-1], scene.R[1:], strict=True)]
    degrees = np.degrees([np.arccos((np.trace(T) - 1) / 2) for T in turns])
    assert degrees.min() > 7
    assert degrees.max() < 20
    axes = np.array([[T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]] for T in turns])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    # Turned about several axes (in the camera's frame), and no plane holds the centres.
    assert np.linalg.svd(axes)[1][1] > 1.0
    assert np.linalg.svd(scene.C - scene.C.mean(axis=0))[1][2] > 1.0


@pytest.mark.parametrize(("i", "j"), [(0, 1), (3, 5), (8, 6), (12, 13)])
def test_depth_of_one_view_agrees_with_that_of_another(scene, i, j):
    X = lift(scene, i)[1]
    depth, stride = load_fixture_depth(j)
    xy, z, inside = seen_in(scene, X, j)
    xy = np.where(inside[:, None], xy, 2.0) / stride
    there = look_up(depth, xy)
    # At a depth edge interpolation means nothing: compare where the four samples lie on one smooth surface.
    r, c = xy[:, 1].astype(int), xy[:, 0].astype(int)
    around = np.stack([depth[r, c], depth[r + 1, c], depth[r, c + 1], depth[r + 1, c + 1]])
    compared = inside & ~np.isnan(there) & (np.ptp(around, axis=0) < 0.04)
    difference = (z - there)[compared]
    visible = np.abs(difference) < 0.02
    assert visible.mean() > 0.6
    assert np.median(np.abs(difference[visible])) < 3e-4
    # A nearer surface of view j may hide the point (z > there); a farther one would mean a hole in the scene.
    assert (difference < -0.02).mean() < 2e-3


@pytest.mark.parametrize(("i", "j"), [(2, 3), (6, 7), (10, 11)])
def test_a_visible_point_has_one_colour(scene, i, j):
    xy1, X = lift(scene, i)
    depth, stride = load_fixture_depth(j)
    xy2, z, inside = seen_in(scene, X, j)
    same = inside & (np.abs(z - look_up(depth, np.where(inside[:, None], xy2, 2.0) / stride)) < 0.005)
    same &= (xy1 > 2).all(axis=1) & (xy1 < np.array(SIZE) - 4).all(axis=1)
    first, second = grey(scene, i), grey(scene, j)

    def correlation(shift):
        return float(np.corrcoef(look_up(first, xy1[same]), look_up(second, xy2[same] + [shift, 0.0]))[0, 1])

    assert correlation(0.0) > 0.95
    # The truth is where the photographs agree best: a quarter of a pixel beside it is worse on both sides.
    assert correlation(0.0) > max(correlation(-0.5), correlation(0.5))
    best = -0.25 * (correlation(0.5) - correlation(-0.5))
    best /= correlation(0.5) + correlation(-0.5) - 2 * correlation(0.0)
    assert abs(best) < 0.06


def test_a_view_is_made_again_byte_for_byte():
    view = 4
    jpeg, depth = render_photograph(build_courtyard(), courtyard_poses()[view], view)
    kept = (FOLDER / "images" / f"{view:04d}.jpg").read_bytes()
    made_with = json.loads((FOLDER / "cameras.json").read_text(encoding="utf-8"))["made_with"]
    if made_with == versions():
        assert jpeg == kept
        assert encode_depth(depth) == (FOLDER / "depth" / f"{view:04d}.png").read_bytes()
    # Another library version may round or encode otherwise; the picture stays.
    a, b = (np.asarray(Image.open(io.BytesIO(data)), dtype=float) for data in (jpeg, kept))
    assert np.abs(a - b).mean() < 0.5
    stored = np.asarray(Image.open(FOLDER / "depth" / f"{view:04d}.png"), dtype=int)
    assert (np.abs(stored - depth.astype(int)) <= 1).mean() > 0.999
