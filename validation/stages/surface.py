"""Section 2.6: surfaces of the same depth maps by ours and Open3D against the true surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import PIL.Image

from thesisrecon.api.views import render
from thesisrecon.arrays import F64, U8
from thesisrecon.camera import Camera
from thesisrecon.config import preset
from thesisrecon.records import TexturedMesh
from thesisrecon.surface.model import SurfaceModel
from validation.metrics.depth import coloured, true_from_maps
from validation.metrics.surfaces import CAPPED, SAMPLES, judge_surface, load_truth
from validation.references.open3d_geometry import OpenTsdf, poisson_mesh
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions, Stage, Task
from validation.runs.rows import OURS, Values, each, ratio, read_arrays, row
from validation.runs.scenes import load_images
from validation.runs.tables import Metric
from validation.stages.depth import COURTYARD, PRESETS, THESIS, our_maps, views_of

TSDF, POISSON = "Open3D TSDF", "Open3D Poisson"
SHOWN = (OURS, TSDF, POISSON)
WITHIN = (0.2, 0.5, 1.0)
RED_PCT = 1.0
"""Distance that is red in the figures, in percent of the scene depth."""
QUICK_SAMPLES = 50_000
OVER = "mean distance, ours over that of Open3D's grid"


class SurfaceStage(Stage):
    """One surface of all depth maps."""

    name = "surface"
    title = "Surfaces"
    scenes = (COURTYARD,)
    definition = (
        "Surfaces of the depth maps of the stage above: our default, and Open3D's grid of truncated signed "
        "distances (voxels of 1.5 pixels, as ours) and its Poisson surface (octree of depth 9) of the same "
        "maps; the thesis' preset of its own maps. Cameras are aligned to the true ones by a similarity; "
        "distances are Open3D's, in per cent of the scene's depth, at most 5 % in the means. Accuracy: from "
        "points spread evenly over the surface, where two images could show them, to the true surface. "
        "Completeness: from what two images show to the surface."
    )

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        return (OURS, TSDF) if options.quick or options.gates_only else (OURS, THESIS, TSDF, POISSON)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        return (("cameras", OURS), ("depth", THESIS if method == THESIS else OURS))

    def run(self, task: Task, options: ReportOptions) -> None:
        mesh = _surface(task.method, task.scene, options)
        folder = options.folder(task.stage, task.scene, task.method)
        np.savez(folder / "mesh.npz", vertices=mesh.vertices, faces=mesh.faces.astype(np.int32))

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        truth = load_truth()
        samples = QUICK_SAMPLES if options.quick else SAMPLES
        meshes = {name: _true_mesh(name, outcome, scene, options) for name, outcome in outcomes.items()}
        judged = {n: None if m is None else judge_surface(m, truth, samples) for n, m in meshes.items()}
        faces = each(meshes, lambda m: len(m.faces))
        text = "triangles of the surface"
        metrics = [*_metrics(scene, judged), row(scene, "faces", "", faces, text, ranked=False)]
        notes = [f"The scene is {truth.depth_m:.2f} m deep, the median over all true depth maps."]
        folder, pictures = options.folder(self.name, scene), list[Picture]()
        camera = _camera(scene, options)
        for name in () if options.gates_only else SHOWN:
            mesh = meshes.get(name)
            if mesh is None:
                continue
            file = f"{name.replace(' ', '-')}.png"
            off_pct = 100.0 * truth.surface.distances(mesh.vertices) / truth.depth_m
            PIL.Image.fromarray(_drawn(mesh, off_pct, camera)).save(folder / file)
            text = f"View of a middle image; blue: no error, red: {RED_PCT:g} % of the depth or more."
            pictures.append(Picture(file, f"Surface: {name}", text))
        return Judgement(metrics, pictures=pictures, notes=notes)


def _surface(method: str, scene: str, options: ReportOptions) -> TexturedMesh:
    maps = our_maps(scene, options, THESIS if method == THESIS else OURS)
    ordered = [maps[view] for view in sorted(maps)]
    if method in PRESETS:
        model = preset(PRESETS[method]).model
        assert isinstance(model, SurfaceModel)
        return model.surface_of(ordered)
    if method == POISSON:
        return poisson_mesh(ordered)
    views = views_of(load_images(scene, options), options)
    return OpenTsdf().fuse(ordered, [views[m.view] for m in ordered])


def _true_mesh(method: str, outcome: Outcome, scene: str, options: ReportOptions) -> TexturedMesh | None:
    """Return the saved surface in the true frame."""
    found = read_arrays(outcome, "mesh.npz")
    if found is None:
        return None
    maps = our_maps(scene, options, THESIS if method == THESIS else OURS)
    align = true_from_maps(maps, load_images(scene, options))
    return TexturedMesh(align.apply(found["vertices"]), found["faces"].astype(np.int64))


def _metrics(scene: str, judged: Mapping[str, tuple[F64, F64] | None]) -> list[Metric]:
    rows, means = [], dict[str, Values]()
    text = {"accuracy": "from the surface to the truth", "completeness": "from the truth to the surface"}
    for side, what in enumerate(text):
        distances = {n: None if d is None else d[side] for n, d in judged.items()}
        means[what] = each(distances, lambda d: np.minimum(d, CAPPED).mean())
        median, where = each(distances, np.median), text[what]
        rows.append(row(scene, f"{what}, median", "% of depth", median, f"median distance {where}"))
        rows.append(row(scene, f"{what}, mean", "% of depth", means[what], f"mean distance {where}"))
        for bound in WITHIN:
            near = {
                n: None if d is None else 100.0 * float((d <= bound).mean()) for n, d in distances.items()
            }
            definition = f"share of the points {where} within this distance"
            rows.append(row(scene, f"{what}, within {bound} %", "%", near, definition, more=True))
    for what, values in means.items():
        over = ratio(values.get(OURS), values.get(TSDF))
        rows.append(row(scene, f"{what} over Open3D TSDF", "", over, OVER))
    return rows


def _camera(scene: str, options: ReportOptions) -> Camera:
    """Return the middle true camera at page size."""
    images = load_images(scene, options)
    K, R, C = images.cameras
    view = len(C) // 2
    with PIL.Image.open(images.image_paths[view]) as opened:
        size = opened.size
    return Camera(K[view], R[view], -R[view] @ C[view], size).scaled(640.0 / max(size))


def _drawn(mesh: TexturedMesh, off_pct: F64, camera: Camera) -> U8:
    """Render the surface coloured by the vertex errors."""
    return render(replace(mesh, colors=coloured(off_pct / RED_PCT)), camera, background=(245, 247, 250)).color
