"""Pictures stripe by stripe: the pixels of the whole picture at once, in less room."""

import io
import threading
import time

import numpy as np
import PIL.Image
import pytest

from thesisrecon.io.images import LARGEST_DECODED, read_images
from thesisrecon.io.pixels import AS_STORED, TURNS, Picture, Room, at_working_size, bytes_to_decode


def coloured(width, height, mode="RGB"):
    """Noise of several scales, so that every row and column is of its own."""
    rng = np.random.default_rng([width, height])
    coarse = PIL.Image.fromarray(rng.integers(0, 256, (height // 9, width // 9, 3), dtype=np.uint8))
    return coarse.resize((width, height), PIL.Image.Resampling.BICUBIC).convert(mode)


def at_once(picture, size, max_size_px):
    """The whole picture by Pillow's own way."""
    scale = max_size_px / max(picture.size)
    box = (0.0, 0.0, min(picture.width, size[0] / scale), min(picture.height, size[1] / scale))
    return np.asarray(picture.resize(size, PIL.Image.Resampling.LANCZOS, box=box, reducing_gap=3.0))


@pytest.mark.parametrize("turn", [AS_STORED, *TURNS.values()], ids=lambda turn: str(turn.method))
@pytest.mark.parametrize(("width", "height"), [(1000, 667), (600, 1100)])
def test_stripes_give_the_pixels_of_the_whole_picture(turn, width, height):
    upright = coloured(width, height)
    back = {PIL.Image.Transpose.ROTATE_90: 270, PIL.Image.Transpose.ROTATE_270: 90}.get(turn.method)
    if back is not None:
        stored = upright.rotate(back, expand=True)
    else:
        stored = upright if turn.method is None else upright.transpose(turn.method)
    picture = Picture(stored, turn)
    assert picture.size == (width, height)
    np.testing.assert_array_equal(at_working_size(picture, 1600), np.asarray(upright))
    for most in (900, 300, 130, 64):
        found = at_working_size(picture, most)
        assert max(found.shape[:2]) == most
        np.testing.assert_array_equal(found, at_once(upright, found.shape[1::-1], most))


@pytest.mark.parametrize("mode", ["L", "1", "P", "CMYK", "YCbCr", "LAB"])
def test_colours_are_converted_alike_in_stripes(mode):
    stored = coloured(500, 700, mode)
    found = at_working_size(Picture(stored), 200)
    np.testing.assert_array_equal(found, at_once(stored.convert("RGB"), (142, 200), 200))


def test_every_stripe_of_a_deep_picture_has_the_range_of_all():
    """The bright end stands below the first stripe."""
    values = np.repeat(np.arange(900, dtype=np.uint16)[:, None] * 4, 80, axis=1)
    for array in (values, values.astype(np.float32), values.astype(np.int32)):
        found = at_working_size(Picture(PIL.Image.fromarray(array)), 1600)
        top = 3596 if array.dtype == np.float32 else 4095
        assert np.abs(found[..., 1] - values * (255.0 / top)).max() <= 0.51


def test_threads_take_no_more_room_together_than_there_is():
    room, held, most = Room(100), [0], [0]

    def use(amount):
        with room.taken(amount):
            held[0] += amount
            most[0] = max(most[0], held[0] if amount <= 100 else 0)
            assert amount <= 100 or held[0] == amount
            time.sleep(0.002)
            held[0] -= amount

    threads = [threading.Thread(target=use, args=(amount,)) for amount in (40, 60, 30, 100, 250, 70, 20) * 3]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()
    assert held == [0]
    assert 60 <= most[0] <= 100


def test_an_error_gives_the_room_back():
    room = Room(10)
    with pytest.raises(KeyError), room.taken(10):
        raise KeyError
    with room.taken(10):
        pass


def opened(kind, image, **options):
    stream = io.BytesIO()
    image.save(stream, kind, **options)
    return PIL.Image.open(stream)


def test_what_decoding_takes_depends_on_the_format():
    image = coloured(90, 90)
    assert bytes_to_decode(opened("PNG", image)) == 4 * 8100
    assert bytes_to_decode(opened("JPEG", image)) == 4 * 8100
    assert bytes_to_decode(opened("JPEG", image, progressive=True)) == 10 * 8100
    assert bytes_to_decode(opened("WEBP", image)) == 16 * 8100


def test_a_photograph_whose_decoder_takes_too_much_is_refused_before_it_begins(tmp_path, monkeypatch):
    for name in ("a.webp", "b.png", "c.jpg"):
        options = {"progressive": True} if name == "c.jpg" else {}
        coloured(90, 80).save(tmp_path / name, **options)
    monkeypatch.setattr("thesisrecon.io.images.LARGEST_DECODED", 5 * 90 * 80)
    read = read_images(tmp_path, max_size_px=1600)
    assert [image.name for image in read.images] == ["b.png"]
    assert "reading a WEBP of that size takes" in read.refused["a.webp"]
    assert "reading a JPEG in several scans of that size takes" in read.refused["c.jpg"]
    assert "save it as PNG or TIFF" in read.refused["a.webp"]


def test_the_largest_sensors_are_read_in_every_kind_of_jpeg():
    assert LARGEST_DECODED > 10 * 14204 * 10652
