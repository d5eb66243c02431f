"""Linear and B-spline surfaces of depth maps: known surfaces with noise and with a fifth of wrong depths."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.records import DepthMap
from thesisrecon.surface.bspline import BSplineSurface
from thesisrecon.surface.model import LinearSurface
from validation.runs.study import Part
from validation.runs.tables import Metric

SURFACES: Mapping[str, LinearSurface | BSplineSurface] = {
    "linear": LinearSurface(),
    "b-spline": BSplineSurface(),
}
NOISE = 5e-4  # Standard deviation of the inverse depths, which are about 0.2


def known_surfaces() -> dict[str, F64]:
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


def surfaces_study() -> Iterator[Part]:
    """Compare linear and B-spline surfaces of noisy depth maps with the truth."""
    yield [check_known(name, rho, wrong) for name, rho in known_surfaces().items() for wrong in (0.0, 0.2)]
