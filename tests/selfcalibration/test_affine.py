"""The affine stratum: what it keeps on exact data, and the front door to it."""

from dataclasses import replace

import numpy as np
import pytest

import thesisrecon
from tests.conftest import refuses
from tests.selfcalibration.stratified_scenes import CENTRED, prior_for
from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conditioning import pixel_from_unit
from thesisrecon.pipeline.outputs import write_affine
from thesisrecon.selfcalibration.cheirality import CheiralitySearch, ModulusConstraint
from thesisrecon.selfcalibration.parallel_lines import ParallelLines
from thesisrecon.selfcalibration.stratified import Stratified, _facing, upgrade_to_affine


def affine_map(source, target):
    """Least-squares affine map (4, 3) of points (N, 3) and its largest residual."""
    homogeneous = np.column_stack([source, np.ones(len(source))])
    A = np.linalg.lstsq(homogeneous, target, rcond=None)[0]
    return A, float(np.abs(homogeneous @ A - target).max())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("plane", [CheiralitySearch(), ModulusConstraint()], ids=lambda p: type(p).__name__)
def test_the_located_plane_leaves_an_affine_map_to_the_scene(plane, seed):
    scene = make_scene(seed=seed)
    given = projective_reconstruction(scene, seed=seed)
    config = PipelineConfig(selfcalibration=Stratified(plane), intrinsics=CENTRED)
    affine = thesisrecon.upgrade_affine(given, config=config)
    assert affine.stratum == "affine"
    assert affine.valid.all()
    np.testing.assert_allclose(affine.X[:, 3], 1.0)
    A, worst = affine_map(scene.X, affine.X[:, :3])
    assert worst < 1e-7
    centres = np.column_stack([scene.centres, np.ones(len(scene.centres))]) @ A
    estimated = -np.linalg.solve(affine.P[:, :, :3], affine.P[:, :, 3:])[..., 0]
    np.testing.assert_allclose(estimated, centres, atol=1e-6)


def test_parallels_stay_parallel_and_ratios_are_kept():
    scene = make_scene(seed=1)
    rng = np.random.default_rng(0)
    start, step, ratio = rng.uniform(-1, 1, (50, 3)), np.array([0.3, -0.5, 0.4]), rng.uniform(0.2, 0.8, 50)
    ends = start + step
    X = np.concatenate([start, ends, start + ratio[:, None] * (ends - start)])
    points = np.concatenate([X, scene.X[150:]])
    given = projective_reconstruction(replace(scene, X=points), seed=1)
    answer = Stratified(ModulusConstraint()).calibrate(
        given, prior=prior_for(scene), rng=np.random.default_rng(0)
    )
    affine = upgrade_to_affine(given, answer.plane_at_infinity)
    a, b, c = affine.X[:150, :3].reshape(3, 50, 3)
    np.testing.assert_allclose(b - a, np.tile(b[0] - a[0], (50, 1)), atol=1e-6)
    np.testing.assert_allclose(c - a, ratio[:, None] * (b - a), atol=1e-6)
    # The projective frame keeps neither.
    p, q = (given.X[:100, :3] / given.X[:100, 3:]).reshape(2, 50, 3)
    directions = (q - p) / np.linalg.norm(q - p, axis=1)[:, None]
    assert np.abs(directions - directions[0]).max() > 0.01


def test_images_stay_what_they_are_and_depths_are_positive():
    scene = make_scene(seed=2)
    given = projective_reconstruction(scene, seed=2)
    affine = upgrade_to_affine(given, np.array([0.1, -0.2, 0.05, 1.0]))
    t = scene.tracks
    before, after = (np.einsum("kij,kj->ki", r.P[t.view_index], r.X[t.point_index]) for r in (given, affine))
    np.testing.assert_allclose(before[:, :2] / before[:, 2:], after[:, :2] / after[:, 2:], rtol=1e-9)
    # Outliers behind a camera do not turn it, even if they are more than the inliers.
    away, X = np.arange(len(affine.X)) % 3 > 0, affine.X.copy()
    X[away, :3] = -2.0 * np.linalg.solve(affine.P[0, :, :3], affine.P[0, :, 3]) - X[away, :3]
    assert (_facing(replace(affine, X=X, inlier=~away[t.point_index]))[0] == affine.P[0]).all()
    true = thesisrecon.upgrade_affine(given, config=PipelineConfig(intrinsics=CENTRED))
    depth = np.einsum("kj,kj->k", true.P[t.view_index, 2], true.X[t.point_index])
    assert (depth > 0).all()
    # One camera is [I | 0] behind its nominal calibration, its points at a median depth of 1.
    units = np.linalg.solve(pixel_from_unit(true.sizes), true.P)
    units /= np.linalg.norm(units[:, 2, :3], axis=1)[:, None, None]
    view = int(np.argmin(np.abs(units - np.eye(3, 4)).max(axis=(1, 2))))
    np.testing.assert_allclose(units[view], np.eye(3, 4), atol=1e-9)
    assert np.median(true.X[t.point_index[t.view_index == view], 2]) == pytest.approx(1.0)


def test_a_located_plane_is_not_needed_where_one_is_given():
    given = projective_reconstruction(make_scene(seed=3), seed=3)
    plane = np.array([0.1, 0.0, -0.1, 1.0])
    upgraded = upgrade_to_affine(given, plane)
    np.testing.assert_array_equal(thesisrecon.upgrade_affine(given, plane).X, upgraded.X)


def test_wrong_calls_and_hopeless_data_are_refused():
    given = projective_reconstruction(make_scene(seed=3), seed=3)
    affine = upgrade_to_affine(given, np.array([0.0, 0.0, 0.0, 1.0]))
    refuses(ValueError, "affine", upgrade_to_affine, affine, np.ones(4))
    refuses(ValueError, "plane", upgrade_to_affine, given, np.zeros(4))
    few = replace(given, registered=np.arange(8) < 2)
    refuses(StageFailure, "at least 3", thesisrecon.upgrade_affine, few)
    with pytest.raises(ValueError, match="an image for each"):
        thesisrecon.upgrade_affine(given, config=PipelineConfig(selfcalibration=Stratified(ParallelLines())))


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


def test_cameras_at_infinity_are_left_out_of_the_file(tmp_path):
    affine = upgrade_to_affine(projective_reconstruction(make_scene()), np.array([0.02, -0.03, 0.01, 1.0]))
    P = affine.P.copy()
    P[1, 2, :3] = P[1, 0, :3] + P[1, 1, :3]
    P[2, 2, :3] = 0.0
    write_affine(tmp_path / "a.ply", replace(affine, P=P), np.zeros((len(affine.X), 3), dtype=np.uint8))
    head = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")[0].decode()
    near = affine.valid & (np.abs(affine.X[:, :3]) < 1e3).all(axis=1)
    assert f"element vertex {near.sum() + len(P) - 2}\n" in head
