"""Section 2.6: surfaces of the same depth maps by ours and Open3D against the true surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import PIL.Image

from thesisrecon.api.views import render
from thesisrecon.arrays import F64, I64, U8
from thesisrecon.camera import Camera
from thesisrecon.config import preset
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface._mesh import face_areas, surface_from_depth
from thesisrecon.surface.model import SurfaceModel
from validation.metrics.depth import coloured, depths_in_view, true_depth, true_from_maps
from validation.references.open3d_geometry import Nearest, OpenTsdf, poisson_mesh
from validation.runs.records import (
    Judgement,
    Outcome,
    Picture,
    ReportOptions,
    Stage,
    Task,
    load_images,
    read_arrays,
)
from validation.runs.tables import OURS, Metric, Values, each, ratio, row, slug
from validation.scenes.real import Scene, load_fixture_scene
from validation.stages.depth import COURTYARD, PRESETS, THESIS, our_maps, views_of

SAMPLES = 200_000  # Number of points sampled on a surface


class Truth(NamedTuple):
    """The true ``surface``, true ``points`` (N, 3) that two images show, and the scene's depth in metres."""

    scene: Scene
    surface: Nearest
    points: F64
    depth_m: float


def load_truth() -> Truth:
    """Return the courtyard from its true depth maps, one triangle sheet per view."""
    scene = load_fixture_scene("courtyard")
    calibrations, R, C = scene.cameras
    sheets, points, depths = [], [], []
    for view in range(len(C)):
        depth, stride, seen = true_depth(scene, view)
        K = np.diag([1.0 / stride, 1.0 / stride, 1.0]) @ calibrations[view]
        P = K @ R[view] @ np.column_stack([np.eye(3), -C[view]])
        std = np.zeros(depth.shape, dtype=np.float32)
        sheet = DepthMap(view, P, depth.astype(np.float32), std, np.ones(depth.shape, np.uint8))
        sheets.append(surface_from_depth(sheet, grazing_deg=1.0))
        y, x = np.nonzero(seen & (np.indices(depth.shape).sum(axis=0) % 2 == 0))
        rays = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(K).T
        points.append((rays * depth[y, x, None]) @ R[view] + C[view])
        depths.append(depth[np.isfinite(depth)])
    depth_m = float(np.median(np.concatenate(depths)))
    first = np.cumsum([0, *(len(m.vertices) for m in sheets[:-1])])
    faces = np.concatenate([m.faces + n for m, n in zip(sheets, first, strict=True)])
    whole = TexturedMesh(np.concatenate([m.vertices for m in sheets]), faces)
    return Truth(scene, Nearest(whole), np.concatenate(points), depth_m)


def points_on(mesh: TexturedMesh, count: int = SAMPLES) -> F64:
    """Sample points (count, 3) uniformly over a surface, deterministically."""
    rng = np.random.default_rng(0)
    area = np.cumsum(face_areas(mesh.vertices, mesh.faces))
    face = np.searchsorted(area, (np.arange(count) + rng.random(count)) * (area[-1] / count))
    s, t = rng.random((2, count, 1))
    turned = s + t > 1.0
    s, t = np.where(turned, 1.0 - s, s), np.where(turned, 1.0 - t, t)
    a, b, c = (mesh.vertices[mesh.faces[np.minimum(face, len(area) - 1), k]] for k in range(3))
    return np.asarray(a + s * (b - a) + t * (c - a))


def asked_for(points: F64, scene: Scene) -> I64:
    """Return the number of images (N,) that truly show each point."""
    count = np.zeros(len(points), dtype=np.int64)
    for view in range(len(scene.image_paths)):
        z, depth = depths_in_view(scene, view, points)
        # Relative depth tolerance of visibility.
        count += z <= (1.0 + 0.05) * depth
    return count


def judge_surface(mesh: TexturedMesh, truth: Truth, samples: int = SAMPLES) -> tuple[F64, F64]:
    """Accuracy and completeness of a surface in the true frame, as distances in percent of the scene's depth.
    Accuracy: from points spread evenly over the surface, where at least two images could show them, to the
    true one. Completeness: from true points that two images show to the surface.
    """
    points = points_on(mesh, samples)
    points = points[asked_for(points, truth.scene) >= 2]
    unit = 100.0 / truth.depth_m
    chosen = truth.points[:: max(1, len(truth.points) // samples)]
    return unit * truth.surface.distances(points), unit * Nearest(mesh).distances(chosen)


TSDF, POISSON = "Open3D TSDF", "Open3D Poisson"
RED_PCT = 1.0  # Distance that is red in the figures, in percent of the scene depth


class SurfaceStage(Stage):
    """One surface of all depth maps."""

    name = "surface"
    scenes = (COURTYARD,)

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        return (OURS, TSDF) if options.quick or options.gates_only else (OURS, THESIS, TSDF, POISSON)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        return (("cameras", OURS), ("depth", THESIS if method == THESIS else OURS))

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        mesh = _surface(task.method, task.scene, options)
        np.savez(folder / "mesh.npz", vertices=mesh.vertices, faces=mesh.faces.astype(np.int32))

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        truth = load_truth()
        samples = 50_000 if options.quick else SAMPLES
        meshes = {name: _true_mesh(name, outcome, scene, options) for name, outcome in outcomes.items()}
        judged = {n: None if m is None else judge_surface(m, truth, samples) for n, m in meshes.items()}
        faces = each(meshes, lambda m: len(m.faces))
        text = "triangles of the surface"
        metrics = [*_metrics(scene, judged), row(scene, "faces", "", faces, text, ranked=False)]
        notes = [f"The scene is {truth.depth_m:.2f} m deep, the median over all true depth maps."]
        folder, pictures = options.folder(self.name, scene), list[Picture]()
        camera = _camera(scene, options)
        for name in () if options.gates_only else (OURS, TSDF, POISSON):
            if (mesh := meshes.get(name)) is None:
                continue
            off_pct = 100.0 * truth.surface.distances(mesh.vertices) / truth.depth_m
            PIL.Image.fromarray(_drawn(mesh, off_pct, camera)).save(folder / f"{slug(name)}.png")
            text = f"View of a middle image; blue: no error, red: {RED_PCT:g} % of the depth or more."
            pictures.append(Picture(f"{slug(name)}.png", f"Surface: {name}", text))
        return Judgement(metrics, notes, pictures=pictures)


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
    found = read_arrays(outcome, "mesh.npz")
    if found is None:
        return None
    maps = our_maps(scene, options, THESIS if method == THESIS else OURS)
    align = true_from_maps(maps, load_images(scene, options))
    return TexturedMesh(align.apply(found["vertices"]), found["faces"].astype(np.int64))


def _metrics(scene: str, judged: Mapping[str, tuple[F64, F64] | None]) -> list[Metric]:
    rows, means = [], dict[str, Values]()
    text = {"accuracy": "from the surface to the truth", "completeness": "from the truth to the surface"}
    for side, (what, where) in enumerate(text.items()):
        distances = {n: None if d is None else d[side] for n, d in judged.items()}
        # Maximum distance in the mean, in percent of the scene depth.
        means[what] = each(distances, lambda d: np.minimum(d, 5.0).mean())
        median = each(distances, np.median)
        rows.append(row(scene, f"{what}, median", "% of depth", median, f"median distance {where}"))
        rows.append(row(scene, f"{what}, mean", "% of depth", means[what], f"mean distance {where}"))
        for bound in (0.2, 0.5, 1.0):
            near = each(distances, lambda d, most=bound: 100.0 * (d <= most).mean())  # type: ignore[misc]
            definition = f"share of the points {where} within this distance"
            rows.append(row(scene, f"{what}, within {bound} %", "%", near, definition, more=True))
    for what, values in means.items():
        over = ratio(values.get(OURS), values.get(TSDF))
        definition = "mean distance, ours over that of Open3D's grid"
        rows.append(row(scene, f"{what} over Open3D TSDF", "", over, definition))
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
