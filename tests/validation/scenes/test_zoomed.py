"""Photographs taken anew: the pixels go where the new calibration says."""

import numpy as np
import pytest
from PIL import Image as PillowImage

from validation.scenes.real import Scene
from validation.scenes.zoomed import Frame, Rezoom, central_scene, rezoom_scene, windowed_scene

SIZE = (180, 120)
K = np.array([[150.0, 0.0, 92.0], [0.0, 151.0, 57.0], [0.0, 0.0, 1.0]])
X = np.array([[0.05, -0.03, 1.0], [-0.1, 0.08, 1.0]])


@pytest.fixture
def scene(tmp_path):
    """Two photographs of two white spots that stand where K sees the points X."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    gray = np.zeros(SIZE[::-1])
    for place in spots(K):
        gray += 250.0 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 2.0**2))
    paths = tuple(tmp_path / f"{n}.png" for n in range(2))
    for path in paths:
        PillowImage.fromarray(np.repeat(gray[..., None], 3, axis=2).clip(0, 255).astype(np.uint8)).save(path)
    return Scene("spots", paths, np.array([K, K]), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))


def spots(calibration):
    seen = X @ calibration.T
    return seen[:, :2] / seen[:, 2:]


def found_spot(path, near):
    """Centre of gravity around a place."""
    with PillowImage.open(path) as picture:
        gray = np.asarray(picture, dtype=np.float64)[..., 0]
    y, x = np.mgrid[: gray.shape[0], : gray.shape[1]]
    weight = gray * (np.hypot(x - near[0], y - near[1]) < 9.0)
    return np.array([np.sum(weight * x), np.sum(weight * y)]) / weight.sum()


def test_spots_of_zoomed_photographs_are_where_their_calibration_sees_them(scene, tmp_path):
    for new in (
        rezoom_scene(scene, tmp_path / "zoom", seed=3, how=Rezoom(0.3, 0.05)),
        central_scene(scene, tmp_path / "centre", share=0.7, zoom=1.3),
    ):
        assert new.K is not None
        for path, calibration in zip(new.image_paths, new.K, strict=True):
            for place in spots(calibration):
                assert found_spot(path, place) == pytest.approx(place, abs=0.05)


def test_zoomed_frames_stay_inside_their_photograph_and_move_the_principal_point():
    rng = np.random.default_rng(0)
    shares = []
    for _ in range(50):
        frame = Rezoom().frame(K, SIZE, rng)
        assert frame.left >= -1e-9
        assert frame.top >= -1e-9
        assert np.all(np.array([frame.left, frame.top]) + frame.size <= frame.zoom * np.array(SIZE) + 1e-9)
        assert np.all(np.array(frame.size) <= SIZE)
        middle = (np.array(frame.size) - 1) / 2
        shares.append((frame.calibration(K)[:2, 2] - middle) / frame.size)
    # Frames are whole pixels wide, the shift is drawn for the unrounded one.
    assert np.abs(shares).max() <= 0.1 + 1e-9
    assert np.abs(shares).max() > 0.08


def test_a_frame_of_the_whole_photograph_changes_nothing():
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (12, 18, 3), dtype=np.uint8)
    frame = Frame(1.0, 0.0, 0.0, (18, 12))
    assert np.array_equal(frame.cut(rgb), rgb)
    assert frame.calibration(K) == pytest.approx(K)


def test_a_windowed_photograph_keeps_its_window_and_its_camera(scene, tmp_path):
    new = windowed_scene(scene, tmp_path / "windows", {1: np.array([0.0, 0.0, 0.4, 1.0])})
    with PillowImage.open(new.image_paths[1]) as picture, PillowImage.open(scene.image_paths[1]) as old:
        after, before = np.asarray(picture), np.asarray(old)
    right = after[:, int(0.4 * SIZE[0]) + 1 :]
    assert np.ptp(right) == 0
    inside = slice(30, 40)
    assert np.array_equal(after[50:60, inside], before[50:60, inside])
    assert new.K is scene.K


def test_photographs_without_calibration_are_not_taken_anew(scene, tmp_path):
    with pytest.raises(ValueError, match="need the calibration"):
        rezoom_scene(Scene("bare", scene.image_paths), tmp_path, seed=0)
