"""The scenes of the validation: made again byte for byte, with true geometry."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from thesisrecon.camera import compose_camera
from thesisrecon.geometry.camera_matrix import project
from validation.runs.records import ReportOptions
from validation.runs.scenes import load_images
from validation.scenes.courtyard import build_courtyard
from validation.scenes.cube import SIZE as CUBE_SIZE
from validation.scenes.cube import make_cube
from validation.scenes.fixtures import (
    SIZE,
    courtyard_cameras,
    courtyard_poses,
    encode_depth,
    render_image,
    versions,
    write_cube,
)
from validation.scenes.materials import Material, over, smooth
from validation.scenes.pose import Pose
from validation.scenes.procedural import courses, fractal
from validation.scenes.raycast import Surface, build_world, trace
from validation.scenes.real import (
    REAL_SCENES,
    ROOT,
    load_fixture_depth,
    load_fixture_scene,
    load_real_scene,
    read_scene,
)
from validation.scenes.sensor import Sensor, expose, integrate_pixels

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


def test_the_set_has_the_documented_size(scene):
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
    jpeg, depth = render_image(build_courtyard(), courtyard_poses()[view], view)
    kept = (FOLDER / "images" / f"{view:04d}.jpg").read_bytes()
    cameras = (FOLDER / "cameras.json").read_text(encoding="utf-8")
    made_with = json.loads(cameras)["made_with"]
    assert courtyard_cameras(made_with) == cameras
    if made_with == versions():
        assert jpeg == kept
        assert encode_depth(depth) == (FOLDER / "depth" / f"{view:04d}.png").read_bytes()
    # Another library version may round or encode otherwise; the picture stays.
    a, b = (np.asarray(Image.open(io.BytesIO(data)), dtype=float) for data in (jpeg, kept))
    assert np.abs(a - b).mean() < 0.5
    stored = np.asarray(Image.open(FOLDER / "depth" / f"{view:04d}.png"), dtype=int)
    assert (np.abs(stored - depth.astype(int)) <= 1).mean() > 0.999


def test_the_file_is_made_again_byte_for_byte(tmp_path):
    write_cube(tmp_path)
    assert (tmp_path / "cube.npz").read_bytes() == (ROOT / "fixtures" / "cube" / "cube.npz").read_bytes()


def test_every_seen_point_is_projected_perfectly():
    cube = make_cube()
    assert cube.R.shape == (27, 3, 3)
    for R, C, xy, seen in zip(cube.R, cube.C, cube.xy, cube.visible, strict=True):
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(R) > 0
        expected = project(compose_camera(cube.K, R, -R @ C), cube.X)
        np.testing.assert_allclose(xy[seen], expected[seen], atol=1e-9)
        assert (xy[seen] >= -0.5).all()
        assert (xy[seen] <= np.array(CUBE_SIZE) - 0.5).all()
        assert ((C - cube.X[seen]) @ R[2] < 0).all()


def test_six_cameras_see_a_single_plane_and_every_point_is_seen_often():
    cube = make_cube()
    assert np.bincount(cube.faces_seen()).tolist() == [0, 6, 15, 6]
    assert cube.visible.sum(axis=0).min() >= 10


SET_SIZES = {"fountain-P11": 11, "Herz-Jesus-P8": 8, "kermit": 11}


@pytest.mark.real
@pytest.mark.parametrize("name", REAL_SCENES)
def test_real_scenes(name):
    scene = load_real_scene(name)
    if scene is None:
        pytest.skip("the real images are not on this machine")
    assert len(scene.image_paths) == SET_SIZES[name]
    assert [p.name for p in scene.image_paths] == sorted(p.name for p in scene.image_paths)
    assert scene.has_truth == (name != "kermit")
    if scene.has_truth:
        np.testing.assert_allclose(np.linalg.det(scene.R), 1.0, atol=1e-4)
        assert scene.K.shape == (SET_SIZES[name], 3, 3)


def test_absent_images_are_none(monkeypatch, tmp_path):
    monkeypatch.setenv("THESISRECON_DATA", str(tmp_path))
    assert load_real_scene("kermit") is None
    monkeypatch.setenv("THESISRECON_DATA", str(tmp_path / "nowhere"))
    assert load_real_scene("kermit") is None


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="a real scene is one of"):
        load_real_scene("atlantis")
    with pytest.raises(ValueError, match="has none"):
        load_fixture_scene("atlantis")


def test_an_image_without_its_truth_is_named(tmp_path):
    (tmp_path / "images").mkdir()
    for name in ("a.jpg", "b.JPG", "notes.txt"):
        (tmp_path / "images" / name).touch()
    assert [p.name for p in read_scene(tmp_path, "x").image_paths] == ["a.jpg", "b.JPG"]
    camera = {"name": "a.jpg", "K": np.eye(3).tolist(), "R": np.eye(3).tolist(), "t": [0, 0, 0]}
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": [camera]}))
    with pytest.raises(ValueError, match=r"b\.JPG"):
        read_scene(tmp_path, "x")


RAY_K = np.array([[90.0, 0.0, 33.0], [0.0, 90.0, 22.0], [0.0, 0.0, 1.0]])


RAY_SIZE = (64, 48)


RIGHT, DOWN, FORWARD = np.eye(3)


SUN = np.array([0.2, -0.6, -0.7])


def material(height):
    grey = np.full((*height.shape, 3), 0.5, np.float32)
    return Material(grey, height.astype(np.float32), 0.01)


def wall(height):
    """A wall 2 m x 2 m, 2 m in front of a camera at the origin, its normal towards the camera."""
    surface = Surface(np.array([-1.0, 1.0, 2.0]), RIGHT, -DOWN, (2.0, 2.0), 0)
    return build_world([[surface]], [material(height)], SUN)


def view(world, **options):
    return trace(world, Pose(RAY_K, np.eye(3), np.zeros(3)), RAY_SIZE, **options)


def test_plane_depth_is_exact():
    depth = view(wall(np.full((201, 201), 0.05)))[1]
    # The slab is entered at the height of the map, so the depth is 2 m less the constant relief.
    np.testing.assert_allclose(depth, 1.95, atol=3e-6)


def test_relief_depth_lies_on_the_height_map():
    height = 0.04 * fractal((201, 201), 0.01, 5, wavelengths_m=(0.5, 0.05))
    depth = view(wall(height))[1]
    y, x = np.mgrid[: RAY_SIZE[1], : RAY_SIZE[0]]
    X, Y = depth * (x - RAY_K[0, 2]) / RAY_K[0, 0], depth * (y - RAY_K[1, 2]) / RAY_K[1, 1]
    u, v = (X + 1.0) / 0.01, (1.0 - Y) / 0.01
    c, r = u.astype(int), v.astype(int)
    fu, fv = u - c, v - r
    top = height[r, c] * (1 - fu) + height[r, c + 1] * fu
    low = height[r + 1, c] * (1 - fu) + height[r + 1, c + 1] * fu
    assert np.abs(2.0 - depth - (top * (1 - fv) + low * fv)).max() < 1e-5
    assert np.ptp(depth) > 0.03


def test_cylinder_depth_is_the_closed_form():
    radius, distance = 0.4, 2.0
    drum = Surface(np.array([0.0, 1.0, distance]), RIGHT, -DOWN, (2 * np.pi * radius, 2.0), 0, radius=radius)
    flat = np.zeros((201, round(2 * np.pi * radius / 0.01) + 1))
    depth = view(build_world([[drum]], [material(flat)], SUN))[1]
    x = (np.arange(RAY_SIZE[0]) - RAY_K[0, 2]) / RAY_K[0, 0]
    a, b, c = 1.0 + x * x, -distance, distance**2 - radius**2
    inside = b * b - a * c
    expected = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0.0)
    np.testing.assert_allclose(depth, np.tile(expected, (RAY_SIZE[1], 1)), atol=5e-6)
    assert (depth > 0).any()
    assert (depth == 0).any()


def test_a_block_casts_its_shadow_where_the_sun_is_hidden():
    # A plate of 0.4 m hangs 0.5 m before the wall, its lit side and its back one surface each.
    plate = [
        Surface(np.array([-0.2, 0.2, 1.5]), RIGHT, -DOWN, (0.4, 0.4), 0, flat=True),
        Surface(np.array([-0.2, -0.2, 1.5]), RIGHT, DOWN, (0.4, 0.4), 0, flat=True),
    ]
    back = Surface(np.array([-1.0, 1.0, 2.0]), RIGHT, -DOWN, (2.0, 2.0), 0)
    flat = material(np.zeros((201, 201)))
    light, depth = view(build_world([plate, [back]], [flat], SUN))
    shadow = np.array([0.0, 0.0, 1.5]) - SUN * (0.5 / -SUN[2])
    shadow_px = RAY_K[:2, :2] @ shadow[:2] / 2.0 + RAY_K[:2, 2]
    c, r = (int(v) for v in np.round(shadow_px))
    assert depth[r, c] == pytest.approx(2.0, abs=1e-5)
    assert light[r, c].max() < 0.7 * light[r, 2].max()


def test_pixels_are_not_shifted_by_the_lens():
    samples = np.zeros((40, 40, 3), np.float32)
    samples[20:22, 16:18] = 1.0
    pixels = integrate_pixels(samples, 2, 0.5)[..., 0].astype(float)
    y, x = np.mgrid[:20, :20]
    assert pixels.sum() == pytest.approx(1.0, abs=1e-4)
    assert (pixels * x).sum() == pytest.approx(8.0, abs=1e-3)
    assert (pixels * y).sum() == pytest.approx(10.0, abs=1e-3)


def test_photon_noise_grows_with_light_and_a_seed_repeats_it():
    light = np.repeat(np.array([0.02, 0.3], np.float32), 20000).reshape(2, 20000, 1).repeat(3, axis=2)
    sensor = Sensor(vignetting=0.0)
    first, again = (
        expose(light, sensor, gains=(1.0, 1.0, 1.0), rng=np.random.default_rng(1)) for _ in range(2)
    )
    assert np.array_equal(first, again)
    # Levels at 0.3 of white: derivative of the tone curve times sqrt(0.3 * 6000) / 6000.
    expected = 255 * 1.055 / 2.4 * 0.3 ** (1 / 2.4 - 1) * np.sqrt(0.3 / sensor.full_well)
    assert first[1].std() == pytest.approx(expected, rel=0.05)


def test_patterns_refuse_to_be_aliased():
    with pytest.raises(ValueError, match="two texels"):
        fractal((8, 8), 0.01, 0, wavelengths_m=(0.1, 0.01))


def test_wrapped_noise_closes():
    noise = fractal((32, 128), 0.01, 3, wavelengths_m=(0.3, 0.04), wrap=True)
    step = np.abs(np.diff(noise, axis=1)).max()
    assert np.abs(noise[:, 0] - noise[:, -1]).max() <= step


def test_bricks_have_joints_and_layers_blend():
    edge, label = courses((100, 200), 0.005, 1, block_m=(0.25, 0.085))
    assert edge.min() < 0.004
    assert 0.03 < edge.max() < 0.06
    assert len(np.unique(label)) > 20
    mortar, brick = material(np.zeros((100, 200))), material(np.ones((100, 200)))
    assert np.array_equal(over(mortar, brick, smooth(edge, 0.004, 0.013)).height, smooth(edge, 0.004, 0.013))


def test_cameras_beside_flat_images_are_their_truth(scene, tmp_path):
    for name in ("0004.jpg", "0007.jpg"):
        (tmp_path / name).symlink_to(FOLDER / "images" / name)
    options = ReportOptions(tmp_path / "out", ("own",), (), folders={"own": str(tmp_path)})
    assert not load_images("own", options).has_truth
    (tmp_path / "cameras.json").symlink_to(FOLDER / "cameras.json")
    np.testing.assert_array_equal(load_images("own", options).C, scene.C[[4, 7]])
    (tmp_path / "other.jpg").symlink_to(FOLDER / "images" / "0009.jpg")
    with pytest.raises(
        ValueError, match=r"must have a camera with K for every image; it lacks \['other.jpg'"
    ):
        load_images("own", options)
