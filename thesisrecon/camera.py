"""The camera record: calibration, pose, image size and radial distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import compose_camera, decompose_camera, project_camera, undistort


@dataclass(frozen=True)
class Camera:
    """Metric camera x ~ K [R t] X with radial distortion (3.21).

    Parameters
    ----------
    K : ndarray (3, 3)
        Calibration matrix in pixels; (0, 0) is the centre of the top-left pixel.
    R : ndarray (3, 3)
        Rotation from world to camera (the thesis writes its transpose).
    t : ndarray (3,)
        Translation, -R centre.
    size : tuple of int
        Image (width, height) in pixels.
    distortion : ndarray (C,), optional
        Radial coefficients k1, k2, ...: a normalised point (x, y) is imaged at (x, y) (1 + k1 r^2 + k2 r^4 +
        ...). None: no distortion.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite or the size is below one pixel.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import Camera
    >>> K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> camera = Camera(K, np.eye(3), np.zeros(3), (640, 480), distortion=np.array([0.1]))
    >>> xy = camera.project(np.array([[1.0, 0.0, 2.0]]))
    >>> xy.round(2).tolist()
    [[576.25, 240.0]]
    >>> camera.unproject(xy, np.array([2.0])).round(6).tolist()
    [[1.0, 0.0, 2.0]]
    """

    K: F64
    R: F64
    t: F64
    size: tuple[int, int]
    distortion: F64 | None = None

    def __post_init__(self) -> None:
        shapes = (np.shape(self.K), np.shape(self.R), np.shape(self.t))
        if shapes != ((3, 3), (3, 3), (3,)):
            raise ValueError(f"Camera needs K (3, 3), R (3, 3), t (3,); got {shapes}")
        if min(self.size) < 1:
            raise ValueError(f"Camera needs a size of at least 1 x 1; got {self.size}")
        if self.distortion is not None and np.ndim(self.distortion) != 1:
            raise ValueError(f"Camera needs distortion (C,); got shape {np.shape(self.distortion)}")
        lens = () if self.distortion is None else (self.distortion,)
        if not all(np.isfinite(a).all() for a in (self.K, self.R, self.t, *lens)):
            raise ValueError("Camera needs finite K, R, t and distortion")

    @classmethod
    def from_matrix(cls, P: F64, size: tuple[int, int]) -> Camera:
        """Return the camera of a matrix of any scale and sign.

        Parameters
        ----------
        P : ndarray (3, 4)
            Finite camera matrix.
        size : tuple of int
            Image (width, height).

        Returns
        -------
        Camera
            K, R and t by RQ decomposition (HZ 6.2.4), without distortion.

        Raises
        ------
        ValueError
            If the camera centre is at infinity.
        """
        return cls(*decompose_camera(P), size)

    @property
    def P(self) -> F64:
        """Camera matrix K [R t] (3, 4), before distortion."""
        return compose_camera(self.K, self.R, self.t)

    @property
    def centre(self) -> F64:
        """Camera centre -R' t (3,)."""
        return np.asarray(-self.R.T @ self.t)

    @property
    def is_pinhole(self) -> bool:
        """Whether the camera has no distortion."""
        return self.distortion is None or not np.any(self.distortion)

    def project(self, X: F64) -> F64:
        """Project points to pixels, distortion included.

        Parameters
        ----------
        X : ndarray (N, 3)
            Points in the world frame. Points behind the camera are projected too; check their depth.

        Returns
        -------
        ndarray (N, 2)
            Pixels xy.
        """
        return project_camera(self.K, self.R, self.t, X, distortion=self._coefficients)

    def unproject(self, xy: F64, depth: F64 | None = None) -> F64:
        """Return the points or viewing directions of pixels.

        Parameters
        ----------
        xy : ndarray (N, 2)
            Pixels of the (distorted) image.
        depth : ndarray (N,), optional
            Depth z in the camera frame. None: return unit viewing directions.

        Returns
        -------
        ndarray (N, 3)
            Points, or unit directions from the centre, in the world frame.
        """
        xy = np.asarray(xy, dtype=np.float64)
        xh = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(self.K).T
        rays = np.column_stack([undistort(xh[:, :2] / xh[:, 2:], self._coefficients), np.ones(len(xy))])
        if depth is None:
            return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True) @ self.R)
        return np.asarray((rays * np.asarray(depth)[:, None] - self.t) @ self.R)

    def scaled(self, factor: float) -> Camera:
        """Return the same view with resized pixels: x goes to (x + 0.5) factor - 0.5.

        Parameters
        ----------
        factor : float
            New size over old size; the sides are rounded to whole pixels.

        Returns
        -------
        Camera
            The camera of the resized image.
        """
        width, height = (max(1, round(side * factor)) for side in self.size)
        S = np.diag([width / self.size[0], height / self.size[1], 1.0])
        S[:2, 2] = (np.diag(S)[:2] - 1.0) / 2.0
        return Camera(S @ self.K, self.R, self.t, (width, height), self.distortion)

    @property
    def _coefficients(self) -> F64:
        return np.zeros(1) if self.distortion is None else np.asarray(self.distortion, dtype=np.float64)
