"""Observations of points, the weighting of their residuals, and the compiled projection of metric cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import B8, F64, I64, numbers, require_finite, require_shapes, whole_numbers
from thesisrecon.lens import ANGLE, BASE, DIVISION


@dataclass(frozen=True)
class SortedObservations:
    """Observations sorted by (point, view).

    ``start`` (N + 1,) is the first observation of each point, ``order`` (K,) the caller's position of each.
    """

    seen: Observations
    start: I64
    order: I64

    def unsort(self, values: F64) -> F64:
        """Bring one value (K, ...) per sorted observation to the order of the caller."""
        out = np.empty_like(values)
        out[self.order] = values
        return out


def read_observations(caller: str, given: Any) -> Observations:
    """The observations of a record with ``view_index``, ``point_index`` and ``xy``, as arrays of numbers."""
    view, point = (
        whole_numbers(caller, name, getattr(given, name)) for name in ("view_index", "point_index")
    )
    (xy,) = numbers(caller, xy=given.xy)
    return Observations(view, point, xy)


def sort_observations(observations: Observations, n_views: int, n_points: int) -> SortedObservations:
    """Sort observations by point and view, with the places at which each point begins."""
    view = np.ascontiguousarray(observations.view_index, dtype=np.int64)
    point = np.ascontiguousarray(observations.point_index, dtype=np.int64)
    xy = np.ascontiguousarray(observations.xy, dtype=np.float64)
    what = "a list of observations"
    require_shapes(what, view_index=(view, ("K",)), point_index=(point, ("K",)), xy=(xy, ("K", 2)))
    require_finite(what, xy)
    if len(view) and (view.min() < 0 or view.max() >= n_views or point.min() < 0 or point.max() >= n_points):
        raise ValueError(f"observation indices are beyond the {n_views} views or {n_points} points")
    key = point * max(n_views, 1) + view
    order = np.arange(len(key))
    if np.any(key[1:] < key[:-1]):
        order = np.argsort(key, kind="stable")
        view, point, xy = view[order], point[order], xy[order]
    start = np.zeros(n_points + 1, dtype=np.int64)
    np.cumsum(np.bincount(point, minlength=n_points), out=start[1:])
    return SortedObservations(Observations(view, point, xy), start, order)


class Jacobians(NamedTuple):
    """Weighted ``residual`` (K, 2) and Jacobians ``A`` (K, 2, C), ``E`` (K, 2, F), ``B`` (K, 2, 3)."""

    residual: F64
    A: F64
    E: F64
    B: F64

    @classmethod
    def empty(cls, n: int, own: int, common: int) -> Jacobians:
        """Allocate buffers of n observations with ``own`` columns in A and ``common`` ones in E."""
        return cls(*(np.empty((n, *shape)) for shape in [(2,), (2, own), (2, common), (2, 3)]))


class Weighting(NamedTuple):
    """Weighting of residuals: in units of ``sigma``, with Huber's loss of width ``delta``.

    ``min_curvature`` is the least fraction of the curvature along a residual that is kept where the second
    derivative of the loss reduces it (Triggs et al., Bundle Adjustment, 1999, equation 11); 1: reweighting.
    """

    sigma: float
    delta: float
    min_curvature: float = 1.0


@kernel(inline="always")
def loss_value(s: float, delta: float) -> float:
    """Evaluate Huber's rho(s); least squares if delta is infinite."""
    d2 = delta * delta
    return s if s <= d2 else 2.0 * delta * math.sqrt(s) - d2


@kernel(inline="always")
def loss_weight(s: float, delta: float) -> float:
    """Evaluate rho'(s)."""
    return 1.0 if s <= delta * delta else delta / math.sqrt(s)


@kernel(inline="always")
def loss_curvature(s: float, delta: float) -> float:
    """Evaluate 1 + 2 s rho'' / rho', the fraction of the curvature along a residual that its loss leaves."""
    return 1.0 if s / (delta * delta) <= 1.0 else 0.0


@kernel(inline="always")
def away_from_zero(w: float) -> float:
    """Move a projective depth off 0, so that a point in the focal plane gets a huge residual."""
    if w >= 0.0:
        return max(w, TINY)
    return min(w, -TINY)


_MORTON_BITS = 31
TINY = 1e-12
LENS = 5 + BASE  # Column of the base of the lens, in tables of twelve columns; others are radial


class Observations(NamedTuple):
    """View, point and pixels (K, 2) of observations of scene points; sorted by point is fastest."""

    view_index: I64
    point_index: I64
    xy: F64

    def at(self, rows: I64 | B8 | slice) -> Observations:
        """The observations of some rows, as arrays of their own."""
        view, point = (np.asarray(part)[rows] for part in (self.view_index, self.point_index))
        xy = np.ascontiguousarray(np.asarray(self.xy)[rows])
        return Observations(np.ascontiguousarray(view), np.ascontiguousarray(point), xy)


def cached_pair_order(first: ArrayLike, second: ArrayLike) -> I64:
    """Indices of view pairs in an order in which cached data of a view are reused.

    Views of a pair get near numbers (reverse Cuthill-McKee), and ranges of Morton's curve (IBM, 1966) contain
    few different views: with all pairs, a cache of M of V views computes V^2 / M.
    """
    i, j = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
    if not len(i):
        return i
    views, place = np.unique(np.concatenate([i, j]), return_inverse=True)
    near, ends = np.empty(len(views), np.int64), place.reshape(2, -1)
    graph = scipy.sparse.coo_array((np.ones(2 * len(i)), (place, ends[::-1].ravel())), shape=[len(views)] * 2)
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True)
    near[order] = np.arange(len(views))
    low, high = np.sort(near[ends], axis=0)
    curve = np.zeros(len(i), dtype=np.int64)
    for bit in range(_MORTON_BITS):
        curve |= ((low >> bit) & 1) << (2 * bit + 1) | ((high >> bit) & 1) << (2 * bit)
    return np.lexsort((i, curve))


@dataclass(frozen=True)
class MetricCameras:
    """Calibrated cameras: poses R (V, 3, 3), t (V, 3) (world-to-camera), and the row (V,) of intrinsics.

    A row of ``intrinsics`` (G, C) is [focal_px, aspect fy/fx, skew_px, cx_px, cy_px, k1], k2, k3 if C = 8;
    rows of equal numbers in a column of ``shared`` (G, C) have one value there. A normalised point (x, y) is
    distorted to (x, y) (1 + k1 r^2 + k2 r^4 + k3 r^6); K = [[f, skew, cx], [0, aspect f, cy], [0, 0, 1]].
    """

    R: F64
    t: F64
    intrinsics: F64
    group: I64
    shared: I64 = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.shared is None:
            every = np.arange(len(self.intrinsics))[:, None]
            object.__setattr__(self, "shared", np.broadcast_to(every, self.intrinsics.shape))

    def of_views(self, views: I64) -> MetricCameras:
        """The cameras of some views, each with a row of intrinsics of its own."""
        rows = self.group[views]
        own = np.arange(len(views), dtype=np.int64)
        return MetricCameras(self.R[views], self.t[views], self.intrinsics[rows], own, self.shared[rows])

    @property
    def K(self) -> F64:
        """Calibration matrices (V, 3, 3)."""
        return calibrations(self.intrinsics[self.group])

    @property
    def P(self) -> F64:
        """Cameras before distortion, K [R t]; (V, 3, 4)."""
        return np.asarray(self.K @ np.concatenate([self.R, self.t[:, :, None]], axis=2))

    @property
    def centres(self) -> F64:
        """Camera centres (V, 3)."""
        return np.asarray(-np.einsum("vba,vb->va", self.R, self.t))


def calibrations(intrinsics: F64) -> F64:
    """Calibration matrices (..., 3, 3) of rows (..., C) of intrinsics."""
    f, aspect, skew, cx, cy = np.moveaxis(intrinsics, -1, 0)[:5]
    zero, one = np.zeros_like(f), np.ones_like(f)
    rows = [f, skew, cx, zero, aspect * f, cy, zero, zero, one]
    return np.stack(rows, axis=-1).reshape(*f.shape, 3, 3)


def pinhole_rows(K: F64) -> F64:
    """Rows (..., 5) of focal length, aspect ratio, skew and principal point of K (..., 3, 3)."""
    f = K[..., 0, 0]
    return np.stack([f, K[..., 1, 1] / f, K[..., 0, 1], K[..., 0, 2], K[..., 1, 2]], axis=-1)


POSE_DOF = 6
FOCAL = 0


class MetricModel(NamedTuple):
    """Poses ``R`` (V, 3, 3), ``t`` (V, 3), points ``X`` (N, 3) and ``intrinsics`` (G, 6) or (G, 8).

    ``group`` (V,) is the row of each view.
    """

    R: F64
    t: F64
    intrinsics: F64
    group: I64
    X: F64


@kernel(inline="always")
def _in_camera(r: F64, t: F64, x: F64) -> tuple[float, float, float]:
    """Return R x + t."""
    return (
        r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 2] * x[2] + t[0],
        r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + t[1],
        r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + t[2],
    )


@kernel(inline="always")
def _image_of(q: F64, x0: float, x1: float, w: float) -> tuple[float, float]:
    """Return the pixel of a point in the camera frame, w away from 0; q is a row of intrinsics."""
    a, b = x0 / w, x1 / w
    r2 = a * a + b * b
    if len(q) > LENS:
        return _image_through_lens(q, a, b, r2)
    d = 1.0 + q[5] * r2
    if len(q) > 6:
        d += (q[6] + q[7] * r2) * r2 * r2
    return q[0] * a * d + q[2] * b * d + q[3], q[0] * q[1] * b * d + q[4]


@kernel
def _image_through_lens(q: F64, a: float, b: float, r2: float) -> tuple[float, float]:
    """Return the pixel of a normalised point, by the lens model q[LENS]."""
    scale = _base_scale(q, r2)[0]
    x, y = scale * a, scale * b
    r2 = x * x + y * y
    d = _polynomial(q, r2)[0]
    u = x * d + 2.0 * q[9] * x * y + q[10] * (r2 + 2.0 * x * x)
    v = y * d + 2.0 * q[10] * x * y + q[9] * (r2 + 2.0 * y * y)
    return q[0] * u + q[2] * v + q[3], q[0] * q[1] * v + q[4]


@kernel
def _base_scale(q: F64, r2: float) -> tuple[float, float, float]:
    """Return the factor of the base of the lens on a normalised point, its derivatives by r^2 and by q[5]."""
    if q[LENS] == DIVISION:
        # r_d = s r solves r = r_d / (1 + k r_d^2).
        root = math.sqrt(max(1.0 - 4.0 * q[5] * r2, TINY))
        s = 2.0 / (1.0 + root)
        return s, s * s * q[5] / root, s * s * r2 / root
    if q[LENS] == ANGLE:
        r = math.sqrt(r2)
        # The quotients lose digits near the axis, where their series are exact to rounding.
        s = math.atan(r) / r if r2 > 1e-6 else 1.0 - r2 / 3.0
        return s, (1.0 / (1.0 + r2) - s) / (2.0 * r2) if r2 > 1e-6 else -1.0 / 3.0 + 0.4 * r2, 0.0
    return 1.0, 0.0, 0.0


@kernel
def _polynomial(q: F64, r2: float) -> tuple[float, float]:
    """Return 1 + k1 r^2 + ... + k4 r^8 and its derivative by r^2; 1 of a division lens."""
    if q[LENS] == DIVISION:
        return 1.0, 0.0
    d = 1.0 + (q[5] + (q[6] + (q[7] + q[8] * r2) * r2) * r2) * r2
    return d, q[5] + (2.0 * q[6] + (3.0 * q[7] + 4.0 * q[8] * r2) * r2) * r2


@kernel
def image_points(model: MetricModel, view: I64, point: I64) -> tuple[F64, F64]:
    """Return pixels (K, 2), with distortion, and depths (K,) of points in views."""
    xy, depth = empty((len(view), 2)), empty(len(view))
    for k in range(len(view)):
        v = view[k]
        x0, x1, depth[k] = _in_camera(model.R[v], model.t[v], model.X[point[k]])
        q = model.intrinsics[model.group[v]]
        xy[k, 0], xy[k, 1] = _image_of(q, x0, x1, away_from_zero(depth[k]))
    return xy, depth


@kernel
def project_metric(model: MetricModel, obs: Observations) -> F64:
    """Return residuals (K, 2), projection minus observation, px."""
    return image_points(model, obs.view_index, obs.point_index)[0] - obs.xy


@kernel
def metric_cost(model: MetricModel, obs: Observations, weighting: Weighting) -> float:
    """Return 1/2 sum rho of the residuals."""
    cost = 0.0
    for k in range(len(obs.xy)):
        v, x = obs.view_index[k], model.X[obs.point_index[k]]
        x0, x1, x2 = _in_camera(model.R[v], model.t[v], x)
        px, py = _image_of(model.intrinsics[model.group[v]], x0, x1, away_from_zero(x2))
        e0, e1 = (px - obs.xy[k, 0]) / weighting.sigma, (py - obs.xy[k, 1]) / weighting.sigma
        cost += loss_value(e0 * e0 + e1 * e1, weighting.delta)
    return 0.5 * cost


@kernel
def move_poses(R: F64, t: F64, step: F64, R_out: F64, t_out: F64) -> None:
    """Apply x -> exp(w) x + d in the camera frames after the poses; ``step`` (V, 6) = (w, d)."""
    for v in range(len(t)):
        w = step[v, :3]
        angle = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
        # Rodrigues: exp(w) = I + a [w]x + b [w]x^2, by series if the quotients lose digits.
        a, b = 1.0 - angle * angle / 6.0, 0.5 - angle * angle / 24.0
        if angle > 1e-4:
            a, b = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
        for c in range(4):
            x = R[v, :, c] if c < 3 else t[v]
            y = R_out[v, :, c] if c < 3 else t_out[v]
            u0, u1, u2 = w[1] * x[2] - w[2] * x[1], w[2] * x[0] - w[0] * x[2], w[0] * x[1] - w[1] * x[0]
            y[0] = x[0] + a * u0 + b * (w[1] * u2 - w[2] * u1)
            y[1] = x[1] + a * u1 + b * (w[2] * u0 - w[0] * u2)
            y[2] = x[2] + a * u2 + b * (w[0] * u1 - w[1] * u0)
        for c in range(3):
            t_out[v, c] += step[v, 3 + c]


@kernel
def linearize_metric(
    model: MetricModel, obs: Observations, weighting: Weighting, own: I64, common: I64, J: Jacobians
) -> float:
    """Fill weighted residuals, in units of sigma, and their Jacobians; return the cost.

    A pose moves by x -> exp(w) x + d in the camera frame: columns (w, d) of A, then the intrinsics ``own``
    among (log f, aspect, skew, cx, cy, k1, k2, k3, k4, p1, p2); ``common`` are those in the columns of E.
    """
    cost = 0.0
    point = max(model.intrinsics.shape[1], 8)
    D = empty((2, point + 2))
    for k in range(len(obs.xy)):
        v, x = obs.view_index[k], model.X[obs.point_index[k]]
        r, q = model.R[v], model.intrinsics[model.group[v]]
        x0, x1, x2 = _in_camera(r, model.t[v], x)
        w = away_from_zero(x2)
        px, py = _image_of(q, x0, x1, w)
        e0, e1 = (px - obs.xy[k, 0]) / weighting.sigma, (py - obs.xy[k, 1]) / weighting.sigma
        s = e0 * e0 + e1 * e1
        cost += loss_value(s, weighting.delta)
        root = np.sqrt(loss_weight(s, weighting.delta))
        a, b = x0 / w, x1 / w
        _fill_columns(q, a, b, root / weighting.sigma, D)
        kept = max(loss_curvature(s, weighting.delta), weighting.min_curvature)
        if kept < 1.0:
            # (I - (1 - sqrt(kept)) e e' / s) J with the residual over sqrt(kept): the gradient is the same.
            kept = np.sqrt(kept)
            root /= kept
            for c in range(point + 2):
                along = (1.0 - kept) * (e0 * D[0, c] + e1 * D[1, c]) / s
                D[0, c], D[1, c] = D[0, c] - along * e0, D[1, c] - along * e1
        J.residual[k, 0], J.residual[k, 1] = root * e0, root * e1
        for c in range(len(own)):
            J.A[k, 0, 6 + c], J.A[k, 1, 6 + c] = D[0, own[c]], D[1, own[c]]
        for c in range(len(common)):
            J.E[k, 0, c], J.E[k, 1, c] = D[0, common[c]], D[1, common[c]]
        da, db = D[:, point], D[:, point + 1]
        j00, j01, j02 = da[0] / w, db[0] / w, -(da[0] * a + db[0] * b) / w
        j10, j11, j12 = da[1] / w, db[1] / w, -(da[1] * a + db[1] * b) / w
        A = J.A[k]
        A[0, 0], A[0, 1], A[0, 2] = j02 * x1 - j01 * w, j00 * w - j02 * x0, j01 * x0 - j00 * x1
        A[1, 0], A[1, 1], A[1, 2] = j12 * x1 - j11 * w, j10 * w - j12 * x0, j11 * x0 - j10 * x1
        A[0, 3], A[0, 4], A[0, 5] = j00, j01, j02
        A[1, 3], A[1, 4], A[1, 5] = j10, j11, j12
        for c in range(3):
            J.B[k, 0, c] = j00 * r[0, c] + j01 * r[1, c] + j02 * r[2, c]
            J.B[k, 1, c] = j10 * r[0, c] + j11 * r[1, c] + j12 * r[2, c]
    return 0.5 * cost


@kernel
def _fill_columns(q: F64, a: float, b: float, root: float, D: F64) -> None:
    """Fill D (2, 10): derivatives of the pixel by eight intrinsics and the normalised point, times root."""
    f, g, skew = root * q[0], root * q[0] * q[1], root * q[2]
    r2 = a * a + b * b
    if len(q) > LENS:
        _fill_lens_columns(q, a, b, (f, g, skew, root), D)
        return
    # d is the distortion, slope its derivative over r^2.
    d, slope = 1.0 + q[5] * r2, q[5]
    if len(q) > 6:
        d += (q[6] + q[7] * r2) * r2 * r2
        slope += (2.0 * q[6] + 3.0 * q[7] * r2) * r2
    D[0, 0], D[1, 0] = f * a * d, g * b * d
    D[0, 1], D[1, 1] = 0.0, f * b * d
    D[0, 2], D[1, 2] = root * b * d, 0.0
    D[0, 3], D[1, 3] = root, 0.0
    D[0, 4], D[1, 4] = 0.0, root
    D[0, 5], D[1, 5] = (f * a + skew * b) * r2, g * b * r2
    D[0, 6], D[1, 6] = D[0, 5] * r2, D[1, 5] * r2
    D[0, 7], D[1, 7] = D[0, 6] * r2, D[1, 6] * r2
    m00, m01, m11 = d + 2.0 * slope * a * a, 2.0 * slope * a * b, d + 2.0 * slope * b * b
    D[0, 8], D[0, 9] = f * m00 + skew * m01, f * m01 + skew * m11
    D[1, 8], D[1, 9] = g * m01, g * m11


@kernel
def _fill_lens_columns(q: F64, a: float, b: float, scales: tuple[float, float, float, float], D: F64) -> None:
    """Fill D (2, 14) for a lens model of its own: eleven intrinsics, the model (0) and the point."""
    f, g, skew, root = scales
    scale, growth, by_k1 = _base_scale(q, a * a + b * b)
    x, y = scale * a, scale * b
    r2 = x * x + y * y
    d, slope = _polynomial(q, r2)
    xx, xy, yy = r2 + 2.0 * x * x, 2.0 * x * y, r2 + 2.0 * y * y
    u, v = x * d + q[9] * xy + q[10] * xx, y * d + q[10] * xy + q[9] * yy
    D[0, 0], D[1, 0] = f * u, g * v
    D[0, 1], D[1, 1] = 0.0, f * v
    D[0, 2], D[1, 2] = root * v, 0.0
    D[0, 3], D[1, 3] = root, 0.0
    D[0, 4], D[1, 4] = 0.0, root
    # Derivatives of (u, v) by (x, y), and by the normalised point.
    m00 = d + 2.0 * slope * x * x + 2.0 * q[9] * y + 6.0 * q[10] * x
    m01 = 2.0 * slope * x * y + 2.0 * q[9] * x + 2.0 * q[10] * y
    m11 = d + 2.0 * slope * y * y + 6.0 * q[9] * y + 2.0 * q[10] * x
    along0, along1 = m00 * a + m01 * b, m01 * a + m11 * b
    power = 1.0
    for n in range(4):
        power *= r2
        c0, c1 = x * power, y * power
        if q[LENS] == DIVISION:
            c0, c1 = (along0 * by_k1, along1 * by_k1) if n == 0 else (0.0, 0.0)
        D[0, 5 + n], D[1, 5 + n] = f * c0 + skew * c1, g * c1
    D[0, 9], D[1, 9] = f * xy + skew * yy, g * yy
    D[0, 10], D[1, 10] = f * xx + skew * xy, g * xy
    D[0, 11], D[1, 11] = 0.0, 0.0
    n00, n01 = scale * m00 + 2.0 * growth * along0 * a, scale * m01 + 2.0 * growth * along0 * b
    n10, n11 = scale * m01 + 2.0 * growth * along1 * a, scale * m11 + 2.0 * growth * along1 * b
    D[0, 12], D[0, 13] = f * n00 + skew * n10, f * n01 + skew * n11
    D[1, 12], D[1, 13] = g * n10, g * n11
