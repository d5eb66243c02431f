"""The thesis' comparison of triangulation methods: ``python -m validation.studies.triangulation``.

Method by noise by frame of space, errors in the image and in space, beside OpenCV and COLMAP; whether the
polynomial method is at the optimum wherever the epipoles are; and the time a point takes on one thread. The
exit code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import compose_camera
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.optimal_triangulation import triangulate_polynomial
from thesisrecon.geometry.strata import Group, random_transform
from thesisrecon.geometry.triangulation import (
    triangulate_iterated,
    triangulate_linear,
    triangulate_midpoint,
    triangulate_optimal,
)
from validation.metrics.record import Metric, markdown_table
from validation.references.libraries import one_thread
from validation.references.triangulation import colmap_points, opencv_linear, opencv_polynomial
from validation.scenes.cloud import make_cloud
from validation.scenes.rigs import Rig

Method = Callable[[F64, F64], F64]

POLYNOMIAL, OPTIMAL, LINEAR = "polynomial", "optimal", "linear"
OPENCV, OPENCV_POLYNOMIAL, COLMAP = "OpenCV linear", "OpenCV polynomial", "COLMAP"
ANY_VIEWS: dict[str, Method] = {
    LINEAR: triangulate_linear,
    "iterated": triangulate_iterated,
    "mid-point": triangulate_midpoint,
    OPTIMAL: triangulate_optimal,
    COLMAP: colmap_points,
}
TWO_VIEWS: dict[str, Method] = ANY_VIEWS | {
    POLYNOMIAL: triangulate_polynomial,
    OPENCV: opencv_linear,
    OPENCV_POLYNOMIAL: opencv_polynomial,
}
NOISES_PX = (0.0, 0.5, 1.0, 2.0, 5.0)
FRAMES: tuple[Group, ...] = ("projective", "affine", "metric")
CAP_PX = 1000.0
"""Distances in the image count no more than this: a point in a focal plane is infinitely far off."""
RELATIVE, ROUNDING_PX = 1e-9, 1e-10
"""Costs are equal to 1e-9 of themselves, or as far as the rounding of X lets its images be."""
POLYNOMIAL_US, LINEAR_US = 5.0, 1.0


@dataclass(frozen=True)
class Errors:
    """``image_px`` RMS distance from the measured points, ``space_pct`` median distance from the true points
    in percent of their distance from the first camera, ``worst_pct`` the 95 % quantile of that."""

    image_px: float
    space_pct: float
    worst_pct: float


def beside(rng: np.random.Generator, views: int, points: int) -> Rig:
    """Cameras on a cap about a cloud of points, each with_images all of it."""
    rig = make_cloud(views, rng, points=points)
    return replace(rig, seen=np.ones_like(rig.seen))


def ahead(rng: np.random.Generator, views: int, points: int) -> Rig:
    """Cameras one behind the other: the epipoles lie in the middle of the pictures."""
    rig = beside(rng, views, points)
    steps = np.column_stack([rng.normal(0.0, 0.05, (views, 2)), np.arange(views)])
    return replace(rig, R=np.repeat(rig.R[:1], views, axis=0), C=rig.C[0] + 0.5 * steps @ rig.R[0])


SCENES: dict[str, tuple[Callable[[np.random.Generator, int, int], Rig], int]] = {
    "two views beside each other": (beside, 2),
    "two views one ahead of the other": (ahead, 2),
    "five views": (beside, 5),
}


def frame_of(group: Group, rng: np.random.Generator) -> F64:
    """A transform (4, 4) of space into a frame of this stratum.

    In a projective one the plane that plays infinity lies anywhere: of any direction, up to 8 from the middle
    of the scene, whose points reach 3 and whose cameras are 6 to 9 off.
    """
    G = random_transform("metric" if group == "projective" else group, rng)
    if group != "projective":
        return G
    normal = rng.normal(size=3)
    plane = np.eye(4)
    plane[3] = np.append(normal / np.linalg.norm(normal), rng.uniform(-8.0, 8.0))
    return G @ plane


def cameras_of(rig: Rig) -> F64:
    """P (V, 3, 4) of the rig."""
    return compose_camera(rig.K, rig.R, -np.einsum("vab,vb->va", rig.R, rig.C))


def squared_distances(P: F64, X: F64, xy: F64) -> F64:
    """Sum over views of squared distances of the projections, (N,), each distance up to ``CAP_PX``."""
    xh = np.einsum("vab,nb->vna", P, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = np.sum((xh[..., :2] / xh[..., 2:] - xy) ** 2, axis=2)
    return np.asarray(np.minimum(np.nan_to_num(squared, nan=np.inf), CAP_PX**2).sum(axis=0))


@dataclass(frozen=True)
class DrawnRig:
    """One draw: the transform ``G`` (4, 4) of space, the cameras ``P`` (V, 3, 4) in its frame, noisy pixels
    ``xy`` (V, N, 2), the true points ``X`` (N, 3) before the transform and the first camera's ``centre``."""

    G: F64
    P: F64
    xy: F64
    X: F64
    centre: F64


def draw_rig(scene: str, sigma_px: float, frame: Group, rng: np.random.Generator, points: int) -> DrawnRig:
    """A rig of the scene, its noise and its frame; the same pixels in every frame."""
    make, views = SCENES[scene]
    rig = make(rng, views, points)
    exact = rig.pixels()
    seen = np.isfinite(exact).all(axis=(0, 2))
    xy = exact[:, seen] + sigma_px * rng.normal(size=(views, int(seen.sum()), 2))
    G = frame_of(frame, rng)
    return DrawnRig(G, cameras_of(rig) @ np.linalg.inv(G), xy, rig.X[seen], rig.C[0])


def compare_on_rig(drawn: DrawnRig, methods: Mapping[str, Method]) -> dict[str, Errors]:
    """Errors of the methods on one draw."""
    return {name: _errors(*_squared_and_apart(drawn, method)) for name, method in methods.items()}


def _squared_and_apart(drawn: DrawnRig, method: Method) -> tuple[F64, F64]:
    """Squared distances in the image, means over the views, and relative distances in space; (N,) each."""
    X = method(drawn.P, drawn.xy)
    back = dehomogenize(X @ np.linalg.inv(drawn.G).T)
    off = np.linalg.norm(back - drawn.X, axis=1) / np.linalg.norm(drawn.X - drawn.centre, axis=1)
    return squared_distances(drawn.P, X, drawn.xy) / len(drawn.P), np.nan_to_num(off, nan=np.inf)


def compare_methods(
    scene: str, sigma_px: float, frame: Group, *, trials: int, points: int
) -> dict[str, Errors]:
    """Errors of every method over ``trials`` rigs of ``points`` points; the same pixels in every frame."""
    methods = TWO_VIEWS if SCENES[scene][1] == 2 else ANY_VIEWS
    rigs = [draw_rig(scene, sigma_px, frame, np.random.default_rng(n), points) for n in range(trials)]
    found = {name: [_squared_and_apart(rig, method) for rig in rigs] for name, method in methods.items()}
    return {
        name: _errors(*(np.concatenate(values) for values in zip(*parts, strict=True)))
        for name, parts in found.items()
    }


def _errors(squared: F64, apart: F64) -> Errors:
    image = float(np.sqrt(np.mean(squared)))
    return Errors(image, 100.0 * float(np.median(apart)), 100.0 * float(np.quantile(apart, 0.95)))


def check_study(scene: str, frame: Group, *, trials: int, points: int) -> list[Metric]:
    """Rows of one scene in one frame: errors of every method at every noise.

    In the image the optimal methods are judged: none may be better.
    """
    judged = POLYNOMIAL if SCENES[scene][1] == 2 else OPTIMAL
    rows, title = [], f"{scene}, {frame} frame"
    for sigma_px in NOISES_PX:
        found = compare_methods(scene, sigma_px, frame, trials=trials, points=points)
        image = {name: errors.image_px for name, errors in found.items()}
        target = (1.0 + RELATIVE) * min(image.values()) + 1e-6 if sigma_px > 0.0 else None
        noise = f"at {sigma_px:g} px"
        rows += [
            Metric(title, f"image, RMS {noise}", "px", image, judged, target),
            Metric(title, f"space, median {noise}", "%", {k: e.space_pct for k, e in found.items()}, judged),
            Metric(title, f"space, 95 % {noise}", "%", {k: e.worst_pct for k, e in found.items()}, judged),
        ]
    return rows


def geometry_of(kind: str, rng: np.random.Generator, points: int) -> tuple[F64, F64]:
    """P (2, 3, 4) and points X (points, 4) where the polynomial method could fail."""
    rig = ahead(rng, 2, points) if kind in ("epipoles in view", "at the epipoles") else beside(rng, 2, points)
    R, C = rig.R.copy(), rig.C.copy()
    if kind in ("rectified", "one epipole at infinity"):
        C[1] = C[0] + R[0].T @ np.append(rng.normal(size=2), 0.0)
    if kind == "rectified":
        R[1] = R[0]
    if kind == "short baseline":
        C[1] = C[0] + 1e-3 * rng.normal(size=3)
    X = np.column_stack([rig.X, np.ones(points)])
    if kind == "at the epipoles":
        along = (C[1] - C[0]) * rng.uniform(3.0, 20.0, (points, 1))
        X[:, :3] = C[0] + along + rng.normal(size=(points, 3)) * 10.0 ** rng.uniform(-6.0, -1.0, (points, 1))
    if kind == "at infinity":
        X[:, :3] = X[:, :3] - C[0]
        X[:, 3] = 0.0
    return cameras_of(replace(rig, R=R, C=C)), X


GEOMETRIES = (
    "general",
    "epipoles in view",
    "at the epipoles",
    "rectified",
    "one epipole at infinity",
    "at infinity",
    "short baseline",
)


def check_optimum(kind: str, *, trials: int, points: int) -> Metric:
    """By how much the polynomial method's cost exceeds that of the n-view method at most, relative."""
    excess, local = [], []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        P, X = geometry_of(kind, rng, points)
        xh = np.einsum("vab,nb->vna", P, X)
        xy = xh[..., :2] / xh[..., 2:] + (0.5, 2.0, 10.0)[seed % 3] * rng.normal(size=(2, points, 2))
        ours = squared_distances(P, triangulate_polynomial(P, xy), xy)
        many = squared_distances(P, triangulate_optimal(P, xy), xy)
        # What the rounding of distances explains is no excess: costs of some matches are nearly 0.
        allowed = 2.0 * np.sqrt(many) * ROUNDING_PX
        excess.append((ours - many - allowed) / many)
        local.append(many > ours * (1.0 + RELATIVE) + allowed)
    beyond = max(0.0, float(np.max(excess)))
    note = f"{100.0 * float(np.mean(local)):.2g} % of n-view answers are at another minimum, a higher one"
    return Metric("optimum", kind, "relative excess", {POLYNOMIAL: beyond}, POLYNOMIAL, RELATIVE, note=note)


def check_speed(*, points: int = 2000, repeats: int = 15) -> list[Metric]:
    """Microseconds a point on one thread, the least of ``repeats`` runs that take turns."""
    one_thread()
    rng = np.random.default_rng(0)
    timed: dict[str, dict[str, Method]] = {
        "polynomial, 2 views": {"ours": triangulate_polynomial, "OpenCV": opencv_polynomial},
        "linear, 2 views": {"ours": triangulate_linear, "OpenCV": opencv_linear, COLMAP: colmap_points},
        "iterated, 2 views": {"ours": triangulate_iterated},
        "mid-point, 2 views": {"ours": triangulate_midpoint},
        "least reprojection, 2 views": {"ours": triangulate_optimal},
        "linear, 5 views": {"ours": triangulate_linear, COLMAP: colmap_points},
        "least reprojection, 5 views": {"ours": triangulate_optimal},
    }
    targets = {"polynomial, 2 views": POLYNOMIAL_US, "linear, 2 views": LINEAR_US}
    rows = []
    for name, methods in timed.items():
        rig = beside(rng, int(name.split(", ")[1][0]), points)
        P, xy = cameras_of(rig), rig.pixels()
        xy = xy[:, np.isfinite(xy).all(axis=(0, 2))]
        xy = xy + rng.normal(size=xy.shape)
        seconds = _least_seconds(methods, P, xy, repeats)
        us = {method: 1e6 * value / xy.shape[1] for method, value in seconds.items()}
        rows.append(Metric("time", name, "us a point", us, "ours", targets.get(name)))
        if "OpenCV" in us:
            ratio = {"ours": us["ours"] / us["OpenCV"]}
            rows.append(Metric("time", f"{name}: ours over OpenCV", "", ratio, "ours", 1.0))
    return rows


def _least_seconds(methods: Mapping[str, Method], P: F64, xy: F64, repeats: int) -> dict[str, float]:
    least = dict.fromkeys(methods, np.inf)
    for repeat in range(repeats + 1):
        for name, method in methods.items():
            start = time.process_time()
            method(P, xy)
            if repeat > 0:
                least[name] = min(least[name], time.process_time() - start)
    return least


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=40, help="rigs per setting")
    parser.add_argument("--points", type=int, default=100, help="points per rig")
    options = parser.parse_args(arguments)
    tables = [
        check_study(scene, frame, trials=options.trials, points=options.points)
        for scene in SCENES
        for frame in FRAMES
    ]
    tables.append([check_optimum(kind, trials=options.trials, points=options.points) for kind in GEOMETRIES])
    tables.append(check_speed())
    for table in tables:
        print(f"## {table[0].scene}", markdown_table(table), sep="\n\n", end="\n\n", flush=True)
    return int(any(row.verdict == "missed" for table in tables for row in table))


if __name__ == "__main__":
    raise SystemExit(main())
