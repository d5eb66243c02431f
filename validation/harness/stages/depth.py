"""Section 2.6: depth maps of all images of a scene against true depth and sparse points."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image

from thesisrecon.arrays import F32
from thesisrecon.config import preset
from thesisrecon.io._files import write_text
from thesisrecon.io.images import read_images
from thesisrecon.records import DepthMap, Image, PinholeView, Reconstruction
from thesisrecon.stereo.depth import MultiViewStereo
from thesisrecon.stereo.neighbours import pinhole_view
from validation.harness.records import Judgement, Outcome, Picture, ReportOptions, Task
from validation.harness.scenes import load_photographs
from validation.harness.stages.cameras import OURS as OUR_CAMERAS
from validation.harness.stages.cameras import read_model
from validation.metrics.depth import (
    Judged,
    JudgedMaps,
    TrueDepth,
    coloured,
    depth_colours,
    depth_range,
    judge_against_points,
    judge_against_truth,
    together,
    true_depth,
    true_from_maps,
)
from validation.metrics.record import Metric
from validation.scenes.real import Scene, load_fixture_depth

OURS, THESIS = "ours", "ours (thesis)"
PRESETS = {OURS: "default", THESIS: "thesis"}
COURTYARD = "courtyard"
SCENES = (COURTYARD, "fountain-P11", "Herz-Jesus-P8")
SIDE_PX = 448
"""Long side of the depth maps; the library default of 1024 takes too long for a report."""
WORST = 0.02
"""Relative error that is red in the figures."""


class DepthStage:
    """Depth maps of the default and the thesis preset, from our cameras."""

    name = "depth"
    title = "Depth maps"
    definition = (
        f"Depth maps of every image from our own cameras, long side {SIDE_PX} px by "
        "default (the library's is 1024), the same for both presets: the default (matched pairs, robust "
        "fusion, slanted windows, completion) and the thesis' (maximum likelihood scanlines, linked along "
        "the sequence; on the courtyard alone, not in a quick report). The courtyard is compared "
        "with its true depth after similarity alignment of the cameras; other images with their sparse "
        "points."
    )

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return scene in SCENES or scene in options.folders

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        # The thesis preset takes as long as the default and is evaluated only with true depth.
        whole = scene == COURTYARD and not (options.quick or options.gates_only)
        return (OURS, THESIS) if whole else (OURS,)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:  # noqa: ARG002 (the same for all)
        return (("cameras", OUR_CAMERAS),)

    def run(self, task: Task, options: ReportOptions) -> None:
        photographs = load_photographs(task.scene, options)
        images, model = images_of(photographs), model_of(photographs, options)
        stereo = stereo_of(task.method, options)
        start = time.process_time()
        maps = stereo.map_all(images, model, threads=1)
        seconds = time.process_time() - start
        place = options.place(task.stage, task.scene, task.method)
        for view, found in maps.items():
            np.savez(
                place / f"{view:04d}.npz", P=found.P, depth=found.depth, std=found.std, views=found.views
            )
        write_text(place / "seconds.txt", f"{seconds / max(len(maps), 1)}\n")

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        photographs = load_photographs(scene, options)
        model = model_of(photographs, options)
        kept = {name: read_maps(o.place) if o.ok else {} for name, o in outcomes.items()}
        truths = _truths(photographs, kept)
        judged = {n: together(_judged(maps, photographs, model, truths)) for n, maps in kept.items() if maps}
        seconds = {
            n: float((outcomes[n].place / "seconds.txt").read_text()) if maps else None
            for n, maps in kept.items()
        }
        metrics = _metrics(scene, {n: judged.get(n) for n in outcomes})
        metrics.append(
            Metric(scene, "time a view", "s", seconds, OURS, definition="processor time, compiling included")
        )
        notes = [f"{name}: {o.failure}." for name, o in outcomes.items() if not o.ok]
        return Judgement(metrics, pictures=_pictures(photographs, kept, model, self, options), notes=notes)


def side_of(options: ReportOptions) -> int:
    """Return the long side of depth maps (px)."""
    return options.side_px or SIDE_PX


def stereo_of(method: str, options: ReportOptions) -> MultiViewStereo:
    """Return the stereo method of a preset, at the size of this report."""
    dense = preset(PRESETS[method]).dense
    assert isinstance(dense, MultiViewStereo)
    return replace(dense, max_side=side_of(options))


def images_of(photographs: Scene) -> list[Image]:
    """Read the original images in scene order."""
    read = read_images(list(photographs.image_paths), max_size_px=10_000)
    by_name = {image.name: image for image in read.images}
    return [by_name[path.name] for path in photographs.image_paths]


def model_of(photographs: Scene, options: ReportOptions) -> Reconstruction:
    """Return our saved reconstruction of a scene; ``ValueError`` if missing."""
    outcome = Outcome(options.place("cameras", photographs.name, OUR_CAMERAS))
    model = read_model(photographs, OUR_CAMERAS, outcome)
    if model is None:
        raise ValueError(f"our model of {photographs.name} is missing: run the stage cameras too")
    return model


def views_of(photographs: Scene, model: Reconstruction, options: ReportOptions) -> dict[int, PinholeView]:
    """Return undistorted images at depth-map size, by view."""
    return {
        i: pinhole_view(image, model, i, max_side=side_of(options))
        for i, image in enumerate(images_of(photographs))
        if model.registered[i]
    }


def read_maps(place: Path) -> dict[int, DepthMap]:
    """Saved depth maps by view."""
    maps = {}
    for file in sorted(Path(place).glob("[0-9]*.npz")):
        with np.load(file) as kept:
            view = int(file.stem)
            maps[view] = DepthMap(view, kept["P"], kept["depth"], kept["std"], kept["views"])
    return maps


def _truths(photographs: Scene, kept: Mapping[str, Mapping[int, DepthMap]]) -> dict[int, TrueDepth]:
    """Return the true depths of the views with a map, if known."""
    if photographs.name != COURTYARD:
        return {}
    return {
        view: true_depth(photographs, view) for view in sorted({v for maps in kept.values() for v in maps})
    }


def _judged(
    maps: Mapping[int, DepthMap], photographs: Scene, model: Reconstruction, truths: Mapping[int, TrueDepth]
) -> list[Judged]:
    if not truths:
        return [judge_against_points(found, model) for found in maps.values()]
    scale = true_from_maps(maps, photographs).scale
    return [judge_against_truth(found, truths[view], scale) for view, found in maps.items()]


def _metrics(scene: str, judged: Mapping[str, JudgedMaps | None]) -> list[Metric]:
    of, against = (
        ("points visible in two images", "true depth")
        if scene == COURTYARD
        else ("sparse points of the view", "depth of the sparse points")
    )

    def row(
        name: str, unit: str, read: Callable[[JudgedMaps], float], words: str, *, least: bool = False
    ) -> Metric:
        values = {n: None if j is None else read(j) for n, j in judged.items()}
        return Metric(scene, name, unit, values, OURS, at_most=not least, definition=words)

    return [
        row(
            "depth error, median",
            "%",
            lambda j: 100.0 * j.median,
            f"median |z / z_true - 1| of all known depths against the {against}",
        ),
        row(
            "within 1 %",
            "%",
            lambda j: 100.0 * j.right,
            f"share of the {of} whose depth is known and right to 1 %, mean of the views",
            least=True,
        ),
        row(
            "within 1 %, worst view",
            "%",
            lambda j: 100.0 * j.worst,
            "the least of these shares",
            least=True,
        ),
        row("known", "%", lambda j: 100.0 * j.known, f"share of the {of} that have a depth", least=True),
        row(
            "within 1 % of the known",
            "%",
            lambda j: 100.0 * j.right_of_known,
            "share of the known depths that are right to 1 %",
            least=True,
        ),
        row(
            "error in deviations",
            "",
            lambda j: j.deviations,
            "median error over the stated standard deviation, over 0.6745: 1 is ideal",
        ),
    ]


def _pictures(
    photographs: Scene,
    kept: Mapping[str, Mapping[int, DepthMap]],
    model: Reconstruction,
    stage: DepthStage,
    options: ReportOptions,
) -> list[Picture]:
    """Draw two views: image, maps, and, if known, truth and errors."""
    views = sorted(set.intersection(*(set(maps) for maps in kept.values()))) if kept else []
    chosen = sorted({views[len(views) // 4], views[len(views) // 2]}) if views else []
    images, place = images_of(photographs), options.place(stage.name, photographs.name)
    pictures = []
    for view in chosen:
        photograph = pinhole_view(images[view], model, view, max_side=side_of(options)).rgb
        maps = {name: found[view] for name, found in kept.items()}
        limits = depth_range([found.depth for found in maps.values()])
        rows = [[photograph, *(depth_colours(found.depth, limits) for found in maps.values())]]
        words = f"Image, {', then '.join(maps)}: near red, far blue, unknown black."
        if photographs.name == COURTYARD:
            scales = {name: true_from_maps(found, photographs).scale for name, found in kept.items()}
            true = _true_map(view, next(iter(maps.values())).depth.shape)
            own = depth_colours((true / next(iter(scales.values()))).astype(np.float32), limits)
            off = [_errors(found, true, scales[name]) for name, found in maps.items()]
            rows.append([own, *off])
            words += f" Below the truth, and errors from blue (none) to red ({100.0 * WORST:g} % or more)."
        file = f"view-{view:02d}.png"
        PIL.Image.fromarray(np.concatenate([np.concatenate(row, axis=1) for row in rows])).save(place / file)
        pictures.append(Picture(file, f"Depth of image {view + 1}", words))
    return pictures


def _true_map(view: int, shape: Sequence[int]) -> F32:
    """Return the true depth at the samples nearest to the pixels of a map of this shape."""
    true, _ = load_fixture_depth(view)
    y, x = (
        np.clip(np.rint((np.arange(n) + 0.5) * m / n - 0.5), 0, m - 1).astype(np.int64)
        for n, m in zip(shape, true.shape, strict=True)
    )
    return np.asarray(true[np.ix_(y, x)], dtype=np.float32)


def _errors(found: DepthMap, true: F32, scale: float) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    with np.errstate(invalid="ignore"):
        off = np.abs(scale * found.depth.astype(np.float64) / true - 1.0) / WORST
    known = np.isfinite(off)
    return np.where(known[..., None], coloured(np.where(known, off, 0.0)), 0).astype(np.uint8)
