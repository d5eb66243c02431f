"""Pinhole views of images: one each, or several where a lens is too wide for one.

Of V images the view of image i has the number i. An image wider than ``WIDE``, or of which a pinhole image
of its size would lose more than ``MAX_LOST``, is divided: its front view has the number i, and those to the
left, right, up and down (if the image shows them) i + V to i + 4 V.
"""

import numpy as np

from thesisrecon.arrays import F64, resizing_transform
from thesisrecon.camera import angles_of_view, pixels_of_rays, viewing_rays, widest_angle
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.imaging.resampling import undistort_image
from thesisrecon.records import Image, PinholeView, Reconstruction

WIDE = 110.0  # degrees along the long side, of which an image is divided into several pinhole views
MAX_LOST = 0.15  # of the pixels of an image, of which it is divided too
FACES = {
    "front": np.eye(3),
    "left": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "right": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "up": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "down": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
"""Rotations from the axes of a wide camera to those of its pinhole views of 90 x 90 degrees."""
LEAST_SEEN = 0.05  # of a pinhole view, which is used from there on
GRID = 33  # samples along a side of an image or a view at which it is tested what the other shows


def is_wide(K: F64, size: tuple[int, int], lens: F64) -> bool:
    """Whether an image is wider than one pinhole image can show."""
    return angles_of_view(K, size, lens)[0] > WIDE


def is_divided(K: F64, size: tuple[int, int], lens: F64) -> bool:
    """Whether the dense stages see an image by views of 90 x 90 degrees, or by one of its K and size."""
    if not lens.any() or is_wide(K, size, lens):
        return bool(lens.any())
    axes = [np.linspace(0.0, side - 1.0, GRID) for side in size]
    rays = viewing_rays(K, np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2), lens)
    with np.errstate(invalid="ignore"):
        straight = rays[:, :2] / rays[:, 2:] @ K[:2, :2].T + K[:2, 2]
        lost = (rays[:, 2] > 0.0) & (np.abs(straight / (np.array(size) - 1.0) - 0.5) > 0.5 + 1e-9).any(axis=1)
    return bool(lost.mean() > MAX_LOST)


def seen_faces(K: F64, size: tuple[int, int], lens: F64) -> tuple[F64, int, dict[str, F64]]:
    """K and the side px of the square pinhole views of a wide image, and by name the boxes that it shows."""
    # A box (2, 2) is the first and the last pixel along x and y; views of which little is shown have none.
    side = 2 * max(int(K[0, 0]), 8)
    middle = (side - 1.0) / 2.0
    own = np.array([[side / 2.0, 0.0, middle], [0.0, side / 2.0, middle], [0.0, 0.0, 1.0]])
    steps = np.linspace(0.0, side - 1.0, GRID)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rays, most, boxes = homogenize(grid) @ np.linalg.inv(own).T, widest_angle(K, size, lens), {}
    for name, turn in FACES.items():
        places = pixels_of_rays(rays @ turn, K, lens, most)
        shown = grid[((places >= 0.0) & (places <= np.array(size) - 1.0)).all(axis=1)]
        if len(shown) > LEAST_SEEN * len(grid):
            ends = shown.min(axis=0) - steps[1], shown.max(axis=0) + steps[1]
            boxes[name] = np.clip([np.floor(ends[0]), np.ceil(ends[1])], 0.0, side - 1.0)
    return own, side, boxes


def pinhole_numbers(reconstruction: Reconstruction) -> list[int]:
    """Numbers of the pinhole views of the registered images of a metric reconstruction, in order."""
    numbers, V, names = list[int](), len(reconstruction.P), list(FACES)
    for i in np.flatnonzero(reconstruction.registered).tolist():
        camera = camera_of_image(reconstruction, i)
        shown = seen_faces(*camera)[2] if is_divided(*camera) else names[:1]
        numbers += [i + V * names.index(name) for name in shown]
    return sorted(numbers)


def pinhole_frame(
    image: Image, reconstruction: Reconstruction, view: int, *, max_side: int = 1536
) -> PinholeView:
    """The view of :func:`pinhole_view` without reading pixels: all are black and valid."""
    P, _, size, _ = _pinhole_camera(image, reconstruction, view, max_side)
    black, seen = np.broadcast_to(np.uint8(0), (*size[::-1], 3)), np.broadcast_to(np.True_, size[::-1])
    return PinholeView(view, P, black, seen)


def pinhole_view(
    image: Image, reconstruction: Reconstruction, view: int, *, max_side: int = 1536
) -> PinholeView:
    """The pinhole view of a number of an image of a metric reconstruction; P[2] X is the depth."""
    # Images longer than `max_side` are reduced.
    P, K, size, turn = _pinhole_camera(image, reconstruction, view, max_side)
    own, _, lens = camera_of_image(reconstruction, view % len(reconstruction.P))
    if not lens.any() and size == image.size and image.mask is None:
        return PinholeView(view, P, image.rgb, np.ones(image.rgb.shape[:2], dtype=bool))
    rgb, seen = undistort_image(image.rgb, own, lens, K, size, mask=image.mask, turn=turn)
    return PinholeView(view, P, rgb, seen)


def camera_of_image(reconstruction: Reconstruction, image: int) -> tuple[F64, tuple[int, int], F64]:
    """K, size and lens of an image."""
    if reconstruction.stratum != "metric" or reconstruction.K is None:
        raise ValueError("undistorted views need a metric reconstruction with K")
    width, height = reconstruction.sizes[image].tolist()
    lens = np.zeros(3) if reconstruction.distortion is None else reconstruction.distortion[image]
    return reconstruction.K[image], (width, height), lens


def _pinhole_camera(
    image: Image, reconstruction: Reconstruction, view: int, max_side: int
) -> tuple[F64, F64, tuple[int, int], F64 | None]:
    """P (3, 4), K (3, 3) and (width, height) of a pinhole view, and its rotation if it is one of several."""
    face, i = divmod(view, len(reconstruction.P))
    K, size, lens = camera_of_image(reconstruction, i)
    if size != image.size:
        raise ValueError(f"image {image.name} must be {reconstruction.sizes[i]} px; got {image.size}")
    P, turn = reconstruction.P[i], None
    P = P * np.sign(np.linalg.det(P[:, :3])) / np.linalg.norm(P[2, :3])
    if is_divided(K, size, lens):
        turn = list(FACES.values())[face]
        own, _, boxes = seen_faces(K, size, lens)
        first, last = boxes[list(FACES)[face]]
        size = (int(last[0] - first[0]) + 1, int(last[1] - first[1]) + 1)
        own[:2, 2] -= first
        K, P = own, own @ turn @ np.linalg.solve(K, P)
    shrink = min(1.0, max_side / max(image.size))
    reduced = (max(round(size[0] * shrink), 1), max(round(size[1] * shrink), 1))
    S = resizing_transform(np.divide(reduced, size))
    return S @ P, S @ K, reduced, turn
