"""The camera record: calibration, pose, image size and radial distortion."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry._conditioning import (
    require_calibration,
    require_finite,
    require_rotations,
    require_shapes,
    resizing_transform,
)
from thesisrecon.geometry.camera_matrix import compose_camera, decompose_camera, project_camera, undistort


@dataclass(frozen=True, eq=False)
class Camera:
    """Metric camera x ~ K [R t] X with radial distortion (3.21).

    Parameters
    ----------
    K : ndarray (3, 3)
        Calibration matrix in pixels; (0, 0) is the centre of the top-left pixel.
    R, t : ndarray (3, 3), ndarray (3,)
        Rotation from world to camera (the thesis writes its transpose) and translation -R centre.
    size : tuple of int
        Image (width, height) in pixels.
    distortion : ndarray (C,), optional
        Radial coefficients k1, k2, ...: a normalised point (x, y) is imaged at (x, y) (1 + k1 r^2 + k2 r^4 +
        ...). None: no distortion.
    std : mapping of str to float, optional
        Standard deviations of estimated values: "focal_px", "aspect", "skew_px", "principal_x_px",
        "principal_y_px", "k1", "k2", "k3" (0: as assumed), and of poses of a run "rotation_x_deg" and y, z
        about the axes of the camera, "centre_x" and y, z along those of the model. None: unknown.
    as_stored : bool
        Whether the pixels are those of the image file as stored, as in COLMAP, and not after EXIF rotation.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite, K is not upper triangular with positive focal lengths and
        K33 = 1, R is not a rotation, or the size is not whole numbers of at least 1.

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
    std: Mapping[str, float] | None = None
    as_stored: bool = False

    def __post_init__(self) -> None:
        fields = {name: np.asarray(getattr(self, name), dtype=np.float64) for name in ("K", "R", "t")}
        K, R, t = fields.values()
        require_shapes("Camera", K=(K, (3, 3)), R=(R, (3, 3)), t=(t, (3,)))
        if self.distortion is not None:
            fields["distortion"] = np.asarray(self.distortion, dtype=np.float64)
            require_shapes("Camera", distortion=(fields["distortion"], ("C",)))
        require_finite("Camera", *fields.values())
        require_calibration("Camera", K)
        require_rotations("Camera", R)
        try:
            width, height = (operator.index(side) for side in self.size)
        except (TypeError, ValueError):
            raise ValueError(f"Camera needs a size of two whole numbers; got {self.size}") from None
        if min(width, height) < 1:
            raise ValueError(f"Camera needs a size of at least 1 x 1; got {self.size}")
        for name, value in {**fields, "size": (width, height)}.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_matrix(cls, P: F64, size: tuple[int, int]) -> Camera:
        """Return the camera of a matrix of any scale and sign, by RQ decomposition (HZ 6.2.4).

        Parameters
        ----------
        P, size : ndarray (3, 4), tuple of int
            Camera matrix (``ValueError`` if the centre is at infinity), and image (width, height).

        Returns
        -------
        Camera
            Without distortion.
        """
        P = np.asarray(P, dtype=np.float64)
        require_shapes("Camera.from_matrix", P=(P, (3, 4)))
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
            Points in the world frame. Points behind the camera are projected, too.

        Returns
        -------
        ndarray (N, 2)
            Pixels xy.
        """
        X = np.asarray(X, dtype=np.float64)
        require_shapes("Camera.project", X=(X, ("N", 3)))
        return project_camera(self.K, self.R, self.t, X, distortion=self._coefficients)

    def unproject(self, xy: F64, depth: F64 | None = None) -> F64:
        """Return the points or viewing directions of pixels.

        Parameters
        ----------
        xy, depth : ndarray (N, 2), ndarray (N,)
            Pixels of the (distorted) image, and depths z in the camera frame (optional).

        Returns
        -------
        ndarray (N, 3)
            Points in the world frame; without ``depth`` unit vectors of the viewing rays in the world frame.
        """
        xy = np.asarray(xy, dtype=np.float64)
        given = {} if depth is None else {"depth": (depth, ("N",))}
        require_shapes("Camera.unproject", xy=(xy, ("N", 2)), **given)
        xh = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(self.K).T
        rays = np.column_stack([undistort(xh[:, :2] / xh[:, 2:], self._coefficients), np.ones(len(xy))])
        if depth is None:
            return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True) @ self.R)
        return np.asarray((rays * np.asarray(depth)[:, None] - self.t) @ self.R)

    def scaled(self, factor: float) -> Camera:
        """Return the camera of the resized image: x goes to (x + 0.5) s - 0.5 along each side.

        Parameters
        ----------
        factor : float
            New over old size, finite and above 0, otherwise a ``ValueError``. The sides are rounded to whole
            pixels; s is the ratio of the rounded side to the old one.

        Returns
        -------
        Camera
        """
        if not 0.0 < factor < math.inf:
            raise ValueError(f"Camera.scaled needs a finite factor above 0; got {factor}")
        width, height = (max(1, round(side * factor)) for side in self.size)
        S = resizing_transform(np.divide((width, height), self.size))
        return replace(self, K=S @ self.K, size=(width, height), std=None)

    @property
    def _coefficients(self) -> F64:
        return np.zeros(1) if self.distortion is None else np.asarray(self.distortion, dtype=np.float64)
