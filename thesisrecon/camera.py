"""The camera: calibration, pose, image size and lens; projection with and without the record."""

import math
import operator
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon import arrays
from thesisrecon.arrays import B8, F64, Record
from thesisrecon.errors import Notice
from thesisrecon.lens import (
    Lens,
    angles_from_axis,
    directions_of_image,
    image_of_directions,
    lens_row,
    named_lens,
)

POSE_STDS = (*(f"rotation_{axis}_deg" for axis in "xyz"), *(f"centre_{axis}" for axis in "xyz"))
"""Names in ``Camera.std`` of the standard deviations of a pose."""


@dataclass(frozen=True, eq=False)
class Camera(Record):
    """Metric camera x ~ K [R t] X with lens distortion (3.21).

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
        Coefficients of the lens. None: no distortion. Of a radial lens, k1, k2, k3: a normalised point (x, y)
        is imaged at (x, y) (1 + k1 r^2 + k2 r^4 + k3 r^6); more numbers that are not 0 are refused, since
        they mean k1, k2, p1, p2, k3 in OpenCV and k1, k2, k3, k4, k5 elsewhere.
    std : mapping of str to float, optional
        Standard deviations of estimated values: "focal_px", "aspect", "skew_px", "principal_x_px",
        "principal_y_px", "k1", "k2", "k3", further "k4", "p1", "p2" of other lenses (0: as assumed), of
        :attr:`angles_of_view` "angle_of_view_deg" and "corner_deg", and of poses of a run "rotation_x_deg"
        and y, z about the axes of the camera, "centre_x" and y, z along those of the model. None: unknown.
    as_stored : bool
        Whether the pixels are those of the image file as stored, as in COLMAP, and not after EXIF rotation.
    lens : {"radial", "division", "fisheye", "brown", "rational", "thin-prism-fisheye"}
        Model of the lens: "division" k1 (Fitzgibbon, 2001: r = r_d / (1 + k1 r_d^2)); "fisheye" k1 to k4 of
        the angle from the axis (Kannala and Brandt, 2006), as in OpenCV, also beyond 90 degrees; "brown" k1,
        k2, p1, p2, k3 and "rational" further k4, k5, k6, as in OpenCV; "thin-prism-fisheye" k1, k2, p1, p2,
        k3, k4, s1, s2, as in COLMAP.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite or masked, K is not upper triangular with positive focal
        lengths and K33 = 1, R is not a rotation, the size is not whole numbers of at least 1, or distortion
        has more numbers that are not 0 than the lens has.

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
    lens: Lens = "radial"

    def __post_init__(self) -> None:
        found = arrays.checked("Camera", K=(self.K, (3, 3)), R=(self.R, (3, 3)), t=(self.t, (3,)))
        fields = {name: array.copy() for name, array in zip("KRt", found, strict=True)}
        if self.distortion is not None:
            (k,) = arrays.checked("Camera", distortion=(self.distortion, ("C",)))
            fields["distortion"] = k.copy()
            if self.lens == "radial":
                _require_radial(k)
        try:
            lens_row(self.lens, self._coefficients)
        except ValueError as error:
            raise ValueError(f"Camera: {error}") from None
        arrays.require_calibration("Camera", fields["K"])
        arrays.require_rotations("Camera", fields["R"])
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
    def from_matrix(cls, P: F64, size: tuple[int, int]) -> "Camera":
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
        (P,) = arrays.checked("Camera.from_matrix", P=(P, (3, 4)))
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
    def angles_of_view(self) -> tuple[float, float]:
        """Angle of view along the long side, and of the farthest corner from the axis, degrees.

        Of the outer edges of the pixels, along the row or column of the principal point; NaN where the lens
        images nothing.
        """
        return angles_of_view(self.K, self.size, self.lens_row)

    @property
    def is_pinhole(self) -> bool:
        """Whether the camera has no distortion."""
        return not np.any(self.lens_row)

    def project(self, X: F64) -> F64:
        """Project points to pixels, distortion included.

        Parameters
        ----------
        X : ndarray (N, 3) or (3,)
            Points in the world frame, or one. Points behind the camera are projected, too.

        Returns
        -------
        ndarray (N, 2) or (2,)
            Pixels xy.
        """
        (X,) = arrays.numbers("Camera.project", missing=("X",), X=X)
        arrays.require_shapes("Camera.project", X=(np.atleast_2d(X), ("N", 3)))
        xy = project_camera(self.K, self.R, self.t, X.reshape(-1, 3), distortion=self.lens_row)
        return xy.reshape(*X.shape[:-1], 2)

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
        given = {"xy": (xy, ("N", 2))} | ({} if depth is None else {"depth": (depth, ("N",))})
        xy, *z = arrays.checked("Camera.unproject", missing=("xy", "depth"), **given)
        rays = viewing_rays(self.K, xy, self.lens_row)
        if not z:
            return np.asarray(rays @ self.R)
        return np.asarray((rays * (z[0] / rays[:, 2])[:, None] - self.t) @ self.R)

    def scaled(self, factor: float) -> "Camera":
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
    def lens_row(self) -> F64:
        """The lens as a row of `thesisrecon.lens`: the coefficients of a radial lens, else twelve numbers."""
        return lens_row(self.lens, self._coefficients)

    @property
    def _coefficients(self) -> F64:
        return np.zeros(1) if self.distortion is None else np.asarray(self.distortion, dtype=np.float64)


def camera_of_row(
    pose: tuple[F64, F64, F64], size: tuple[int, int], row: F64, *, std: Mapping[str, float] | None = None,
    as_stored: bool = False,
) -> Camera:  # fmt: skip
    """The camera of (K, R, t) with the lens of a row as in :attr:`Camera.lens_row`."""
    lens, coefficients = named_lens(row)
    return Camera(*pose, size, coefficients, std, as_stored, lens)


def viewing_rays(K: F64, xy: F64, lens: F64) -> F64:
    """Unit directions (N, 3) of pixels in the camera frame, by the row of a lens; NaN: of nothing."""
    xh = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(K).T
    return directions_of_image(xh[:, :2] / xh[:, 2:], lens)


def angles_of_view(K: F64, size: tuple[int, int], lens: F64) -> tuple[float, float]:
    """As :attr:`Camera.angles_of_view`, of a camera with the row of a lens."""
    x, y = size[0] - 0.5, size[1] - 0.5
    cx, cy = K[:2, 2]
    ends = [[-0.5, cy], [x, cy]] if size[0] >= size[1] else [[cx, -0.5], [cx, y]]
    rays = viewing_rays(K, np.array([*ends, [-0.5, -0.5], [x, -0.5], [-0.5, y], [x, y]]), lens)
    angle = np.degrees(angles_from_axis(rays))
    return float(angle[:2].sum()), float(angle[2:].max())


def widest_angle(K: F64, size: tuple[int, int], lens: F64) -> float:
    """Largest angle of a ray of a pixel on the border of an image from the axis, radians."""
    x, y = (np.linspace(0.0, side - 1.0, 33) for side in size)
    sides = [np.column_stack([x, np.full(33, end)]) for end in y[[0, -1]]]
    sides += [np.column_stack([np.full(33, end), y]) for end in x[[0, -1]]]
    rays = viewing_rays(K, np.concatenate(sides), lens)
    return float(np.nanmax(angles_from_axis(rays)))


def pixels_of_rays(rays: F64, K: F64, lens: F64, widest: float) -> F64:
    """Pixels (N, 2) of directions in the camera frame; NaN farther than the angle ``widest`` from the axis.

    Beyond the rays of its pixels a lens may image directions a second time.
    """
    near = angles_from_axis(rays) <= widest
    xy = np.full((len(rays), 2), np.nan)
    xy[near] = image_of_directions(rays[near], lens) @ K[:2, :2].T + K[:2, 2]
    return xy


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


def _require_radial(distortion: F64) -> None:
    """Refuse numbers after k3: their meaning is not that of OpenCV's calibration files."""
    if np.any(distortion[3:]) or (len(distortion) > 3 and np.any(distortion[2:])):
        raise ValueError(Notice("ambiguous-distortion", len(distortion)))


def project_camera(K: F64, R: F64, t: F64, X: F64, *, distortion: float | F64 = 0.0) -> F64:
    """Project points (N, 3) with a metric camera and a lens as of :func:`thesisrecon.lens.distort`."""
    return image_of_directions(X @ R.T + t, distortion) @ K[:2, :2].T + K[:2, 2]
