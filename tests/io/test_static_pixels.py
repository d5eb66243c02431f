"""Pixels that stay the same while the scene moves are left out."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from thesisrecon import reconstruct
from thesisrecon.imaging.static import static_pixels
from thesisrecon.records import Image

SIZE = (120, 160)


def texture(seed, size=(260, 300)):
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=size), 1.5)
    return 120.0 + 45.0 * smooth / smooth.std()


def images(frames, seed=5):
    """Frames with noise of two levels."""
    rng = np.random.default_rng(seed)
    noisy = (np.clip(frame + rng.normal(0.0, 2.0, frame.shape), 0.0, 255.0) for frame in frames)
    return [
        Image(f"{n}.png", np.repeat(frame.astype(np.uint8)[..., None], 3, axis=2), frame.shape[::-1])
        for n, frame in enumerate(noisy)
    ]


def moving(count, step=(5, 9)):
    """A texture that moves behind the image."""
    world = texture(0)
    return [world[k * step[0] :, k * step[1] :][: SIZE[0], : SIZE[1]].copy() for k in range(count)]


def box(frame, here):
    """The frame with a static rectangle."""
    frame[70:110, 20:90] = here[70:110, 20:90]
    return frame


@pytest.mark.parametrize("count", [4, 7, 14])
def test_a_part_that_stands_still_before_a_moving_scene_is_found(count):
    still = texture(1, SIZE)
    found = static_pixels(images([box(frame, still) for frame in moving(count)]))
    assert sorted(found) == list(range(count))
    for mask in found.values():
        assert mask.shape == SIZE
        assert mask[74:106, 24:86].mean() > 0.95
        outside = mask.copy()
        outside[66:114, 16:94] = False
        assert outside.mean() < 0.01


def test_an_object_before_a_static_room_is_kept():
    room, frames = texture(1, SIZE), []
    for frame in moving(8):
        frame[:, :50], frame[:, 110:], frame[:20] = room[:, :50], room[:, 110:], room[:20]
        frames.append(frame)
    found = static_pixels(images(frames))
    assert len(found) == 8
    for mask in found.values():
        assert mask[:, :46].mean() > 0.95
        assert not mask[26:, 56:104].any()


@pytest.mark.parametrize("frames", [
    pytest.param(moving(8), id="moving"),
    pytest.param(moving(8, (0, 1)), id="slowly moving"),
    pytest.param([texture(1, SIZE)] * 8, id="camera stands still"),
    pytest.param([box(frame, texture(1, SIZE)) for frame in moving(3)], id="three images"),
    pytest.param([np.full(SIZE, 90.0)] * 8, id="no texture"),
    pytest.param([shift(texture(1, SIZE), (0.0, 0.7 * k), mode="reflect") for k in range(8)], id="drift"),
])  # fmt: skip
def test_nothing_is_left_out_of(frames):
    assert not static_pixels(images(frames))


def test_sizes_are_compared_with_their_own_kind_only():
    still = texture(1, SIZE)
    upright = images([box(frame, still) for frame in moving(5)])
    sideways = images([frame.T.copy() for frame in moving(5)])
    assert sorted(static_pixels([*upright, *sideways])) == list(range(5))


def test_a_run_says_what_it_leaves_out_and_can_keep_it(tmp_path):
    still = texture(1, SIZE)
    given = images([box(frame, still) for frame in moving(5)])
    found = reconstruct(given, tmp_path / "out", until="features")
    (warning,) = [text for text in found.warnings if text.code == "static-pixels"]
    assert "of the pixels of 5 images look the same" in warning
    for image, features in zip(found.images, found.features, strict=True):
        x, y = features.xy.T
        assert len(features.xy) > 20
        assert not np.any((x > 24) & (x < 86) & (y > 74) & (y < 106))
        assert not image.mask[90, 50]
    kept = reconstruct(given, tmp_path / "kept", until="features", set={"images.static": "keep"})
    assert all(image.mask is None for image in kept.images)
    assert "static" not in " ".join(text.code for text in kept.warnings)
