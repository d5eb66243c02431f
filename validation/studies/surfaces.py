"""Linear and B-spline surfaces of depth maps.

Known surfaces with noise and with a fifth of wrong depths; then depths and normals of the courtyard, whose
depth maps come from the images alone and are kept in OUT.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

import thesisrecon
from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig, preset
from thesisrecon.geometry.camera_matrix import camera_from_centre, decompose_camera
from thesisrecon.records import DepthMap
from thesisrecon.surface._depth_grid import GRAZING_DEG, max_depth_slope, triangulate_grid
from thesisrecon.surface.bspline import BSplineFit, BSplineSurface
from thesisrecon.surface.linear import LinearSurface
from validation.metrics.depth import SAME, true_depth, true_from_maps
from validation.metrics.record import Metric
from validation.scenes.real import Scene, load_fixture_scene
from validation.studies.runner import Part

SURFACES: Mapping[str, LinearSurface | BSplineSurface] = {
    "linear": LinearSurface(),
    "b-spline": BSplineSurface(),
}
SMOOTH_DEG = 3.0
"""A pixel whose two one-sided normals differ by more lies on an edge and has no true normal."""
NOISE = 5e-4
"""Standard deviation of the inverse depths, which are about 0.2."""


@dataclass(frozen=True)
class LinearFit:
    """Piecewise linear surface of a depth map, as ``surface_from_depth`` triangulates it."""

    depth_map: DepthMap

    def evaluate(self, xy: F64) -> tuple[F64, F64]:
        """Inverse depth (N,) and gradient (N, 2) at pixels (N, 2), which are linear within a triangle."""
        # Padding gives every pixel its own square.
        depth, std = (
            np.pad(part.astype(np.float64), ((0, 1), (0, 1)), constant_values=np.nan)
            for part in (self.depth_map.depth, self.depth_map.std)
        )
        triangles = triangulate_grid(depth, std, max_depth_slope(self.depth_map.P, GRAZING_DEG))
        height, width = self.depth_map.depth.shape
        inside = np.all((xy >= -1e-9) & (xy <= np.array([width, height]) - 1.0 + 1e-9), axis=1)
        at = np.where(inside[:, None], xy, 0.0)
        x, y = np.floor(at + 1e-9).astype(np.int64).T
        u, v = (at - np.stack([x, y], axis=1)).T
        a, b, c, d = (1.0 / depth[y + j, x + i] for j, i in ((0, 0), (0, 1), (1, 0), (1, 1)))
        rising = triangles.rising[y, x]
        second = np.where(rising, u + v > 1.0, u > v)
        along_x, along_y = np.where(rising == second, d - c, b - a), np.where(second, d - b, c - a)
        value = np.where(
            rising & second, d - (1.0 - u) * along_x - (1.0 - v) * along_y, a + u * along_x + v * along_y
        )
        whole = inside & triangles.whole[y, x, second.astype(np.int64)]
        pixel = inside & (np.maximum(np.abs(u), np.abs(v)) < 1e-6)
        value = np.where(whole, value, np.where(pixel, a, np.nan))
        return value, np.where(whole[:, None], np.stack([along_x, along_y], axis=1), np.nan)


def camera_normals(fit: LinearFit | BSplineFit, xy: F64) -> F64:
    """Unit normals (N, 3) in the camera frame: a . (x, y, 1) = 1 / z near a pixel, the normal is -K' a."""
    inverse_depth, gradient = fit.evaluate(xy)
    offset = inverse_depth - np.sum(gradient * xy, axis=1)
    normal = -np.column_stack([gradient, offset]) @ decompose_camera(fit.depth_map.P)[0]
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def known_surfaces() -> dict[str, F64]:
    """Return inverse depths (240, 320) by name."""
    y, x = np.indices((240, 320))
    u, v = x / 320.0 - 0.5, y / 240.0 - 0.5

    def waves(period_px: float) -> F64:
        return np.asarray(
            0.2 + 5e-5 * period_px * np.sin(2 * np.pi * x / period_px) * np.cos(2 * np.pi * y / period_px)
        )

    return {
        "plane": 0.2 + 0.05 * u - 0.03 * v,
        "roof": 0.2 - 0.1 * np.abs(u),
        "quadric": 0.2 + 0.03 * u + 0.1 * u * u - 0.08 * v * v,
        "waves of 40 px": waves(40.0),
        "waves of 16 px": waves(16.0),
        "step": np.where(x < 150, 0.3, 0.2),
    }


def check_known(name: str, rho: F64, wrong: float) -> Metric:
    """Return the RMS error of inverse depths over their noise, with a share of ``wrong`` ones."""
    K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    noisy = rho + NOISE * rng.normal(size=rho.shape)
    noisy += np.where(rng.random(rho.shape) < wrong, rng.uniform(-0.1, 0.1, rho.shape), 0.0)
    P, std = camera_from_centre(K, np.eye(3), np.zeros(3)), NOISE / noisy**2
    views = np.ones(rho.shape, dtype=np.uint8)
    given = DepthMap(0, P, (1.0 / noisy).astype(np.float32), std.astype(np.float32), views)
    off = {
        word: 1.0 / surface.smooth(given).depth.astype(np.float64) - rho for word, surface in SURFACES.items()
    }
    rms = {word: float(np.sqrt(np.nanmean(e**2))) / NOISE for word, e in off.items()}
    label = f"RMS error, {wrong:.0%} wrong" if wrong else "RMS error"
    return Metric("known surfaces", f"{name}: {label}", "standard deviations", rms, "b-spline")


def true_normals(scene: Scene, view: int, depth: F64, stride: int) -> F64:
    """Return unit normals (h, w, 3) of a true depth map, in its camera and towards it, NaN at edges."""
    assert scene.K is not None
    K = scene.K[view]
    y, x = np.indices(depth.shape) * stride
    rho = 1.0 / depth

    def from_steps(gx: F64, gy: F64) -> F64:
        normal = -np.stack([gx, gy, rho - gx * x - gy * y], axis=-1) @ K
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    ahead, behind = np.full((2, 2, *depth.shape), np.nan)
    ahead[0][:, :-1] = behind[0][:, 1:] = np.diff(rho, axis=1) / stride
    ahead[1][:-1] = behind[1][1:] = np.diff(rho, axis=0) / stride
    turn = np.sum(from_steps(*ahead) * from_steps(*behind), axis=-1)
    mean = from_steps(*(0.5 * (ahead + behind)))
    return np.where((turn > np.cos(np.radians(SMOOTH_DEG)))[..., None], mean, np.nan)


def check_map(found: DepthMap, scene: Scene, scale: float) -> dict[str, dict[str, float]]:
    """Measure the surfaces of one depth map at the true samples, which lie between its pixels."""
    depth, stride, seen = true_depth(scene, found.view)
    true = true_normals(scene, found.view, depth, stride)
    shrink = found.depth.shape[1] / (stride * depth.shape[1])
    y, x = (np.indices(depth.shape) * stride + 0.5) * shrink - 0.5
    xy = np.stack([x, y], axis=-1).reshape(-1, 2)
    measured = {}
    for word in SURFACES:
        start = time.process_time()
        fit = LinearFit(found) if word == "linear" else BSplineSurface().fit(found)
        seconds = time.process_time() - start
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.abs(scale / fit.evaluate(xy)[0].reshape(depth.shape) / depth - 1.0)
            cosine = np.sum(camera_normals(fit, xy).reshape(true.shape) * true, axis=-1)
        known = seen & np.isfinite(error)
        angle = np.degrees(np.arccos(np.clip(cosine[seen & np.isfinite(cosine)], -1.0, 1.0)))
        measured[word] = {
            "known, of the pixels that two views see (%)": 100.0 * known.sum() / seen.sum(),
            "depth error, median (%)": 100.0 * float(np.median(error[known])),
            "within 1 %, of the known (%)": 100.0 * float(np.mean(error[known] < SAME)),
            "normals, median error (deg)": float(np.median(angle)),
            "normals within 10 deg (%)": 100.0 * float(np.mean(angle < 10.0)),
            "processor seconds a view": seconds,
        }
    return measured


def check_courtyard(out: Path, variant: str, views: Sequence[int] | None) -> list[Metric]:
    """Return means over the views of the courtyard."""
    scene = load_fixture_scene("courtyard")
    dense = replace(preset(variant).dense, max_side=640)  # type: ignore[type-var]
    config = replace(PipelineConfig(), dense=dense)
    run = thesisrecon.reconstruct(list(scene.image_paths), out / variant, config=config, until="dense")
    scale = true_from_maps({m.view: m for m in run.depth_maps}, scene).scale
    measured = [check_map(m, scene, scale) for m in run.depth_maps if views is None or m.view in views]
    return [
        Metric(
            f"courtyard, {variant} maps",
            label,
            "",
            {word: float(np.mean([one[word][label] for one in measured])) for word in SURFACES},
            "b-spline",
        )
        for label in measured[0]["linear"]
    ]


def surfaces_study(
    out: Path,
    variant: Sequence[Literal["default", "thesis"]] = ("default",),
    views: Sequence[int] | None = None,
) -> Iterator[Part]:
    """Compare linear and B-spline surfaces of depth maps with the truth.

    Parameters
    ----------
    variant : sequence of str
        Presets whose depth maps of the courtyard are used.
    """
    yield [check_known(name, rho, wrong) for name, rho in known_surfaces().items() for wrong in (0.0, 0.2)]
    for name in variant:
        yield check_courtyard(out, name, views)
