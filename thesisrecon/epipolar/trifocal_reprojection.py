"""The reprojection error of points and lines in three views, as a problem for Levenberg-Marquardt.

P1 = [I 0] stays; P2 and P3 move with all their 24 entries, of which 18 matter (the scales and the frame of
space are left to the damping). A point moves in the 3 directions across its vector, a line, kept by two
orthonormal points, in the 4 across their plane: neither has a position in which this fails.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.lines_and_planes import line_through, unit_normals
from thesisrecon.geometry.triangulation import triangulate_linear
from thesisrecon.geometry.trifocal import cameras_from_tensor
from thesisrecon.optimize.levenberg_marquardt import floored_diagonal, solve_positive
from thesisrecon.optimize.losses import LOSSES

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class TrifocalState:
    """Conditioned cameras (3, 3, 4), unit points (N, 4), lines (M, 2, 4) by two orthonormal points."""

    P: F64
    X: F64
    lines: F64


@dataclass(frozen=True)
class TrifocalStep:
    """Moves of P2 and P3 (24,), of points (N, 3) and lines (M, 4) in their tangent spaces."""

    cameras: F64
    points: F64
    lines: F64


@dataclass(frozen=True)
class FeatureBlock:
    """Normal equations of one kind of feature: with the cameras W (n, 24, f), alone V (n, f, f), h (n, f)."""

    W: F64
    V: F64
    h: F64

    def damped(self, damping: float) -> tuple[F64, F64]:
        """V^-1 W' (n, f, 24) and V^-1 h (n, f) with the damped V."""
        V = self.V.copy()
        f = V.shape[1]
        V[:, range(f), range(f)] += self.diagonal(damping)
        solved = np.linalg.solve(V, np.concatenate([self.W.swapaxes(1, 2), self.h[:, :, None]], axis=2))
        return solved[:, :, :-1], solved[:, :, -1]

    def diagonal(self, damping: float) -> F64:
        """What the damping adds to the diagonals of V; (n, f)."""
        diagonal = np.diagonal(self.V, axis1=1, axis2=2)
        return damping * np.asarray(floored_diagonal(diagonal))


@dataclass(frozen=True)
class TrifocalSystem:
    """[[H, W], [W', V]] of the cameras and both kinds of features, which are eliminated."""

    cost: float
    H: F64
    g: F64
    blocks: tuple[FeatureBlock, FeatureBlock]

    def reduced(self, damping: float) -> tuple[F64, F64, list[tuple[F64, F64]]]:
        """The damped system S c = b of the cameras alone, with each block's part of the way back."""
        S = self.H + np.diag(damping * floored_diagonal(np.diag(self.H)))
        b = -self.g
        solved = [block.damped(damping) for block in self.blocks]
        for block, (Y, z) in zip(self.blocks, solved, strict=True):
            S = S - np.einsum("nif,nfj->ij", block.W, Y)
            b = b + np.einsum("nif,nf->i", block.W, z)
        return S, b, solved

    def solve(self, damping: float) -> tuple[TrifocalStep, float] | None:
        """The damped step and the gain it promises."""
        S, b, solved = self.reduced(damping)
        cameras = solve_positive(S, b)
        if cameras is None:
            return None
        diagonal = damping * floored_diagonal(np.diag(self.H))
        promised = float(cameras @ (diagonal * cameras - self.g))
        moves = [-(z + Y @ cameras) for Y, z in solved]
        for block, move in zip(self.blocks, moves, strict=True):
            promised += float(np.sum(move * (block.diagonal(damping) * move - block.h)))
        return TrifocalStep(cameras, moves[0], moves[1]), 0.5 * promised


@dataclass(frozen=True)
class TrifocalReprojection:
    """points (N, 3, 2) and ends (M, 3, 2, 3), conditioned; ``scale`` (3,) conditioned units per pixel."""

    points: F64
    ends: F64
    scale: F64
    loss_px: float

    @classmethod
    def of(cls, points: F64, segments: F64, transforms: F64, loss_px: float) -> TrifocalReprojection:
        x = homogenize(points) @ transforms.swapaxes(1, 2)
        y = homogenize(segments) @ transforms.swapaxes(1, 2)[:, None]
        return cls(x[:, :, :2].swapaxes(0, 1), y.swapaxes(0, 1), transforms[:, 0, 0], loss_px)

    def start(self, T: F64) -> TrifocalState:
        """Cameras of a conditioned tensor, points by triangulation, lines as the meet of their planes."""
        P = np.stack(cameras_from_tensor(T))
        P[1:] /= np.linalg.norm(P[1:], axis=(1, 2), keepdims=True)
        X = _off_principal_planes(triangulate_linear(P, self.points.swapaxes(0, 1)), P)
        seen = unit_normals(line_through(self.ends[:, :, 0], self.ends[:, :, 1]))
        planes = np.einsum("mva,vab->mvb", seen, P)
        return TrifocalState(P, X, np.linalg.svd(planes)[2][:, 2:])

    def linearize(self, state: TrifocalState) -> TrifocalSystem:
        """Normal equations with Huber's weights, in pixels."""
        residual = self.residual(state)
        rho, weight = LOSSES["huber"](np.sum(residual**2, axis=2), self.loss_px)
        root = np.sqrt(weight)[:, :, None]
        H, g, blocks, first = np.zeros((24, 24)), np.zeros(24), [], 0
        for cameras, features in (self._point_jacobian(state), self._line_jacobian(state)):
            n = len(cameras)
            w = root[first : first + n]
            r = (w * residual[first : first + n]).reshape(n, 6)
            A, B = ((w[..., None] * J).reshape(n, 6, J.shape[3]) for J in (cameras, features))
            H += np.einsum("nri,nrj->ij", A, A)
            g += np.einsum("nri,nr->i", A, r)
            At, Bt = A.swapaxes(1, 2), B.swapaxes(1, 2)
            blocks.append(FeatureBlock(At @ B, Bt @ B, (Bt @ r[:, :, None])[:, :, 0]))
            first += n
        return TrifocalSystem(0.5 * float(rho.sum()), H, g, (blocks[0], blocks[1]))

    def retract(self, state: TrifocalState, step: TrifocalStep) -> TrifocalState:
        """Cameras and points of unit norm, lines orthonormal again."""
        P = state.P.copy()
        P[1:] += step.cameras.reshape(2, 3, 4)
        P[1:] /= np.linalg.norm(P[1:], axis=(1, 2), keepdims=True)
        X = state.X + np.einsum("nf,nfa->na", step.points, _complement(state.X[:, None]))
        X /= np.linalg.norm(X, axis=1, keepdims=True)
        lines = state.lines + step.lines.reshape(-1, 2, 2) @ _complement(state.lines)
        return TrifocalState(P, X, np.linalg.qr(lines.swapaxes(1, 2))[0].swapaxes(1, 2))

    def cost(self, state: TrifocalState) -> float:
        """1/2 sum rho, px^2; inf where a point falls on a principal plane."""
        residual = self.residual(state)
        if not np.isfinite(residual).all():
            return np.inf
        return 0.5 * float(LOSSES["huber"](np.sum(residual**2, axis=2), self.loss_px)[0].sum())

    def residual(self, state: TrifocalState) -> F64:
        """Offsets of the points, then distances of the segments' ends; (N + M, 3 views, 2) px."""
        p = np.einsum("vab,nb->nva", state.P, state.X)
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = p[:, :, :2] / p[:, :, 2:] - self.points
            distance = self._line_distances(*self._line_images(state))
        return np.concatenate([offset, distance]) / self.scale[:, None]

    def _line_images(self, state: TrifocalState) -> tuple[F64, F64]:
        """Images (M, 3, 3) of the two points that stand for each line."""
        ends = np.einsum("vab,meb->mvea", state.P, state.lines)
        return ends[:, :, 0], ends[:, :, 1]

    def _line_distances(self, p: F64, q: F64) -> F64:
        """Signed distances (M, 3, 2) of the segments' ends to the lines through p and q, conditioned."""
        return np.asarray(np.einsum("mvea,mva->mve", self.ends, unit_normals(line_through(p, q))))

    def _point_jacobian(self, state: TrifocalState) -> tuple[F64, F64]:
        """By the cameras (N, 3, 2, 24) and the points (N, 3, 2, 3), px."""
        p = np.einsum("vab,nb->nva", state.P, state.X)
        by_image = np.zeros((*p.shape[:2], 2, 3))
        by_image[:, :, 0, 0] = by_image[:, :, 1, 1] = 1.0 / p[:, :, 2]
        by_image[:, :, :, 2] = -p[:, :, :2] / p[:, :, 2:] ** 2
        by_image /= self.scale[:, None, None]
        by_point = np.einsum("nvra,vab,nfb->nvrf", by_image, state.P, _complement(state.X[:, None]))
        return _camera_columns(np.einsum("nvra,nb->nvrab", by_image, state.X)), by_point

    def _line_jacobian(self, state: TrifocalState) -> tuple[F64, F64]:
        """By the cameras (M, 3, 2, 24) and the lines (M, 3, 2, 4), px: d = l.y / |(l_1, l_2)|, l = p x q."""
        p, q = self._line_images(state)
        l = line_through(p, q)
        size = np.linalg.norm(l[:, :, :2], axis=2)[:, :, None]
        unit = l / size
        distance = self._line_distances(p, q)
        normal = np.concatenate([unit[:, :, :2], np.zeros_like(unit[:, :, 2:])], axis=2)
        by_line = self.ends - distance[..., None] * normal[:, :, None]
        by_line /= (size * self.scale[:, None])[..., None]
        by_p, by_q = np.cross(q[:, :, None], by_line), np.cross(by_line, p[:, :, None])
        by_camera = np.einsum("mvra,mb->mvrab", by_p, state.lines[:, 0])
        by_camera += np.einsum("mvra,mb->mvrab", by_q, state.lines[:, 1])
        across = np.einsum("vab,mfb->mvaf", state.P, _complement(state.lines))
        return _camera_columns(by_camera), np.concatenate([by_p @ across, by_q @ across], axis=3)


def _off_principal_planes(X: F64, P: F64) -> F64:
    """Unit points X (N, 4), those exactly on a principal plane moved off it, where they have an image."""
    on = (np.einsum("va,na->nv", P[:, 2], X) == 0.0).any(axis=1)
    X = X + 1e-9 * on[:, None] * np.array([0.6, -0.5, 0.4, 0.3])
    return np.asarray(X / np.maximum(np.linalg.norm(X, axis=1, keepdims=True), 1e-300))


def _complement(subspace: F64) -> F64:
    """Orthonormal rows (n, 4 - k, 4) orthogonal to those of (n, k, 4)."""
    return np.linalg.svd(subspace)[2][:, subspace.shape[1] :]


def _camera_columns(by_camera: F64) -> F64:
    """Derivatives (n, 3, 2, 3, 4) by the camera of each view as columns (n, 3, 2, 24) of P2 and P3."""
    n = len(by_camera)
    columns = np.zeros((n, 3, 2, 2, 12))
    for view in (1, 2):
        columns[:, view, :, view - 1] = by_camera[:, view].reshape(n, 2, 12)
    return columns.reshape(n, 3, 2, 24)
