"""Section 2.6: surfaces of the same depth maps by ours and Open3D against the true surface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.config import preset
from thesisrecon.records import TexturedMesh
from thesisrecon.surface.model import SurfaceModel
from thesisrecon.views.render import render
from validation.harness.records import Judgement, Outcome, Picture, ReportOptions, Task
from validation.harness.scenes import load_photographs
from validation.harness.stages.depth import (
    COURTYARD,
    OURS,
    PRESETS,
    THESIS,
    model_of,
    read_maps,
    views_of,
)
from validation.metrics.depth import coloured, true_from_maps
from validation.metrics.record import Metric
from validation.metrics.similarity import Similarity
from validation.metrics.surfaces import CAPPED, SAMPLES, judge_surface, load_truth
from validation.references.open3d_surfaces import OpenTsdf, poisson_mesh

TSDF, POISSON = "Open3D TSDF", "Open3D Poisson"
SHOWN = (OURS, TSDF, POISSON)
WITHIN = (0.2, 0.5, 1.0)
RED_PCT = 1.0
"""Distance that is red in the figures, in percent of the scene depth."""
QUICK_SAMPLES = 50_000


class SurfaceStage:
    """One surface of all depth maps."""

    name = "surface"
    title = "Surfaces"
    definition = (
        "Surfaces of the depth maps of the stage above: our default, and Open3D's grid of truncated signed "
        "distances (voxels of 1.5 pixels, as ours) and its Poisson surface (octree of depth 9) of the same "
        "maps; the thesis' preset of its own maps. Cameras are aligned to the true ones by a similarity; "
        "distances are Open3D's, in per cent of the scene's depth, at most 5 % in the means. Accuracy: from "
        "points spread evenly over the surface, where two images could show them, to the true surface. "
        "Completeness: from what two images show to the surface."
    )

    def takes(self, scene: str, options: ReportOptions) -> bool:  # noqa: ARG002 (the same for all)
        return scene == COURTYARD

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:  # noqa: ARG002 (the same everywhere)
        return (OURS, TSDF) if options.quick or options.gates_only else (OURS, THESIS, TSDF, POISSON)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        return (("depth", THESIS if method == THESIS else OURS),)

    def run(self, task: Task, options: ReportOptions) -> None:
        mesh = _surface(task.method, task.scene, options)
        place = options.place(task.stage, task.scene, task.method)
        np.savez(place / "mesh.npz", vertices=mesh.vertices, faces=mesh.faces.astype(np.int32))

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        truth = load_truth()
        samples = QUICK_SAMPLES if options.quick else SAMPLES
        meshes = {n: _true_mesh(n, o, scene, options) if o.ok else None for n, o in outcomes.items()}
        judged = {n: None if m is None else judge_surface(m, truth, samples) for n, m in meshes.items()}
        faces = {n: None if m is None else float(len(m.faces)) for n, m in meshes.items()}
        metrics = [
            *_metrics(scene, judged),
            Metric(scene, "faces", "", faces, OURS, definition="triangles of the surface"),
        ]
        notes = [f"{name}: {o.failure}." for name, o in outcomes.items() if not o.ok]
        notes.append(f"The scene is {truth.depth_m:.2f} m deep, the median over all true depth maps.")
        place, pictures = options.place(self.name, scene), list[Picture]()
        camera = _camera(scene, options)
        for name in SHOWN:
            mesh = meshes.get(name)
            if mesh is None:
                continue
            file = f"{name.replace(' ', '-')}.png"
            off_pct = 100.0 * truth.surface.distances(mesh.vertices) / truth.depth_m
            PIL.Image.fromarray(_drawn(mesh, off_pct, camera)).save(place / file)
            words = f"View of a middle image; blue: no error, red: {RED_PCT:g} % of the depth or more."
            pictures.append(Picture(file, f"Surface: {name}", words))
        return Judgement(metrics, pictures=pictures, notes=notes)


def _surface(method: str, scene: str, options: ReportOptions) -> TexturedMesh:
    maps = read_maps(options.place("depth", scene, THESIS if method == THESIS else OURS))
    if not maps:
        raise ValueError(f"there are no depth maps of {scene}: run the stage depth too")
    ordered = [maps[view] for view in sorted(maps)]
    if method in PRESETS:
        model = preset(PRESETS[method]).model
        assert isinstance(model, SurfaceModel)
        return model.surface_of(ordered)
    if method == POISSON:
        return poisson_mesh(ordered)
    photographs = load_photographs(scene, options)
    views = views_of(photographs, model_of(photographs, options), options)
    return OpenTsdf().fuse(ordered, [views[m.view] for m in ordered])


def _true_mesh(method: str, outcome: Outcome, scene: str, options: ReportOptions) -> TexturedMesh:
    """Return the saved surface in the true frame."""
    align = _true_from_ours(scene, options, THESIS if method == THESIS else OURS)
    with np.load(Path(outcome.place) / "mesh.npz") as kept:
        faces = kept["faces"].astype(np.int64)
        return TexturedMesh(align.apply(kept["vertices"]), faces)


def _true_from_ours(scene: str, options: ReportOptions, maps: str) -> Similarity:
    return true_from_maps(read_maps(options.place("depth", scene, maps)), load_photographs(scene, options))


def _metrics(scene: str, judged: Mapping[str, tuple[F64, F64] | None]) -> list[Metric]:
    rows, means = [], dict[str, dict[str, float | None]]()
    words = {"accuracy": "from the surface to the truth", "completeness": "from the truth to the surface"}
    for side, what in enumerate(words):

        def of(read: Callable[[F64], float], side: int = side) -> dict[str, float | None]:
            return {n: None if d is None else read(d[side]) for n, d in judged.items()}

        means[what] = of(lambda d: float(np.minimum(d, CAPPED).mean()))
        median = of(lambda d: float(np.median(d)))
        rows += [
            _row(scene, f"{what}, median", "% of depth", median, f"median distance {words[what]}"),
            _row(scene, f"{what}, mean", "% of depth", means[what], f"mean distance {words[what]}"),
        ]
        for bound in WITHIN:
            near = of(lambda d, bound=bound: 100.0 * float((d <= bound).mean()))  # type: ignore[misc]
            name = f"{what}, within {bound} %"
            definition = f"share of the points {words[what]} within this distance"
            rows.append(Metric(scene, name, "%", near, OURS, at_most=False, definition=definition))
    for what, values in means.items():
        ours, theirs = values.get(OURS), values.get(TSDF)
        ratio = ours / theirs if ours is not None and theirs else None
        definition = "mean distance, ours over that of Open3D's grid"
        rows.append(_row(scene, f"{what} over Open3D TSDF", "", {OURS: ratio}, definition))
    return rows


def _row(scene: str, name: str, unit: str, values: Mapping[str, float | None], words: str) -> Metric:
    return Metric(scene, name, unit, values, OURS, definition=words)


def _camera(scene: str, options: ReportOptions) -> Camera:
    """Return the middle true camera at page size."""
    truth = load_photographs(scene, options)
    assert truth.K is not None
    assert truth.R is not None
    assert truth.C is not None
    view = len(truth.C) // 2
    with PIL.Image.open(truth.image_paths[view]) as opened:
        size = opened.size
    camera = Camera(truth.K[view], truth.R[view], -truth.R[view] @ truth.C[view], size)
    return camera.scaled(640.0 / max(size))


def _drawn(mesh: TexturedMesh, off_pct: F64, camera: Camera) -> NDArray[np.uint8]:
    """Render the surface coloured by the vertex errors."""
    colored = replace(mesh, colors=coloured(off_pct / RED_PCT))
    return render(colored, camera, background=(245, 247, 250)).color
