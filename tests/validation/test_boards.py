"""Photographs of a board, and what OpenCV makes of them."""

import numpy as np
import pytest

from thesisrecon.errors import StageFailure
from validation.references.libraries import NoReference, load
from validation.references.opencv import board_corners, calibrate_from_corners
from validation.scenes.boards import CORNERS, K1, LENS, RENDERED, SIZE, K, board_images, make_board
from validation.stages.boards import OURS, _metrics

try:
    load("cv2")
except NoReference as missing:
    pytest.skip(str(missing), allow_module_level=True)

VIEWS = 5


def test_boards_are_seen_whole_and_from_all_sides():
    for views in (VIEWS, 12, 16):
        places = make_board(LENS, views).projections()
        assert places.min() > 15.0
        assert (places.max(axis=(0, 1)) < np.array(SIZE) - 15.0).all()
    with pytest.raises(StageFailure, match="no board"):
        board_corners(np.zeros((48, 64, 3), np.uint8), CORNERS)


@pytest.mark.parametrize("way", [RENDERED, LENS])
def test_a_calibration_finds_the_true_camera(way):
    board = make_board(way, VIEWS)
    corners = np.array([board_corners(picture, CORNERS) for picture in board_images(way, board)])
    found = calibrate_from_corners(board.X, list(corners), SIZE)
    reported = {"corners": corners, "K": found.K, "k1": np.array(found.k1), "std": found.std}
    rows = _metrics("boards", way, board, reported)
    # An error of OpenCV's beside its standard deviation is no comparison with us.
    assert not any(row.ranked for row in rows)
    numbers = {row.name.split(": ")[1]: row.values[OURS] for row in rows}
    limits = {"corners": 0.02, "focal length": 0.1, "principal point": 0.7, "distortion": 3e-3}
    for name, limit in limits.items():
        value = numbers[name]
        assert value is not None
        assert value < limit, name
    if way == LENS:
        assert found.k1 == pytest.approx(K1, abs=3e-3)
    shifted = reported | {"corners": corners + 0.5, "K": K + np.diag([3.0, 3.0, 0.0])}
    wrong = {row.name.split(": ")[1]: row.values[OURS] for row in _metrics("boards", way, board, shifted)}
    assert wrong["corners"] == pytest.approx(0.5 * np.sqrt(2.0), abs=0.05)
    assert wrong["focal length"] == pytest.approx(100.0 * 3.0 / K[0, 0])
