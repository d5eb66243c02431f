"""The plane at infinity from vanishing points: given ones, and those of segments found in photographs."""

from dataclasses import replace

import numpy as np
import pytest

from tests.selfcalibration import stratified_scenes as scenes
from tests.synthetic import TrueScene, make_scene, projective_reconstruction
from thesisrecon.errors import StageFailure
from thesisrecon.io._images import read_images
from thesisrecon.records import Tracks
from thesisrecon.selfcalibration._frame import projective_scene
from thesisrecon.selfcalibration.parallel_lines import (
    LineSegments,
    ParallelLines,
    _find_parallel_directions,
    _normalize_segments,
    _propose_vanishing_points,
    _refine_plane,
    _refined_point,
)
from thesisrecon.selfcalibration.stratified import Stratified
from validation.scenes.real import load_fixture_scene

TURN = np.array([[0.8, 0.36, 0.48], [-0.6, 0.48, 0.64], [0.0, -0.8, 0.6]])
"""Three directions at right angles, none of them along an axis."""


def vanishing_points(scene, directions, views):
    """Exact vanishing points of directions (D, 3) in the named views."""
    found = np.full((len(scene.K), len(directions), 3), np.nan)
    found[views] = directions @ (scene.K @ scene.R)[views].swapaxes(1, 2)
    return found


def drawn_segments(scene, *, sigma_px, stray, seed):
    """Segments of 40 lines along each of three directions seen by every camera, and ``stray`` of none."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1.5, 1.5, (120, 3))
    Y = X + np.repeat(TURN, 40, axis=0) * rng.uniform(0.5, 1.0, (120, 1))
    found = []
    for P in scene.P:
        ends = [np.column_stack([Z, np.ones(len(Z))]) @ P.T for Z in (X, Y)]
        true = np.concatenate([e[:, :2] / e[:, 2:] for e in ends], axis=1)
        place = rng.uniform(0.0, 1000.0, (stray, 2))
        wild = np.concatenate([place, place + rng.normal(0.0, 60.0, (stray, 2))], axis=1)
        found.append(np.concatenate([true + rng.normal(0.0, sigma_px, true.shape), wild]))
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("views", [[0, 1], [2, 5, 7]])
def test_three_given_directions_fix_the_plane(seed, views):
    scene = make_scene(seed=seed)
    found, plane = scenes.setup(scene, seed=seed)
    way = ParallelLines(vanishing_points(scene, TURN, views))
    located = way.locate(found, np.random.default_rng(0))
    np.testing.assert_allclose(located.planes[0], plane, atol=1e-8)


def test_more_directions_and_points_at_infinity_do_no_harm():
    scene = make_scene(seed=1)
    R0 = scene.R[0]
    level = np.array([R0[0], R0[1], R0[2], [0.3, -0.2, 0.9]])
    given = vanishing_points(scene, level, [0, 3, 6])
    assert abs(given[0, 0, 2]) < 1e-12
    found, plane = scenes.setup(scene, seed=1)
    located = ParallelLines(given).locate(found, np.random.default_rng(0))
    np.testing.assert_allclose(located.planes[0], plane, atol=1e-8)


def test_directions_at_right_angles_give_the_calibration_too():
    """With three views nothing but right angles and zero skew settles K of one camera."""
    scene = make_scene(seed=2, views=3, principal_shift=(50.0, -30.0), seen_share=1.0)
    way = ParallelLines(vanishing_points(scene, TURN, [0, 1]), orthogonal_directions=True)
    answer = Stratified(way, refine=False).calibrate(
        projective_reconstruction(scene, seed=2), prior=scenes.prior_for(scene, scenes.NOTHING_BUT_CONSTANT),
        rng=np.random.default_rng(0),
    )  # fmt: skip
    np.testing.assert_allclose(answer.K, scene.K, rtol=1e-7, atol=1e-3)


def test_directions_in_one_plane_are_refused():
    scene = make_scene(seed=3)
    found, _ = scenes.setup(scene, seed=3)
    flat = np.array([TURN[0], TURN[1], TURN[0] + TURN[1]])
    with pytest.raises(StageFailure, match="lie in one plane"):
        ParallelLines(vanishing_points(scene, flat, [0, 1])).locate(found, np.random.default_rng(0))


def test_two_directions_are_refused_with_their_number():
    scene = make_scene(seed=3)
    found, _ = scenes.setup(scene, seed=3)
    given = vanishing_points(scene, TURN, [0, 1])
    given[1, 2] = np.nan
    with pytest.raises(StageFailure, match=r"three directions.*2 have"):
        ParallelLines(given).locate(found, np.random.default_rng(0))


def test_a_direction_along_the_baseline_is_no_direction():
    scene = make_scene(seed=3)
    found, plane = scenes.setup(scene, seed=3)
    centres = -np.einsum("vji,vj->vi", scene.R, scene.t)
    along = np.array([*TURN[:2], centres[1] - centres[0]])
    with pytest.raises(StageFailure, match=r"2 have vanishing points .*not parallel to the baseline"):
        ParallelLines(vanishing_points(scene, along, [0, 1])).locate(found, np.random.default_rng(0))
    given = vanishing_points(scene, np.vstack([along, TURN[2]]), [0, 1])
    located = ParallelLines(given).locate(found, np.random.default_rng(0))
    np.testing.assert_allclose(located.planes[0], plane, atol=1e-8)


@pytest.mark.parametrize(("sigma", "stray", "limit"), [(0.0, 0, 1e-8), (0.3, 60, 0.01)])
def test_directions_are_found_among_strays(sigma, stray, limit):
    scene = make_scene(seed=5, views=6)
    found, plane = scenes.setup(scene, seed=5)
    frame = found.frame
    segments = _normalize_segments(frame, drawn_segments(scene, sigma_px=sigma, stray=stray, seed=5))
    rng = np.random.default_rng(1)
    proposals = [_propose_vanishing_points(segments.subset(segments.camera == k), rng) for k in range(6)]
    X, direction = _find_parallel_directions(frame.P, segments, proposals, 3)
    again = _refined_point(frame.P, segments, X[0] + [1e-3, -1e-3, 1e-3, 0.0])
    np.testing.assert_allclose(again, X[0], atol=2e-4)
    truth = np.tile(np.concatenate([np.repeat([0, 1, 2], 40), np.full(stray, -1)]), 6)
    for d in range(3):
        mine = truth[direction == d]
        # A segment that runs towards two of the directions goes to the stronger one.
        right = np.bincount(mine[mine >= 0], minlength=3).max()
        assert right > max(0.7 * 240, 0.85 * len(mine))
    v = X[:, :3] / np.linalg.norm(X[:, :3], axis=1, keepdims=True)
    start = np.linalg.svd(X)[2][-1]
    refined, _, noise = _refine_plane(frame, segments, direction, start[:3] / start[3], v)
    np.testing.assert_allclose(refined, plane, atol=limit)
    assert noise == pytest.approx(sigma, rel=0.5, abs=0.01)


def test_the_detector_finds_the_sides_of_a_turned_square():
    y, x = np.mgrid[0:200, 0:240].astype(np.float64)
    angle, half, centre = np.radians(17.0), 60.0, (118.3, 97.6)
    a = (x - centre[0]) * np.cos(angle) + (y - centre[1]) * np.sin(angle)
    b = -(x - centre[0]) * np.sin(angle) + (y - centre[1]) * np.cos(angle)
    outside = np.maximum(np.abs(a), np.abs(b)) - half
    gray = (60.0 + 120.0 * np.clip(0.5 - outside, 0.0, 1.0)).astype(np.float32)
    segments = LineSegments().detect(gray)
    assert len(segments) == 4
    for x1, y1, x2, y2 in segments:
        assert np.hypot(x2 - x1, y2 - y1) > 100.0
        for px, py in ((x1, y1), (x2, y2)):
            u = (px - centre[0]) * np.cos(angle) + (py - centre[1]) * np.sin(angle)
            w = -(px - centre[0]) * np.sin(angle) + (py - centre[1]) * np.cos(angle)
            assert max(abs(u), abs(w)) == pytest.approx(half, abs=0.15)


def test_a_flat_image_has_no_segments_and_noise_has_few():
    assert LineSegments().detect(np.full((50, 60), 90.0, dtype=np.float32)).shape == (0, 4)
    noise = np.random.default_rng(0).normal(128.0, 5.0, (300, 400)).astype(np.float32)
    assert len(LineSegments().detect(noise)) < 10


def courtyard(views):
    """The true cameras of the courtyard with points strewn over the yard."""
    reported = load_fixture_scene()
    X = np.random.default_rng(0).uniform([-3.0, -2.5, 0.2], [3.0, -0.2, 3.0], (200, 3))
    t = -np.einsum("vij,vj->vi", reported.R, reported.C)[views]
    K, R = reported.K[views], reported.R[views]
    seen = np.einsum("vij,nj->vni", K @ R, X) + (K @ t[..., None])[:, None, :, 0]
    point, view = np.indices((len(X), len(views))).reshape(2, -1)
    xy = (seen[..., :2] / seen[..., 2:])[view, point]
    tracks = Tracks(view, point, xy, len(views), len(X))
    sizes = np.tile([1024, 768], (len(views), 1))
    return TrueScene(K, R, t, X, 0.0, tracks, sizes), [reported.image_paths[v] for v in views]


def test_parallel_lines_are_found_in_photographs():
    scene, paths = courtyard([0, 3, 6, 9, 12])
    photographs = read_images(paths, max_size_px=1600).images
    given, prior = projective_reconstruction(scene), scenes.prior_for(scene, scenes.CENTRED)
    variant = Stratified(ParallelLines(), refine=False).with_images(photographs)
    found = projective_scene(given, prior)
    located = variant.plane.locate(found, np.random.default_rng(0))
    plane = scenes.true_plane(scene, found)
    assert np.linalg.norm(located.planes[0] - plane) < 0.02 * (1.0 + np.linalg.norm(plane))
    answer = variant.calibrate(given, prior=prior, rng=np.random.default_rng(0))
    np.testing.assert_allclose(answer.K[:, 0, 0], scene.K[0, 0, 0], rtol=0.03)


def test_a_wall_of_nothing_is_refused_with_its_directions():
    scene, paths = courtyard([0, 6, 12])
    photographs = read_images(paths, max_size_px=1600).images
    flat = [replace(image, rgb=np.full_like(image.rgb, 90)) for image in photographs]
    with pytest.raises(StageFailure, match="0 directions"):
        Stratified(ParallelLines()).with_images(flat).calibrate(
            projective_reconstruction(scene), prior=scenes.prior_for(scene), rng=np.random.default_rng(0)
        )
