"""Rendering beside the photographs, and its time: ``python -m validation.studies.rendering``.

The model is fixtures/courtyard fused from its true depth and textured from its photographs, so that what is
left is due to surface, texture and rendering alone. It is rendered from each photograph's camera and
compared where there is a surface; times are of one frame of an orbit. The exit code is 1 where a target is
missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image

from thesisrecon.camera import Camera
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.records import DepthMap, PinholeView, TexturedMesh
from thesisrecon.surface.fusion import VolumetricFusion
from thesisrecon.surface.texture_atlas import TextureAtlas
from thesisrecon.views.paths import orbit, surface_points
from thesisrecon.views.render import Light, Shading, render
from validation.metrics.record import Metric, markdown_table

COURTYARD = Path(__file__).parent.parent.parent / "fixtures" / "courtyard"
SIZE = (1000, 700)
FRAME_S = 1.0
"""Of a frame of half a million faces on one thread."""
DEPTH_STD_M = 0.001


def courtyard() -> tuple[list[DepthMap], list[PinholeView]]:
    """True depth maps (every second pixel) and photographs."""
    truth = json.loads((COURTYARD / "cameras.json").read_text(encoding="utf-8"))
    unit, stride = truth["depth"]["unit_m"], truth["depth"]["stride"]
    maps, views = [], []
    for view, (name, camera) in enumerate(sorted(truth["cameras"].items())):
        K, R, C = (np.array(camera[part]) for part in "KRC")
        with PIL.Image.open(COURTYARD / "depth" / Path(name).with_suffix(".png")) as image:
            depth = np.asarray(image).astype(np.float32) * np.float32(unit)
        depth[depth == 0.0] = np.nan
        # Pixel k of the map is pixel stride k of the photograph.
        P = camera_from_centre(np.diag([1 / stride, 1 / stride, 1.0]) @ K, R, C)
        std = np.full(depth.shape, DEPTH_STD_M, dtype=np.float32)
        maps.append(DepthMap(view, P, depth, std, np.full(depth.shape, 3, dtype=np.uint8)))
        with PIL.Image.open(COURTYARD / "images" / name) as image:
            rgb = np.asarray(image.convert("RGB"))
        views.append(PinholeView(view, camera_from_centre(K, R, C), rgb, np.ones(rgb.shape[:2], dtype=bool)))
    return maps, views


def psnr_db(mesh: TexturedMesh, view: PinholeView) -> tuple[float, float]:
    """Of the rendered photograph where there is a surface, and how much of the picture that is."""
    seen = render(mesh, camera_of(view), threads=2)
    apart = (seen.color.astype(np.float64) - view.rgb)[seen.valid]
    return float(10.0 * np.log10(255.0**2 / (apart**2).mean())), float(seen.valid.mean())


def camera_of(view: PinholeView) -> Camera:
    """Of the photograph's own size."""
    height, width = view.rgb.shape[:2]
    return Camera.from_matrix(view.P, (width, height))


def least_seconds(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Processor and wall seconds of the fastest of some calls."""
    processor, wall = [], []
    for _ in range(repeats + 1):  # the first compiles
        start = time.process_time(), time.perf_counter()
        work()
        processor.append(time.process_time() - start[0])
        wall.append(time.perf_counter() - start[1])
    return min(processor[1:]), min(wall[1:])


def times(mesh: TexturedMesh, camera: Camera, repeats: int) -> list[Metric]:
    """A frame as photographed and under a lamp, on one thread and two."""
    lamp = Shading(lights=(Light(position=(0.0, 0.0, 0.0)),), specular=0.2)
    values: dict[str, dict[str, float | None]] = {"processor": {}, "wall": {}}
    for light, shading in (("as photographed", None), ("a lamp", lamp)):
        for threads in (1, 2):

            def frame(shading: Shading | None = shading, threads: int = threads) -> object:
                return render(mesh, camera, shading=shading, threads=threads)

            name = f"{light}, {threads} thread{'s' * (threads > 1)}"
            values["processor"][name], values["wall"][name] = least_seconds(frame, repeats)
    scene = f"courtyard, {len(mesh.faces)} faces"
    return [
        Metric(
            scene, f"{kind} time of a frame", "s", row, name, target=FRAME_S if kind == "processor" else None
        )
        for kind, row in values.items()
        for name in ["a lamp, 1 thread"]
    ]


def main(arguments: list[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--voxel-px", type=float, default=2.1, help="2.1 gives about half a million faces")
    parser.add_argument("--repeats", type=int, default=5)
    wishes = parser.parse_args(arguments)
    maps, views = courtyard()
    surface = VolumetricFusion(voxel_px=wishes.voxel_px).fuse(maps, threads=2)
    mesh = TextureAtlas().texture(surface, views, threads=2)
    found = np.array([psnr_db(mesh, view) for view in views])
    cameras = [camera_of(view) for view in views]
    frame = orbit(cameras, surface_points(mesh), 8, size=SIZE)[0]
    rows = times(mesh, frame, wishes.repeats)
    for name, unit, values in (
        ("PSNR of a photograph rendered", "dB", found[:, 0]),
        ("surface", "", found[:, 1]),
    ):
        spread = {"median": float(np.median(values)), "least": float(values.min())}
        rows.append(Metric(rows[0].scene, name, unit, spread, "median"))
    for row in rows:
        print(markdown_table([row]), end="\n\n")
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
