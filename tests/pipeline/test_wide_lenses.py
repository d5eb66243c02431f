"""Lenses that bend lines: found in pairs of images, and cameras of a room without any prior."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PillowImage
from scipy.spatial.transform import Rotation

from thesisrecon import Camera, reconstruct, reconstruct_from_tracks
from thesisrecon.arrays import F64
from thesisrecon.epipolar.division import bend, estimate_division, is_nearly_straight, is_straight, straighten
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.imaging.resampling import resampled
from thesisrecon.io._images import read_image
from thesisrecon.io._models import read_model
from thesisrecon.lens import DIVISION, PERSPECTIVE, image_of_directions, lens_row
from thesisrecon.pipeline.inputs import given_tracks, views_of
from thesisrecon.pipeline.lens import StraightFrame
from thesisrecon.records import Image

FIXTURES = Path(__file__).parents[2] / "fixtures"
SIZE = (1000, 750)
CENTRE = (np.array(SIZE) - 1.0) / 2.0 + [6.0, -5.0]
LENSES: dict[str, tuple[Any, list[float], float]] = {
    "straight": ("radial", [0.0], 700.0),
    "slight": ("radial", [-0.05], 800.0),
    "radial": ("radial", [-0.2, 0.04], 520.0),
    "fisheye": ("fisheye", [-0.02, 0.001], 380.0),
    "division": ("division", [-0.25], 420.0),
    "decentred": ("thin-prism-fisheye", [-0.02, 0.001, 0.002, -0.0015], 380.0),
    "slight-decentred": ("brown", [-0.05, 0.01, -0.0015, 0.002], 700.0),
}


def _inside(lens: str, *, seed: int = 0, views: int = 12, points: int = 1800) -> tuple[F64, F64, F64]:
    """Pixels (V, N, 2) of a room, cameras on a circle in it that look outwards; centres and rotations."""
    kind, k, focal = LENSES[lens]
    rng = np.random.default_rng([11, seed])
    X = rng.uniform(-1.0, 1.0, (points, 3))
    wall = rng.integers(0, 3, points)
    X[np.arange(points), wall] = np.sign(X[np.arange(points), wall])
    X *= [7.0, 7.0, 3.5]
    angles = 2.0 * np.pi * np.arange(views) / views
    C = np.column_stack([2.5 * np.cos(angles), 2.5 * np.sin(angles), 0.6 * np.sin(3.0 * angles)])
    turn = Rotation.from_euler(
        "yx", np.column_stack([90.0 - np.degrees(angles), rng.normal(0, 8, views)]), degrees=True
    )
    R = turn.inv().as_matrix() @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    row, xy = lens_row(kind, np.array(k)), np.full((views, points, 2), np.nan)
    for v in range(views):
        Y = (X - C[v]) @ R[v].T
        ahead = Y[:, 2] > 0.1 * np.linalg.norm(Y, axis=1)
        place = image_of_directions(Y[ahead], row) * focal + CENTRE
        inside = ((place > 0) & (place < np.array(SIZE) - 1.0)).all(axis=1)
        seen = np.flatnonzero(ahead)[inside]
        xy[v, seen] = place[inside]
    return xy + rng.normal(0.0, 0.3, xy.shape), C, R


def _matches(xy: F64) -> Any:
    return given_tracks(xy, views_of([SIZE] * len(xy), None, None)).matches


def _straightness(lens: str, k: F64) -> float:
    """Largest distance px of true straight positions from those of a lens, up to a focal length."""
    kind, coefficients, focal = LENSES[lens]
    tangents = np.linspace(0.02, 1.2, 60)
    rays = np.column_stack([tangents, 0.0 * tangents, np.ones(60)])
    middle = (np.array(SIZE) - 1.0) / 2.0
    xy = image_of_directions(rays, lens_row(kind, np.array(coefficients))) * focal + middle
    straight = (straighten(xy, np.array(SIZE), k)[0] - middle)[:, 0]
    scale = float(straight @ tangents / (tangents @ tangents))
    return float(np.abs(straight / scale - tangents).max())


@pytest.mark.parametrize(("lens", "base"), [
    ("straight", None), ("slight", None), ("radial", PERSPECTIVE), ("fisheye", DIVISION),
])  # fmt: skip
def test_pairs_show_the_lens(lens: str, base: int | None) -> None:
    found = estimate_division(_matches(_inside(lens)[0]), np.array([SIZE] * 12), np.random.default_rng(0))
    assert found is not None
    assert found.bends is (base is not None)
    if base is not None:
        assert found.k[2] == base
        assert _straightness(lens, found.k) < 0.01
        assert _straightness(lens, np.array([0.0, 0.0, DIVISION])) > 0.05


def test_a_bent_lens_is_found_although_zero_is_a_minimum() -> None:
    rng, xy = np.random.default_rng(2), _inside("fisheye", seed=2, points=500)[0]
    # With a third of the points wrong and the corners empty, k1 refined from zero stays near zero.
    xy[np.linalg.norm(xy - CENTRE, axis=2) > 0.8 * np.linalg.norm(CENTRE)] = np.nan
    wrong = rng.permutation(500)[:150]
    xy[:, wrong] = np.where(np.isnan(xy[:, wrong]), np.nan, rng.uniform(0, 700, xy[:, wrong].shape))
    neighbours = [m for m in _matches(xy) if m.j == m.i + 1]
    assert not is_nearly_straight(neighbours, np.array([SIZE] * 12), np.random.default_rng(1))


def test_wrong_matches_do_not_change_the_lens() -> None:
    rng, xy = np.random.default_rng(5), _inside("fisheye")[0]
    # A third of the points are seen somewhere else in each image.
    wrong = rng.permutation(xy.shape[1])[: xy.shape[1] // 3]
    xy[:, wrong] = np.where(np.isnan(xy[:, wrong]), np.nan, rng.uniform(0, 700, xy[:, wrong].shape))
    found = estimate_division(_matches(xy), np.array([SIZE] * 12), rng)
    assert found is not None
    assert found.bends
    assert _straightness("fisheye", found.k) < 0.01


@pytest.mark.parametrize("k", [[-0.9, -0.3, DIVISION], [-0.3, 0.08, PERSPECTIVE], [0.1, 0.0, DIVISION]])
def test_straight_positions_have_an_inverse(k: list[float]) -> None:
    rng, size = np.random.default_rng(2), np.array(SIZE)
    xy = rng.uniform(0.0, size - 1.0, (300, 2))
    straight, magnification = straighten(xy, size, np.array(k))
    near = is_straight(magnification)
    np.testing.assert_allclose(bend(straight[near], size, np.array(k)), xy[near], atol=1e-9)
    along = xy[near] - (size - 1.0) / 2.0
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    ends = (straighten(xy[near] + sign * 1e-3 * along, size, np.array(k))[0] for sign in (1, -1))
    slope = np.linalg.norm(next(ends) - next(ends), axis=1) / 2e-3
    np.testing.assert_allclose(magnification[near], slope, rtol=1e-5)


def test_a_straight_image_has_corners_of_the_scales_of_its_image() -> None:
    rgb = np.random.default_rng(3).integers(0, 256, (240, 320, 3)).astype(np.uint8).repeat(2, 0).repeat(2, 1)
    image = Image("a.png", rgb, (1280, 960))
    straight = StraightFrame.of(image.size, np.array([-0.6, -0.1, DIVISION])).image(image)
    assert max(straight.size) > 1000 > max(image.size)
    scales = [np.unique(MultiScaleCorners().detect(one).scale) for one in (image, straight)]
    np.testing.assert_array_equal(*scales)


@pytest.mark.parametrize(("lens", "views", "given"), [
    ("radial", 18, "auto"), ("division", 12, "auto"), ("fisheye", 12, "auto"), ("decentred", 12, "auto"),
    ("slight-decentred", 24, "brown"), ("slight", 24, "fisheye"),
])  # fmt: skip
def test_cameras_of_a_room_without_a_prior(lens: str, views: int, given: str) -> None:
    xy, C, _ = _inside(lens, views=views)
    result = reconstruct_from_tracks(xy, [SIZE] * len(C), set={"intrinsics.lens": given})
    assert len(result.cameras) == len(C)
    assert result.metric is not None
    assert result.metric.trusted, result.metric.failed_checks
    kind, k, focal = LENSES[lens]
    camera = result.cameras[0]
    assert camera.std is not None
    assert camera.lens == (kind if given == "auto" else given)
    assert abs(camera.K[0, 0] - focal) < max(3.0 * camera.std["focal_px"], 0.002 * focal)
    centres = np.array([result.cameras[i].centre for i in range(len(C))])
    off = estimate_similarity(centres, C).apply(centres) - C
    extent = np.sqrt(((C - C.mean(axis=0)) ** 2).sum(axis=1).mean())
    # Narrow lenses in the middle of a room are less certain.
    assert np.sqrt((off**2).sum(axis=1).mean()) < (0.005 if given == "auto" else 0.01) * extent
    K = np.array([[focal, 0.0, CENTRE[0]], [0.0, focal, CENTRE[1]], [0.0, 0.0, 1.0]])
    true = Camera(K, np.eye(3), np.zeros(3), SIZE, np.array(k), lens=kind)
    stds = [camera.std[name] for name in ("angle_of_view_deg", "corner_deg")]
    off = np.abs(np.subtract(camera.angles_of_view, true.angles_of_view))
    assert (off < 3.5 * np.array(stds)).all()
    assert off[0] < 0.002 * true.angles_of_view[0]
    if "decentred" in lens:
        assert camera.distortion is not None
        stds = [camera.std["p1"], camera.std["p2"]]
        assert max(stds) < 0.002
        assert (np.abs(camera.distortion[2:4] - k[2:4]) < 3.5 * np.array(stds)).all()


def test_the_angle_of_corners_without_points_contains_that_of_other_lenses() -> None:
    rng, views, k = np.random.default_rng([5, 810]), 12, np.array([-0.2, 0.04])
    X = rng.uniform(-1.0, 1.0, (900, 3)) * [2.5, 2.5, 1.5]
    angles = np.linspace(-1.3, 1.3, views)
    C = np.column_stack([6.0 * np.cos(angles), 6.0 * np.sin(angles), 1.5 + 0.7 * np.sin(4.0 * angles)])
    turn = np.column_stack([270.0 - np.degrees(angles), rng.normal(0.0, 8.0, views)])
    R = Rotation.from_euler("yx", turn, degrees=True).inv().as_matrix()
    R = R @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    xy = np.stack([image_of_directions((X - c) @ r.T, k) for r, c in zip(R, C, strict=True)]) * 560.0 + CENTRE
    xy[~((xy > 0) & (xy < np.array(SIZE) - 1.0)).all(axis=2)] = np.nan
    result = reconstruct_from_tracks(xy + rng.normal(0.0, 0.3, xy.shape), [SIZE] * views)
    K = np.array([[560.0, 0.0, CENTRE[0]], [0.0, 560.0, CENTRE[1]], [0.0, 0.0, 1.0]])
    true, camera = Camera(K, np.eye(3), np.zeros(3), SIZE, k), result.cameras[0]
    assert camera.std is not None
    stds = [camera.std[name] for name in ("angle_of_view_deg", "corner_deg")]
    assert (np.abs(np.subtract(camera.angles_of_view, true.angles_of_view)) < 3.0 * np.array(stds)).all()


def test_points_in_the_middle_leave_the_corners_uncertain() -> None:
    rng, views = np.random.default_rng(4), 10
    X = rng.uniform(-2.0, 2.0, (1200, 3))
    angles = np.radians(np.linspace(-60.0, 60.0, views))
    R = Rotation.from_euler("yx", np.column_stack([angles, rng.normal(0.0, 0.1, views)])).as_matrix()
    row = lens_row("fisheye", np.array([-0.02]))
    xy = np.stack([image_of_directions(X @ turn.T + [0.0, 0.0, 9.0], row) for turn in R]) * 420.0 + CENTRE
    result = reconstruct_from_tracks(xy + rng.normal(0.0, 0.3, xy.shape), [SIZE] * views)
    camera = result.cameras[0]
    assert camera.std is not None
    assert abs(camera.K[0, 0] - 420.0) < 3.0 * camera.std["focal_px"]
    assert result.metric is not None
    assert "of the half diagonal" in str(result.metric.warnings)


@pytest.mark.slow
def test_bent_photographs_give_the_cameras_of_straight_ones(tmp_path: Path) -> None:
    k, shrink = np.array([-0.35, -0.05, DIVISION]), 0.7
    truth = read_model(FIXTURES / "courtyard" / "cameras.json")
    names = truth.names[:8]
    for name in names:
        image = read_image(FIXTURES / "courtyard" / "images" / name, max_size_px=640).images[0]
        size = np.array(image.size)
        middle = (size - 1.0) / 2.0

        def lookup(rows: range, size: Any = size, middle: Any = middle) -> F64:
            x, y = np.meshgrid(np.arange(float(size[0])), np.arange(float(rows.start), float(rows.stop)))
            straight = straighten(np.stack([x, y], axis=-1).reshape(-1, 2), size, k)[0]
            return np.asarray((middle + shrink * (straight - middle)).reshape(*x.shape, 2))

        rgb, _ = resampled(image.levels, lookup, image.size)
        PillowImage.fromarray(rgb).save(tmp_path / f"{Path(name).stem}.png")
    result = reconstruct(tmp_path, tmp_path / "out", until="metric", threads=1)
    assert len(result.cameras) == len(names)
    camera, view = result.cameras[0], truth.views[0]
    # The middle of the bending is not the principal point: it looks like decentring.
    assert camera.std is not None
    assert view.K is not None
    assert view.size is not None
    focal = view.K[0, 0] * 640.0 / max(view.size) / shrink
    assert abs(camera.K[0, 0] - focal) < max(3.0 * camera.std["focal_px"], 0.005 * focal)
    C = np.array([truth.views[i].centre for i in range(len(names))])
    centres = np.array([result.cameras[i].centre for i in range(len(names))])
    off = estimate_similarity(centres, C).apply(centres) - C
    extent = np.sqrt(((C - C.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.005 * extent
