"""The pencil of epipolar lines of a pair: what every way of rectifying shares.

Epipolar planes are numbered by an angle phi, the plane p = (cos phi, sin phi) being seen as the line L p in
either view (3, 2 matrices L, two lines through the epipole). Every pixel lies on one half-plane bounded by
the baseline, so phi runs over the whole circle: half epipolar lines (Pollefeys, Koch and Van Gool, ICCV
1999), without an exception for epipoles at infinity. Places are z = (x - centre) / unit, the unit about one
focal length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.types import F64

FOCAL_PER_SIDE = 1.2
"""The unit of length in an image over its long side: the focal length of a usual lens."""
_J = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True)
class EpipolarPencil:
    """``lines`` (2, 3, 2): L of each view in places z, oriented such that matches share their phi.

    ``centres`` (2, 2) px and ``units`` (2,) px make z of pixels; ``sizes`` (2, 2) width, height of the
    photographs. ``turned`` says that rows run against phi and columns against the half-lines: with it larger
    disparities are nearer.
    """

    lines: F64
    centres: F64
    units: F64
    sizes: tuple[tuple[int, int], tuple[int, int]]
    turned: bool = False

    def places(self, side: int, xy: F64) -> F64:
        """z (..., 2) of pixels (..., 2)."""
        return np.asarray((xy - self.centres[side]) / self.units[side])

    def pixels(self, side: int, z: F64) -> F64:
        """Pixels (..., 2) of z (..., 2)."""
        return np.asarray(z * self.units[side] + self.centres[side])

    def epipole(self, side: int) -> F64:
        """(3,) homogeneous, in places; the third entry is 0 at infinity."""
        return np.asarray(np.cross(self.lines[side, :, 0], self.lines[side, :, 1]))

    def planes(self, side: int, xy: F64) -> F64:
        """p (..., 2), any positive length, of the half-planes that hold pixels (..., 2)."""
        z = self.places(side, xy)
        L = self.lines[side]
        q = z @ L[:2] + L[2]
        return np.stack([q[..., 1], -q[..., 0]], axis=-1)

    def angles(self, side: int, xy: F64, *, about: float = 0.0) -> F64:
        """phi (...) of pixels (..., 2), within pi of ``about``."""
        p = self.planes(side, xy)
        c, s = np.cos(about), np.sin(about)
        return np.asarray(about + np.arctan2(c * p[..., 1] - s * p[..., 0], c * p[..., 0] + s * p[..., 1]))

    def half_lines(self, side: int, phi: F64) -> HalfLines:
        """The half epipolar lines phi (N,) of a view."""
        l = plane_of(phi) @ self.lines[side].T
        norm = np.linalg.norm(l[:, :2], axis=1)
        n, offset = l[:, :2] / norm[:, None], l[:, 2] / norm
        d = np.stack([-n[:, 1], n[:, 0]], axis=1)
        e = self.epipole(side)
        away = np.hypot(e[0], e[1])
        e = e / max(away, abs(e[2]))
        return HalfLines(-offset[:, None] * n, d, offset, e)

    def swept(self, side: int, phi: F64, z: F64) -> F64:
        """How far lines phi (N,) move across their points z (N, 2) per radian, in places."""
        p = plane_of(phi)
        l, moving = p @ self.lines[side].T, p @ (self.lines[side] @ _J).T
        return np.asarray(
            np.abs(np.sum(moving[:, :2] * z, axis=1) + moving[:, 2]) / np.linalg.norm(l[:, :2], axis=1)
        )


@dataclass(frozen=True)
class HalfLines:
    """Half-lines as ``foot`` (N, 2), the point nearest to the image centre, and unit ``direction`` (N, 2).

    Along the direction d(z - e) grows, or falls where the epipole's third coordinate is negative;
    ``epipole`` (3,) has a largest entry of about 1, ``distance`` (N,) is signed, of the centre.
    """

    foot: F64
    direction: F64
    distance: F64
    epipole: F64

    @property
    def sagitta(self) -> F64:
        """(N,) by how much the circle about the epipole through the centre is off each foot.

        D (1 - cos alpha) with the epipole's distance D and the angle alpha it sees foot and centre under:
        columns of equal distance from the epipole, without cancellation where that is far away, and 0 at
        infinity.
        """
        e = self.epipole
        D_w = float(np.hypot(e[0], e[1]))
        if D_w == 0.0:
            return np.zeros(len(self.foot))
        sign = -1.0 if e[2] < 0.0 else 1.0
        cosine = -(self.direction @ e[:2]) / D_w
        near = np.maximum(1.0 + cosine, 1.0)
        flat = self.distance**2 * abs(e[2]) / D_w / near
        with np.errstate(divide="ignore", invalid="ignore"):
            steep = np.where(cosine < 0.0, D_w / abs(e[2]) * (1.0 - cosine), 0.0) if e[2] else 0.0 * cosine
        return np.asarray(sign * np.where(cosine < 0.0, steep, flat))

    @property
    def start(self) -> F64:
        """(N,) position along the direction where the half-line begins or ends; infinite for an epipole at
        infinity."""
        e = self.epipole
        if e[2] == 0.0:
            return np.full(len(self.foot), -np.inf)
        return np.asarray(self.direction @ (e[:2] / e[2]))

    def on_half(self, t: F64) -> F64:
        """Whether positions ``t`` (N, ...) along the directions lie on the half-lines, not beyond."""
        first = self.start.reshape(-1, *([1] * (t.ndim - 1)))
        return np.asarray(t < first if self.epipole[2] < 0.0 else t > first)

    def chord(self, low: F64, high: F64) -> tuple[F64, F64]:
        """The positions (N,), (N,) between which the half-lines are within the box ``low`` to ``high`` (2,);
        the first is not below the second where they miss it."""
        with np.errstate(divide="ignore", invalid="ignore"):
            one, two = (low - self.foot) / self.direction, (high - self.foot) / self.direction
        inside = (self.foot >= low) & (self.foot <= high)
        parallel = self.direction == 0.0
        enter = np.where(parallel, np.where(inside, -np.inf, np.inf), np.minimum(one, two)).max(axis=1)
        leave = np.where(parallel, np.where(inside, np.inf, -np.inf), np.maximum(one, two)).min(axis=1)
        if self.epipole[2] < 0.0:
            return enter, np.minimum(leave, self.start)
        return np.maximum(enter, self.start), leave


def plane_of(phi: F64) -> F64:
    """(cos phi, sin phi), (N, 2)."""
    return np.stack([np.cos(phi), np.sin(phi)], axis=-1)


def pencil_of_fundamental(
    F: F64, sizes: tuple[tuple[int, int], tuple[int, int]]
) -> tuple[EpipolarPencil, float]:
    """The pencil of F (3, 3), of either orientation, and the ratio of the singular values of F in places."""
    units = FOCAL_PER_SIDE * np.array([max(size) for size in sizes], dtype=np.float64)
    centres = (np.array(sizes, dtype=np.float64) - 1.0) / 2.0
    T = [
        np.array([[u, 0.0, c[0]], [0.0, u, c[1]], [0.0, 0.0, 1.0]])
        for u, c in zip(units, centres, strict=True)
    ]
    U, s, Vt = np.linalg.svd(T[1].T @ F @ T[0])
    ratio = float(s[1] / s[0]) if s[0] > 0.0 else 0.0
    # F z1 = U S V'z1, and V'z1 = J p with p the plane of z1.
    lines = np.stack([Vt[:2].T, (U[:, :2] * s[:2]) @ _J / max(s[0], 1e-300)])
    return EpipolarPencil(lines, centres, units, sizes), ratio


def orient(pencil: EpipolarPencil, xy1: F64, xy2: F64) -> tuple[EpipolarPencil, float]:
    """The pencil with the second view's sign such that matches share their half-planes, and how many do."""
    p1, p2 = pencil.planes(0, xy1), pencil.planes(1, xy2)
    with np.errstate(invalid="ignore"):
        same = np.sum(p1 * p2, axis=1) > 0.0
    share = float(np.mean(same))
    if share >= 0.5:
        return pencil, share
    lines = pencil.lines.copy()
    lines[1] *= -1.0
    return replace(pencil, lines=lines), 1.0 - share
