"""Reading images: formats, orientation, bit depth, frames and resampling; names of images in all files."""

import json
import struct
import threading
import time
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest

from tests.bad_input import files
from tests.conftest import refuses
from thesisrecon import export
from thesisrecon.errors import UsageError
from thesisrecon.io import _pixels as pixels
from thesisrecon.io._files import require_image_name
from thesisrecon.io._images import images_folder, list_images, read_images, read_pixels, scene_name
from thesisrecon.io._models import read_model
from thesisrecon.pipeline.inputs import views_of
from thesisrecon.records import Image
from thesisrecon.results import SparseModel, SparseView


def picture(seed=0, size=(96, 80)):
    """A colourful (H, W, 3) picture without two equal corners."""
    return np.array(files.picture(seed, size))


def read_one(path, max_size_px=1600):
    photographs = read_images([path], max_size_px=max_size_px)
    assert not photographs.refused
    return photographs.images[0]


def reason(path):
    photographs = read_images([path], max_size_px=1600)
    assert not photographs.images
    return photographs.refused[path.name]


def save(path, array, mode=None, **options):
    image = PIL.Image.fromarray(array)
    (image.convert(mode) if mode else image).save(path, **options)
    return path


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".webp", ".ppm"])
def test_lossless_formats_give_the_pixels(tmp_path, suffix):
    options = {"lossless": True} if suffix == ".webp" else {}
    image = read_one(save(tmp_path / f"a{suffix}", picture(), **options))
    np.testing.assert_array_equal(image.rgb, picture())
    assert image.size == image.original_size == (96, 80)
    assert image.scale == 1.0


def test_equal_names_are_numbered(tmp_path):
    path = save(tmp_path / "frame", picture(3), format="PNG")
    records = [Image("frame", picture(n), (96, 80)) for n in range(2)] + [
        Image("image-3", picture(5), (96, 80))
    ]
    found = read_images([*records[:2], path, picture(4), records[2]], max_size_px=99)
    names = ["frame", "frame (2)", "frame (3)", "image-3", "image-3 (2)"]
    assert [decoded.image.name for decoded in found.decoded] == names
    for n, image in zip((0, 1, 3, 4, 5), found.images, strict=True):
        np.testing.assert_array_equal(image.rgb, picture(n))


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_rotation_is_applied(tmp_path, orientation, suffix):
    """Pillow itself turns TIFF images."""
    upright = PIL.Image.fromarray(picture())
    # The stored pixels are those that the orientation turns back into the upright picture.
    turns = PIL.Image.Transpose
    stored = {
        1: None, 2: turns.FLIP_LEFT_RIGHT, 3: turns.ROTATE_180, 4: turns.FLIP_TOP_BOTTOM,
        5: turns.TRANSPOSE, 6: turns.ROTATE_90, 7: turns.TRANSVERSE, 8: turns.ROTATE_270,
    }[orientation]  # fmt: skip
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / f"a.{suffix}"
    (upright if stored is None else upright.transpose(stored)).save(path, exif=exif)
    image = read_one(path)
    np.testing.assert_array_equal(image.rgb, picture())
    assert image.original_size == (96, 80)


def test_heic_images_are_read_with_their_reader(tmp_path):
    pillow_heif = pytest.importorskip("pillow_heif", reason="the extra heif is not installed")
    pillow_heif.register_heif_opener()
    image = read_one(save(tmp_path / "a.heic", picture(), quality=-1, chroma=444))
    assert image.size == (96, 80)
    assert np.abs(image.rgb.astype(int) - picture()).mean() < 2.0


def test_heic_images_without_their_reader_name_it(tmp_path, monkeypatch):
    monkeypatch.setattr("thesisrecon.io._images._formats", lambda: ("JPEG", "PNG"))
    (tmp_path / "IMG_0001.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    assert "the extra heif" in reason(tmp_path / "IMG_0001.HEIC")


def test_the_focal_length_of_exif_is_read_but_only_offered(tmp_path):
    exif = PIL.Image.Exif()
    exif[0x8769] = {0xA405: 36}
    PIL.Image.fromarray(picture()).save(tmp_path / "a.jpg", exif=exif)
    save(tmp_path / "b.jpg", picture(1))
    with PIL.Image.open(tmp_path / "a.jpg") as file:
        save(tmp_path / "c.tif", picture(2), exif=file.getexif())
    focal = read_images(tmp_path, max_size_px=1600).exif_focal_px
    np.testing.assert_allclose(focal, [96.0, np.nan, 96.0])


def test_a_large_photograph_is_reduced_at_one_exact_scale(tmp_path):
    """A ramp tells where each pixel went: (x + 0.5) s - 0.5 along both axes."""
    x, y = np.meshgrid(np.arange(1000), np.arange(667))
    rgb = np.stack([x * 0.25, y * 0.25, 0 * x], axis=-1).astype(np.uint8)
    image = read_one(save(tmp_path / "a.png", rgb), max_size_px=300)
    assert image.size == (300, 200)
    assert image.scale == 0.3
    inner = slice(5, -5)
    for line, channel in ((image.rgb[100], 0), (image.rgb[:, 100], 1)):
        original = (np.arange(len(line)) + 0.5) / image.scale - 0.5
        off = (line[:, channel] - (original * 0.25 - 0.375))[inner]
        assert np.abs(off).max() < 1.0
        # Averaged over the ramp, rounding to whole grey levels leaves far less than a pixel.
        assert off.mean() == pytest.approx(0, abs=0.05)


def test_the_first_frame_of_an_animation_is_used_and_reported(tmp_path):
    path = save(tmp_path / "a.gif", picture(), save_all=True, append_images=[files.picture(1)])
    assert read_images([path], max_size_px=1600).decoded[0].note == "only the first frame is used"


def test_unreadable_images_are_rejected_and_the_others_are_used(tmp_path):
    for k, name in enumerate(("good one ü.jpg", "good two.png")):
        save(tmp_path / name, picture(k))
    save(tmp_path / "same.bmp", picture(1))
    (tmp_path / "text.jpg").write_text("dear reader")
    for name in ("notes.txt", ".hidden.jpg"):
        (tmp_path / name).write_text("not listed")
    (tmp_path / "folder.jpg").mkdir()
    photographs = read_images(tmp_path, max_size_px=1600)
    assert [image.name for image in photographs.images] == ["good one ü.jpg", "good two.png"]
    assert set(photographs.refused) == {"text.jpg", "same.bmp"}
    assert photographs.refused["same.bmp"] == "has the same pixels as good two.png"


def test_arrays_are_named_by_number_and_tiny_ones_are_left_out():
    given = [picture(0), picture(1)[..., 0]]
    assert read_images(given, max_size_px=48).images == ()
    arrays = read_images(given, max_size_px=90)
    assert [image.name for image in arrays.images] == ["image-0", "image-1"]
    assert arrays.images[0].size == (90, 75)
    refuses(ValueError, r"must be \(H, W\), .* got \(3,\)", read_images, [np.zeros(3)], max_size_px=90)


def test_a_scene_is_called_after_its_folder_which_must_exist(tmp_path):
    for folder in ("castle", "castle/images", "castle/DCIM"):
        assert scene_name(tmp_path / folder) == "castle"
    refuses(UsageError, "no folder", list_images, tmp_path / "absent")
    (tmp_path / "file").write_text("")
    refuses(UsageError, "not a folder", list_images, tmp_path / "file")


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


@pytest.mark.parametrize("transform", [None, *pixels.EXIF_TRANSFORMS.values()])
@pytest.mark.parametrize(("width", "height"), [(1000, 667), (600, 1100)])
def test_stripes_give_the_pixels_of_the_whole_image(transform, width, height):
    upright = coloured(width, height)
    back = {PIL.Image.Transpose.ROTATE_90: 270, PIL.Image.Transpose.ROTATE_270: 90}.get(transform)
    if back is not None:
        stored = upright.rotate(back, expand=True)
    else:
        stored = upright if transform is None else upright.transpose(transform)
    picture = pixels.StoredImage(stored, transform)
    assert picture.size == (width, height)
    np.testing.assert_array_equal(pixels.resized_to(picture, 1600), np.asarray(upright))
    for most in (900, 300, 130, 64):
        found = pixels.resized_to(picture, most)
        assert max(found.shape[:2]) == most
        np.testing.assert_array_equal(found, at_once(upright, found.shape[1::-1], most))


@pytest.mark.parametrize("mode", ["L", "1", "P", "CMYK", "YCbCr", "LAB"])
def test_colours_are_converted_alike_in_stripes(mode):
    stored = coloured(500, 700, mode)
    found = pixels.resized_to(pixels.StoredImage(stored), 200)
    np.testing.assert_array_equal(found, at_once(stored.convert("RGB"), (142, 200), 200))


def icc_profile(description, gamma, columns):
    """A matrix profile (ICC.1:2001) of an RGB space: XYZ of its primaries under D50 in ``columns``."""

    def tag(kind, content):
        return kind + bytes(4) + content + bytes(-len(content) % 4)

    def xyz(values):
        return tag(b"XYZ ", struct.pack(">3i", *(round(65536 * v) for v in values)))

    text = description.encode() + b"\0"
    name = tag(b"desc", struct.pack(">I", len(text)) + text + bytes(78))
    curve = tag(b"curv", struct.pack(">IH", 1, round(256 * gamma)))
    tags = {b"desc": name, b"cprt": tag(b"text", b"none\0"), b"wtpt": xyz([0.9642, 1.0, 0.8249])}
    for letter, column in zip(b"rgb", columns, strict=True):
        tags |= {bytes([letter]) + b"XYZ": xyz(column), bytes([letter]) + b"TRC": curve}
    table, content, start = b"", b"", 128 + 4 + 12 * len(tags)
    for key, value in tags.items():
        table += key + struct.pack(">2I", start + len(content), len(value))
        content += value
    size = struct.pack(">I", start + len(content))
    head = size + bytes(4) + b"\x02\x40\0\0mntrRGB XYZ " + bytes(12) + b"acsp" + bytes(28)
    head += struct.pack(">3i", 63190, 65536, 54061)
    return head + bytes(128 - len(head)) + struct.pack(">I", len(tags)) + table + content


DISPLAY_P3 = [[0.5151, 0.2412, -0.0011], [0.2920, 0.6922, 0.0419], [0.1571, 0.0666, 0.7841]]
SRGB = [[0.4361, 0.2225, 0.0139], [0.3851, 0.7169, 0.0971], [0.1431, 0.0606, 0.7142]]


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_colours_of_a_wide_gamut_become_those_of_srgb(tmp_path, suffix):
    """As a phone writes them; without the profile saturated colours would look pale."""
    levels = np.random.default_rng(0).integers(60, 190, (64, 80, 3), dtype=np.uint8)
    # Near grey, inside both spaces.
    levels = (0.3 * levels + 0.7 * levels.mean(axis=2, keepdims=True)).astype(np.uint8)
    path, profile = tmp_path / f"a.{suffix}", icc_profile("Display P3", 2.2, DISPLAY_P3)
    PIL.Image.fromarray(levels).save(path, icc_profile=profile)
    linear = (levels / 255.0) ** 2.2 @ (np.array(DISPLAY_P3) @ np.linalg.inv(SRGB))
    expected = 255.0 * np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0) ** (1 / 2.4) - 0.055
    )
    (found,) = read_pixels(path)
    assert np.abs(found - expected).max() < 2.0
    assert np.abs(levels - expected).max() > 6.0
    upright = pixels.StoredImage(PIL.Image.open(path), PIL.Image.Transpose.ROTATE_90)
    np.testing.assert_array_equal(np.asarray(upright.rows(0, 80)), np.rot90(found))
    # The space of displays itself changes no byte.
    PIL.Image.fromarray(levels).save(path, icc_profile=icc_profile("sRGB IEC61966-2.1", 2.2, SRGB))
    np.testing.assert_array_equal(read_pixels(path)[0], levels)


def test_every_stripe_of_a_deep_picture_has_the_range_of_all(tmp_path):
    """The bright end stands below the first stripe; 12 bits of 16 are used, as some cameras do."""
    values = np.repeat(np.arange(900, dtype=np.uint16)[:, None] * 4, 80, axis=1)
    for array in (values, values.astype(np.float32), values.astype(np.int32)):
        found = pixels.resized_to(pixels.StoredImage(PIL.Image.fromarray(array)), 1600)
        top = 3596 if array.dtype == np.float32 else 4095
        assert np.abs(found[..., 1] - values * (255.0 / top)).max() <= 0.51
    deep = (picture()[..., 0].astype(np.uint16) << 8) + 3
    image = read_one(save(tmp_path / "a.png", deep))
    assert np.abs(image.rgb[..., 0] - np.rint(deep * (255 / 65535))).max() <= 1


def test_threads_take_no_more_room_together_than_there_is():
    room, held, most = pixels.MemoryBudget(100), [0], [0]

    def use(amount):
        with room.reserve(amount):
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
    with pytest.raises(KeyError), room.reserve(100):
        raise KeyError
    with room.reserve(100):
        pass


def test_an_image_whose_decoder_needs_too_much_memory_is_rejected_first(tmp_path, monkeypatch):
    for name in ("a.webp", "b.png", "c.jpg"):
        options = {"progressive": True} if name == "c.jpg" else {}
        coloured(90, 80).save(tmp_path / name, **options)
    monkeypatch.setattr("thesisrecon.io._images.MAX_DECODED_BYTES", 5 * 90 * 80)
    read = read_images(tmp_path, max_size_px=1600)
    assert [image.name for image in read.images] == ["b.png"]
    assert "decoding a WEBP of this size takes" in read.refused["a.webp"]
    assert "decoding a progressive JPEG of this size takes" in read.refused["c.jpg"]
    assert "save it as PNG or TIFF" in read.refused["a.webp"]


OUTSIDE = [
    "/a/x.png", "../x.png", "a/../../x.png", "a/..", "..", "", ".", "a/", "C:\\x.png", "C:x.png", "\\x.png",
    "..\\x.png", "a\\..\\x.png", "\\\\host\\share\\x.png", "x\0.png", "//host/x.png",
]  # fmt: skip
INSIDE = [
    "\\x0ab.png", "x.png", "a/x.png", "./x.png", "a b/..x.png", "...png", "a\\x.png", "\udcff.png", "böld",
]  # fmt: skip
RULE = "an image name must be a relative path inside the folder of images, without '..'"


def view(name):
    K = np.array([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]])
    return SparseView(name, np.eye(3), np.zeros(3), K, (128, 96), np.zeros(3))


def as_json(path, name):
    camera = {"name": name, "width": 128, "height": 96, "K": view("").K.tolist(), "R": np.eye(3).tolist()}
    (path / "cameras.json").write_text(json.dumps({"cameras": [camera | {"t": [0, 0, 0]}]}))


def as_colmap(path, name):
    (path / "cameras.txt").write_text("1 PINHOLE 128 96 100 100 64 48\n")
    (path / "points3D.txt").write_text("")
    encoded = name.encode("utf-8", "surrogateescape")
    (path / "images.txt").write_bytes(b"1 1 0 0 0 0 0 0 1 " + encoded + b"\n\n")


@pytest.mark.parametrize("name", OUTSIDE)
def test_names_outside_the_folder_of_images_are_refused_everywhere(tmp_path, name):
    refuses(UsageError, RULE, require_image_name, name, "m")
    as_json(tmp_path, name)
    refuses(UsageError, f"{tmp_path} names an image .*{RULE}", read_model, tmp_path)
    model, out = SparseModel([view(name)]), tmp_path / "out"
    refuses(UsageError, RULE, export, model, out, to="colmap")
    refuses(UsageError, RULE, export, model, out, to="nerfstudio", images=tmp_path)
    refuses(UsageError, RULE, views_of, [(128, 96)], [name], None)
    image = Image(name, np.zeros((96, 128, 3), np.uint8), (128, 96))
    refuses(UsageError, RULE, read_images, [image], max_size_px=200)
    assert [file.name for file in tmp_path.iterdir()] == ["cameras.json"]
    if name.strip():
        (tmp_path / "model").mkdir()
        as_colmap(tmp_path / "model", name)
        refuses(UsageError, RULE, read_model, tmp_path / "model")


@pytest.mark.parametrize("name", INSIDE)
def test_names_inside_the_folder_are_read(tmp_path, name):
    as_colmap(tmp_path, name)
    assert read_model(tmp_path).names == [name]


@pytest.mark.parametrize("names", [("a/x.png", "A/X.png"), ("ö.png", "o\u0308.png"), ("a//x.png", "a/x.png")])
def test_names_that_would_be_one_file_elsewhere_are_not_exported(tmp_path, names):
    model = SparseModel([view(name) for name in names])
    for to in ("nerfstudio", "colmap-undistorted"):
        given = {"to": to, "images": tmp_path}
        refuses(UsageError, "two images of the model would", export, model, tmp_path / to, **given)
    assert not any(tmp_path.glob("*"))


def test_files_of_one_name_are_named_below_their_common_folder(tmp_path):
    files = []
    for k, place in enumerate(("left/1", "right")):
        files.append(tmp_path / place / "x.png")
        files[-1].parent.mkdir(parents=True)
        rgb = np.random.default_rng(k).integers(0, 255, (96, 128, 3), np.uint8)
        PIL.Image.fromarray(rgb).save(files[-1])
    names = [image.name for image in read_images(files, max_size_px=200).images]
    assert names == ["left/1/x.png", "right/x.png"]
    assert images_folder(files) == tmp_path
    views = [replace(view(name), t=np.array([k, 0.0, 0])) for k, name in enumerate(names)]
    written = export(SparseModel(views), tmp_path / "out", to="nerfstudio", images=tmp_path)
    there = {file.relative_to(written.file.parent).as_posix() for file in (tmp_path / "out").rglob("*.png")}
    assert there == {"images/left/1/x.png", "images/right/x.png"}


def test_a_file_whose_name_no_model_may_have_is_left_out_by_name(tmp_path):
    for k, name in enumerate(("C:a.png", "b.png", "\nc.png")):
        rgb = np.random.default_rng(k).integers(0, 255, (96, 128, 3), np.uint8)
        PIL.Image.fromarray(rgb).save(tmp_path / name)
    found = read_images(tmp_path, max_size_px=200)
    assert [image.name for image in found.images] == ["\\x0ac.png", "b.png"]
    assert found.refused == {"C:a.png": f"has to be renamed: {RULE}"}
