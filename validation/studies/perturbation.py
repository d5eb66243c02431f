"""How far rounding moves the result: ``python -m validation.studies.perturbation``.

Another processor, another BLAS or another version of it rounds sums otherwise, and decisions that hang on a
rounding may fall the other way. So the numbers on which a stage works are changed by as little: by 1e-12 of
themselves where they are of double precision, by the rounding of single precision where they are of that. The
run is made again from there on, and its cameras are held against the undisturbed ones, in units of the
standard deviations that it states: what is moved by more than these is not what they say it is.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from thesisrecon.config import ImageOptions, PipelineConfig, preset
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import Features, Image, Matches, MetricResult, Tracks, TwoView
from validation.metrics.cameras import TrueCameras, measure_cameras
from validation.metrics.record import Metric, markdown_table
from validation.scenes.real import REAL_SCENES, Scene, load_fixture_scene, load_real_scene

DOUBLE_REL, SINGLE_REL = 1e-12, 6e-8
STAGES = ("corners", "matches", "tracks")
LIMIT = 1.0
"""Standard deviations that rounding may move an intrinsic by."""


def shaken(values: Any, rng: np.random.Generator) -> Any:
    """An array with every element changed by a rounding error."""
    rel = DOUBLE_REL if values.dtype == np.float64 else SINGLE_REL
    noise = 1.0 + rel * rng.uniform(-1.0, 1.0, values.shape)
    return (values * noise).astype(values.dtype)


@dataclass(frozen=True)
class ShakenDetector:
    """Corners and the patches of the seeds, as another rounding would give them."""

    inner: Any
    repeat: int

    def detect(self, image: Image) -> Features:
        """Corners of one photograph."""
        found: Features = self.inner.detect(image)
        rng = np.random.default_rng([self.repeat, *image.name.encode()])
        seeds = found.seeds
        if seeds is not None:
            seeds = replace(seeds, xy=shaken(seeds.xy, rng), patches=shaken(seeds.patches, rng))
        return replace(found, xy=shaken(found.xy, rng), seeds=seeds)


@dataclass(frozen=True)
class ShakenMatcher:
    """Matched places, as another rounding would give them."""

    inner: Any
    repeat: int

    def prepare(self, image: Image, features: Features) -> Any:
        """As it is."""
        return self.inner.prepare(image, features)

    def match(self, view1: Any, view2: Any, *, pair: tuple[int, int], **given: Any) -> Matches:
        """Matches of a pair."""
        found: Matches = self.inner.match(view1, view2, pair=pair, **given)
        rng = np.random.default_rng([self.repeat, *pair])
        return replace(found, xy1=shaken(found.xy1, rng), xy2=shaken(found.xy2, rng))


@dataclass(frozen=True)
class ShakenTracks:
    """Observations, as another rounding would give them."""

    inner: Any
    repeat: int

    def build(self, prepared: Sequence[Any], pairs: Sequence[TwoView], rng: np.random.Generator) -> Tracks:
        """Observations of scene points."""
        found: Tracks = self.inner.build(prepared, pairs, rng)
        return replace(found, xy=shaken(found.xy, np.random.default_rng([self.repeat])))


def disturbed(config: PipelineConfig, stage: str, repeat: int) -> PipelineConfig:
    """The pipeline with the numbers of one stage shaken."""
    if stage == "corners":
        return replace(config, features=ShakenDetector(config.features, repeat))
    if stage == "matches":
        return replace(config, matching=ShakenMatcher(config.matching, repeat))
    return replace(config, tracks=ShakenTracks(config.tracks, repeat))


@dataclass(frozen=True)
class Moved:
    """How far one disturbed result lies from the undisturbed: the intrinsic that moved most in its standard
    deviations, mean of the camera centres as a share of their spread, median rotation, and views that only
    one of both registered."""

    intrinsics_std: float
    centres_rel: float
    rotation_deg: float
    registered: int
    points_rel: float


def compare(still: MetricResult, other: MetricResult) -> Moved:
    """Two results on the same photographs."""
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
    """The cameras of a result as what others are measured by, and how far their centres spread."""
    r = result.reconstruction
    assert r.K is not None
    poses = np.linalg.solve(r.K, r.P)
    # P is known up to a factor: that of a rotation is one.
    Rt = np.asarray(poses / np.cbrt(np.linalg.det(poses[:, :, :3]))[:, None, None], dtype=np.float64)
    centres = -np.einsum("vji,vj->vi", Rt[:, :, :3], Rt[:, :, 3])
    seen = centres[r.registered]
    return TrueCameras(r.K, Rt[:, :, :3], centres), float(
        np.linalg.norm(seen - seen.mean(axis=0), axis=1).mean()
    )


def measure(scene: Scene, *, long_side: int, repeats: int, threads: int) -> list[Metric]:
    """Shake each stage ``repeats`` times; the largest movements over the repeats."""
    config = replace(preset("default"), images=ImageOptions(max_size_px=long_side))
    moved: dict[str, list[Moved]] = {stage: [] for stage in STAGES}
    with tempfile.TemporaryDirectory() as out:

        def run(chosen: PipelineConfig) -> MetricResult:
            # In the same folder: what stands before the shaken stage is kept.
            found = reconstruct(
                scene.image_paths, out, config=chosen, until="metric", overwrite=True, threads=threads
            )
            assert found.metric is not None
            return found.metric

        for stage in reversed(STAGES):
            still = run(config)
            for repeat in range(repeats):
                moved[stage].append(compare(still, run(disturbed(config, stage, repeat))))
                print(scene.name, stage, moved[stage][-1], flush=True)
    return rows(scene.name, moved)


def rows(name: str, moved: Mapping[str, Sequence[Moved]]) -> list[Metric]:
    """The largest movements as a table, the columns being where the rounding was changed."""
    first = STAGES[0]

    def row(what: str, unit: str, field: str, target: float | None = None) -> Metric:
        worst = {stage: max(getattr(m, field) for m in found) for stage, found in moved.items() if found}
        judged = max(worst, key=lambda stage: worst[stage]) if target is not None else first
        return Metric(name, what, unit, worst, judged, target)

    return [
        row("intrinsic that moves most", "of its standard deviation", "intrinsics_std", LIMIT),
        row("camera centres, of their spread", "", "centres_rel"),
        row("rotations, median", "deg", "rotation_deg"),
        row("views registered otherwise", "", "registered", 0.0),
        row("number of points, relative", "", "points_rel"),
    ]


def main(arguments: list[str] | None = None) -> int:
    """Print a table for each scene; exit code 1 where rounding moves more than the intervals say."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.perturbation", description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=["courtyard", *REAL_SCENES])
    parser.add_argument("--long-side", type=int, default=800)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    wishes = parser.parse_args(arguments)
    missed = False
    for name in wishes.scenes:
        scene = load_fixture_scene() if name == "courtyard" else load_real_scene(name)
        if scene is None:
            print(f"{name} is not on this machine")
            continue
        found = measure(scene, long_side=wishes.long_side, repeats=wishes.repeats, threads=wishes.threads)
        print(f"\n## {name}, {wishes.long_side} px, {wishes.repeats} repeats\n\n{markdown_table(found)}\n")
        missed |= any(metric.verdict == "missed" for metric in found)
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
