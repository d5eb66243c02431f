"""Section 6.3.3: the polynomial method, the optimal triangulation from two views.

Hartley and Sturm, "Triangulation", CVIU 68(2), 1997: the pair of points nearest to the measured one that
satisfies the epipolar constraint is the best of at most six stationary points of a one-parameter cost, the
roots of a polynomial of degree 6. Their rays meet exactly. The parameter is the epipolar plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import cross_matrix, require_finite, unit_of
from thesisrecon.geometry.two_view.kernels import correct_each_match, meet_in_pencil

F64 = NDArray[np.float64]

_RANK = 1e-13
"""Singular values below this share of the largest are zero."""


@dataclass(frozen=True)
class _Frame:
    """Pixels moved to the middle of a view's points and scaled alike in both views, so that costs compare."""

    scale: float
    centre: F64

    @property
    def to(self) -> F64:
        """(2, 3, 3) conditioned from pixel coordinates."""
        T = np.zeros((2, 3, 3))
        T[:, 0, 0] = T[:, 1, 1] = self.scale
        T[:, :2, 2] = -self.scale * self.centre
        T[:, 2, 2] = 1.0
        return T

    def conditioned(self, xy: F64) -> F64:
        return np.ascontiguousarray((xy - self.centre[:, None]) * self.scale)

    def pixels(self, xy: F64) -> F64:
        return np.asarray(xy / self.scale + self.centre[:, None])


def _frame(xy: F64) -> _Frame:
    seen = np.isfinite(xy).all(axis=(0, 2))
    if not seen.any():
        return _Frame(1.0, np.zeros((2, 2)))
    points = xy if seen.all() else xy[:, seen]
    centre = points.mean(axis=1)
    spread = float(np.abs(points - centre[:, None]).max())
    return _Frame(1.0 / spread if spread > 0.0 else 1.0, centre)


def _balanced(L: F64) -> tuple[F64, F64, F64]:
    """Lines L (2, 3, 2) of a pencil in a basis of like weight, its change (2, 2), and the forms (2, 3).

    A pencil of (nearly) parallel lines in both images keeps the line at infinity for its second member.
    """
    B = np.einsum("vka,vkb->vab", L[:, :2], L[:, :2])
    traces = np.maximum(np.trace(B, axis1=1, axis2=2), 1e-300)
    values, basis = np.linalg.eigh((B / traces[:, None, None]).sum(axis=0))
    basis = basis / np.sqrt(np.maximum(values, _RANK * values[1]))
    L = np.ascontiguousarray(L @ basis)
    u, v = L[:, :2, 0], L[:, :2, 1]
    return L, basis, np.stack([np.sum(u * u, axis=1), np.sum(u * v, axis=1), np.sum(v * v, axis=1)], axis=1)


def correct_matches(F: F64, xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """Nearest pairs with x2' F x1 = 0 to measured pairs (N, 2), (N, 2): least sum of squared distances.

    Parameters
    ----------
    F : (3, 3) of rank 2, any scale. xy1, xy2 : (N, 2) px.

    Returns
    -------
    Two (N, 2) arrays, px. The minimum is global: every stationary point is looked at where more than one may
    exist (near an epipole), infinity included. Of a match with a point on its epipole, which is exact with
    every partner, the points stay where they are.

    Raises ``ValueError`` for a F of rank below 2, for wrong shapes and for numbers that are not finite.
    """
    xy1, xy2 = np.asarray(xy1, dtype=np.float64), np.asarray(xy2, dtype=np.float64)
    if xy1.ndim != 2 or xy1.shape[1:] != (2,) or xy1.shape != xy2.shape or np.shape(F) != (3, 3):
        shapes = f"{np.shape(F)}, {xy1.shape} and {xy2.shape}"
        raise ValueError(f"correct_matches needs F (3, 3) and two (N, 2) arrays; got {shapes}")
    require_finite("correct_matches", xy1, xy2)
    F = unit_of(np.asarray(F, dtype=np.float64), "correct_matches")
    xy = np.stack([xy1, xy2])
    frame = _frame(xy)
    back = np.linalg.inv(frame.to)
    U, s, Vt = np.linalg.svd(back[1].T @ F @ back[0])
    if not s[1] > _RANK * s[0]:
        raise ValueError("correct_matches needs an F of rank 2; got one of rank 1")
    lines1 = Vt[:2].T
    lines2 = (U[:, :2] * s[:2]) @ Vt[:2] @ cross_matrix(Vt[2]) @ lines1
    L, _, B = _balanced(np.stack([lines1, lines2]))
    moved = frame.conditioned(xy)
    correct_each_match(L[0], L[1], B[0], B[1], moved[0], moved[1], np.empty((len(xy1), 2)))
    moved = frame.pixels(moved)
    return moved[0], moved[1]


@dataclass(frozen=True)
class _Pencil:
    """Two cameras in a frame of their own: ``P`` (2, 3, 4) with P1'P1 + P2'P2 = I in conditioned pixels.

    The centres are then orthonormal. ``planes`` (4, 3): two that span the epipolar pencil, and the sum of
    the centres; ``lines`` (2, 3, 2) the images of the planes, ``forms`` (2, 3), ``back`` (4, 4) to the
    caller's frame of space.
    """

    P: F64
    planes: F64
    lines: F64
    forms: F64
    back: F64


def _pencil(P: F64, to: F64) -> _Pencil:
    conditioned = to @ P
    size = np.linalg.norm(conditioned, axis=(1, 2), keepdims=True)
    stacked = (conditioned / np.where(size > 0.0, size, 1.0)).reshape(6, 4)
    columns = np.linalg.norm(stacked, axis=0)
    columns = np.where(columns > 0.0, columns, 1.0)
    U, s, Vt = np.linalg.svd(stacked / columns, full_matrices=False)
    if not s[3] > _RANK * s[0]:
        raise ValueError("the polynomial method needs two cameras with different centres")
    Q = np.ascontiguousarray(U.reshape(2, 3, 4))
    # Eigenvalues 0 and 1 belong to the centres of the second and the first camera, which the other one sees.
    values, vectors = np.linalg.eigh(Q[1].T @ Q[1])
    if not (values[1] > _RANK and 1.0 - values[2] > _RANK):
        raise ValueError("the polynomial method needs cameras of rank 3")
    N = vectors[:, 1:3]
    lines, basis, forms = _balanced(np.stack([Q[0] @ N / (1.0 - values[1:3]), Q[1] @ N / values[1:3]]))
    planes = np.column_stack([N @ basis, vectors[:, 0] + vectors[:, 3]])
    back = (Vt.T / s) / columns[:, None]
    return _Pencil(Q, planes, lines, forms, np.ascontiguousarray(back))


def triangulate_polynomial(P: F64, xy: F64) -> F64:
    """Optimal triangulation from two views (6.3.3): P (2, 3, 4), xy (2, N, 2) px; -> X (N, 4) unit norm.

    Every match is moved to the nearest pair of points whose rays meet (:func:`correct_matches`), and X is
    where they do: the sum of squared distances of its images from the measured points is the least there is,
    in any frame, projective ones included. Nothing keeps X in front of the cameras.

    NaN = not seen: such points come out as zeros. A match whose nearest exact pair has one point on an
    epipole belongs to the centre of the other camera, where no image exists; one with both there to some
    point of the baseline. Raises ``ValueError`` for another number of cameras, for cameras with one centre or
    of a rank below 3, and for wrong shapes.
    """
    if P.shape != (2, 3, 4):
        raise ValueError(f"the polynomial method needs exactly two cameras; got P of shape {P.shape}")
    if xy.ndim != 3 or xy.shape[0] != 2 or xy.shape[2] != 2:
        raise ValueError(f"the polynomial method needs xy (2, N, 2); got {xy.shape}")
    require_finite("triangulate_polynomial", P)
    frame = _frame(xy)
    p, moved = _pencil(P, frame.to), frame.conditioned(xy)
    q, X = np.empty((xy.shape[1], 2)), np.empty((xy.shape[1], 4))
    L, B = p.lines, p.forms
    correct_each_match(L[0], L[1], B[0], B[1], moved[0], moved[1], q)
    meet_in_pencil(p.P, L, p.planes, p.back, moved, q, X)
    return X
