"""The thesis' comparison of triangulation methods as a task: points of noisy images against the true ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, get_args

import numpy as np

from thesisrecon.api.cameras import triangulate
from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.geometry.polynomial_triangulation import triangulate_polynomial
from thesisrecon.geometry.strata import Group
from validation.ablation.statistics import Sample
from validation.ablation.study import Measure, Place, Task
from validation.references.triangulation import colmap_points, opencv_linear, opencv_polynomial
from validation.scenes.rigs import SCENES, draw_rig, squared_distances

POLYNOMIAL = "polynomial"
METHODS: dict[str, Callable[[F64, F64], F64]] = {
    **{name: partial(triangulate, method=name) for name in ("linear", "iterated", "optimal")},
    "mid-point": partial(triangulate, method="midpoint"),
    POLYNOMIAL: triangulate_polynomial,
    "COLMAP": colmap_points,
    "OpenCV linear": opencv_linear,
    "OpenCV polynomial": opencv_polynomial,
}
"""Points X (N, 4) from cameras P (V, 3, 4) and pixels (V, N, 2)."""


@dataclass(frozen=True)
class TriangulationOverNoise(Task):
    """``points`` points of a rig drawn by the seed, seen with Gaussian noise of ``noise_px``, triangulated by
    ``method`` in a ``frame`` of space that is "metric", "affine" or "projective".

    Every method meets the same rig, noise and frame.
    """

    method: str = POLYNOMIAL
    noise_px: float = 1.0
    frame: str = "metric"
    points: int = 200

    sample: ClassVar[Sample] = "draws"
    measures: ClassVar[Sequence[Measure]] = (
        Measure("image_px", "px", "less", True, "RMS distance of projected from measured points"),
        Measure("space_pct", "%", "less", True, "median distance from the true point over its depth"),
        Measure("worst_pct", "%", "less", True, "95 % quantile of the same"),
    )

    def __post_init__(self) -> None:
        for what, word, known in (("method", self.method, METHODS), ("frame", self.frame, get_args(Group))):
            if word not in known:
                raise ValueError(unknown_word(what, word, known))
        if self.noise_px < 0.0 or self.points < 1:
            raise ValueError("noise_px is at least 0, points at least 1")

    def check(self, scene: str) -> None:
        if scene not in SCENES:
            raise UsageError(unknown_word("scene", scene, SCENES))

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        if SCENES[scene][1] > 2 and self.method == POLYNOMIAL:
            raise ValueError("the polynomial method is one of two views")
        rng = np.random.default_rng(seed)
        drawn = draw_rig(scene, self.noise_px, self.frame, rng, self.points)  # type: ignore[arg-type]
        X = METHODS[self.method](drawn.P, drawn.xy)
        squared = squared_distances(drawn.P, X, drawn.xy) / len(drawn.P)
        errors_pct = drawn.errors_pct(X)
        return {
            "image_px": float(np.sqrt(np.mean(squared))),
            "space_pct": float(np.median(errors_pct)),
            "worst_pct": float(np.quantile(errors_pct, 0.95)),
        }
