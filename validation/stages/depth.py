"""Section 2.6: depth maps of all images of a scene against true depth and sparse points."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import numpy as np
import PIL.Image

from thesisrecon.api.surface import confirmed_depth_maps
from thesisrecon.arrays import F32, U8
from thesisrecon.config import preset
from thesisrecon.imaging.pinholes import pinhole_view
from thesisrecon.io._files import write_text
from thesisrecon.io._images import read_images
from thesisrecon.records import DepthMap, Image, PinholeView, Reconstruction
from thesisrecon.stereo.depth import MultiViewStereo
from validation.metrics.depth import (
    Judged,
    Scores,
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
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions, Stage, Task, load_images
from validation.runs.tables import OURS, Metric, each, row
from validation.scenes.real import Scene, load_fixture_depth
from validation.stages.cameras import our_model

THESIS = "ours (thesis)"
PRESETS = {OURS: "default", THESIS: "thesis"}
COURTYARD = "courtyard"
SCENES = (COURTYARD, "fountain-P11", "Herz-Jesus-P8")
SIDE_PX = 448  # Long side of the depth maps; the library default of 1024 takes too long for a report
FEW, FEW_AROUND = ("fountain-P11",), 2
"""Scenes whose depth maps only their own gates read; images on each side of the middle that these need."""
WORST = 0.02  # Relative error that is red in the figures


class DepthStage(Stage):
    """Depth maps of the default and the thesis preset, from our cameras."""

    name = "depth"
    scenes, own = SCENES, True
    required = (("cameras", OURS),)

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        # The thesis preset takes as long as the default and is evaluated only with true depth.
        whole = scene == COURTYARD and not (options.quick or options.gates_only)
        return (OURS, THESIS) if whole else (OURS,)

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        scene = load_images(task.scene, options)
        images, model = images_of(scene), our_model(scene, options)
        if options.gates_only and task.scene in FEW:
            middle = np.abs(np.arange(len(images)) - len(images) // 2) <= FEW_AROUND
            model = replace(model, registered=model.registered & middle)
        dense = preset(PRESETS[task.method]).dense
        assert isinstance(dense, MultiViewStereo)
        start = time.process_time()
        dense = replace(dense, max_side=side_of(options))
        maps = confirmed_depth_maps(dense, dense.prepare(images, model))
        seconds = time.process_time() - start
        for view, m in maps.items():
            np.savez(folder / f"{view:04d}.npz", P=m.P, depth=m.depth, std=m.std, views=m.views)
        write_text(folder / "seconds.txt", f"{seconds / max(len(maps), 1)}\n")

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        images = load_images(scene, options)
        model = our_model(images, options)
        found = {name: read_maps(o.folder) if o.ok else {} for name, o in outcomes.items()}
        views = sorted({view for maps in found.values() for view in maps})
        truths = {view: true_depth(images, view) for view in views} if scene == COURTYARD else {}
        judged = {
            name: together(_judged(maps, images, model, truths)) if maps else None
            for name, maps in found.items()
        }
        known = {name: outcomes[name].folder if maps else None for name, maps in found.items()}
        seconds = each(known, lambda folder: (folder / "seconds.txt").read_text())
        text = "processor time, compiling included"
        metrics = [*_metrics(scene, judged), row(scene, "time a view", "s", seconds, text)]
        pictures = [] if options.gates_only else _pictures(images, found, model, options)
        return Judgement(metrics, pictures=pictures)


def side_of(options: ReportOptions) -> int:
    """Return the long side of depth maps (px)."""
    return options.side_px or SIDE_PX


def images_of(scene: Scene) -> list[Image]:
    """Read the original images in scene order."""
    read = read_images(list(scene.image_paths), max_size_px=10_000)
    by_name = {image.name: image for image in read.images}
    return [by_name[path.name] for path in scene.image_paths]


def views_of(scene: Scene, options: ReportOptions) -> dict[int, PinholeView]:
    """Return undistorted images at depth-map size, by view."""
    model = our_model(scene, options)
    return {
        i: pinhole_view(image, model, i, max_side=side_of(options))
        for i, image in enumerate(images_of(scene))
        if model.registered[i]
    }


def read_maps(folder: Path) -> dict[int, DepthMap]:
    """Saved depth maps by view."""
    maps = {}
    for file in sorted(Path(folder).glob("[0-9]*.npz")):
        with np.load(file) as m:
            view = int(file.stem)
            maps[view] = DepthMap(view, m["P"], m["depth"], m["std"], m["views"])
    return maps


def our_maps(scene: str, options: ReportOptions, method: str = OURS) -> dict[int, DepthMap]:
    """Return the saved depth maps of this stage; ``ValueError`` without any."""
    maps = read_maps(options.folder("depth", scene, method))
    if not maps:
        raise ValueError(f"there are no depth maps of {scene}: run the stage depth too")
    return maps


def _judged(
    maps: Mapping[int, DepthMap], scene: Scene, model: Reconstruction, truths: Mapping[int, TrueDepth]
) -> list[Judged]:
    if not truths:
        return [judge_against_points(found, model) for found in maps.values()]
    scale = true_from_maps(maps, scene).scale
    return [judge_against_truth(found, truths[view], scale) for view, found in maps.items()]


def _metrics(scene: str, judged: Mapping[str, Scores | None]) -> list[Metric]:
    of, against = (
        ("points visible in two images", "true depth")
        if scene == COURTYARD
        else ("sparse points of the view", "depth of the sparse points")
    )
    error = f"median |z / z_true - 1| of all known depths against the {against}"
    bias = f"|median of z / z_true - 1| against the {against}: 0 without systematic error"
    right = f"share of the {of} whose depth is known and right to 1 %, mean of the views"
    ideal = "median error over the stated standard deviation, over 0.6745: 1 is ideal"
    rows = {
        "depth error, median": ("%", error),
        "depth error, bias": ("%", bias),
        "within 1 %": ("%", right),
        "within 1 %, worst view": ("%", "the least of these shares"),
        "known": ("%", f"share of the {of} that have a depth"),
        "within 1 % of the known": ("%", "share of the known depths that are right to 1 %"),
        "error in deviations": ("", ideal),
    }
    return [
        row(scene, name, unit, each(judged, itemgetter(name)), text, more="error" not in name)
        for name, (unit, text) in rows.items()
    ]


def _pictures(
    scene: Scene, found: Mapping[str, Mapping[int, DepthMap]], model: Reconstruction, options: ReportOptions
) -> list[Picture]:
    """Draw two views: image, maps, and, if known, truth and errors."""
    views = sorted(set.intersection(*(set(maps) for maps in found.values()))) if found else []
    chosen = sorted({views[len(views) // 4], views[len(views) // 2]}) if views else []
    images, folder = images_of(scene), options.folder(DepthStage.name, scene.name)
    pictures = []
    for view in chosen:
        rgb = pinhole_view(images[view], model, view, max_side=side_of(options)).rgb
        maps = {name: of_method[view] for name, of_method in found.items()}
        limits = depth_range([m.depth for m in maps.values()])
        rows = [[rgb, *(depth_colours(m.depth, limits) for m in maps.values())]]
        text = f"Image, {', then '.join(maps)}: near red, far blue, unknown black."
        if scene.name == COURTYARD:
            scales = {name: true_from_maps(of_method, scene).scale for name, of_method in found.items()}
            true = _true_map(view, rgb.shape[:2])
            own = depth_colours(true / next(iter(scales.values())), limits)
            rows.append([own, *(_errors(m, true, scales[name]) for name, m in maps.items())])
            text += f" Below the truth, and errors from blue (none) to red ({100.0 * WORST:g} % or more)."
        file = f"view-{view:02d}.png"
        PIL.Image.fromarray(np.concatenate([np.concatenate(row, axis=1) for row in rows])).save(folder / file)
        pictures.append(Picture(file, f"Depth of image {view + 1}", text))
    return pictures


def _true_map(view: int, shape: Sequence[int]) -> F32:
    """Return the true depth at the samples nearest to the pixels of a map of this shape."""
    true, stride = load_fixture_depth(view)
    # Sample k is the pixel stride * k of the image.
    y, x = (
        np.clip(np.rint((np.arange(n) + 0.5) * m / n - 0.5 / stride), 0, m - 1).astype(np.int64)
        for n, m in zip(shape, true.shape, strict=True)
    )
    return np.asarray(true[np.ix_(y, x)], dtype=np.float32)


def _errors(found: DepthMap, true: F32, scale: float) -> U8:
    with np.errstate(invalid="ignore"):
        return coloured(np.abs(scale * found.depth.astype(np.float64) / true - 1.0) / WORST)
