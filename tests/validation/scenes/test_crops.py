"""Parts of photographs: the same each time, of the right size, and their overlap known."""

import numpy as np
import pytest

from validation.scenes.crops import Crop, make_crops, make_separate_crops, shared_area
from validation.scenes.real import load_fixture_scene

PHOTOGRAPHS = load_fixture_scene().image_paths[:3]


def crops_of(count, seed=0):
    return make_crops(
        [PHOTOGRAPHS[:2], PHOTOGRAPHS[2:]], count, long_side=96, rng=np.random.default_rng(seed)
    )


def test_parts_are_the_same_each_time_and_their_sources_take_turns():
    crops, again = crops_of(6), crops_of(6)
    assert all(np.array_equal(a.image.rgb, b.image.rgb) for a, b in zip(crops, again, strict=True))
    assert [crop.image.name for crop in crops] == [f"{k:04d}.png" for k in range(6)]
    assert sorted(crop.source for crop in crops) == [0, 0, 1, 1, 2, 2]
    assert all(crop.scene == (0 if crop.source < 2 else 1) for crop in crops)
    assert all(max(crop.image.size) == 96 for crop in crops)
    assert all(crop.box.min() >= 0.0 and crop.box.max() <= 1.0 for crop in crops)


def test_the_shared_area_is_that_of_the_boxes():
    crop = crops_of(1)[0]
    a = Crop(crop.image, 0, 0, np.array([0.0, 0.0, 0.5, 0.5]))
    b = Crop(crop.image, 0, 0, np.array([0.25, 0.0, 1.0, 0.75]))
    apart = Crop(crop.image, 0, 0, np.array([0.5, 0.5, 1.0, 1.0]))
    other = Crop(crop.image, 1, 0, a.box)
    assert shared_area(a, b) == shared_area(b, a) == pytest.approx(0.5)
    assert shared_area(a, a) == pytest.approx(1.0)
    assert shared_area(a, apart) == shared_area(a, other) == 0.0


def test_separate_scenes_share_nothing_and_come_again_changed():
    rng = np.random.default_rng(0)
    crops = make_separate_crops([PHOTOGRAPHS[:1]], 8, long_side=64, rng=rng, per_scene=2)
    assert [crop.scene for crop in crops] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert all(shared_area(a, b) == 0.0 for a in crops for b in crops if a.scene != b.scene)
    bright = [float(crop.image.rgb.mean()) for crop in crops]
    assert abs(bright[0] + bright[2] - 255.0) < 60.0
    with pytest.raises(ValueError, match="at most 8"):
        make_separate_crops([PHOTOGRAPHS[:1]], 9, long_side=64, rng=rng, per_scene=2)
