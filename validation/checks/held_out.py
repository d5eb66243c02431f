"""A photograph that the model has not seen beside the model, and beside Open3D's.

``python -m validation.checks.held_out [-o OUT] [--scenes ...] [--views K] [--levelled]``

Every view in turn of a few is left out: its depth map and its photograph go into neither model. (The other
depth maps were matched with it, for both alike.) Ours is fused and textured; Open3D's is a grid of truncated
signed distances with the colours of its vertices from the same depth maps and photographs, with voxels of
the same size as ours and finer ones. All meshes are drawn by our renderer at the camera that was left out
and compared over the pixels that all of them cover whole. Photographs are exposed differently, and how an
unseen one was exposed nobody knows: numbers are of pictures made as bright as the photograph by one factor a
channel, each method its own, and of pictures as they are. With ``--levelled`` all photographs are made
equally bright before any model is made of them. The exit code is 1 where Open3D is better in the former
numbers. Pictures are kept in OUT.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from thesisrecon.dense.multiview import MultiViewStereo
from thesisrecon.geometry.pinhole import PinholeCamera
from thesisrecon.model import SurfaceModel
from thesisrecon.model.texture import BlendedViews, SingleView, TextureAtlas
from thesisrecon.types import DepthMap, PinholeView, RenderedView, TexturedMesh
from thesisrecon.views import render
from thesisrecon.views.likeness import exposed_alike, psnr_db, ssim, whole_pixels
from validation.checks.dense_scene import depth_maps_of
from validation.metrics.record import Metric, markdown_table
from validation.references.open3d_meshes import render_open3d
from validation.references.open3d_surfaces import OpenTsdf
from validation.scenes.real import load_fixture_scene, load_real_scene

SCENES = ("fountain-P11", "Herz-Jesus-P8")
VOXELS_PX = (1.5, 1.0)
"""Of Open3D's grids: as ours, and finer so that its colours are."""
OURS, SINGLE = "ours", "ours, one photograph each"


@dataclass(frozen=True)
class Likeness:
    """Of one picture to the photograph: with exposures made alike, as it is, and the share of the frame that
    the surface covers."""

    psnr_db: float
    ssim: float
    psnr_as_is_db: float
    ssim_as_is: float
    covered: float


def models(
    maps: Sequence[DepthMap], views: Sequence[PinholeView], *, threads: int
) -> dict[str, TexturedMesh]:
    """The same depth maps and photographs as models of ours and of Open3D."""
    surface = SurfaceModel().surface_of(maps, threads=threads)
    single = TextureAtlas(painter=SingleView())
    found = {
        OURS: SurfaceModel().color(surface, views, threads=threads),
        SINGLE: single.texture(surface, views, threads=threads),
    }
    for voxel in VOXELS_PX:
        found[f"Open3D TSDF, voxel {voxel} px"] = OpenTsdf(voxel_px=voxel).fuse(maps, views)
    return found


def compare(view: PinholeView, drawn: Mapping[str, RenderedView]) -> dict[str, Likeness]:
    """Pictures of one camera beside its photograph, over the pixels that all of them have."""
    whole = {name: whole_pixels(picture) & view.seen for name, picture in drawn.items()}
    compared = np.logical_and.reduce(list(whole.values()))
    found = {}
    for name, picture in drawn.items():
        alike = exposed_alike(view.rgb, picture.color, compared)
        found[name] = Likeness(
            psnr_db(view.rgb, alike, compared),
            ssim(view.rgb, alike, compared),
            psnr_db(view.rgb, picture.color, compared),
            ssim(view.rgb, picture.color, compared),
            float(whole[name].mean()),
        )
    return found


def hold_out(
    left_out: int,
    maps: Mapping[int, DepthMap],
    views: Mapping[int, PinholeView],
    *,
    pictures: Path | None = None,
    threads: int = 1,
) -> dict[str, Likeness]:
    """Leave one view out of all models and compare them with its photograph."""
    others = [i for i in sorted(maps) if i != left_out]
    made = models([maps[i] for i in others], [views[i] for i in others], threads=threads)
    view = views[left_out]
    camera = PinholeCamera.from_matrix(view.P, (view.rgb.shape[1], view.rgb.shape[0]))
    drawn = {name: render(mesh, camera, threads=threads) for name, mesh in made.items()}
    finest = list(made)[-1]
    try:
        own = render_open3d(made[finest], camera)
        drawn[f"{finest}, its own picture"] = RenderedView(own, drawn[finest].depth, drawn[finest].valid)
    except RuntimeError as error:
        print(f"Open3D cannot draw here: {error}")
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        Image.fromarray(view.rgb).save(pictures / f"{left_out:02d}-photograph.png")
        for name, picture in drawn.items():
            Image.fromarray(picture.color).save(pictures / f"{left_out:02d}-{name.replace(' ', '-')}.png")
    return compare(view, drawn)


def table(scene: str, found: Sequence[Mapping[str, Likeness]]) -> list[Metric]:
    """Means over the photographs that were left out; Open3D's best is the target of ours."""

    def row(label: str, unit: str, field: str, judged: bool) -> Metric:
        values = {name: float(np.mean([getattr(one[name], field) for one in found])) for name in found[0]}
        theirs = max(value for name, value in values.items() if name.startswith("Open3D"))
        return Metric(scene, label, unit, values, OURS, theirs if judged else None, at_most=False)

    return [
        row("PSNR, exposure alike", "dB", "psnr_db", True),
        row("SSIM, exposure alike", "", "ssim", True),
        row("PSNR as it is", "dB", "psnr_as_is_db", False),
        row("SSIM as it is", "", "ssim_as_is", False),
        row("covered", "", "covered", False),
    ]


def equally_bright(
    maps: Mapping[int, DepthMap], views: Mapping[int, PinholeView], *, threads: int = 1
) -> dict[int, PinholeView]:
    """All photographs with one exposure, by the gains that the texture of ours finds."""
    order = sorted(maps)
    surface = SurfaceModel().surface_of([maps[i] for i in order], threads=threads)
    gains = BlendedViews().prepare(surface, [views[i] for i in order], threads=threads).gains
    return {
        i: replace(views[i], rgb=np.clip(np.rint(views[i].rgb * gain), 0, 255).astype(np.uint8))
        for i, gain in zip(order, gains, strict=True)
    }


def spread_out(views: Sequence[int], count: int) -> list[int]:
    """``count`` of the views, evenly, without the first and the last where there are others."""
    places = np.linspace(0, len(views) - 1, count + 2)[1:-1]
    return sorted({views[round(float(place))] for place in places})


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print tables, say whether the targets are reached."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("-o", "--out", type=Path, help="where reconstructions and pictures are kept")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=[*SCENES, "courtyard"])
    parser.add_argument("--views", type=int, default=3, help="how many photographs are left out, one by one")
    parser.add_argument("--left-out", type=int, nargs="*", help="these instead")
    parser.add_argument("--max-side", type=int, default=1024, help="px of the depth maps")
    parser.add_argument(
        "--levelled", action="store_true", help="make all photographs equally bright first, for every model"
    )
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args(arguments)
    missed = False
    with tempfile.TemporaryDirectory() as temporary:
        out = options.out or Path(temporary)
        for name in options.scenes:
            scene = load_fixture_scene(name) if name == "courtyard" else load_real_scene(name)
            if scene is None:
                print(f"{name}: not on this machine")
                continue
            stereo = MultiViewStereo(max_side=options.max_side)
            maps, views = depth_maps_of(scene.image_paths, out / name, stereo, threads=options.threads)
            if options.levelled:
                views = equally_bright(maps, views, threads=options.threads)
            found = []
            for left_out in options.left_out or spread_out(sorted(maps), options.views):
                where = out / f"{name}-held-out"
                found.append(hold_out(left_out, maps, views, pictures=where, threads=options.threads))
                print(f"{name}, without {left_out}: {_in_short(found[-1])}", flush=True)
            metrics = table(name, found)
            print(f"\n## {name}\n\n{markdown_table(metrics)}", flush=True)
            missed |= any(metric.verdict == "missed" for metric in metrics)
    return int(missed)


def _in_short(found: Mapping[str, Likeness]) -> str:
    return ", ".join(f"{name} {one.psnr_db:.2f} dB {one.ssim:.4f}" for name, one in found.items())


if __name__ == "__main__":
    raise SystemExit(main())
