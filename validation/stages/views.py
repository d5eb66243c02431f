"""Section 2.6: renderings of the model compared with left-out images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
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
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions, Stage, Task, load_images
from validation.runs.tables import OURS, Metric, each, row
from validation.stages.depth import COURTYARD, our_maps, read_maps, views_of

TSDF, FINE, LEVELLED = "Open3D TSDF, 1.5 px", "Open3D TSDF, 1 px", "Open3D TSDF, 1 px, levelled"
OWN_PICTURE = "Open3D TSDF, 1 px, its own image"
VOXELS_PX = {TSDF: 1.5, FINE: 1.0, LEVELLED: 1.0}
SCENES = (COURTYARD, "Herz-Jesus-P8")
LEFT_OUT, QUICK_LEFT_OUT = 2, 1
RED_LEVELS = 64.0  # Difference in grey levels that is red in the figures
EQUAL = "exposures equalised first; mean over the left-out images"
ORIGINAL = "original exposures; mean over the left-out images"
NUMBERS = {
    "PSNR": ("dB", EQUAL),
    "SSIM": ("", EQUAL),
    "PSNR as it is": ("dB", ORIGINAL),
    "SSIM as it is": ("", ORIGINAL),
    "covered": ("%", "share of the frame that the model covers whole"),
}
Scores = dict[str, float]


class ViewsStage(Stage):
    """Images are left out one by one."""

    name = "views"
    scenes, own = SCENES, True

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        strictest = (OURS, FINE, LEVELLED)
        return strictest if options.quick or options.gates_only else (OURS, TSDF, FINE, LEVELLED)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        surface = ((self.name, OURS),) if method == LEVELLED else ()
        return (("cameras", OURS), ("depth", OURS), *surface)

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        maps = our_maps(task.scene, options)
        views = views_of(load_images(task.scene, options), options)
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
        found: dict[str, list[Scores]] = {}
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


def compare(view: PinholeView, drawn: Mapping[str, RenderedView]) -> tuple[dict[str, Scores], B8]:
    """Return the scores of the renderings, and the pixels (H, W) that all of them cover whole."""
    whole = {name: covered_pixels(picture) & view.seen for name, picture in drawn.items()}
    compared = np.logical_and.reduce([view.seen, *whole.values()])
    found = {}
    for name, picture in drawn.items():
        shown = (match_exposure(view.rgb, picture.color, compared), picture.color)
        scores = [score(view.rgb, color, compared) for color in shown for score in (psnr_db, ssim)]
        found[name] = dict(zip(NUMBERS, [*scores, 100.0 * float(whole[name].mean())], strict=True))
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


def _mean(found: Sequence[Scores] | None) -> Scores | None:
    return {name: float(np.mean([one[name] for one in found])) for name in NUMBERS} if found else None


def _metrics(scene: str, found: Mapping[str, Scores | None]) -> list[Metric]:
    rows = [
        row(scene, name, unit, each(found, itemgetter(name)), text, more=True)
        for name, (unit, text) in NUMBERS.items()
    ]
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
