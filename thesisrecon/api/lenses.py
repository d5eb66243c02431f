"""Lens distortion removed from points and images, and pairs of known cameras rectified."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thesisrecon.api.given import CameraInput, as_cameras, checked_sizes
from thesisrecon.arrays import B8, F32, F64, I64, U8, checked, numbers, require_calibration
from thesisrecon.camera import Camera
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, map_in_front
from thesisrecon.imaging.resampling import undistort_image as resampled
from thesisrecon.imaging.resampling import warp_image
from thesisrecon.io._images import read_pixels
from thesisrecon.lens import distort, undistort
from thesisrecon.pipeline.matching import ImageInput
from thesisrecon.stereo.rectification import rotation_along_baseline


class UndistortedImage(NamedTuple):
    """An image (H, W, 3) uint8 of a pinhole camera, black where the mask ``seen`` (H, W) is false."""

    image: U8
    seen: B8
    camera: Camera


def undistort_points(xy: F64, camera: Camera, K: F64 | None = None) -> F64:
    """Remove the lens distortion of pixels.

    The inverse of the lens, such as (x, y) (1 + k1 r^2 + k2 r^4 + ...), by Newton's method.

    Parameters
    ----------
    xy : array_like (N, 2)
        Pixels of the image with distortion; NaN stays NaN.
    camera : Camera
        Its calibration and distortion; the pose does not matter.
    K : ndarray (3, 3), optional
        Calibration of the pixels returned; None: that of the camera. The identity gives normalised
        coordinates.

    Returns
    -------
    ndarray (N, 2)
        Pixels of a pinhole camera, NaN beyond the range of the lens.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import Camera, undistort_points
    >>> K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> camera = Camera(K, np.eye(3), np.zeros(3), (640, 480), distortion=np.array([0.1]))
    >>> undistort_points(np.array([[576.25, 240.0]]), camera).round(6).tolist()
    [[570.0, 240.0]]
    """
    (xy,) = checked("undistort_points", missing=("xy",), xy=(xy, ("N", 2)))
    K = _calibration("undistort_points", camera, K)
    given = dehomogenize(homogenize(xy) @ np.linalg.inv(camera.K).T)
    if camera.is_pinhole:
        rays = given
    else:
        rays = undistort(given, camera.lens_row)
        back = np.abs(distort(rays, camera.lens_row) - given).max(axis=1, initial=0.0)
        rays = np.where((back <= 1e-6 * (1.0 + np.abs(given).max(axis=1)))[:, None], rays, np.nan)
    return np.asarray(rays @ K[:2, :2].T + K[:2, 2])


def undistort_image(
    image: ImageInput, camera: Camera, K: F64 | None = None, *, size: tuple[int, int] | None = None
) -> UndistortedImage:
    """Resample an image to a pinhole camera by cubic convolution.

    Parameters
    ----------
    image : path, ndarray (H, W), (H, W, 3) or (H, W, 4) uint8, or Image
        The image with distortion, of the size of the camera.
    camera : Camera
        Its calibration and distortion.
    K, size : ndarray (3, 3), tuple of int, optional
        Calibration and (width, height) of the result; None: those of the camera.

    Returns
    -------
    UndistortedImage
        The image, where it has content, and its pinhole camera with the pose of ``camera``.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import Camera, undistort_image
    >>> K = np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])
    >>> camera = Camera(K, np.eye(3), np.zeros(3), (64, 48), distortion=np.array([0.1]))
    >>> found = undistort_image(np.full((48, 64), 90, np.uint8), camera)
    >>> found.image.shape, int(found.image[24, 32, 0]), bool(found.seen[0, 0])
    ((48, 64, 3), 90, False)
    """
    K, (pixels,) = _calibration("undistort_image", camera, K), read_pixels(image)
    _require_size("undistort_image", pixels, camera)
    pinhole = Camera(K, camera.R, camera.t, camera.size if size is None else size)
    rgb, seen = resampled(pixels, camera.K, camera.lens_row, K, pinhole.size)
    return UndistortedImage(rgb, seen, pinhole)


@dataclass(frozen=True)
class RectifiedCameras:
    """Two cameras turned about their centres so that their rows correspond, without distortion."""

    cameras: tuple[Camera, Camera]  #: the rectified ones: one K and one R, x along the baseline
    H: F64  #: (2, 3, 3) homographies K R (K_i R_i)^-1 from undistorted pixels to rectified ones
    Q: F64  #: (4, 4), (x, y, x1 - x2, 1) to homogeneous points in the frame of the first rectified camera
    given: tuple[Camera, Camera]  #: the cameras of the images

    @property
    def K(self) -> F64:
        """Calibration (3, 3) of both rectified images."""
        return self.cameras[0].K

    def rectified_from_original(self, side: int, xy: F64) -> F64:
        """Map pixels (N, 2) of an image (side 0 or 1), with distortion, to the rectified one."""
        return map_in_front(self.H[side], undistort_points(xy, self.given[side]))

    def original_from_rectified(self, side: int, xy: F64) -> F64:
        """Map pixels (N, 2) of a rectified image (side 0 or 1) to the original one, with distortion."""
        xy, camera = map_in_front(np.linalg.inv(self.H[side]), xy), self.given[side]
        rays = dehomogenize(homogenize(xy) @ np.linalg.inv(camera.K).T)
        return np.asarray(distort(rays, camera.lens_row) @ camera.K[:2, :2].T + camera.K[:2, 2])

    def images(self, image1: ImageInput, image2: ImageInput) -> tuple[F32, F32]:
        """Resample two images (H, W, 3), NaN outside, for :func:`thesisrecon.match_rectified`."""
        width = self.cameras[0].size[0]

        def warped(side: int, image: ImageInput) -> F32:
            (pixels,) = read_pixels(image)
            _require_size("RectifiedCameras.images", pixels, self.given[side])

            def lookup(rows: range) -> F64:
                x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.array(rows, dtype=np.float64))
                places = self.original_from_rectified(side, np.stack([x, y], axis=-1).reshape(-1, 2))
                return places.reshape(len(rows), width, 2)

            return np.clip(warp_image(pixels.astype(np.float32), lookup, self.cameras[0].size), 0.0, 255.0)

        return warped(0, image1), warped(1, image2)


def rectify_cameras(
    cameras: CameraInput, *, sizes: I64 | None = None, K: F64 | None = None,
    size: tuple[int, int] | None = None,
) -> RectifiedCameras:  # fmt: skip
    """Rectify two images of known cameras by rotations about their centres (2.5; Fusiello et al., 2000).

    H_i = K R (K_i R_i)^-1 with the x axis of R along the baseline and z nearest to the mean viewing
    direction. A point at depth z in this frame has the disparity x1 - x2 = f B / z.

    Parameters
    ----------
    cameras : sequence of two Camera, tuple (K, R, t) or other models
        The two cameras; the first is the left one if disparities are to be positive.
    sizes : array_like (2, 2) or (2,), optional
        Image width and height, for plain arrays.
    K, size : ndarray (3, 3), tuple of int, optional
        Calibration and (width, height) of the rectified images. None: the mean focal length with the images
        centred, and the size of the first image.

    Returns
    -------
    RectifiedCameras
        The rectified cameras, H, Q, and the maps of points and images.

    Raises
    ------
    ValueError
        If there are not two cameras, or their centres are equal.
    StageFailure
        If both cameras look along the baseline.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import Camera, rectify_cameras
    >>> K, R = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), np.eye(3)
    >>> pair = [Camera(K, R, np.array([-x, 0.1 * x, 0.0]), (640, 480)) for x in (0.0, 1.0)]
    >>> found, X = rectify_cameras(pair), np.array([[0.5, 0.2, 5.0]])
    >>> left, right = (found.rectified_from_original(i, c.project(X))[0] for i, c in enumerate(pair))
    >>> Xh = found.Q @ [*left, left[0] - right[0], 1.0]
    >>> bool(abs(left[1] - right[1]) < 1e-9), (Xh[:3] / Xh[3] @ found.cameras[0].R).round(6).tolist()
    (True, [0.5, 0.2, 5.0])
    """
    given = as_cameras("rectify_cameras", cameras, sizes)
    if len(given) != 2:
        raise ValueError(f"rectify_cameras needs two cameras; got {len(given)}")
    centres = np.array([camera.centre for camera in given])
    baseline = float(np.linalg.norm(centres[1] - centres[0]))
    if not baseline > 1e-12 * float(np.abs(centres).max()):
        raise ValueError(f"rectify_cameras needs two camera centres; both are {centres[0].tolist()}")
    R = rotation_along_baseline(np.array([camera.P for camera in given]))
    width, height = given[0].size if size is None else checked_sizes("rectify_cameras", size, 1)[0].tolist()
    if K is None:
        focal = float(np.exp(np.mean([np.log(np.diag(camera.K)[:2]) for camera in given])))
        # Where the centres of the images go, about the middle of the frame.
        middle = np.array([[(np.array(camera.size) - 1.0) / 2.0] for camera in given])
        rays = [camera.unproject(xy)[0] @ R.T for camera, xy in zip(given, middle, strict=True)]
        centre = np.array([(width - 1.0) / 2.0, (height - 1.0) / 2.0])
        centre -= focal * np.mean([ray[:2] / ray[2] for ray in rays], axis=0)
        K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    K = _calibration("rectify_cameras", given[0], K)
    first, second = (Camera(K, R, -R @ centre, (width, height)) for centre in centres)
    H = np.array([K @ R @ np.linalg.inv(camera.K @ camera.R) for camera in given])
    Q = np.zeros((4, 4))
    # K^-1 (x, y, 1) times the depth f B / d, divided by f B / d.
    Q[:3, [0, 1, 3]] = np.linalg.inv(K)
    Q[3, 2] = 1.0 / (K[0, 0] * baseline)
    return RectifiedCameras((first, second), H, Q, (given[0], given[1]))


def _calibration(caller: str, camera: Camera, K: F64 | None) -> F64:
    if not isinstance(camera, Camera):
        raise ValueError(f"{caller} needs a thesisrecon.Camera; got a {type(camera).__name__}")
    if K is None:
        return camera.K
    (K,) = numbers(caller, K=K)
    require_calibration(caller, K)
    return K


def _require_size(caller: str, pixels: U8, camera: Camera) -> None:
    width, height = camera.size
    if pixels.shape[:2] != (height, width):
        got = f"an image of {pixels.shape[1]} x {pixels.shape[0]} px and a camera of {width} x {height}"
        raise ValueError(f"{caller} needs an image of the size of its camera; got {got}")
