"""Reading masks: names, sizes, orientation, colour modes, and a sentence for each unusable one."""

import numpy as np
import PIL.Image
import pytest

from tests.bad_input import files
from tests.conftest import refuses
from thesisrecon.errors import UsageError
from thesisrecon.io._images import add_masks, check_masks_folder, read_images
from thesisrecon.records import Image

ROTATED = 6
"""EXIF orientation: the stored image is turned a quarter to the right."""
SIZE = (180, 120)


def exif_of(orientation):
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    return exif


def half_white(size=SIZE):
    """A mask (H, W) whose left third is black, and a corner that shows its orientation."""
    mask = np.full(size[::-1], 255, np.uint8)
    mask[:, : size[0] // 3] = 0
    mask[: size[1] // 4, -size[0] // 4 :] = 0
    return mask


@pytest.fixture
def folders(tmp_path):
    """Images a.jpg, b.png and c.png, and an empty folder of masks."""
    for name in ("images", "masks"):
        (tmp_path / name).mkdir()
    for seed, name in enumerate(("a.jpg", "b.png", "c.png")):
        files.picture(seed, SIZE).save(tmp_path / "images" / name)
    return tmp_path / "images", tmp_path / "masks"


def save(path, mask, mode="L", **options):
    PIL.Image.fromarray(mask).convert(mode).save(path, **options)


def masks_of(folders, max_size_px=1600):
    inputs, unused = add_masks(read_images(folders[0], max_size_px=max_size_px), folders[1])
    return {image.name: image.mask for image in inputs.images}, unused


def test_a_mask_is_named_like_its_image(folders):
    white = np.full_like(half_white(), 255)
    save(folders[1] / "a.jpg.png", half_white())
    save(folders[1] / "a.bmp", white)
    save(folders[1] / "b.tif", white - half_white())
    found, unused = masks_of(folders)
    np.testing.assert_array_equal(found["a.jpg"], half_white() > 0)
    np.testing.assert_array_equal(found["b.png"], half_white() == 0)
    assert found["c.png"] is None
    assert unused == ["a.bmp is a mask of no image"]


def test_a_mask_changes_the_digest_of_its_image_only(folders):
    inputs = read_images(folders[0], max_size_px=1600)
    save(folders[1] / "a.png", half_white())
    save(folders[1] / "b.png", np.full_like(half_white(), 255))
    masked = add_masks(inputs, folders[1])[0].decoded
    assert [one.digest == two.digest for one, two in zip(inputs.decoded, masked, strict=True)] == [
        False, True, True,
    ]  # fmt: skip
    assert masked[1].image.mask is None
    # The same mask in an image record.
    assert read_images([masked[0].image], max_size_px=1600).decoded[0].digest == masked[0].digest
    image = masked[0].image
    refuses(ValueError, r"needs rgb \(H, W, 3\), mask \(H, W\)", Image, "d", image.rgb, SIZE, image.mask[1:])


@pytest.mark.parametrize("size", [SIZE, (90, 60), (37, 25), (600, 400)])
def test_masks_of_any_size_are_resized_like_the_image(folders, size):
    """Nearest neighbour, for images reduced to half size too; the borders stay within a mask pixel."""
    save(folders[1] / "a.png", half_white(size))
    for max_size_px in (180, 105):
        mask = masks_of(folders, max_size_px)[0]["a.jpg"]
        assert mask.shape == (max_size_px * 2 // 3, max_size_px)
        apart = mask != (half_white((max_size_px, max_size_px * 2 // 3)) > 0)
        assert apart.mean() < 0.05 if size == (37, 25) else apart.mean() < 0.02


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_exif_rotation_is_that_of_the_image(folders, suffix):
    """A mask is upright, or has an EXIF rotation of its own."""
    images, masks = folders
    files.picture(0, SIZE).save(images / "a.jpg", exif=exif_of(ROTATED))
    upright = half_white((SIZE[1], SIZE[0]))
    path = masks / f"a.{suffix}"
    save(path, upright)
    np.testing.assert_array_equal(masks_of(folders)[0]["a.jpg"], upright > 0)
    for orientation, turned in ((ROTATED, np.rot90(upright)), (3, np.rot90(upright, 2))):
        save(path, turned, exif=exif_of(orientation))
        np.testing.assert_array_equal(masks_of(folders)[0]["a.jpg"], upright > 0)
    save(path, np.rot90(upright))
    refuses(UsageError, r"has 180 x 120 pixels and its image 120 x 180 \(after EXIF", masks_of, folders)


@pytest.mark.parametrize("mode", ["1", "P", "RGB", "RGBA", "LA", "I;16"])
def test_black_is_left_out_in_any_colour_mode(folders, mode):
    mask = half_white()
    if mode == "I;16":
        # Levels below 256 are not black either.
        PIL.Image.fromarray((mask > 0).astype(np.uint16)).save(folders[1] / "a.png", exif=exif_of(1))
    else:
        save(folders[1] / "a.png", mask, mode)
    np.testing.assert_array_equal(masks_of(folders)[0]["a.jpg"], mask > 0)


def test_unusable_masks_are_refused_with_a_sentence(folders, tmp_path):
    images, masks = folders
    refuses(UsageError, "there are no masks in", check_masks_folder, masks, images)
    refuses(UsageError, "there is no folder", check_masks_folder, tmp_path / "nothing", images)
    refuses(UsageError, "a folder of their own", check_masks_folder, images, images)
    for name, content, words in (
        ("d.png", half_white(), r"no file in .* is named like an image; the mask of IMG.jpg is IMG.jpg.png"),
        ("a.png", half_white((80, 80)), "has 80 x 80 pixels and its image 180 x 120 .* not another ratio"),
        ("a.png", np.zeros_like(half_white()), "leaves no pixel of a.jpg: black pixels are left out"),
    ):
        save(masks / name, content)
        refuses(UsageError, words, masks_of, folders)
    (masks / "a.png").write_bytes((masks / "a.png").read_bytes()[:60])
    refuses(UsageError, r"the mask .*a\.png cannot be decoded: .*; replace or remove it", masks_of, folders)
    save(masks / "a.bmp", half_white())
    refuses(UsageError, "a.jpg has two masks", masks_of, folders)
    (masks / "a.png").unlink()
    files.picture(7, SIZE).save(images / "a.tif")
    refuses(UsageError, "belongs to a.jpg and to a.tif", masks_of, folders)
