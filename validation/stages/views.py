"""Section 2.6: renderings of the model compared with left-out images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import PIL.Image

from thesisrecon.api.views import render
from thesisrecon.arrays import B8, U8
from thesisrecon.camera import Camera
from thesisrecon.records import DepthMap, PinholeView, RenderedView, TexturedMesh
from thesisrecon.surface._texture_blending import depth_buffers, prepare_views
from thesisrecon.surface.model import SurfaceModel
from thesisrecon.views.render import covered_pixels, match_exposure, psnr_db, ssim
from validation.metrics.depth import coloured
from validation.references.open3d_geometry import OpenTsdf, render_open3d
from validation.runs.records import OURS, Judgement, Outcome, Picture, ReportOptions, Stage, Task, each, row
from validation.runs.scenes import load_images
from validation.runs.tables import Metric
from validation.stages.depth import COURTYARD, our_maps, read_maps, views_of

TSDF, FINE, LEVELLED = "Open3D TSDF, 1.5 px", "Open3D TSDF, 1 px", "Open3D TSDF, 1 px, levelled"
OWN_PICTURE = "Open3D TSDF, 1 px, its own image"
VOXELS_PX = {TSDF: 1.5, FINE: 1.0, LEVELLED: 1.0}
SCENES = (COURTYARD, "Herz-Jesus-P8")
LEFT_OUT, QUICK_LEFT_OUT = 2, 1
RED_LEVELS = 64.0
"""Difference in grey levels that is red in the figures."""


@dataclass(frozen=True)
class Likeness:
    """Mean scores of left-out images, exposures equalised or as they are, and the share ``covered``."""

    psnr_db: float
    ssim: float
    psnr_as_is_db: float
    ssim_as_is: float
    covered: float


class ViewsStage(Stage):
    """Images are left out one by one."""

    name = "views"
    title = "Views of the model"
    definition = (
        f"{LEFT_OUT} images (in a quick report {QUICK_LEFT_OUT}) are left out, one by one: neither "
        "their depth map nor their colours go into a model. (Other depth maps were matched with them, for "
        "all alike.) Ours is textured; Open3D's is its grid of truncated signed distances with coloured "
        "vertices, from the same depth maps and images, once with exposures equalised by our gains. All "
        "are drawn by our renderer at the left-out camera, Open3D's finer one "
        "(but for a quick report) also by its own, and compared over the pixels that all cover whole. The "
        "exposure of a left-out image is unknown: each rendering is first multiplied by the best factor of "
        "each channel."
    )

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return scene in SCENES or scene in options.folders

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        strictest = (OURS, FINE, LEVELLED)
        return strictest if options.quick or options.gates_only else (OURS, TSDF, FINE, LEVELLED)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        surface = ((self.name, OURS),) if method == LEVELLED else ()
        return (("cameras", OURS), ("depth", OURS), *surface)

    def run(self, task: Task, options: ReportOptions) -> None:
        maps = our_maps(task.scene, options)
        views = views_of(load_images(task.scene, options), options)
        folder = options.folder(task.stage, task.scene, task.method)
        shared = options.folder(task.stage, task.scene, OURS)
        for k in _left_out(sorted(maps), options):
            others = [i for i in sorted(maps) if i != k]
            seen = [views[i] for i in others]
            mesh = _model(task.method, [maps[i] for i in others], seen, shared / f"surface-{k:04d}.npz")
            camera = Camera.from_matrix(views[k].P, (views[k].rgb.shape[1], views[k].rgb.shape[0]))
            drawn = render(mesh, camera)
            _save(folder / f"{k:04d}.png", drawn.color)
            _save(folder / f"{k:04d}-covered.png", np.where(drawn.valid, 255, 0).astype(np.uint8))
            if task.method == FINE and not options.quick:
                try:
                    _save(folder / f"{k:04d}-own.png", render_open3d(mesh, camera))
                except RuntimeError as error:
                    print(f"Open3D cannot draw here: {error}")

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        views = views_of(load_images(scene, options), options)
        left_out = _left_out(sorted(read_maps(options.folder("depth", scene, OURS))), options)
        folder, pictures = options.folder(self.name, scene), list[Picture]()
        found: dict[str, list[Likeness]] = {}
        for k in left_out:
            drawn = _drawn(outcomes, k)
            scores, compared = compare(views[k], drawn)
            for name, one in scores.items():
                found.setdefault(name, []).append(one)
            shown = {n: drawn[n].color for n in (OURS, FINE, OWN_PICTURE) if n in drawn}
            file = f"left-out-{k:02d}.png"
            _save(folder / file, _beside(views[k].rgb, shown, compared))
            text = (
                f"The image, then {'; '.join(shown)}; below the differences, blue (none) to red "
                f"({RED_LEVELS:g} grey levels or more), black where not compared."
            )
            pictures.append(Picture(file, f"Image {k + 1}, left out", text))
        names = [*outcomes, *([OWN_PICTURE] if OWN_PICTURE in found else [])]
        numbers = ", ".join(str(k + 1) for k in left_out)
        notes = [f"Left out: image{'s' * (len(left_out) > 1)} {numbers}."]
        metrics = _metrics(scene, {n: _mean(found.get(n)) for n in names})
        return Judgement(metrics, notes, pictures=pictures)


def _left_out(views: Sequence[int], options: ReportOptions) -> list[int]:
    """Return evenly spaced views, without the first and the last if possible."""
    count = QUICK_LEFT_OUT if options.quick else LEFT_OUT
    shares = np.linspace(0, len(views) - 1, count + 2)[1:-1]
    return sorted({views[round(float(share))] for share in shares})


def _model(
    method: str, maps: Sequence[DepthMap], views: Sequence[PinholeView], surface: Path
) -> TexturedMesh:
    """Build a coloured model; ours stores its ``surface`` for the other methods."""
    if method == OURS:
        surface_model = SurfaceModel().surface_of(maps)
        np.savez(surface, vertices=surface_model.vertices, faces=surface_model.faces)
        return SurfaceModel().color(surface_model, views)
    if method == LEVELLED:
        views = _equally_bright(_read_surface(surface), views)
    return OpenTsdf(voxel_px=VOXELS_PX[method]).fuse(maps, views)


def _read_surface(path: Path) -> TexturedMesh:
    with np.load(path) as kept:
        return TexturedMesh(kept["vertices"], kept["faces"])


def _equally_bright(surface: TexturedMesh, views: Sequence[PinholeView]) -> list[PinholeView]:
    prepared = prepare_views(surface, views, depth_buffers(surface, views))
    return [
        replace(view, rgb=np.clip(np.rint(view.rgb * seen.gain), 0, 255).astype(np.uint8))
        for view, seen in zip(views, prepared, strict=True)
    ]


def compare(view: PinholeView, drawn: Mapping[str, RenderedView]) -> tuple[dict[str, Likeness], B8]:
    """Return the scores of the renderings, and the pixels (H, W) that all of them cover whole."""
    whole = {name: covered_pixels(picture) & view.seen for name, picture in drawn.items()}
    compared = np.logical_and.reduce([view.seen, *whole.values()])
    found = {}
    for name, picture in drawn.items():
        shown = (match_exposure(view.rgb, picture.color, compared), picture.color)
        scores = [score(view.rgb, color, compared) for color in shown for score in (psnr_db, ssim)]
        found[name] = Likeness(*[*scores, 100.0 * float(whole[name].mean())])
    return found, compared


def _drawn(outcomes: Mapping[str, Outcome], view: int) -> dict[str, RenderedView]:
    """Return the saved renderings of a camera, without depths."""
    drawn = {}
    for name, outcome in outcomes.items():
        folder = Path(outcome.folder)
        if not outcome.ok:
            continue
        covered = _read(folder / f"{view:04d}-covered.png") > 0
        depth = np.full(covered.shape, np.nan, dtype=np.float32)
        for method, end in ((name, ""), (OWN_PICTURE, "-own")):
            if (file := folder / f"{view:04d}{end}.png").is_file():
                drawn[method] = RenderedView(_read(file), depth, covered)
    return drawn


def _mean(found: Sequence[Likeness] | None) -> Likeness | None:
    if not found:
        return None
    return Likeness(*np.mean([list(vars(one).values()) for one in found], axis=0).tolist())


def _metrics(scene: str, found: Mapping[str, Likeness | None]) -> list[Metric]:
    equal = "exposures equalised first; mean over the left-out images"
    original = "original exposures; mean over the left-out images"
    rows = []
    for name, unit, field, text in (
        ("PSNR", "dB", "psnr_db", equal),
        ("SSIM", "", "ssim", equal),
        ("PSNR as it is", "dB", "psnr_as_is_db", original),
        ("SSIM as it is", "", "ssim_as_is", original),
        ("covered", "%", "covered", "share of the frame that the model covers whole"),
    ):
        values = each(found, lambda one, field=field: getattr(one, field))  # type: ignore[misc]
        rows.append(row(scene, name, unit, values, text, more=True))
    for metric in rows[:2]:
        theirs = [v for n, v in metric.values.items() if n.startswith("Open3D") and v is not None]
        ours = metric.values.get(OURS)
        over = ours - max(theirs) if ours is not None and theirs else None
        text = f"{metric.name} of ours minus the best of Open3D's"
        rows.append(row(scene, f"{metric.name} over Open3D", metric.unit, over, text, more=True))
    return rows


def _beside(rgb: U8, shown: Mapping[str, U8], compared: B8) -> U8:
    """Draw the image and renderings in a row, exposure-compensated differences below."""
    above, below = [rgb], [np.zeros_like(rgb)]
    for color in shown.values():
        equal = match_exposure(rgb, color, compared)
        off = np.abs(equal.astype(np.float64) - rgb).mean(axis=2) / RED_LEVELS
        above.append(equal)
        below.append(coloured(np.where(compared, off, np.nan)))
    return np.concatenate([np.concatenate(above, axis=1), np.concatenate(below, axis=1)])


def _save(path: Path, picture: U8) -> None:
    PIL.Image.fromarray(picture).save(path, compress_level=1)


def _read(path: Path) -> U8:
    with PIL.Image.open(path) as opened:
        return np.asarray(opened)
