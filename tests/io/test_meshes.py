"""Meshes and point clouds as files."""

from dataclasses import replace

import numpy as np
import trimesh

from tests.conftest import refuses
from thesisrecon.api.export import write_mesh
from thesisrecon.errors import UsageError
from thesisrecon.io._exports import write_point_cloud
from thesisrecon.io._meshes import read_mesh
from thesisrecon.records import TexturedMesh


def roof():
    """Two faces with a common ridge at different places of the texture."""
    vertices = np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 1.5], [1, 1, 2]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    uv = np.array([[[0, 0], [9, 0], [0, 9]], [[19, 0], [19, 9], [10, 9]]], dtype=float)
    texture = np.zeros((10, 20, 3), dtype=np.uint8)
    texture[:, :10], texture[:, 10:] = [200, 30, 10], [10, 40, 220]
    return TexturedMesh(vertices, faces, uv=uv, texture=texture)


def color_of(mesh, face):
    """Colour in the middle of a face, by the texture coordinates of the file."""
    image = getattr(mesh.visual.material, "baseColorTexture", None) or mesh.visual.material.image
    u, v = mesh.visual.uv[mesh.faces[face]].mean(axis=0)
    picture = np.asarray(image.convert("RGB"))
    return picture[int((1.0 - v) * picture.shape[0]), int(u * picture.shape[1])]


def test_textures_are_where_they_were(tmp_path):
    path = tmp_path / "model.glb"
    write_mesh(path, roof())
    read = trimesh.load(path, process=False, force="mesh")
    np.testing.assert_allclose(read.triangles, roof().vertices[roof().faces] * [1.0, -1.0, -1.0], atol=1e-6)
    assert np.abs(color_of(read, 0).astype(int) - [200, 30, 10]).max() <= 6
    assert np.abs(color_of(read, 1).astype(int) - [10, 40, 220]).max() <= 6
    assert not list(tmp_path.glob(".*"))


def test_a_mesh_that_no_program_could_read_is_not_written(tmp_path):
    plain = TexturedMesh(roof().vertices, roof().faces)
    hole = np.where(np.arange(4)[:, None] == 3, np.nan, plain.vertices)
    for mesh, words in (
        (replace(plain, vertices=hole), "vertices of faces must be finite"),
        (replace(plain, faces=plain.faces + 1), "vertices that do not exist"),
        (replace(roof(), uv=roof().uv * np.nan), "uv must be finite"),
    ):
        refuses(ValueError, words, write_mesh, tmp_path / "model.glb", mesh)
    assert not (tmp_path / "model.glb").exists()
    unused = replace(plain, vertices=np.vstack([np.full(3, np.nan), plain.vertices]), faces=plain.faces + 1)
    write_mesh(tmp_path / "model.glb", unused)
    np.testing.assert_allclose(read_mesh(tmp_path / "model.glb").vertices, plain.vertices, atol=1e-7)


def test_a_textured_glb_is_read_as_it_was_written(tmp_path):
    mesh = roof()
    write_mesh(tmp_path / "model.glb", mesh)
    read = read_mesh(tmp_path / "model.glb")
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_allclose(read.uv, mesh.uv, atol=1e-4)
    assert np.abs(read.texture.astype(int) - mesh.texture).max() <= 70  # JPEG, at the edge of the colours
    assert np.abs(read.texture.astype(int) - mesh.texture).mean() <= 8
    write_mesh(tmp_path / "again.glb", read)
    again = read_mesh(tmp_path / "again.glb")
    np.testing.assert_array_equal(again.vertices, read.vertices)
    np.testing.assert_array_equal(again.faces, read.faces)


def test_a_large_glb_keeps_its_surface_and_its_order(tmp_path):
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(500, 3)) * [1, 10, 100] + [0, 0, 1000]
    faces = rng.permuted(np.tile(np.arange(500), (4000, 1)), axis=1)[:, :3]
    uv = rng.uniform(-0.5, [299.5, 199.5], (4000, 3, 2))
    mesh = TexturedMesh(vertices, faces, uv=uv, texture=np.zeros((200, 300, 3), np.uint8))
    write_mesh(tmp_path / "model.glb", mesh)
    read = read_mesh(tmp_path / "model.glb")
    np.testing.assert_array_equal(read.vertices, vertices.astype(np.float32))
    np.testing.assert_array_equal(read.faces, faces)
    np.testing.assert_allclose(read.uv, uv, atol=1e-4)


def test_colours_of_vertices_and_bare_meshes_are_read(tmp_path):
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [51, 102, 204]], dtype=np.uint8)
    for given in (colors, None):
        write_mesh(tmp_path / "model.glb", TexturedMesh(roof().vertices, roof().faces, colors=given))
        read = read_mesh(tmp_path / "model.glb")
        np.testing.assert_allclose(read.vertices, roof().vertices)
        np.testing.assert_array_equal(read.faces, roof().faces)
        assert read.uv is read.texture is None
        np.testing.assert_array_equal(read.colors, given)
    before = (tmp_path / "model.glb").read_bytes()
    write_mesh(tmp_path / "again.glb", TexturedMesh(roof().vertices, roof().faces))
    assert (tmp_path / "again.glb").read_bytes() == before


def test_an_unreadable_glb_is_reported(tmp_path):
    path = tmp_path / "model.glb"
    refuses(UsageError, "there is no mesh", read_mesh, path)
    write_mesh(path, roof())
    whole = path.read_bytes()
    for damaged in (b"", b"glTF", whole[:40], whole[: len(whole) // 2], b"x" + whole[1:]):
        path.write_bytes(damaged)
        refuses(UsageError, r"model\.glb (cannot be read|holds no surface)", read_mesh, path)


def test_another_reader_finds_points_and_colours(tmp_path):
    rng = np.random.default_rng(1)
    xyz, rgb = rng.normal(size=(50, 3)), rng.integers(0, 256, (50, 3), dtype=np.uint8)
    write_point_cloud(tmp_path / "deep" / "points.ply", xyz, rgb)
    cloud = trimesh.load(tmp_path / "deep" / "points.ply")
    np.testing.assert_allclose(cloud.vertices, xyz, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:, :3], rgb)
    write_point_cloud(tmp_path / "none.ply", np.zeros((0, 3)), rgb[:0])
    assert b"element vertex 0\n" in (tmp_path / "none.ply").read_bytes()
    refuses(ValueError, "finite", write_point_cloud, tmp_path / "nan.ply", np.full((2, 3), np.nan), rgb[:2])
    assert not (tmp_path / "nan.ply").exists()
