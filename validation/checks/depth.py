"""Depth maps from photographs alone: ``python -m validation.checks.depth [-o OUT] [--scenes ...]``.

The courtyard against its true depth (after similarity alignment of the cameras), fountain-P11 and
Herz-Jesus-P8 against their own sparse points. Reconstructions are kept in OUT; with ``--pictures`` every map
is drawn there, red near, blue far, black unknown. The exit code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

import thesisrecon
from thesisrecon.dense.multiview import MultiViewScene, MultiViewStereo, SequenceLinking
from thesisrecon.geometry.alignment import estimate_similarity
from thesisrecon.geometry.camera import camera_centre, project
from thesisrecon.types import B8, F64, DepthMap, Reconstruction
from validation.metrics.record import Metric, markdown_table
from validation.scenes.real import Scene, load_fixture_depth, load_fixture_scene, load_real_scene

SCENES = ("courtyard", "fountain-P11", "Herz-Jesus-P8")
MEDIAN, WITHIN_1, SPARSE = 0.3, 90.0, 0.2
SAME = 0.01
"""Relative difference of depths up to which two views see the same place, and a depth is right."""
COLOURS = np.array(
    [[48, 18, 59], [70, 107, 227], [40, 187, 236], [50, 242, 152], [238, 207, 58], [208, 48, 5]]
)
VARIANTS = {
    "default": MultiViewStereo(),
    "thesis": MultiViewStereo(linker=SequenceLinking(), refinement=None),
}


@dataclass(frozen=True)
class Judged:
    """Relative errors of the known depths, share known and share right of what can be known, and the root of
    the median squared error in deviations."""

    error: F64
    known: float
    right: float
    in_deviations: float


def true_depth(scene: Scene, view: int) -> tuple[F64, int, B8]:
    """True depth of a view of the courtyard, its stride, and where another view sees the place too."""
    assert scene.K is not None
    assert scene.R is not None
    assert scene.C is not None
    depth, stride = load_fixture_depth(view)
    rows, columns = depth.shape
    x, y = np.meshgrid(stride * np.arange(float(columns)), stride * np.arange(float(rows)))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(scene.K[view]).T
    X = (rays * depth[..., None]) @ scene.R[view] + scene.C[view]
    seen = np.zeros(depth.shape, dtype=bool)
    for j in range(len(scene.image_paths)):
        if j != view:
            q = (X - scene.C[j]) @ (scene.K[j] @ scene.R[j]).T
            with np.errstate(divide="ignore", invalid="ignore"):
                at = q[..., :2] / q[..., 2:] / stride
                inside = (q[..., 2] > 0.0) & np.all((at >= 0) & (at <= [columns - 1, rows - 1]), axis=-1)
            place = np.rint(np.where(inside[..., None], at, 0.0)).astype(np.int64)
            other = load_fixture_depth(j)[0][place[..., 1], place[..., 0]]
            with np.errstate(divide="ignore", invalid="ignore"):
                seen |= inside & (np.abs(other / q[..., 2] - 1.0) < SAME)
    return depth, stride, seen


def judge_against_truth(found: DepthMap, scene: Scene, model: Reconstruction) -> Judged:
    """One map of the courtyard; what can be known is what two views see."""
    assert scene.C is not None
    mine = model.registered
    centres = np.array([camera_centre(P) for P in model.P[mine]])
    scale = estimate_similarity(centres[:, :3] / centres[:, 3:], scene.C[mine]).scale
    depth, stride, seen = true_depth(scene, found.view)
    size = np.array(found.depth.shape[::-1])
    shrink = size / model.sizes[found.view]
    at = [
        np.clip(np.rint((stride * np.arange(n) + 0.5) * s - 0.5), 0, m - 1).astype(np.int64)
        for n, s, m in zip(depth.shape[::-1], shrink, size, strict=True)
    ]
    ours = scale * found.depth[np.ix_(at[1], at[0])].astype(np.float64)
    std = scale * found.std[np.ix_(at[1], at[0])].astype(np.float64)
    known = seen & np.isfinite(ours)
    error = np.abs(ours / depth - 1.0)[known]
    deviations = (np.abs(ours - depth) / std)[known]
    total = max(int(seen.sum()), 1)
    return Judged(
        error, len(error) / total, float(np.sum(error < SAME)) / total, _median(deviations) / 0.6745
    )


def judge_against_points(found: DepthMap, scene: MultiViewScene) -> Judged:
    """One map at the sparse points that its view observes."""
    X = scene.points.X[scene.points.seen[found.view]]
    z = X @ found.P[2, :3] + found.P[2, 3]
    at = np.rint(project(found.P, X)).astype(np.int64)
    inside = np.all((at >= 0) & (at < found.depth.shape[::-1]), axis=1)
    at, z = at[inside], z[inside]
    ours = found.depth[at[:, 1], at[:, 0]].astype(np.float64)
    known = np.isfinite(ours)
    error = np.abs(ours / z - 1.0)[known]
    deviations = np.abs(ours - z)[known] / found.std[at[:, 1], at[:, 0]][known]
    total = max(len(z), 1)
    return Judged(
        error, known.sum() / total, float(np.sum(error < SAME)) / total, _median(deviations) / 0.6745
    )


def _median(values: F64) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def draw_depth(found: DepthMap, to: Path) -> None:
    """Inverse depth between its 1 and 99 % quantiles."""
    inverse = 1.0 / found.depth.astype(np.float64)
    known = np.isfinite(inverse)
    if not known.any():
        return
    low, high = np.quantile(inverse[known], [0.01, 0.99])
    share = np.where(known, np.clip((inverse - low) / max(high - low, 1e-12), 0.0, 1.0), 0.0)
    stops = np.linspace(0.0, 1.0, len(COLOURS))
    rgb = np.stack([np.interp(share, stops, COLOURS[:, k]) for k in range(3)], axis=-1)
    Image.fromarray(np.where(known[..., None], rgb, 0.0).astype(np.uint8)).save(to)


def check_scene(name: str, out: Path, options: argparse.Namespace) -> list[Metric]:
    """All depth maps of a scene; nothing where the photographs are not on this machine."""
    scene = load_fixture_scene(name) if name == "courtyard" else load_real_scene(name)
    if scene is None:
        print(f"{name}: not on this machine")
        return []
    run = thesisrecon.reconstruct(list(scene.image_paths), out / name, until="metric")
    if run.metric is None:
        raise RuntimeError(f"{name}: {run.failure}")
    model = run.metric.reconstruction
    stereo = replace(VARIANTS[options.variant], max_side=options.max_side)
    wall, cpu = time.perf_counter(), time.process_time()
    prepared = stereo.prepare(run.images, model)
    maps = stereo.map_all(run.images, model, threads=options.threads)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    truth = name == "courtyard"
    judged = [
        judge_against_truth(m, scene, model) if truth else judge_against_points(m, prepared)
        for m in maps.values()
    ]
    if options.pictures:
        for view, found in maps.items():
            draw_depth(found, out / f"{name}-{view:02d}.png")
    return _metrics(name, judged, (wall, cpu))


def _metrics(name: str, judged: Sequence[Judged], seconds: tuple[float, float]) -> list[Metric]:
    truth = name == "courtyard"
    error = np.concatenate([j.error for j in judged])
    what = "depth error" if truth else "difference from the sparse points"
    of = "of what two views see" if truth else "of the points"

    def row(label: str, unit: str, value: float, target: float | None = None, least: bool = False) -> Metric:
        return Metric(name, label, unit, {"ours": value}, "ours", target, at_most=not least)

    return [
        row(f"{what}, median", "%", 100.0 * _median(error), MEDIAN if truth else SPARSE),
        row(
            f"within 1 %, {of}",
            "%",
            100.0 * float(np.mean([j.right for j in judged])),
            WITHIN_1 if truth else None,
            True,
        ),
        row("the same, worst view", "%", 100.0 * min(j.right for j in judged)),
        row(f"known, {of}", "%", 100.0 * float(np.mean([j.known for j in judged]))),
        row("within 1 %, of the known", "%", 100.0 * float(np.mean(error < SAME))),
        row("error in deviations", "", float(np.nanmedian([j.in_deviations for j in judged]))),
        row("views", "", float(len(judged))),
        row("wall time", "s", seconds[0]),
        row("processor time", "s", seconds[1]),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print tables, say whether the targets are reached."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, help="where reconstructions and pictures are kept")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=SCENES)
    parser.add_argument("--variant", default="default", choices=list(VARIANTS))
    parser.add_argument("--max-side", type=int, default=MultiViewStereo().max_side, help="px")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--pictures", action="store_true", help="draw the depth maps into OUT")
    options = parser.parse_args(arguments)
    missed = False
    with tempfile.TemporaryDirectory() as temporary:
        out = options.out or Path(temporary)
        for name in options.scenes:
            metrics = check_scene(name, out, options)
            if metrics:
                print(f"\n## {name}\n\n{markdown_table(metrics)}", flush=True)
            missed |= any(metric.verdict == "missed" for metric in metrics)
    return int(missed)


if __name__ == "__main__":
    raise SystemExit(main())
