"""Transparent pixels: masked in every format and reader, with the colours of the others unchanged."""

import struct
import zlib

import numpy as np
import PIL.Image
import pytest

import thesisrecon
from tests.bad_input import files
from tests.conftest import refuses
from thesisrecon import reconstruct
from thesisrecon.errors import UsageError
from thesisrecon.io._images import USELESS_MASKS, add_masks, read_images, read_levels

SIZE = (180, 120)
OPAQUE = np.zeros(SIZE[::-1], bool)
OPAQUE[30:100, 40:150] = True
OPAQUE[:20, :25] = True
"""A cutout without symmetry."""


def colours(seed=0):
    return np.array(files.picture(seed, SIZE))


def cutout(seed=0, hidden=(255, 0, 255), alpha=OPAQUE):
    """RGBA of a picture; ``hidden`` is the colour below transparent pixels."""
    rgb = np.where(OPAQUE[..., None], colours(seed), np.array(hidden, np.uint8))
    return np.dstack([rgb, np.where(alpha, 255, 0)]).astype(np.uint8)


def read(path, max_size_px=1600):
    found = read_images([path], max_size_px=max_size_px)
    assert not found.refused
    return found.images[0]


def deep_png(samples, colour, transparent=b""):
    """A PNG of 16 bits a sample (H, W, C)."""
    height, width = samples.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in samples)
    header = struct.pack(">IIBBBBB", width, height, 16, colour, 0, 0, 0)
    parts = (b"IHDR", header), (b"tRNS", transparent), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")
    kept = (part for part in parts if part[1] or part[0] == b"IEND")
    return b"\x89PNG\r\n\x1a\n" + b"".join(files.chunk(*part) for part in kept)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("PNG", {}),
        ("WEBP", {"lossless": True, "exact": True}),
        ("TIFF", {}),
        ("JPEG2000", {"irreversible": False}),
        ("AVIF", {"quality": 100, "subsampling": "4:4:4"}),
    ],
)
def test_transparent_pixels_of_each_format_are_masked(tmp_path, kind, options):
    path = tmp_path / "a"
    PIL.Image.fromarray(cutout()).save(path, kind, **options)
    image = read(path)
    np.testing.assert_array_equal(image.mask, OPAQUE)
    worst = np.abs(image.rgb.astype(int) - colours())[OPAQUE].max()
    assert worst <= (24 if kind == "AVIF" else 0)
    assert (image.rgb[~OPAQUE] == 128).all()


def test_palettes_grey_and_16_bits_have_transparency_too(tmp_path):
    grey = colours()[..., 0]
    indexed = PIL.Image.fromarray(colours()).quantize(200)
    index = np.where(OPAQUE, np.asarray(indexed), 200).astype(np.uint8)
    layered = PIL.Image.fromarray(index, "P")
    layered.putpalette([*indexed.getpalette()[:600], 255, 0, 255])
    expected = {}
    for name, options in (("a.gif", {"transparency": 200}), ("b.png", {"transparency": 200})):
        layered.save(tmp_path / name, **options)
        expected[name] = np.asarray(indexed.convert("RGB"))
    some = layered.copy()
    some.save(tmp_path / "c.png", transparency=bytes([255] * 200 + [0]))
    expected["c.png"] = expected["b.png"]
    both = np.dstack([grey, np.where(OPAQUE, 255, 0).astype(np.uint8)])
    PIL.Image.fromarray(both, "LA").save(tmp_path / "d.png")
    PIL.Image.fromarray(both, "LA").save(tmp_path / "e.tif")
    marked = np.where(OPAQUE, np.maximum(grey, 1), 0).astype(np.uint8)
    PIL.Image.fromarray(marked).save(tmp_path / "f.png", transparency=0)
    rgb = np.where(OPAQUE[..., None], np.maximum(colours(), 1), 0).astype(np.uint8)
    PIL.Image.fromarray(rgb).save(tmp_path / "g.png", transparency=(0, 0, 0))
    alpha = np.where(OPAQUE, 65535, 0)[..., None]
    (tmp_path / "h.png").write_bytes(deep_png(np.dstack([colours() * np.uint16(257), alpha]), 6))
    (tmp_path / "i.png").write_bytes(deep_png(np.dstack([grey * np.uint16(257), alpha]), 4))
    (tmp_path / "j.png").write_bytes(deep_png((marked * np.uint16(257))[..., None], 0, b"\0\0"))
    (tmp_path / "k.png").write_bytes(deep_png(rgb * np.uint16(257), 2, bytes(6)))
    expected |= {
        name: np.repeat(grey[..., None], 3, axis=2) for name in ("d.png", "e.tif", "f.png", "i.png", "j.png")
    }
    expected |= dict.fromkeys(("g.png", "h.png", "k.png"), colours())
    for name, rgb in expected.items():
        image = read(tmp_path / name)
        np.testing.assert_array_equal(image.mask, OPAQUE, name)
        assert np.abs(image.rgb.astype(int) - rgb)[OPAQUE].max() <= 1, name


@pytest.mark.parametrize("max_size_px", [1600, 150, 100])
def test_hidden_colours_do_not_reach_the_edge_of_a_reduced_image(max_size_px):
    one, two = (
        read_images([cutout(hidden=h)], max_size_px=max_size_px).images[0] for h in ((255, 0, 255), (0, 0, 0))
    )
    np.testing.assert_array_equal(one.rgb, two.rgb)
    np.testing.assert_array_equal(one.mask, two.mask)
    whole = read_images([colours()], max_size_px=max_size_px).images[0].rgb
    apart = np.abs(one.rgb.astype(int) - whole)[one.mask]
    assert np.quantile(apart, 0.95) <= (0 if max_size_px == 1600 else 8)
    assert apart.max() <= (0 if max_size_px == 1600 else 40)
    assert abs(one.mask.mean() - OPAQUE.mean()) < 0.01


def test_an_opaque_alpha_channel_changes_nothing(tmp_path):
    for n, array in enumerate((colours(), np.dstack([colours(), np.full(SIZE[::-1], 255, np.uint8)]))):
        PIL.Image.fromarray(array).save(tmp_path / f"{n}.png")
    for max_size_px in (1600, 151, 101):
        one, two = (read_images([tmp_path / f"{n}.png"], max_size_px=max_size_px).decoded[0] for n in (0, 1))
        assert two.image.mask is None
        assert one.digest == two.digest


@pytest.mark.parametrize("orientation", [3, 6, 7])
def test_transparency_is_rotated_with_the_image(tmp_path, orientation):
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    PIL.Image.fromarray(cutout()).save(tmp_path / "a.png", exif=exif)
    PIL.Image.fromarray(np.where(OPAQUE[..., None], colours(), 9).astype(np.uint8)).save(
        tmp_path / "b.png", exif=exif
    )
    one, two = read(tmp_path / "a.png"), read(tmp_path / "b.png")
    np.testing.assert_array_equal(one.mask, (two.rgb != 9).any(axis=2))
    np.testing.assert_array_equal(one.rgb[one.mask], two.rgb[one.mask])


def test_images_without_an_opaque_pixel_are_left_out_with_a_reason(tmp_path):
    for n in range(3):
        PIL.Image.fromarray(cutout(n, alpha=np.zeros_like(OPAQUE))).save(tmp_path / f"{n}.png")
    found = read_images(tmp_path, max_size_px=1600)
    assert not found.images
    assert set(found.refused.values()) == {
        "is blank: all its pixels are transparent; save it without its alpha channel"
    }
    # The colour of what is used decides whether an image is blank.
    flat = np.dstack([np.full((*SIZE[::-1], 3), 90, np.uint8), np.where(OPAQUE, 255, 0).astype(np.uint8)])
    assert "is blank" in read_images([flat], max_size_px=1600).refused["image-0"]


def test_masks_leave_out_more_than_transparency(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    PIL.Image.fromarray(cutout()).save(tmp_path / "images" / "a.png")
    upper = np.zeros(SIZE[::-1], np.uint8)
    upper[:60] = 255
    PIL.Image.fromarray(upper).save(tmp_path / "masks" / "a.png")
    inputs = read_images(tmp_path / "images", max_size_px=1600)
    (image,) = add_masks(inputs, tmp_path / "masks")[0].images
    np.testing.assert_array_equal(image.mask, OPAQUE & (upper > 0))
    PIL.Image.fromarray(np.where(OPAQUE, 0, 255).astype(np.uint8)).save(tmp_path / "masks" / "a.png")
    refuses(UsageError, "leaves no pixel of a.png", add_masks, inputs, tmp_path / "masks")


WHITE, BLACK = np.full((*SIZE[::-1], 3), 255), np.zeros((*SIZE[::-1], 3))


@pytest.mark.parametrize(
    "rgb", [WHITE, BLACK, np.maximum(colours(), 1), np.where(OPAQUE[..., None], WHITE, BLACK)]
)
@pytest.mark.parametrize("kind", ["PNG", "WEBP", "TIFF"])
def test_the_alpha_of_a_mask_is_its_content(tmp_path, rgb, kind):
    """Background removers save a white image, or the image itself, with an alpha channel."""
    array = np.dstack([rgb, np.where(OPAQUE, 255, 0)]).astype(np.uint8)
    options = {"lossless": True, "exact": True} if kind == "WEBP" else {}
    np.testing.assert_array_equal(mask_of(tmp_path, array, kind, **options), OPAQUE)


def mask_of(folder, array, kind="PNG", **options):
    (folder / "masks").mkdir(exist_ok=True)
    PIL.Image.fromarray(array).save(folder / "masks" / "image-0.png", kind, **options)
    (image,) = add_masks(read_images([colours()], max_size_px=1600), folder / "masks")[0].images
    return image.mask


def test_black_paint_on_a_transparent_mask_is_left_out(tmp_path):
    painted = np.where(OPAQUE[..., None], [0, 0, 0, 255], [255, 255, 255, 0]).astype(np.uint8)
    np.testing.assert_array_equal(mask_of(tmp_path, painted), ~OPAQUE)
    # An alpha channel of zeros is no mask.
    empty = np.dstack([np.where(OPAQUE[..., None], WHITE, BLACK), np.zeros(SIZE[::-1])]).astype(np.uint8)
    np.testing.assert_array_equal(mask_of(tmp_path, empty), OPAQUE)


@pytest.mark.parametrize(("level", "warned"), [(1, True), (0, False)])
def test_masks_without_effect_are_reported(tmp_path, level, warned):
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[:40] = level
    mask_of(tmp_path, mask)
    found = reconstruct([colours(), colours(1)], tmp_path / "out", masks=tmp_path / "masks", until="features")
    assert (USELESS_MASKS in found.warnings) == warned


def test_a_run_has_no_corners_in_transparent_pixels(tmp_path):
    arrays = [cutout(0), cutout(1, hidden=(0, 0, 0))]
    found = reconstruct(arrays, tmp_path / "out", until="features", threads=1)
    for features in found.features:
        x, y = np.rint(features.xy).astype(int).T
        assert len(x)
        assert OPAQUE[y, x].all()
    assert found.summary["cameras"][0]["masked_fraction"] == pytest.approx(1 - OPAQUE.mean())


def test_rectified_images_have_no_levels_where_they_are_transparent():
    F = np.array([[0.0, 0, 4], [0, 0, -8], [-4, 8, 0]])
    xy1 = np.random.default_rng(0).uniform(20, 100, (30, 2))
    xy2 = xy1 - np.array([[8.0, 4]]) / np.random.default_rng(1).uniform(1, 4, (30, 1))
    with_alpha, without = (thesisrecon.rectify(one, one, F, xy1, xy2) for one in (cutout(), colours()))
    missing = np.isnan(with_alpha.left).any(axis=2) & np.isfinite(without.left).all(axis=2)
    assert 0.3 < missing.mean() < 0.7
    # Beside missing pixels the interpolation is linear.
    np.testing.assert_allclose(with_alpha.left[~missing], without.left[~missing], atol=2.0)
    assert isinstance(read_levels(colours())[0], np.ndarray)
    assert np.isnan(read_levels(cutout())[0][~OPAQUE]).all()
    moved = np.roll(cutout(), -6, axis=1)
    disparity = thesisrecon.match_rectified(cutout(), moved, max_disparity_px=12).disparity
    known = np.isfinite(disparity)
    assert not known[~OPAQUE].any()
    assert np.median(disparity[known]) == pytest.approx(6, abs=0.3)
