import numpy as np
import pytest
import trimesh

from thesisrecon.io.exports import write_point_cloud


def test_another_reader_finds_points_and_colours(tmp_path):
    rng = np.random.default_rng(1)
    xyz, rgb = rng.normal(size=(50, 3)), rng.integers(0, 256, (50, 3), dtype=np.uint8)
    write_point_cloud(tmp_path / "deep" / "points.ply", xyz, rgb)
    cloud = trimesh.load(tmp_path / "deep" / "points.ply")
    np.testing.assert_allclose(cloud.vertices, xyz, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:, :3], rgb)


def test_no_points_are_a_file_too(tmp_path):
    write_point_cloud(tmp_path / "points.ply", np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert b"element vertex 0\n" in (tmp_path / "points.ply").read_bytes()


def test_wrong_shapes_and_infinite_points_are_refused(tmp_path):
    with pytest.raises(ValueError, match="uint8"):
        write_point_cloud(tmp_path / "points.ply", np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="finite"):
        write_point_cloud(tmp_path / "points.ply", np.full((2, 3), np.nan), np.zeros((2, 3), np.uint8))
    assert not list(tmp_path.iterdir())
