"""Many images from few: zoomed crops with known overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image as PillowImage

from thesisrecon.arrays import F64, U8
from thesisrecon.records import Image
from validation.scenes.image_files import read_rgb


@dataclass(frozen=True)
class Crop:
    """A part of an image as an image of its own.

    ``source`` counts the images it may come from, ``scene`` the sets these belong to; ``box`` (4,)
    is the part (left, top, right, bottom) as shares of the width and the height of the source.
    """

    image: Image
    source: int
    scene: int
    box: F64


def make_crops(
    scenes: Sequence[Sequence[Path]],
    count: int,
    *,
    long_side: int,
    rng: np.random.Generator,
    least_share: float = 0.5,
) -> list[Crop]:
    """``count`` parts of the images of some scenes, at random places and zooms.

    The sources take turns in an order drawn from ``rng``, so that ``count`` images come from as many
    sources as there are. The side of a part is ``least_share`` to 1 of that of its source, all logarithms
    equally likely; it is resized to ``long_side`` px, never enlarged by more than its source allows.
    """
    sources = [(scene, path) for scene, paths in enumerate(scenes) for path in paths]
    order = np.concatenate([rng.permutation(len(sources)) for _ in range(-(-count // len(sources)))])[:count]
    kept: dict[int, U8] = {}
    crops = []
    for number, source in enumerate(int(s) for s in order):
        scene, path = sources[source]
        if source not in kept:
            kept[source] = read_rgb(path)
        share = float(np.exp(rng.uniform(np.log(least_share), 0.0)))
        left, top = rng.uniform(0.0, 1.0 - share, 2)
        box = np.array([left, top, left + share, top + share])
        rgb = _cut(kept[source], box, long_side)
        name = f"{number:04d}.png"
        crops.append(Crop(Image(name, rgb, (rgb.shape[1], rgb.shape[0])), source, scene, box))
    return crops


def make_separate_crops(
    scenes: Sequence[Sequence[Path]],
    count: int,
    *,
    long_side: int,
    rng: np.random.Generator,
    per_scene: int = 10,
) -> list[Crop]:
    """As :func:`make_crops`, but every ``per_scene`` images have a scene of their own.

    So an image overlaps with as many others however many there are. Where the sets do not suffice they
    come again as negatives, mirrored, and as mirrored negatives, which show nothing that the first ones show.
    Raises ``ValueError`` if these do not suffice either.
    """
    most = 4 * len(scenes) * per_scene
    if count > most:
        raise ValueError(f"{len(scenes)} sets make at most {most} images; got {count}")
    crops: list[Crop] = []
    for k in range(-(-count // per_scene)):
        change, scene = divmod(k, len(scenes))
        want = min(per_scene, count - len(crops))
        for crop in make_crops([scenes[scene]], want, long_side=long_side, rng=rng):
            rgb = 255 - crop.image.rgb if change % 2 else crop.image.rgb
            rgb = np.ascontiguousarray(rgb[:, ::-1]) if change >= 2 else rgb
            image = replace(crop.image, name=f"{len(crops):04d}.png", rgb=rgb)
            # Images of other scenes have other numbers.
            crops.append(replace(crop, image=image, scene=k, source=1000 * k + crop.source))
    return crops


def shared_area(a: Crop, b: Crop) -> float:
    """The part that two crops of one source share, as a share of the smaller one; 0 for different sources."""
    if a.source != b.source:
        return 0.0
    low, high = np.maximum(a.box[:2], b.box[:2]), np.minimum(a.box[2:], b.box[2:])
    area = float(np.prod(np.maximum(high - low, 0.0)))
    return area / min(float(np.prod(c.box[2:] - c.box[:2])) for c in (a, b))


def _cut(rgb: U8, box: F64, long_side: int) -> U8:
    height, width = rgb.shape[:2]
    left, top, right, bottom = (float(v) for v in box * np.array([width, height, width, height]))
    scale = min(1.0, long_side / max(right - left, bottom - top))
    size = (round((right - left) * scale), round((bottom - top) * scale))
    picture = PillowImage.fromarray(rgb)
    return np.asarray(picture.resize(size, PillowImage.Resampling.LANCZOS, box=(left, top, right, bottom)))
