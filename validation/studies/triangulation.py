"""The thesis' comparison of triangulation methods.

Errors in the image and in space by method, noise and frame of space, beside OpenCV and COLMAP; the optimality
of the polynomial method for all positions of the epipoles; the time per point on one thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import compose_camera
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.optimal_triangulation import triangulate_polynomial
from thesisrecon.geometry.strata import Group
from thesisrecon.geometry.triangulation import triangulate
from validation.metrics.record import Metric
from validation.references.libraries import one_thread
from validation.references.triangulation import colmap_points, opencv_linear, opencv_polynomial
from validation.scenes.cloud import make_cloud
from validation.scenes.rigs import Rig
from validation.scenes.transforms import random_transform
from validation.studies.measuring import least_seconds
from validation.studies.runner import Part, Rows

Method = Callable[[F64, F64], F64]

POLYNOMIAL, OPTIMAL, LINEAR = "polynomial", "optimal", "linear"
OPENCV, OPENCV_POLYNOMIAL, COLMAP = "OpenCV linear", "OpenCV polynomial", "COLMAP"
ANY_VIEWS: dict[str, Method] = {
    LINEAR: partial(triangulate, method="linear"),
    "iterated": partial(triangulate, method="iterated"),
    "mid-point": partial(triangulate, method="midpoint"),
    OPTIMAL: partial(triangulate, method="optimal"),
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
"""Image distances are capped here: a point in a focal plane projects to infinity."""
RELATIVE, ROUNDING_PX = 1e-9, 1e-10
"""Costs count as equal within 1e-9 of themselves or within the rounding of X."""
POLYNOMIAL_US, LINEAR_US = 5.0, 1.0


@dataclass(frozen=True)
class Errors:
    """RMS distance to the measured points (px); median and 95 % quantile of the distance to the true points,
    in percent of their distance to the first camera.
    """

    image_px: float
    space_pct: float
    worst_pct: float


def beside(rng: np.random.Generator, views: int, points: int) -> Rig:
    """Draw cameras on a cap around a point cloud that all of them see."""
    rig = make_cloud(views, rng, points=points)
    return replace(rig, seen=np.ones_like(rig.seen))


def ahead(rng: np.random.Generator, views: int, points: int) -> Rig:
    """Draw cameras one behind the other, with the epipoles in the middle of the images."""
    rig = beside(rng, views, points)
    steps = np.column_stack([rng.normal(0.0, 0.05, (views, 2)), np.arange(views)])
    return replace(rig, R=np.repeat(rig.R[:1], views, axis=0), C=rig.C[0] + 0.5 * steps @ rig.R[0])


SCENES: dict[str, tuple[Callable[[np.random.Generator, int, int], Rig], int]] = {
    "two views beside each other": (beside, 2),
    "two views one ahead of the other": (ahead, 2),
    "five views": (beside, 5),
}


def frame_of(group: Group, rng: np.random.Generator) -> F64:
    """Draw a transform (4, 4) of space into a frame of this stratum.

    In a projective frame the plane at infinity has any direction and lies up to 8 units from the middle of
    the scene, whose points reach 3 units and whose cameras are 6 to 9 units away.
    """
    G = random_transform("metric" if group == "projective" else group, rng)
    if group != "projective":
        return G
    normal = rng.normal(size=3)
    plane = np.eye(4)
    plane[3] = np.append(normal / np.linalg.norm(normal), rng.uniform(-8.0, 8.0))
    return G @ plane


def cameras_of(rig: Rig) -> F64:
    """Return P (V, 3, 4) of the rig."""
    return compose_camera(rig.K, rig.R, -np.einsum("vab,vb->va", rig.R, rig.C))


def squared_distances(P: F64, X: F64, xy: F64) -> F64:
    """Return the sum (N,) over views of squared projection distances, each capped at ``CAP_PX``."""
    xh = np.einsum("vab,nb->vna", P, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = np.sum((xh[..., :2] / xh[..., 2:] - xy) ** 2, axis=2)
    return np.asarray(np.minimum(np.nan_to_num(squared, nan=np.inf), CAP_PX**2).sum(axis=0))


@dataclass(frozen=True)
class DrawnRig:
    """One draw.

    ``G`` (4, 4): transform of space; ``P`` (V, 3, 4): cameras in the transformed frame; ``xy`` (V, N, 2):
    noisy pixels; ``X`` (N, 3): true points before the transform; ``centre`` (3,): centre of the first
    camera.
    """

    G: F64
    P: F64
    xy: F64
    X: F64
    centre: F64


def draw_rig(scene: str, sigma_px: float, frame: Group, rng: np.random.Generator, points: int) -> DrawnRig:
    """Draw a rig, its noise and its frame; the pixels do not depend on the frame."""
    make, views = SCENES[scene]
    rig = make(rng, views, points)
    exact = rig.pixels()
    seen = np.isfinite(exact).all(axis=(0, 2))
    xy = exact[:, seen] + sigma_px * rng.normal(size=(views, int(seen.sum()), 2))
    G = frame_of(frame, rng)
    return DrawnRig(G, cameras_of(rig) @ np.linalg.inv(G), xy, rig.X[seen], rig.C[0])


def compare_on_rig(drawn: DrawnRig, methods: Mapping[str, Method]) -> dict[str, Errors]:
    """Measure the methods on one draw."""
    return {name: _errors(*_squared_and_apart(drawn, method)) for name, method in methods.items()}


def _squared_and_apart(drawn: DrawnRig, method: Method) -> tuple[F64, F64]:
    """Return mean squared image distances and relative space distances, (N,) each."""
    X = method(drawn.P, drawn.xy)
    back = dehomogenize(X @ np.linalg.inv(drawn.G).T)
    off = np.linalg.norm(back - drawn.X, axis=1) / np.linalg.norm(drawn.X - drawn.centre, axis=1)
    return squared_distances(drawn.P, X, drawn.xy) / len(drawn.P), np.nan_to_num(off, nan=np.inf)


def compare_methods(
    scene: str, sigma_px: float, frame: Group, *, trials: int, points: int
) -> dict[str, Errors]:
    """Measure every method over ``trials`` rigs; the pixels do not depend on the frame."""
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
    """Measure every method at every noise; no method may beat the optimal ones in the image."""
    rows = Rows(f"{scene}, {frame} frame", POLYNOMIAL if SCENES[scene][1] == 2 else OPTIMAL)
    for sigma_px in NOISES_PX:
        found = compare_methods(scene, sigma_px, frame, trials=trials, points=points)
        image = {name: errors.image_px for name, errors in found.items()}
        target = (1.0 + RELATIVE) * min(image.values()) + 1e-6 if sigma_px > 0.0 else None
        rows.add(f"image, RMS at {sigma_px:g} px", image, "px", at_most=target)
        rows.add(f"space, median at {sigma_px:g} px", {k: e.space_pct for k, e in found.items()}, "%")
        rows.add(f"space, 95 % at {sigma_px:g} px", {k: e.worst_pct for k, e in found.items()}, "%")
    return rows


def geometry_of(kind: str, rng: np.random.Generator, points: int) -> tuple[F64, F64]:
    """Draw P (2, 3, 4) and points X (points, 4) of a geometry that is hard for the polynomial method."""
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
    """Return the largest relative excess of the polynomial cost over that of the n-view method."""
    excess, local = [], []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        P, X = geometry_of(kind, rng, points)
        xh = np.einsum("vab,nb->vna", P, X)
        xy = xh[..., :2] / xh[..., 2:] + (0.5, 2.0, 10.0)[seed % 3] * rng.normal(size=(2, points, 2))
        ours = squared_distances(P, triangulate_polynomial(P, xy), xy)
        many = squared_distances(P, triangulate(P, xy, method="optimal"), xy)
        # Costs of some matches are nearly 0, so the rounding of distances is subtracted.
        allowed = 2.0 * np.sqrt(many) * ROUNDING_PX
        excess.append((ours - many - allowed) / many)
        local.append(many > ours * (1.0 + RELATIVE) + allowed)
    beyond = max(0.0, float(np.max(excess)))
    note = f"{100.0 * float(np.mean(local)):.2g} % of n-view answers are at another minimum, a higher one"
    return Metric("optimum", kind, "relative excess", {POLYNOMIAL: beyond}, POLYNOMIAL, RELATIVE, note=note)


def check_speed(*, points: int = 2000, repeats: int = 15) -> list[Metric]:
    """Measure microseconds per point on one thread, the least of ``repeats`` runs that take turns."""
    one_thread()
    rng = np.random.default_rng(0)
    linear = ANY_VIEWS[LINEAR]
    calls: dict[str, dict[str, Method]] = {
        "polynomial, 2 views": {"ours": triangulate_polynomial, "OpenCV": opencv_polynomial},
        "linear, 2 views": {"ours": linear, "OpenCV": opencv_linear, COLMAP: colmap_points},
        "iterated, 2 views": {"ours": ANY_VIEWS["iterated"]},
        "mid-point, 2 views": {"ours": ANY_VIEWS["mid-point"]},
        "least reprojection, 2 views": {"ours": ANY_VIEWS[OPTIMAL]},
        "linear, 5 views": {"ours": linear, COLMAP: colmap_points},
        "least reprojection, 5 views": {"ours": ANY_VIEWS[OPTIMAL]},
    }
    targets = {"polynomial, 2 views": POLYNOMIAL_US, "linear, 2 views": LINEAR_US}
    rows = Rows("time", "ours")
    for name, methods in calls.items():
        rig = beside(rng, int(name.split(", ")[1][0]), points)
        P, xy = cameras_of(rig), rig.pixels()
        xy = xy[:, np.isfinite(xy).all(axis=(0, 2))]
        xy = xy + rng.normal(size=xy.shape)
        seconds = least_seconds({m: partial(method, P, xy) for m, method in methods.items()}, repeats)
        us = {method: 1e6 * cpu / xy.shape[1] for method, (cpu, _) in seconds.items()}
        rows.add(name, us, "us a point", at_most=targets.get(name))
        if "OpenCV" in us:
            rows.add(f"{name}: ours over OpenCV", us["ours"] / us["OpenCV"], at_most=1.0)
    return rows


def triangulation_study(trials: int = 40, points: int = 100) -> Iterator[Part]:
    """Compare triangulation methods by noise and frame of space, with OpenCV and COLMAP."""
    for scene in SCENES:
        for frame in FRAMES:
            yield check_study(scene, frame, trials=trials, points=points)
    yield [check_optimum(kind, trials=trials, points=points) for kind in GEOMETRIES]
    yield check_speed()
