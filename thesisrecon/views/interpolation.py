"""View interpolation (view morphing) between two images (thesis, section 1.2; Seitz and Dyer 1995).

A view between two images is the synthesis of ``thesisrecon.views.tensor`` for two cameras that differ by
a translation along the rows of the rectified frame, where the inverse depth is the disparity.
"""

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F32, F64, U8, Record
from thesisrecon.camera import rq
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import homography_linear
from thesisrecon.records import DisparityMap
from thesisrecon.views import tensor

MIN_DEPTH = 0.2  #: minimum third coordinate of its corners, in units of that of its centre


def original_from_rectified(H: F64, size: tuple[int, int], s: float) -> F64:
    """Return the homography from the rectified frame to the pixels of the view between two images at s.

    In the frame a point is (1 - s) x_left + s x_right, its exact image in a camera on the baseline. The
    homography takes a quadrilateral, linear between those of both images, to the image corners.
    """
    corners, left, right = _quadrilaterals(H, size)
    between = (1.0 - s) * left + s * right
    H = homography_linear(between, corners)
    return np.asarray(H * np.sign(H[2] @ np.append(between[0], 1.0)))


def roll_between(H: F64, size: tuple[int, int]) -> float:
    """Return the angle by which the second image is rotated about its axis against the first, in degrees."""
    _, *both = _quadrilaterals(H, size)
    left, right = (quadrilateral - quadrilateral.mean(axis=0) for quadrilateral in both)
    across = left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0]
    return float(np.degrees(np.arctan2(across.sum(), (left * right).sum())))


def _quadrilaterals(H: F64, size: tuple[int, int]) -> tuple[F64, F64, F64]:
    """A rectangle (4, 2) of image pixels in front of both cameras, and its place in the frame for each."""
    shrink = 0.8  # Factor by which the quadrilateral is reduced until it lies in front of both cameras
    width, height = size
    middle = 0.5 * np.array([width - 1.0, height - 1.0])
    reach = np.maximum(middle, 0.5) * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    third = H[:, 2]
    min_depth = MIN_DEPTH * (third @ np.append(middle, 1.0))
    if not (min_depth > 0.0).all():
        raise ValueError("the image centre lies beyond the line at infinity of the rectification")
    while not (homogenize(middle + reach) @ third.T >= min_depth).all():
        reach *= shrink
    corners = middle + reach
    left, right = (dehomogenize(homogenize(corners) @ side.T) for side in H)
    return corners, left, right


@dataclass(frozen=True, eq=False)
class InterpolatedPair(Record):
    """Two images and the views between them (thesis, section 1.2).

    Nearer pixels occlude farther ones, which also handles violations of monotonicity. A pixel seen in one
    image only is taken from it, with the depth of the adjacent background; a pixel seen in neither is filled
    from behind.
    """

    H: F64  #: (2, 3, 3) homographies to the rectified frame, third coordinate positive for visible pixels
    left: DisparityMap  #: of the first image in the rectified frame, x_right = x_left - d
    synthesis: tensor.TensorSynthesis  #: of two cameras with the inverse homographies as intrinsics

    @property
    def known(self) -> float:
        """Share of the pixels of both images with known correspondence."""
        return float(np.mean([levels[..., 3] for levels in self.synthesis.levels]))

    def view(self, s: float, *, threads: int = 1) -> U8:
        """Render the view at s."""
        if not 0.0 <= s <= 1.0:
            raise ValueError(f"s must be from 0 (first image) to 1 (second image); got {s}")
        if s in (0.0, 1.0):
            return self.synthesis.levels[int(s)][..., :3].astype(np.uint8)
        size = self.synthesis.sizes[0]
        K, R = rq(original_from_rectified(self.H, size, s))
        camera = tensor.VirtualCamera(R, R[:, 0] * (1.0 - s), K / K[2, 2], size)
        return self.synthesis.render(camera, threads=threads)


def prepare_interpolation(
    images: tuple[U8, U8], H: F64, left: DisparityMap, places: tuple[F32, F32], *, gain: F32,
    agree_px: float = tensor.AGREE_PX,
) -> InterpolatedPair:  # fmt: skip
    """Prepare two images with the corresponding pixels of the other one, and the gain of the second."""
    # Cameras 1 px apart: the disparity is the inverse depth.
    K1, K2 = np.linalg.inv(H)
    pair = tensor.CalibratedPair(K1, K2, np.eye(3), np.array([-1.0, 0.0, 0.0]))
    synthesis = tensor.prepare_synthesis(pair, images, places, gain=gain, agree_px=agree_px)
    return InterpolatedPair(H, left, synthesis)


def disparity_of_right(left: DisparityMap) -> DisparityMap:
    """Derive the disparities of the right image from those of the left one."""
    height, width = left.disparity.shape
    disparity = np.full((height, width), -np.inf, dtype=np.float32)
    confidence = np.zeros((height, width), dtype=np.float32)
    y, x = np.nonzero(np.isfinite(left.disparity))
    d = left.disparity[y, x]
    at = np.rint(x - d).astype(np.int64)
    inside = (at >= 0) & (at < width)
    y, x, at, d = y[inside], x[inside], at[inside], d[inside]
    np.maximum.at(disparity, (y, at), d)
    seen = disparity[y, at] == d
    confidence[y[seen], at[seen]] = left.confidence[y[seen], x[seen]]
    disparity[np.isinf(disparity)] = np.nan
    before, here, after = disparity[:, :-2], disparity[:, 1:-1], disparity[:, 2:]
    gap = np.isfinite(before) & np.isfinite(after) & np.isnan(here)
    here[gap] = np.fmin(before, after)[gap]
    return replace(left, disparity=disparity, confidence=confidence)
