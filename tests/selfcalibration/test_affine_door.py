"""The affine stratum in the run's folder."""

import numpy as np

from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.pipeline.outputs import write_affine
from thesisrecon.selfcalibration.affine import upgrade_to_affine


def test_points_and_camera_centres_are_written(tmp_path):
    affine = upgrade_to_affine(projective_reconstruction(make_scene()), np.array([0.02, -0.03, 0.01, 1.0]))
    colours = np.full((300, 3), 77, dtype=np.uint8)
    write_affine(tmp_path / "affine.ply", affine, colours)
    head, _, body = (tmp_path / "affine.ply").read_bytes().partition(b"end_header\n")
    near = affine.valid & (np.abs(affine.X[:, :3]) < 1e3).all(axis=1)
    count = int(near.sum()) + 8
    assert f"element vertex {count}\n".encode() in head
    vertices = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert (vertices["rgb"][-8:] == [255, 0, 0]).all()
    assert (vertices["rgb"][:-8] == 77).all()
    np.testing.assert_allclose(vertices["xyz"][:-8], affine.X[near, :3], rtol=1e-5)


def test_nothing_is_written_of_nothing(tmp_path):
    write_affine(tmp_path / "affine.ply", None, np.zeros((0, 3), dtype=np.uint8))
    assert not (tmp_path / "affine.ply").exists()
