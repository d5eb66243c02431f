"""The compiled loops of rendering beside plain NumPy."""

import numpy as np
import pytest

from thesisrecon.camera import Camera
from thesisrecon.geometry.zbuffer import rasterize, sample_texture
from thesisrecon.records import TexturedMesh
from thesisrecon.views.render import Light, Shading, average_blocks, shade_points, vertex_normals


def unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-20)


def shaded(color, points, normals, eye, shading):
    """The plain twin of ``shade_points``: Lambert's law and Blinn's highlight."""
    normals, to_eye = unit(normals), unit(eye - points)
    normals = normals * np.where((normals * to_eye).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    light, shine = np.full_like(color, shading.ambient), np.zeros_like(color)
    for lamp in shading.lights:
        if lamp.direction is not None:
            to_lamp = unit(np.tile(np.asarray(lamp.direction), (len(points), 1)))
        else:
            to_lamp = unit(np.asarray(lamp.position) - points)
        cosine = np.maximum((normals * to_lamp).sum(axis=1), 0.0)[:, None]
        half = np.maximum((normals * unit(to_lamp + to_eye)).sum(axis=1), 0.0)[:, None]
        light += cosine * lamp.color
        shine += 255.0 * shading.specular * (cosine > 0.0) * half**shading.shininess * np.array(lamp.color)
    return np.asarray(color * light + shine)


@pytest.mark.parametrize("specular", [0.0, 0.4])
def test_light_is_that_of_the_formulas(specular):
    rng = np.random.default_rng(0)
    color, points, normals = (
        rng.uniform(0, 255, (500, 3)),
        rng.normal(size=(500, 3)),
        rng.normal(size=(500, 3)),
    )
    normals[:5] = 0.0
    lamps = (Light(direction=(1.0, 2.0, -3.0), color=(0.5, 0.6, 0.2)), Light(position=(0.3, 0.1, -4.0)))
    for lights in ((), lamps[:1], lamps):
        shading = Shading(ambient=0.2, lights=lights, specular=specular, shininess=7.0)
        eye = np.array([0.1, -0.2, -3.0])
        seen = color.astype(np.float32)
        shading.shade(seen, points.astype(np.float32), normals.astype(np.float32), eye)
        np.testing.assert_allclose(seen, shaded(color, points, normals, eye, shading), atol=0.02)


def test_normals_are_means_by_area():
    rng = np.random.default_rng(1)
    vertices, faces = rng.normal(size=(40, 3)), rng.integers(0, 40, (90, 3))
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((40, 3))
    np.add.at(total, faces.ravel(), np.repeat(across, 3, axis=0))
    np.testing.assert_allclose(vertex_normals(TexturedMesh(vertices, faces)), unit(total), atol=1e-12)
    alone = TexturedMesh(np.zeros((2, 3)), np.zeros((0, 3), dtype=np.int64))
    assert (vertex_normals(alone) == 0.0).all()


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_blocks_are_means_before_the_background(samples):
    rng = np.random.default_rng(2)
    color = rng.uniform(-20, 300, (6 * samples, 8 * samples, 3)).astype(np.float32)
    drawn = rng.integers(-1, 2, color.shape[:2])
    behind = np.array([10, 200, 30], dtype=np.float32)
    out = np.empty((6, 8, 3), dtype=np.uint8)
    average_blocks(color, drawn, samples, behind, out)
    plain = np.where(drawn[..., None] < 0, behind, color).reshape(6, samples, 8, samples, 3).mean(axis=(1, 3))
    assert np.abs(out - np.clip(np.rint(plain), 0, 255)).max() <= 1


def test_values_of_vertices_and_corners_are_interpolated_alike():
    rng = np.random.default_rng(3)
    vertices, faces = rng.uniform([-2, -2, 3], [2, 2, 6], (30, 3)), rng.integers(0, 30, (20, 3))
    K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
    raster = rasterize(vertices, faces, Camera(K, np.eye(3), np.zeros(3), (64, 48)))
    values = rng.uniform(size=(30, 4)).astype(np.float32)
    assert (raster.face >= 0).mean() > 0.2
    np.testing.assert_array_equal(
        raster.interpolate_vertices(faces, values), raster.interpolate(values[faces])
    )
    part = raster.rows(10, 20)
    np.testing.assert_array_equal(part.interpolate(values[faces]), raster.interpolate(values[faces])[10:20])


def test_bytes_and_floats_of_a_texture_are_sampled_alike():
    rng = np.random.default_rng(4)
    texture = rng.integers(0, 256, (9, 7, 3), dtype=np.uint8)
    uv = rng.uniform(-2, 10, (20, 30, 2)).astype(np.float32)
    drawn = rng.integers(-1, 3, (20, 30))
    seen = [np.zeros((20, 30, 3), dtype=np.float32) for _ in range(2)]
    sample_texture(texture, uv, drawn, seen[0])
    sample_texture(texture.astype(np.float32), uv, drawn, seen[1])
    np.testing.assert_array_equal(*seen)
    u, v = np.clip(uv[..., 0], 0, 6), np.clip(uv[..., 1], 0, 8)
    left, top = np.minimum(u.astype(int), 5), np.minimum(v.astype(int), 7)
    s, t = (u - left)[..., None], (v - top)[..., None]
    T = texture.astype(float)
    plain = (1 - t) * ((1 - s) * T[top, left] + s * T[top, left + 1])
    plain += t * ((1 - s) * T[top + 1, left] + s * T[top + 1, left + 1])
    np.testing.assert_allclose(seen[0], np.where(drawn[..., None] < 0, 0.0, plain), atol=1e-2)


def test_a_colour_without_lamps_is_dimmed_alone():
    color = np.full((2, 3), 100, dtype=np.float32)
    points, normals = np.zeros((2, 3), dtype=np.float32), np.ones((2, 3), dtype=np.float32)
    shade_points(color, points, normals, np.array([0.0, 0, -1]), np.zeros((0, 7)), (0.5, 0.0, 1.0))
    np.testing.assert_allclose(color, 50.0)
