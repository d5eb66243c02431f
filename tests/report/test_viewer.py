"""What the page tells its viewer of the model."""

import base64
import io
import json
from dataclasses import replace

import numpy as np
from PIL import Image as PillowImage

from tests.report.sphere_run import NAMES, SIZE, sphere_model, sphere_reconstruction
from thesisrecon.geometry.camera_matrix import decompose_camera
from thesisrecon.records import TexturedMesh
from thesisrecon.report import viewer
from thesisrecon.report.figures import upright_rotation
from thesisrecon.report.viewer import LEVELS, viewer_data


def unpacked(text, kind, columns):
    return np.frombuffer(base64.b64decode(text), dtype=kind).reshape(-1, columns)


def upright():
    P = sphere_reconstruction().P
    return upright_rotation(np.stack([decompose_camera(p)[1] for p in P]))


def data_of(mesh):
    return viewer_data(mesh, sphere_reconstruction(), NAMES)


def corners(data):
    """(M, 3, 3) of every triangle as the viewer places it."""
    low, high = np.array(data["low"]), np.array(data["high"])
    positions = low + unpacked(data["positions"], "<u2", 3) / LEVELS * (high - low)
    return positions[unpacked(data["indices"], "<u4", 3)]


def test_every_triangle_arrives_where_it_is_with_its_texture():
    mesh = sphere_model()
    assert mesh.uv is not None
    assert mesh.texture is not None
    data = json.loads(json.dumps(data_of(mesh), allow_nan=False))
    step = max(np.array(data["high"]) - data["low"]) / LEVELS
    expected = (mesh.vertices @ upright().T)[mesh.faces]
    assert np.abs(corners(data) - expected).max() <= 0.51 * step
    uv = unpacked(data["uv"], "<u2", 2)[unpacked(data["indices"], "<u4", 3)] / LEVELS
    height, width = mesh.texture.shape[:2]
    assert np.abs(uv * (width, height) - 0.5 - mesh.uv).max() < 0.51 * max(width, height) / LEVELS
    picture = PillowImage.open(io.BytesIO(base64.b64decode(data["texture"].split(",")[1])))
    assert picture.size == (width, height)
    assert np.abs(np.asarray(picture).astype(int) - mesh.texture).mean() < 6.0


def test_corners_that_agree_are_sent_once():
    mesh = sphere_model()
    assert mesh.uv is not None
    sent = len(unpacked(data_of(mesh)["positions"], "<u2", 3))
    assert len(mesh.vertices) < sent < 0.6 * 3 * len(mesh.faces)


def test_a_model_with_colours_or_none_needs_no_texture():
    mesh = sphere_model()
    colors = np.random.default_rng(0).integers(0, 255, mesh.vertices.shape, dtype=np.uint8)
    bare = replace(mesh, uv=None, texture=None, untextured=None)
    coloured = data_of(replace(bare, colors=colors))
    assert "texture" not in coloured
    np.testing.assert_array_equal(unpacked(coloured["colors"], "u1", 3), colors)
    plain = unpacked(data_of(bare)["colors"], "u1", 3)
    assert (plain == viewer.PLAIN).all()
    assert len(plain) == len(unpacked(data_of(bare)["positions"], "<u2", 3))


def test_the_viewer_stands_where_photographs_were_taken():
    data = data_of(sphere_model())
    names = [f"{k + 1} · {name}" for k, name in enumerate(NAMES)]
    assert [stand["name"] for stand in data["stands"]] == names
    turn = upright()
    for stand, P in zip(data["stands"], sphere_reconstruction().P, strict=True):
        R, t = decompose_camera(P)[1:]
        np.testing.assert_allclose(stand["eye"], turn @ (-R.T @ t), atol=1e-9)
        ahead = np.array(stand["target"]) - stand["eye"]
        np.testing.assert_allclose(ahead / np.linalg.norm(ahead), turn @ R[2], atol=1e-9)
        # Looking at the sphere from 3.8 away, the middle depth lies between its front and its back.
        assert 2.5 < np.linalg.norm(ahead) < 4.9
        np.testing.assert_allclose(stand["field"], (SIZE[0] / 300.0, SIZE[1] / 300.0))
    assert 0 <= data["start"] < len(NAMES)


def test_views_without_a_camera_are_no_stand():
    reconstruction = sphere_reconstruction()
    registered = reconstruction.registered.copy()
    registered[3] = False
    P = reconstruction.P * registered[:, None, None]
    data = viewer_data(sphere_model(), replace(reconstruction, registered=registered, P=P), NAMES)
    assert [stand["name"][0] for stand in data["stands"]] == list("1235678")


def test_a_texture_beyond_the_limit_is_reduced(monkeypatch):
    monkeypatch.setattr(viewer, "MAX_TEXELS", 100 * 100)
    data = data_of(sphere_model())
    picture = PillowImage.open(io.BytesIO(base64.b64decode(data["texture"].split(",")[1])))
    assert 0.9 * 100 * 100 < picture.width * picture.height <= 100 * 100


def test_a_flat_model_has_a_box():
    mesh = TexturedMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]), np.array([[0, 1, 2]]))
    data = data_of(mesh)
    assert np.isfinite(corners(data)).all()
    assert (np.array(data["high"]) > data["low"]).all()


def test_a_stray_does_not_take_the_resolution_of_the_rest():
    mesh = sphere_model()
    assert mesh.uv is not None
    far = np.array([[500.0, 0, 0], [501, 0, 0], [500, 1, 0]])
    n = len(mesh.vertices)
    spoiled = replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, far]),
        faces=np.concatenate([mesh.faces, [[n, n + 1, n + 2]]]),
        uv=np.concatenate([mesh.uv, mesh.uv[:1]]),
    )
    assert data_of(spoiled) == data_of(mesh)
    bare = replace(spoiled, uv=None, texture=None)
    np.testing.assert_array_equal(
        corners(data_of(bare)), corners(data_of(replace(mesh, uv=None, texture=None)))
    )
