"""The camera: calibration, pose, image size and radial distortion; projection with and without the record."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon import arrays
from thesisrecon.arrays import B8, F64, Record


@dataclass(frozen=True, eq=False)
class Camera(Record):
    """Metric camera x ~ K [R t] X with radial distortion (3.21).

    It holds read-only copies of its arrays.

    Parameters
    ----------
    K : ndarray (3, 3)
        Calibration matrix in pixels; (0, 0) is the centre of the top-left pixel.
    R, t : ndarray (3, 3), ndarray (3,)
        Rotation from world to camera (the thesis writes its transpose) and translation -R centre.
    size : tuple of int, or image
        Image (width, height) in pixels, or the image.
    distortion : ndarray (C,), optional
        Radial coefficients k1, k2, k3: a normalised point (x, y) is imaged at (x, y) (1 + k1 r^2 + k2 r^4 +
        k3 r^6). None: no distortion. More than three numbers are refused unless the others are 0: four and
        more mean k1, k2, p1, p2, k3 in OpenCV and k1, k2, k3, k4, k5 elsewhere.
    std : mapping of str to float, optional
        Standard deviations of estimated values: "focal_px", "aspect", "skew_px", "principal_x_px",
        "principal_y_px", "k1", "k2", "k3" (0: as assumed), and of poses of a run "rotation_x_deg" and y, z
        about the axes of the camera, "centre_x" and y, z along those of the model. None: unknown.
    as_stored : bool
        Whether the pixels are those of the image file as stored, as in COLMAP, and not after EXIF rotation.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite or masked, K is not upper triangular with positive focal
        lengths and K33 = 1, R is not a rotation, the size is not whole numbers of at least 1, or distortion
        has more than three numbers that are not 0.

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
        given = {name: getattr(self, name) for name in ("K", "R", "t", "distortion")}
        if self.distortion is None:
            del given["distortion"]
        fields = {
            name: array.copy() for name, array in zip(given, arrays.numbers("Camera", **given), strict=True)
        }
        K, R, t = fields["K"], fields["R"], fields["t"]
        arrays.require_shapes("Camera", K=(K, (3, 3)), R=(R, (3, 3)), t=(t, (3,)))
        if "distortion" in fields:
            arrays.require_shapes("Camera", distortion=(fields["distortion"], ("C",)))
            _require_radial(fields["distortion"])
        arrays.require_finite("Camera", *fields.values())
        arrays.require_calibration("Camera", K)
        arrays.require_rotations("Camera", R)
        try:
            width, height = (operator.index(side) for side in arrays.sizes_of_images(self.size))
        except (TypeError, ValueError):
            raise ValueError(f"Camera needs a size of two whole numbers; got {self.size}") from None
        if min(width, height) < 1:
            raise ValueError(f"Camera needs a size of at least 1 x 1; got {self.size}")
        for array in fields.values():
            array.setflags(write=False)
        std = self.std if self.std is None else dict(self.std)
        for name, value in {**fields, "size": (width, height), "std": std}.items():
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
        (P,) = arrays.numbers("Camera.from_matrix", P=P)
        arrays.require_shapes("Camera.from_matrix", P=(P, (3, 4)))
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
        (X,) = arrays.numbers("Camera.project", missing=("X",), X=X)
        arrays.require_shapes("Camera.project", X=(X, ("N", 3)))
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
            NaN for pixels farther out than the distortion images any point.
        """
        (xy,) = arrays.numbers("Camera.unproject", missing=("xy",), xy=xy)
        z = None if depth is None else arrays.numbers("Camera.unproject", missing=("depth",), depth=depth)[0]
        given = {} if z is None else {"depth": (z, ("N",))}
        arrays.require_shapes("Camera.unproject", xy=(xy, ("N", 2)), **given)
        xh = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(self.K).T
        places = xh[:, :2] / xh[:, 2:]
        plane = undistort(places, self._coefficients)
        # Beyond the radius up to which the distortion grows, its inverse does not exist.
        largest = growing_radius(self._coefficients)
        returned = np.linalg.norm(distort(plane, self._coefficients) - places, axis=1)
        outside = np.linalg.norm(plane, axis=1) > largest * (1.0 + 1e-9)
        outside |= returned > 1e-6 * np.maximum(1.0, np.linalg.norm(places, axis=1))
        plane[outside] = np.nan
        rays = np.column_stack([plane, np.ones(len(xy))])
        if z is None:
            return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True) @ self.R)
        return np.asarray((rays * z[:, None] - self.t) @ self.R)

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
        if not 0.0 < arrays.number("Camera.scaled", "factor", factor, "a finite factor above 0") < math.inf:
            raise ValueError(f"Camera.scaled needs a finite factor above 0; got {factor}")
        width, height = (max(1, round(side * factor)) for side in self.size)
        S = arrays.resizing_transform(np.divide((width, height), self.size))
        return replace(self, K=S @ self.K, size=(width, height), std=None)

    @property
    def _coefficients(self) -> F64:
        return np.zeros(1) if self.distortion is None else np.asarray(self.distortion, dtype=np.float64)


def compose_camera(K: F64, R: F64, t: F64) -> F64:
    """Return P (..., 3, 4) = K [R t], with t = -R C the thesis' K [R' | -R' C] (3.18 - 3.21)."""
    return np.asarray(K @ np.concatenate([R, t[..., None]], axis=-1))


def decompose_camera(P: F64) -> tuple[F64, F64, F64]:
    """Decompose P (3, 4) of any scale and sign into K, R and t with K33 = 1 and det R = 1 (3.21)."""
    P = P * np.sign(_left_determinant(P, "decompose_camera"))
    K, R = rq(P[:, :3])
    t = np.linalg.solve(K, P[:, 3])
    return K / K[2, 2], R, np.asarray(t, dtype=np.float64)


def _left_determinant(P: F64, caller: str) -> F64:
    """det M (...) of cameras (..., 3, 4); ``ValueError`` if one is 0 to rounding."""
    if not np.isfinite(P).all():
        raise ValueError(f"{caller} needs finite cameras; some entries are NaN or infinite")
    if not finite_cameras(P).all():
        raise ValueError(f"{caller} needs a finite camera; the left 3x3 part of P is singular")
    return np.asarray(np.linalg.det(P[..., :3]))


def finite_cameras(P: F64) -> B8:
    """Whether the centres of cameras (..., 3, 4) are finite, in any unit of the pixels."""
    rows = np.linalg.norm(P[..., :3], axis=-1)
    return np.asarray(np.abs(np.linalg.det(P[..., :3])) > 1e-14 * rows.prod(axis=-1))


def rq(M: F64) -> tuple[F64, F64]:
    """Factor M (3, 3) = K R with K upper triangular, of positive diagonal; R is a rotation if det M > 0."""
    Q, U = np.linalg.qr(M[::-1].T)
    K = U.T[::-1, ::-1]
    R = Q.T[::-1]
    signs = np.sign(np.diag(K))
    signs[signs == 0] = 1.0
    return K * signs, signs[:, None] * R


def distort(xy_normalized: F64, distortion: float | F64) -> F64:
    """Apply radial distortion k (C,) or (N, C) to points (N, 2): (x, y) (1 + k1 r^2 + k2 r^4 + ...)."""
    r2 = np.sum(xy_normalized**2, axis=-1, keepdims=True)
    return np.asarray(xy_normalized * _radial_factor(distortion, r2))


def undistort(xy_normalized: F64, distortion: float | F64) -> F64:
    """Invert :func:`distort` by Newton's method; points without an inverse, far outside, are not changed."""
    distorted = np.sum(xy_normalized**2, axis=-1, keepdims=True)
    k = np.atleast_1d(distortion)
    slopes = k * np.arange(1, k.shape[-1] + 1)
    r2 = distorted
    with np.errstate(all="ignore"):
        for _ in range(20):
            factor = _radial_factor(k, r2)
            slope = factor * (factor + 2.0 * (_radial_factor(slopes, r2) - 1.0))
            step = (r2 * factor**2 - distorted) / slope
            r2 = r2 - step
            # Converged to rounding: the next error is the square of the relative step.
            if np.all(np.abs(step) <= 1e-9 * np.abs(r2)):
                break
        factor = _radial_factor(k, r2)
        reached = np.abs(r2 * factor**2 - distorted) <= 1e-9 * distorted
    return np.asarray(xy_normalized / np.where(reached & (factor > 0.0), factor, 1.0))


def growing_radius(distortion: F64) -> float:
    """Normalised radius up to which r (1 + k1 r^2 + k2 r^4 + ...) grows, infinity if everywhere."""
    slopes = distortion * np.arange(3, 2 * len(distortion) + 2, 2)
    roots = np.roots([*slopes[::-1], 1.0])
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return float(np.sqrt(squares.min())) if len(squares) else np.inf


def _require_radial(distortion: F64) -> None:
    """Refuse numbers after k3: their meaning is not that of OpenCV's calibration files."""
    if np.any(distortion[3:]) or (len(distortion) > 3 and np.any(distortion[2:])):
        both = "they are k1, k2, p1, p2, k3 in OpenCV, and k1, k2, k3, k4, k5 of a radial lens elsewhere"
        advice = "give radial k1, k2, k3; for tangential p1, p2 undistort the images first"
        raise ValueError(f"Camera got {len(distortion)} distortion numbers, and {both}; {advice}")


def _radial_factor(distortion: float | F64, r2: F64) -> F64:
    k = np.atleast_1d(distortion)
    factor = np.zeros_like(r2)
    for n in reversed(range(k.shape[-1])):
        factor = (factor + k[..., n : n + 1]) * r2
    return 1.0 + factor


def project_camera(K: F64, R: F64, t: F64, X: F64, *, distortion: float | F64 = 0.0) -> F64:
    """Project points (N, 3) with a metric camera and radial distortion as of :func:`distort`."""
    X = X @ R.T + t
    return distort(X[:, :2] / X[:, 2:], distortion) @ K[:2, :2].T + K[:2, 2]
