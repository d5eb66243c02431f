from __future__ import annotations

import base64
import dataclasses
import io

import numpy as np
import pytest
from PIL import Image as PillowImage

from tests.report.synthetic import SIZE, made_up_run
from thesisrecon.report.drawing import HUES, clip_line, draw_pair, spread_matches, thumbnail


def opened(uri: str) -> PillowImage.Image:
    head, text = uri.split(",", 1)
    assert head == "data:image/jpeg;base64"
    return PillowImage.open(io.BytesIO(base64.b64decode(text)))


def test_a_thumbnail_keeps_the_aspect_and_shrinks_when_there_are_many() -> None:
    photograph = made_up_run(points=50).photographs[0]
    few, many = thumbnail(photograph, 10), thumbnail(photograph, 2000)
    assert few is not None
    assert many is not None
    assert opened(few.uri).size == (few.width, few.height) == (360, 240)
    assert many.width < few.width / 3
    assert thumbnail(dataclasses.replace(photograph, rgb=None), 10) is None


def test_the_lines_pass_through_the_numbered_matches() -> None:
    data = made_up_run(points=400)
    pair = data.pairs[2]
    flat = [np.full((SIZE[1], SIZE[0], 3), 90, dtype=np.uint8)] * 2
    first, second = (
        dataclasses.replace(data.photographs[v], rgb=rgb)
        for v, rgb in zip((pair.i, pair.j), flat, strict=True)
    )
    drawn = draw_pair(pair, first, second)
    assert drawn is not None
    pixels = np.asarray(opened(drawn.uri)).astype(int)
    s = 640 / max(SIZE)
    chosen = spread_matches(pair.xy1, len(HUES))
    for x, y in (pair.xy1[chosen] + 0.5) * s - 0.5:
        # A dot of the colour of its line: bright and coloured or at least far from the grey ground.
        spot = pixels[round(y), round(x)]
        assert np.abs(spot - 70).max() > 60
    # The second half holds lines as well: something coloured crosses it from side to side.
    right = pixels[:, 640 + 8 + 1 :]
    assert (np.ptp(right, axis=2) > 40).any(axis=0).mean() > 0.95


def test_a_pair_without_pixels_or_matches_is_no_error() -> None:
    data = made_up_run(points=100)
    pair = data.pairs[0]
    bare = dataclasses.replace(data.photographs[0], rgb=None)
    assert draw_pair(pair, bare, data.photographs[1]) is None
    empty = dataclasses.replace(pair, xy1=np.zeros((0, 2)), xy2=np.zeros((0, 2)))
    assert draw_pair(empty, data.photographs[0], data.photographs[1]) is not None


def test_lines_are_cut_at_the_edges_of_the_photograph() -> None:
    level = clip_line(np.array([0.0, 1.0, -10.0]), 100, 50)
    assert level == ((-0.5, 10.0), (99.5, 10.0))
    upright = clip_line(np.array([1.0, 0.0, -10.0]), 100, 50)
    assert upright == ((10.0, -0.5), (10.0, 49.5))
    assert clip_line(np.array([0.0, 1.0, 20.0]), 100, 50) is None
    assert clip_line(np.zeros(3), 100, 50) is None


def test_spread_matches_are_different_and_far_apart() -> None:
    xy = np.random.default_rng(0).uniform(0, 100, (500, 2))
    chosen = spread_matches(xy, 12)
    assert len(set(chosen.tolist())) == 12
    gaps = np.linalg.norm(xy[chosen][:, None] - xy[chosen][None], axis=2) + np.eye(12) * 1e9
    assert gaps.min() > 20
    assert len(spread_matches(xy[:5], 12)) == 5
    assert len(spread_matches(np.zeros((0, 2)), 12)) == 0


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 900, 3)])
def test_odd_pictures_have_thumbnails(shape: tuple[int, int, int]) -> None:
    photograph = dataclasses.replace(
        made_up_run(points=50).photographs[0], rgb=np.zeros(shape, dtype=np.uint8)
    )
    assert thumbnail(photograph, 3) is not None
