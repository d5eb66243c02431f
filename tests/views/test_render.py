"""What a rendered picture must show."""

import numpy as np
import pytest

from thesisrecon.camera import Camera
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.records import TexturedMesh
from thesisrecon.views.render import Light, Shading, render, without_texture

K = np.array([[60.0, 0.0, 31.3], [0.0, 62.0, 22.7], [0.0, 0.0, 1.0]])
SIZE = (64, 48)


def wall(**more):
    """A wall at depth 2 that fills the picture, its corners at the picture's."""
    corners = homogenize(np.array([[-0.5, -0.5], [63.5, -0.5], [63.5, 47.5], [-0.5, 47.5]]))
    vertices = 2.0 * corners @ np.linalg.inv(K).T
    return TexturedMesh(vertices, np.array([[0, 2, 1], [0, 3, 2]]), **more)


def test_a_texture_is_shown_texel_for_pixel():
    texture = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    corner = np.array([[-0.5, -0.5], [63.5, -0.5], [63.5, 47.5], [-0.5, 47.5]])
    mesh = wall(texture=texture, uv=corner[np.array([[0, 2, 1], [0, 3, 2]])])
    seen = render(mesh, Camera(K, np.eye(3), np.zeros(3), SIZE), samples=1)
    assert seen.valid.all()
    np.testing.assert_allclose(seen.depth, 2.0, rtol=1e-6)
    assert np.abs(seen.color.astype(int) - texture).max() <= 1


def test_a_finer_picture_is_averaged():
    board = (np.indices((96, 128)).sum(axis=0) % 2 * 255).astype(np.uint8)
    corner = np.array([[-0.5, -0.5], [127.5, -0.5], [127.5, 95.5], [-0.5, 95.5]])
    mesh = wall(texture=np.repeat(board[..., None], 3, axis=2), uv=corner[np.array([[0, 2, 1], [0, 3, 2]])])
    seen = render(mesh, Camera(K, np.eye(3), np.zeros(3), SIZE), samples=2)
    assert np.abs(seen.color.astype(int) - 128).max() <= 2


def test_vertex_colours_run_from_corner_to_corner():
    colors = np.array([[0, 0, 0], [255, 0, 0], [255, 255, 0], [0, 255, 0]], dtype=np.uint8)
    seen = render(wall(colors=colors), Camera(K, np.eye(3), np.zeros(3), SIZE)).color.astype(float)
    x = (np.arange(64) + 0.5) / 64 * 255
    assert np.abs(seen[20, :, 0] - x).max() < 1.0
    assert (seen[..., 2] == 0).all()


def test_light_falls_by_the_cosine_and_shines_towards_the_eye():
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE)

    def brightness(**shading):
        return render(wall(), camera, shading=Shading(**shading)).color[:, :, 0].astype(float)

    assert np.abs(brightness(ambient=0.5) - 100).max() <= 1
    slanted = Light(direction=(0.0, np.sqrt(3.0), -1.0))
    assert np.abs(brightness(ambient=0.0, lights=(slanted,)) - 100).max() <= 1
    behind = Light(direction=(0.0, 0.0, 1.0))
    assert brightness(ambient=0.0, lights=(behind,)).max() == 0.0
    lamp = brightness(ambient=0.0, lights=(Light(position=(0.0, 0.0, 0.0)),), specular=0.5)
    assert lamp[23, 31] == lamp.max() == 255
    assert lamp[0, 0] < 200


def test_nothing_is_seen_where_nothing_is():
    empty = TexturedMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE)
    seen = render(empty, camera, background=(1, 2, 3))
    assert not seen.valid.any()
    assert np.isnan(seen.depth).all()
    assert (seen.color == [1, 2, 3]).all()
    away = Camera(K, np.diag([-1.0, 1.0, -1.0]), np.zeros(3), SIZE)
    assert not render(wall(), away).valid.any()
    needle = TexturedMesh(np.array([[0.0, 0, 2], [1, 0, 2], [2, 0, 2]]), np.array([[0, 1, 2], [0, 0, 1]]))
    assert render(needle, camera).valid.sum() <= 64


def test_a_shape_alone_has_no_colours():
    mesh = wall(colors=np.zeros((4, 3), dtype=np.uint8))
    assert without_texture(mesh).colors is None
    assert (render(without_texture(mesh), Camera(K, np.eye(3), np.zeros(3), SIZE)).color == 200).all()


def test_wrong_calls_are_refused():
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE)
    with pytest.raises(ValueError, match="at least one sample"):
        render(wall(), camera, samples=0)
    with pytest.raises(ValueError, match="vertices that do not exist"):
        render(TexturedMesh(np.zeros((2, 3)), np.array([[0, 1, 2]])), camera)
    with pytest.raises(ValueError, match="uv must be"):
        render(wall(uv=np.zeros((1, 3, 2)), texture=np.zeros((2, 2, 3), np.uint8)), camera)
    with pytest.raises(ValueError, match="colors must be"):
        render(wall(colors=np.zeros((1, 3), np.uint8)), camera)
    with pytest.raises(ValueError, match="either a direction or a position"):
        Light()
    with pytest.raises(ValueError, match="at least 1 x 1"):
        Camera(K, np.eye(3), np.zeros(3), (0, 5))
    with pytest.raises(ValueError, match="finite"):
        Camera(K * np.nan, np.eye(3), np.zeros(3), SIZE)
    with pytest.raises(ValueError, match="needs K"):
        Camera(K[:2], np.eye(3), np.zeros(3), SIZE)
