"""Masks in a run: no features, matches, depth and texture from masked pixels."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from tests.conftest import refuses
from tests.pipeline.fake_stages import photographs
from thesisrecon import Camera, PipelineConfig, reconstruct, render
from thesisrecon.config import ImageOptions
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.pipeline.matching import MASK_REACH

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "images"
FOCAL_PX = 908.6 * 480 / 1024
BOX = np.s_[100:260, 140:360]
"""Rows and columns of the watermark in images of 480 x 360 pixels."""
PATCH, PATCHED = np.s_[270:340, 150:330], 1
"""Another magenta part, in one image only."""


def is_loud(rgb):
    """Pixels in which red and blue exceed green as in magenta, and as nothing in the courtyard."""
    red, green, blue = np.moveaxis(rgb.astype(int), -1, 0)
    return np.minimum(red, blue) - green > 60


def save_masks(folder, mask, names):
    folder.mkdir()
    for name in names:
        PIL.Image.fromarray(mask).save(folder / f"{name}.png")
    return folder


@pytest.fixture(scope="module")
def marked(tmp_path_factory):
    """Four images of the courtyard with one magenta checkerboard at the same pixels, and their masks.

    One of them has a magenta patch beside it.
    """
    place = tmp_path_factory.mktemp("marked")
    (place / "images").mkdir()
    mask = np.full((360, 480), 255, np.uint8)
    mask[BOX] = 0
    board = np.random.default_rng(0).integers(0, 2, (27, 37), dtype=np.uint8).repeat(6, 0).repeat(6, 1)
    board = np.array([[255, 0, 255], [160, 0, 160]], np.uint8)[board[:160, :220]]
    files = sorted(COURTYARD.glob("*.jpg"))[:4]
    save_masks(place / "masks", mask, [f"{file.stem}.png" for file in files])
    for n, file in enumerate(files):
        rgb = np.array(PIL.Image.open(file).resize((480, 360), PIL.Image.Resampling.LANCZOS))
        assert not is_loud(rgb).any()
        rgb[BOX] = board
        if n == PATCHED:
            rgb[PATCH] = 255, 0, 255
            patched = mask.copy()
            patched[PATCH] = 0
            PIL.Image.fromarray(patched).save(place / "masks" / f"{file.stem}.png.png")
        PIL.Image.fromarray(rgb).save(place / "images" / f"{file.stem}.png")
    return place / "images", place / "masks", mask > 0


def test_a_watermark_spoils_only_the_run_that_keeps_it(marked, tmp_path):
    images, masks, mask = marked
    options = {"until": "metric", "max_size": 320, "threads": 2}
    with suppress(StageFailure):
        spoiled = reconstruct(images, tmp_path / "spoiled", set={"images.static": "keep"}, **options)
        assert not spoiled.metric.trusted
    found = reconstruct(images, tmp_path / "found", **options)
    assert found.metric.trusted
    assert found.summary["cameras"][0]["focal_px"]["value"] == pytest.approx(FOCAL_PX, rel=5e-3)
    # Working images of 320 px: the masks are larger, as are the files.
    sizes = {"images.max_size_px": 320, "dense.max_side": 320, "dense.match_side": 320}
    result = reconstruct(images, tmp_path / "out", masks=masks, set=sizes, threads=2)
    assert result.metric.trusted
    assert result.summary["registered"] == 4
    assert result.summary["cameras"][0]["focal_px"]["value"] == pytest.approx(FOCAL_PX, rel=5e-3)
    assert result.summary["cameras"][0]["masked_fraction"] == pytest.approx(1.0 - mask.mean(), abs=0.005)
    for image, features in zip(result.images, result.features, strict=True):
        for xy in (features.xy, features.seeds.xy):
            x, y = np.rint(xy).astype(int).T
            assert image.mask[y, x].all()
    x, y = np.rint(result.tracks.xy).astype(int).T
    assert all(result.images[i].mask[y[k], x[k]] for k, i in enumerate(result.tracks.view_index))
    assert len(result.depth_maps) == 4
    for depth_map, view in zip(result.depth_maps, result.views, strict=True):
        assert 0.7 < view.seen.mean() / mask.mean() < 1.0
        assert (view.seen[180:224, 105:215].mean() < 0.05) == (depth_map.view == PATCHED)
        assert not np.isfinite(depth_map.depth[~view.seen]).any()
        assert np.isfinite(depth_map.depth[view.seen]).mean() > 0.6
        assert not is_loud(view.rgb).any()
    # The surface behind the patch has the texture of the other images.
    camera = Camera.from_matrix(result.views[PATCHED].P, (320, 240))
    rendered = render(result.mesh, camera)
    assert rendered.valid[180:224, 105:215].mean() > 0.8
    assert not is_loud(rendered.color).any()
    assert not is_loud(result.mesh.texture).any()


def masked_photographs(folder):
    """Three small images; masks of the left half for the first two."""
    mask = np.full((80, 96), 255, np.uint8)
    mask[:, :48] = 0
    return photographs(3), save_masks(folder, mask, ["00.png", "01.png"])


def grid(image):
    y, x = np.mgrid[0 : image.shape[0] : 4, 0 : image.shape[1] : 4]
    return np.column_stack([x.ravel(), y.ravel()]).astype(float)


def test_methods_from_outside_keep_to_the_masks(tmp_path):
    images, masks = masked_photographs(tmp_path / "masks")
    own = PipelineConfig(features=grid)
    features = reconstruct(images, tmp_path / "a", config=own, masks=masks, until="features").features
    assert [found.xy[:, 0].min() for found in features] == [52.0, 52.0, 0.0]
    # The nearest masked column is 47.
    assert 52.0 - 47.0 > MASK_REACH > 48.0 - 47.0
    own = PipelineConfig(matching=lambda one, two: (grid(one), grid(two)[::-1]))
    pairs = reconstruct(images, tmp_path / "b", config=own, masks=masks, until="matches").pairs
    xy, last = grid(images[0].rgb), grid(images[0].rgb)[::-1]
    right, last = xy[:, 0] >= 48, last[:, 0] >= 48
    candidates = {(pair.i, pair.j): pair.candidates for pair in pairs}
    assert candidates == {
        (0, 1): int((right & last).sum()),
        (0, 2): int(right.sum()),
        (1, 2): int(right.sum()),
    }


def test_stored_results_are_not_those_of_another_mask(tmp_path):
    images, masks = masked_photographs(tmp_path / "masks")
    config = PipelineConfig(images=ImageOptions(max_size_px=96))

    def corners(**options):
        found = reconstruct(images, tmp_path / "out", config=config, until="features", **options)
        return [len(features.xy) for features in found.features]

    whole = corners()
    refuses(UsageError, "this run is with a changed '00.png' and 1 more", corners, masks=masks)
    half = corners(masks=masks, overwrite=True)
    assert half[0] < whole[0]
    assert half[1] < whole[1]
    assert half[2] == whole[2]
    assert corners(masks=masks) == half
