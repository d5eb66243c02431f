"""The cube sequence: its file is what the code makes, and its numbers are perfect projections."""

import numpy as np

from thesisrecon.geometry.camera_matrix import compose_camera, project
from validation.scenes.cube import SIZE, make_cube
from validation.scenes.fixtures import write_cube
from validation.scenes.real import ROOT


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
        assert (xy[seen] <= np.array(SIZE) - 0.5).all()
        assert ((C - cube.X[seen]) @ R[2] < 0).all()


def test_six_cameras_see_a_single_plane_and_every_point_is_seen_often():
    cube = make_cube()
    assert np.bincount(cube.faces_seen()).tolist() == [0, 6, 15, 6]
    assert cube.visible.sum(axis=0).min() >= 10
