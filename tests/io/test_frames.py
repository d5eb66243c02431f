"""Frames and moving pictures, read again by Pillow."""

import numpy as np
import PIL.Image
import pytest

from thesisrecon.errors import UsageError
from thesisrecon.io.frames import animation_suffix, frame_name, write_animation, write_frame


def picture(k):
    """A smooth picture with a bright bar at another place in each."""
    rgb = np.tile(np.linspace(30, 200, 64).astype(np.uint8)[None, :, None], (48, 1, 3))
    rgb[8 * k : 8 * k + 8] = [220, 40, 60]
    return rgb


def frames(folder, count):
    return [write_frame(folder, k + 1, picture(k)) for k in range(count)]


def test_frames_are_numbered_from_one_and_hold_their_picture(tmp_path):
    written = frames(tmp_path / "new", 3)
    assert [path.name for path in written] == ["frame-0001.png", "frame-0002.png", "frame-0003.png"]
    assert frame_name(12345) == "frame-12345.png"
    for k, path in enumerate(written):
        with PIL.Image.open(path) as image:
            np.testing.assert_array_equal(np.asarray(image), picture(k))
    assert len(list((tmp_path / "new").iterdir())) == 3


@pytest.mark.parametrize(("suffix", "apart"), [(".webp", 4.0), (".png", 0.0)])
def test_an_animation_plays_all_frames_for_ever(suffix, apart, tmp_path):
    path = write_animation(tmp_path / f"all{suffix}", frames(tmp_path, 4), milliseconds=50)
    with PIL.Image.open(path) as image:
        assert image.n_frames == 4
        assert image.info["loop"] == 0
        for k in range(4):
            image.seek(k)
            image.load()
            assert image.info["duration"] == 50
            assert np.abs(np.asarray(image.convert("RGB")).astype(int) - picture(k)).mean() <= apart
    again = write_animation(tmp_path / f"again{suffix}", frames(tmp_path, 4), milliseconds=50)
    assert again.read_bytes() == path.read_bytes()
    assert animation_suffix() in (".webp", ".png")


@pytest.mark.parametrize("suffix", [".webp", ".png"])
def test_one_frame_is_an_animation_too(suffix, tmp_path):
    path = write_animation(tmp_path / f"one{suffix}", frames(tmp_path, 1))
    with PIL.Image.open(path) as image:
        assert image.size == (64, 48)


def test_what_cannot_be_written_is_told(tmp_path):
    (one,) = frames(tmp_path, 1)
    with pytest.raises(ValueError, match=r"written as \.webp or \.png; got all\.gif"):
        write_animation(tmp_path / "all.gif", [one])
    with pytest.raises(ValueError, match="at least one frame"):
        write_animation(tmp_path / "all.webp", [])
    with pytest.raises(UsageError, match=r"absent\.png cannot be read"):
        write_animation(tmp_path / "all.webp", [one, tmp_path / "absent.png"])
    with pytest.raises(UsageError, match="cannot be written"):
        write_frame(one, 1, picture(0))
    assert not (tmp_path / "all.webp").exists()
