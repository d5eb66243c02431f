"""Sensitivity of the result to rounding errors.

Another processor or BLAS rounds sums differently, and decisions close to a threshold may change. The outputs
of one stage are therefore changed by 1e-12 of their values in double precision, or by the rounding of single
precision. The run continues from there, and its cameras are compared with the undisturbed ones in units of
the standard deviations that it states.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.config import ImageOptions, PipelineConfig, preset
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import Features, Image, Matches, MetricResult, Tracks, TwoView
from validation.metrics.cameras import TrueCameras, measure_cameras
from validation.metrics.record import Metric
from validation.scenes.real import REAL_SCENES, Scene
from validation.studies.runner import Part, Rows, scenes_here

DOUBLE_REL, SINGLE_REL = 1e-12, 6e-8
STAGES = ("corners", "matches", "tracks")
LIMIT = 1.0
"""Largest allowed movement of an intrinsic in standard deviations."""


def perturbed(values: Any, rng: np.random.Generator) -> Any:
    """Change every element of an array by a rounding error."""
    rel = DOUBLE_REL if values.dtype == np.float64 else SINGLE_REL
    noise = 1.0 + rel * rng.uniform(-1.0, 1.0, values.shape)
    return (values * noise).astype(values.dtype)


@dataclass(frozen=True)
class PerturbedDetector:
    """Detector whose corners and seed patches are perturbed."""

    inner: Any
    repeat: int

    def detect(self, image: Image) -> Features:
        found: Features = self.inner.detect(image)
        rng = np.random.default_rng([self.repeat, *image.name.encode()])
        seeds = found.seeds
        if seeds is not None:
            seeds = replace(seeds, xy=perturbed(seeds.xy, rng), patches=perturbed(seeds.patches, rng))
        return replace(found, xy=perturbed(found.xy, rng), seeds=seeds)


@dataclass(frozen=True)
class PerturbedMatcher:
    """Matcher whose matched points are perturbed."""

    inner: Any
    repeat: int

    def prepare(self, image: Image, features: Features) -> Any:
        return self.inner.prepare(image, features)

    def match(self, view1: Any, view2: Any, *, pair: tuple[int, int], **given: Any) -> Matches:
        found: Matches = self.inner.match(view1, view2, pair=pair, **given)
        rng = np.random.default_rng([self.repeat, *pair])
        return replace(found, xy1=perturbed(found.xy1, rng), xy2=perturbed(found.xy2, rng))


@dataclass(frozen=True)
class PerturbedTracks:
    """Track builder whose observations are perturbed."""

    inner: Any
    repeat: int

    def build(self, prepared: Sequence[Any], pairs: Sequence[TwoView], rng: np.random.Generator) -> Tracks:
        found: Tracks = self.inner.build(prepared, pairs, rng)
        return replace(found, xy=perturbed(found.xy, np.random.default_rng([self.repeat])))


def disturbed(config: PipelineConfig, stage: str, repeat: int) -> PipelineConfig:
    if stage == "corners":
        return replace(config, features=PerturbedDetector(config.features, repeat))
    if stage == "matches":
        return replace(config, matching=PerturbedMatcher(config.matching, repeat))
    return replace(config, tracks=PerturbedTracks(config.tracks, repeat))


@dataclass(frozen=True)
class Moved:
    """Distance of one perturbed result from the unperturbed one.

    ``intrinsics_std``: largest movement of an intrinsic in its standard deviations; ``centres_rel``: mean
    movement of the camera centres over their spread; ``rotation_deg``: median rotation; ``registered``:
    views that only one result registered; ``points_rel``: relative change of the number of points.
    """

    intrinsics_std: float
    centres_rel: float
    rotation_deg: float
    registered: int
    points_rel: float


def compare(still: MetricResult, other: MetricResult) -> Moved:
    both = still.reconstruction.registered & other.reconstruction.registered
    steps = [
        abs(other.intrinsics[view][name].value - interval.value) / interval.std
        for view in np.flatnonzero(both)
        for name, interval in still.intrinsics[view].items()
        if interval.std > 0.0
    ]
    truth, spread = _as_truth(still)
    kept = replace(other.reconstruction, registered=both)
    errors = measure_cameras(kept, truth)
    counts = [int(r.reconstruction.valid.sum()) for r in (still, other)]
    return Moved(
        max(steps),
        (errors.centre_error or 0.0) / spread,
        errors.rotation_error_deg,
        int(np.sum(still.reconstruction.registered != other.reconstruction.registered)),
        abs(counts[1] / counts[0] - 1.0),
    )


def _as_truth(result: MetricResult) -> tuple[TrueCameras, float]:
    """Return the cameras of a result as truth, and the spread of their centres."""
    r = result.reconstruction
    assert r.K is not None
    poses = np.linalg.solve(r.K, r.P)
    # Scale P so that its rotation has determinant 1.
    Rt = np.asarray(poses / np.cbrt(np.linalg.det(poses[:, :, :3]))[:, None, None], dtype=np.float64)
    centres = -np.einsum("vji,vj->vi", Rt[:, :, :3], Rt[:, :, 3])
    seen = centres[r.registered]
    return TrueCameras(r.K, Rt[:, :, :3], centres), float(
        np.linalg.norm(seen - seen.mean(axis=0), axis=1).mean()
    )


def measure(scene: Scene, out: Path, *, long_side: int, repeats: int, threads: int) -> list[Metric]:
    """Perturb each stage ``repeats`` times; return the largest movements."""
    config = replace(preset("default"), images=ImageOptions(max_size_px=long_side))
    moved: dict[str, list[Moved]] = {stage: [] for stage in STAGES}

    def run(chosen: PipelineConfig) -> MetricResult:
        # One folder: the stages before the perturbed one are reused.
        found = reconstruct(
            scene.image_paths, out, config=chosen, until="metric", overwrite=True, threads=threads
        )
        assert found.metric is not None
        return found.metric

    for stage in reversed(STAGES):
        still = run(config)
        for repeat in range(repeats):
            moved[stage].append(compare(still, run(disturbed(config, stage, repeat))))
            print(scene.name, stage, moved[stage][-1], file=sys.stderr, flush=True)
    return rows(scene.name, moved)


def rows(name: str, moved: Mapping[str, Sequence[Moved]]) -> list[Metric]:
    table = Rows(name, STAGES[0])

    def add(label: str, unit: str, field: str, limit: float | None = None) -> None:
        worst = {stage: max(getattr(m, field) for m in found) for stage, found in moved.items() if found}
        # The stage that moves the result most is judged.
        table.judged = STAGES[0] if limit is None else max(worst, key=lambda stage: worst[stage])
        table.add(label, worst, unit, at_most=limit)

    add("intrinsic that moves most", "of its standard deviation", "intrinsics_std", LIMIT)
    add("camera centres, of their spread", "", "centres_rel")
    add("rotations, median", "deg", "rotation_deg")
    add("views registered otherwise", "", "registered", 0.0)
    add("number of points, relative", "", "points_rel")
    return table


def perturbation_study(
    out: Path,
    scenes: Sequence[str] = ("courtyard", *REAL_SCENES),
    long_side: int = 800,
    repeats: int = 3,
    threads: int = 2,
) -> Iterator[Part]:
    """Measure how far rounding errors move the result, in its standard deviations."""
    for scene in scenes_here(scenes):
        place = out / scene.name
        yield measure(scene, place, long_side=long_side, repeats=repeats, threads=threads)
