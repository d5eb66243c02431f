"""Images too wide for one pinhole view: several see all of them, for depth maps and texture."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from thesisrecon import Camera, depth_maps, fuse_depth_maps, texture
from thesisrecon.api.surface import _scene
from thesisrecon.imaging.pinholes import pinhole_frame, pinhole_numbers, pinhole_view
from thesisrecon.records import Image
from thesisrecon.stereo.depth import project_inside

SIZE, DISTANCE = (240, 180), 2.0


def wide_camera(degrees, x=0.0):
    """An equidistant camera at (x, 0, 0) that looks along z."""
    f = SIZE[0] / 2.0 / np.radians(degrees / 2.0)
    K = np.array([[f, 0.0, 121.0], [0.0, f, 88.0], [0.0, 0.0, 1.0]])
    return Camera(K, np.eye(3), np.array([-x, 0.0, 0.0]), SIZE, np.zeros(4), lens="fisheye")


def every_pixel():
    x, y = np.meshgrid(*(np.arange(float(side)) for side in SIZE))
    return np.column_stack([x.ravel(), y.ravel()])


def image_of(colors):
    """An image of grey levels (N,) or colours (N, 3) of its pixels."""
    levels = np.broadcast_to(colors.reshape(SIZE[1], SIZE[0], -1), (SIZE[1], SIZE[0], 3))
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("degrees", [70.0, 90.0, 120.0, 178.0])
def test_the_pinhole_views_of_a_wide_image_see_all_of_it_with_its_colours(degrees):
    camera = wide_camera(degrees)
    rays = camera.unproject(every_pixel())
    known = np.isfinite(rays).all(axis=1)
    rgb = image_of(np.where(known[:, None], 127.0 + 100.0 * np.nan_to_num(rays), 0.0))
    _, model = _scene("depth_maps", [rgb], [camera], None, 1000)
    image, seen = Image("a.png", rgb, SIZE), np.zeros(len(rays), dtype=bool)
    # Of one image the numbers are those of the faces.
    numbers = pinhole_numbers(model)
    assert numbers[:3] == ([0, 1, 2] if degrees > 110.0 else [0])
    for n in numbers:
        view = pinhole_view(image, model, n)
        assert view.seen.shape == pinhole_frame(image, model, n).seen.shape
        y, x = np.nonzero(view.seen)
        towards = np.linalg.solve(view.P[:, :3], np.stack([x, y, np.ones(len(x))])).T
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        off = np.abs(view.rgb[view.seen] - (127.0 + 100.0 * towards)).max(axis=1)
        assert np.quantile(off, 0.99) < 2.0
        half = pinhole_view(image, model, n, max_side=120)
        np.testing.assert_allclose(half.seen.shape, np.array(view.seen.shape) / 2.0, atol=1.0)
        xy, inside = project_inside(view, np.where(known[:, None], rays, -1.0))
        here = np.flatnonzero(inside & known)
        x, y = np.rint(xy[here]).astype(int).T
        seen[here] |= view.seen[y, x]
    # Less than 5 % of a view is left out.
    assert seen[known].mean() > 0.95


def test_an_image_of_which_a_pinhole_image_shows_most_has_a_view_of_its_k_and_size():
    camera = replace(wide_camera(60.0), lens="radial", distortion=np.array([-0.08]))
    image, model = _scene("depth_maps", [image_of(every_pixel()[:, 0])], [camera], None, 1000)
    view = pinhole_frame(image[0], model, 0)
    assert view.seen.shape == SIZE[::-1]
    np.testing.assert_allclose(view.P[:, :3], camera.K)


def test_depth_maps_and_texture_reach_beyond_what_one_pinhole_view_sees():
    noise = gaussian_filter(np.random.default_rng(0).uniform(-900.0, 1100.0, (400, 1600)), 2.0)
    places, cameras, images = 0.02, [wide_camera(140.0, x) for x in (-0.3, 0.0, 0.3)], []

    def painted(X):
        return map_coordinates(noise, [X[:, 1] / places + 200.0, X[:, 0] / places + 800.0], order=1, cval=0.0)

    for camera in cameras:
        rays = camera.unproject(every_pixel())
        X = camera.centre + rays * (DISTANCE / np.where(rays[:, 2] > 0.05, rays[:, 2], np.nan))[:, None]
        images.append(image_of(np.nan_to_num(painted(np.nan_to_num(X, nan=1e6)))))
    maps = depth_maps(images, cameras, depth_range=(0.05, 4.0))
    assert {m.view // 3 for m in maps} >= {0, 1, 2}
    points = []
    for m in maps:
        y, x = np.nonzero(np.isfinite(m.depth))
        towards = np.linalg.solve(m.P[:, :3], np.stack([x, y, np.ones(len(x))])).T
        points.append(cameras[m.view % 3].centre + m.depth[y, x][:, None] * towards)
    X = np.concatenate(points)
    assert np.median(np.abs(X[:, 2] - DISTANCE)) < 0.02 * DISTANCE
    beyond = np.abs(X[:, 0]) > DISTANCE * np.tan(np.radians(58.0))
    # A pinhole view of this size and focal length ends at 51 degrees.
    assert beyond.mean() > 0.05
    mesh = texture(fuse_depth_maps(maps), images, cameras)
    beyond = np.abs(mesh.vertices[mesh.faces, 0]).min(axis=1) > DISTANCE * np.tan(np.radians(58.0))
    assert (~mesh.untextured[beyond]).mean() > 0.5
