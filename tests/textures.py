"""Random textures and a stereo scene whose correspondence is known."""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from thesisrecon.records import FundamentalFit, Image


def texture(height, width, seed=0):
    """(H, W) grey values about 128: noise of several sizes, as rich in corners as a stone wall."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for sigma in (1.2, 2.5, 5.0, 10.0):
        layer = gaussian_filter(rng.normal(size=(height, width)), sigma)
        total += layer / layer.std() * sigma**0.3
    return np.clip(128.0 + 38.0 * total / total.std(), 0.0, 255.0)


def photograph(gray, name="a.png"):
    """A grey photograph."""
    values = np.clip(np.rint(gray), 0, 255).astype(np.uint8)
    return Image(name, np.repeat(values[:, :, None], 3, axis=2), (gray.shape[1], gray.shape[0]))


def disparity(xy2):
    """(N,) disparity of the stereo scene at pixels of the second image: x1 = x2 + disparity, y1 = y2."""
    return 14.0 + 5.0 * np.sin(xy2[:, 0] / 60.0) + 4.0 * np.cos(xy2[:, 1] / 45.0)


def stereo_scene(height=300, width=420, seed=3):
    """Two photographs of a curved surface by cameras side by side; the second is darker and duller."""
    first = texture(height, width, seed)
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    shifted = x + disparity(np.stack([x.ravel(), y.ravel()], 1)).reshape(x.shape)
    second = map_coordinates(first, [y, shifted], order=3, mode="reflect")
    return photograph(first, "left.png"), photograph(0.8 * second + 10.0, "right.png")


def sideways_fundamental(xy1, xy2, rng):
    """The true F of cameras side by side, with the matches that obey it: stands in for chapter 5."""
    del rng
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]) / np.sqrt(2.0)
    inliers = np.abs(xy1[:, 1] - xy2[:, 1]) < 2.0
    return FundamentalFit(F, inliers, 0.5, np.eye(9))
