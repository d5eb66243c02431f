"""The plane of the initial cameras (3.42), two ways: ``python -m validation.studies.initial_cameras``.

Nearest to the identity or nearest to a rotation: how well conditioned the second camera is, how many points
the plane that plays infinity cuts off from the others, and what the linear method makes of the frame. The
exit code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from thesisrecon.epipolar.estimation import estimate_fundamental
from thesisrecon.geometry.camera_matrix import compose_camera, project
from thesisrecon.geometry.homogeneous import cross_matrix, pixel_from_unit
from thesisrecon.geometry.optimal_triangulation import triangulate_polynomial
from thesisrecon.geometry.triangulation import triangulate_linear
from thesisrecon.geometry.two_view import canonical_cameras, epipoles, unit_norm
from thesisrecon.projective.initial_pair import initial_cameras
from thesisrecon.records import TwoView
from validation.metrics.record import Metric, markdown_table

SIZES = np.array([[1280, 960], [1280, 960]])
FOCALS_PX = (800.0, 1600.0, 3200.0)
SIGMA_PX, POINTS = 0.5, 200
IDENTITY, ROTATION = "nearest to the identity", "nearest to a rotation"
KINDS = ("small turn", "30 degrees apart", "on its side", "upside down", "forward")
MOST_CONDITION, MOST_BEYOND_PCT = 3.0, 2.0


def make_pair(kind: str, focal_px: float, rng: np.random.Generator) -> F64:
    """Noisy matches (2, N, 2) of points about 5 off; how the second camera stands is of this ``kind``."""
    K = np.array([[focal_px, 0.0, 639.5], [0.0, focal_px, 479.5], [0.0, 0.0, 1.0]])
    X = rng.uniform([-1.2, -1.2, 3.8], [1.2, 1.2, 6.2], (POINTS, 3))
    turn, centre = rng.normal(0.0, 0.1, 3), rng.normal(size=3) * [1.0, 0.3, 0.3]
    R = Rotation.from_rotvec(turn)
    if kind == "30 degrees apart":
        R, centre = R * Rotation.from_rotvec([0.0, -0.5, 0.0]), np.array([2.5, 0.2, 0.5])
    if kind == "forward":
        centre = np.array([0.05, 0.02, 1.5])
    roll_deg = {"on its side": 90.0, "upside down": 180.0}.get(kind, 0.0)
    rotation = (Rotation.from_euler("z", roll_deg, degrees=True) * R).as_matrix()
    P = compose_camera(
        np.stack([K, K]), np.stack([np.eye(3), rotation]), np.stack([np.zeros(3), -rotation @ centre])
    )
    return np.stack([project(camera, X) for camera in P]) + SIGMA_PX * rng.normal(size=(2, POINTS, 2))


def nearest_identity(F: F64) -> F64:
    """Cameras (2, 3, 4) in pixels whose plane brings M = -[e2]x F + e2 v' nearest to a multiple of I.

    v = trace(-[e2]x F) / 2 e2; a trace near 0 would leave M nearly singular and is kept off it.
    """
    T = pixel_from_unit(SIZES)
    F = unit_norm(T[1].T @ F @ T[0])
    _, e2 = epipoles(F)
    M = -cross_matrix(e2) @ F
    half, size = float(np.trace(M)) / 2.0, float(np.linalg.norm(M)) / np.sqrt(2.0)
    multiple = half if abs(half) > 0.1 * size else size
    return T @ np.stack(canonical_cameras(F, plane=multiple * e2))


def nearest_rotation(F: F64, xy: F64) -> F64:
    """The initial cameras (2, 3, 4) of the pipeline."""
    none = np.zeros(0, dtype=np.int64)
    pair = TwoView(0, 1, F, SIGMA_PX, none, none, xy[0], xy[1], np.zeros((0, 2, 2)), 0, 0.0, True)
    return np.stack(initial_cameras(pair, SIZES))


def measure(P: F64, xy: F64) -> tuple[float, float, float]:
    """Condition number of the second camera in unit-free pixels, percent of points beyond the plane at
    infinity, and the linear method's RMS residual over the least."""
    T = pixel_from_unit(SIZES)
    M = np.linalg.inv(T[1]) @ P[1, :, :3] @ np.linalg.inv(P[0, :, :3]) @ T[0]
    X, best = triangulate_linear(P, xy), triangulate_polynomial(P, xy)
    side = np.sign(X[:, 3] * (X @ P[0, 2]))
    beyond = 50.0 * (1.0 - abs(float(side.mean())))
    return float(np.linalg.cond(M)), beyond, _rms(P, X, xy) / _rms(P, best, xy)


def _rms(P: F64, X: F64, xy: F64) -> float:
    return float(np.sqrt(np.mean((np.stack([project(camera, X) for camera in P]) - xy) ** 2)))


def check_kind(kind: str, trials: int) -> list[Metric]:
    """The worst condition number, the means of the others, over the focal lengths and ``trials`` of each."""
    found: dict[str, list[tuple[float, float, float]]] = {IDENTITY: [], ROTATION: []}
    for focal_px in FOCALS_PX:
        for seed in range(trials):
            xy = make_pair(kind, focal_px, np.random.default_rng(seed))
            F = estimate_fundamental(xy[0], xy[1], seed=seed).F
            found[IDENTITY].append(measure(nearest_identity(F), xy))
            found[ROTATION].append(measure(nearest_rotation(F, xy), xy))
    condition = {name: float(np.max([row[0] for row in rows])) for name, rows in found.items()}
    beyond = {name: float(np.mean([row[1] for row in rows])) for name, rows in found.items()}
    linear = {name: float(np.mean([row[2] for row in rows])) for name, rows in found.items()}
    return [
        Metric(kind, "condition number, worst", "", condition, ROTATION, MOST_CONDITION),
        Metric(kind, "points beyond the plane, mean", "%", beyond, ROTATION, MOST_BEYOND_PCT),
        Metric(kind, "linear over least residual, mean", "", linear, ROTATION),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=12, help="pairs per kind and focal length")
    options = parser.parse_args(arguments)
    tables = [check_kind(kind, options.trials) for kind in KINDS]
    for table in tables:
        print(f"## {table[0].scene}", markdown_table(table), sep="\n\n", end="\n\n", flush=True)
    return int(any(row.verdict == "missed" for table in tables for row in table))


if __name__ == "__main__":
    raise SystemExit(main())
