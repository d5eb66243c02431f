"""Panoramas: images of a camera that turns, or of a plane, on the image plane of one of them."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from thesisrecon.api.pairs import estimate_homography
from thesisrecon.arrays import B8, F64, U8
from thesisrecon.config.text import Config, as_config
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.imaging.resampling import warp_image
from thesisrecon.io._images import eight_bit_images, list_of_images, read_image
from thesisrecon.pipeline.matching import ImageInput, match_images
from thesisrecon.runtime._blas import one_blas_thread

LARGEST = 6.0  # sides of the panorama over those of the middle image


class Panorama(NamedTuple):
    """A panorama, its pixels that some image shows, and the homographies (V, 3, 3) to it from the images."""

    image: U8
    seen: B8
    H: F64


@one_blas_thread()
def stitch(images: Sequence[ImageInput], *, config: Config | None = None, seed: int = 0) -> Panorama:
    """Join images of a camera that turns about its centre, or of a plane, into one (HZ 8.4).

    Neighbours in the list are matched, and x2 ~ H x1 (of a rotation H = K2 R K1^-1) is estimated; all are
    mapped to the plane of the middle image and blended with weights that fall to zero at their borders.

    Parameters
    ----------
    images : sequence of path, ndarray or Image
        Two images or more, each overlapping the next.
    config, seed : PipelineConfig, str or path, int
        As for :func:`thesisrecon.match_pair`.

    Returns
    -------
    Panorama
        ``image`` (H, W, 3), ``seen`` (H, W), and ``H`` from pixels of the images at working size.

    Raises
    ------
    StageFailure
        If neighbours do not match, or the images turn too far for one plane.

    Examples
    --------
    >>> import numpy as np
    >>> from PIL import Image
    >>> from thesisrecon import sample, stitch
    >>> scene = np.asarray(Image.open(sample() / "images" / "0000.jpg").reduce(2))
    >>> found = stitch([scene[:, :320], scene[:, 192:]])
    >>> tuple(abs(a - b) <= 2 for a, b in zip(found.image.shape, scene.shape))
    (True, True, True)
    """
    config, images = as_config(config), list_of_images("stitch", images)
    if len(images) < 2:
        raise ValueError(f"stitch needs two images or more; got {len(images)}")
    size = config.images.max_size_px
    read = [read_image(one, max_size_px=size).images[0] for one in eight_bit_images(*images)]
    middle = len(read) // 2
    H = np.tile(np.eye(3), (len(read), 1, 1))
    # From the middle outwards: x_middle ~ H[near] x_near, and x_near ~ G x_far.
    for far in [*range(middle - 1, -1, -1), *range(middle + 1, len(read))]:
        near = far + 1 if far < middle else far - 1
        pair = match_images(config, (read[far], read[near]), seed)
        H[far] = H[near] @ estimate_homography(pair.xy1, pair.xy2, threshold_px=2.0, seed=seed).H
    corners = [
        homogenize(np.array([[-0.5, -0.5], [w - 0.5, -0.5], [-0.5, h - 0.5], [w - 0.5, h - 0.5]])) @ G.T
        for G, (w, h) in zip(H, (one.size for one in read), strict=True)
    ]
    # The sign of H is that which maps the centre of an image in front.
    H *= np.array([np.sign(x.mean(axis=0)[2]) for x in corners])[:, None, None]
    behind = [i for i, x in enumerate(corners) if not (x[:, 2] * np.sign(x.mean(axis=0)[2]) > 1e-9).all()]
    placed = np.concatenate([dehomogenize(x) for i, x in enumerate(corners) if i not in behind])
    low, high = np.floor(placed.min(axis=0)), np.ceil(placed.max(axis=0))
    if behind or (high - low > LARGEST * np.array(read[middle].size)).any():
        names = ", ".join(read[i].name for i in behind) or "some images"
        raise StageFailure.of("panorama-too-wide", names)
    H = np.array([[1.0, 0, -low[0] - 0.5], [0, 1, -low[1] - 0.5], [0, 0, 1]]) @ H
    width, height = (high - low).astype(int).tolist()
    total, weights = np.zeros((height, width, 3)), np.zeros((height, width, 1))
    grid = homogenize(np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), axis=-1))
    for one, G in zip(read, H, strict=True):
        xh = grid @ np.linalg.inv(G).T
        places = np.where(xh[..., 2:] > 0.0, dehomogenize(xh), np.nan)
        pixels = warp_image(one.levels, partial(_rows_of, places), (width, height))
        # Distance to the nearest border, over that of the centre.
        off = np.abs(places - (np.array(one.size) - 1.0) / 2.0) / (np.array(one.size) / 2.0)
        weight = np.maximum(1.0 - np.nan_to_num(off, nan=1.0).max(axis=2, keepdims=True), 1e-3)
        weight = np.where(np.isfinite(pixels).all(axis=2, keepdims=True), weight, 0.0)
        total += weight * np.nan_to_num(pixels)
        weights += weight
    image = np.clip(np.rint(total / np.maximum(weights, 1e-9)), 0, 255).astype(np.uint8)
    return Panorama(image, weights[..., 0] > 0.0, H)


def _rows_of(places: F64, rows: range) -> F64:
    return places[rows.start : rows.stop]
