"""Rendering beside the images, and its time.

The model is fixtures/courtyard fused from its true depth and textured from its images, so the remaining error
comes from surface, texture and rendering alone. It is rendered from each camera of the images and compared
where there is a surface; times are of one frame of an orbit.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import PIL.Image

from thesisrecon.camera import Camera
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.records import DepthMap, PinholeView, TexturedMesh
from thesisrecon.surface.fusion import VolumetricFusion
from thesisrecon.surface.texture_atlas import TextureAtlas
from thesisrecon.views.paths import orbit, sample_surface
from thesisrecon.views.render import Light, Shading, render
from validation.metrics.record import Metric
from validation.studies.measuring import least_seconds
from validation.studies.runner import Part, Rows

COURTYARD = Path(__file__).parent.parent.parent / "fixtures" / "courtyard"
SIZE = (1000, 700)
FRAME_S = 1.0
"""Bound for a frame of half a million faces on one thread."""
DEPTH_STD_M = 0.001


def courtyard() -> tuple[list[DepthMap], list[PinholeView]]:
    """Load true depth maps (every second pixel) and images."""
    truth = json.loads((COURTYARD / "cameras.json").read_text(encoding="utf-8"))
    unit, stride = truth["depth"]["unit_m"], truth["depth"]["stride"]
    maps, views = [], []
    for view, (name, camera) in enumerate(sorted(truth["cameras"].items())):
        K, R, C = (np.array(camera[part]) for part in "KRC")
        with PIL.Image.open(COURTYARD / "depth" / Path(name).with_suffix(".png")) as image:
            depth = np.asarray(image).astype(np.float32) * np.float32(unit)
        depth[depth == 0.0] = np.nan
        # Pixel k of the map is pixel stride k of the image.
        P = camera_from_centre(np.diag([1 / stride, 1 / stride, 1.0]) @ K, R, C)
        std = np.full(depth.shape, DEPTH_STD_M, dtype=np.float32)
        maps.append(DepthMap(view, P, depth, std, np.full(depth.shape, 3, dtype=np.uint8)))
        with PIL.Image.open(COURTYARD / "images" / name) as image:
            rgb = np.asarray(image.convert("RGB"))
        views.append(PinholeView(view, camera_from_centre(K, R, C), rgb, np.ones(rgb.shape[:2], dtype=bool)))
    return maps, views


def psnr_db(mesh: TexturedMesh, view: PinholeView) -> tuple[float, float]:
    """Return the PSNR of the rendered view where it shows the surface, and the share of these pixels."""
    seen = render(mesh, _camera_of(view), threads=2)
    apart = (seen.color.astype(np.float64) - view.rgb)[seen.valid]
    return float(10.0 * np.log10(255.0**2 / (apart**2).mean())), float(seen.valid.mean())


def times(mesh: TexturedMesh, camera: Camera, repeats: int) -> list[Metric]:
    """Time one frame with the texture as it is and with a headlight, on one thread and on two."""
    lamp = Shading(lights=(Light(position=(0.0, 0.0, 0.0)),))
    seconds = least_seconds(
        {
            f"{light}, {threads} thread{'s' * (threads > 1)}": partial(
                render, mesh, camera, shading=shading, threads=threads
            )
            for light, shading in (("unlit", None), ("headlight", lamp))
            for threads in (1, 2)
        },
        repeats,
    )
    rows = Rows(f"courtyard, {len(mesh.faces)} faces", "headlight, 1 thread")
    rows.add("processor time of a frame", {n: s[0] for n, s in seconds.items()}, "s", at_most=FRAME_S)
    rows.add("wall time of a frame", {n: s[1] for n, s in seconds.items()}, "s")
    return rows


def _camera_of(view: PinholeView) -> Camera:
    height, width = view.rgb.shape[:2]
    return Camera.from_matrix(view.P, (width, height))


def rendering_study(voxel_px: float = 2.1, repeats: int = 5) -> Iterator[Part]:
    """Compare renderings of the courtyard with its images, and time them.

    Parameters
    ----------
    voxel_px : float
        Voxel size in pixels; 2.1 gives about half a million faces.
    """
    maps, views = courtyard()
    mesh = TextureAtlas().texture(VolumetricFusion(voxel_px=voxel_px).fuse(maps, threads=2), views, threads=2)
    frame = orbit([_camera_of(view) for view in views], sample_surface(mesh), 8, size=SIZE)[0]
    yield times(mesh, frame, repeats)
    found = np.array([psnr_db(mesh, view) for view in views])
    rows = Rows(f"courtyard, {len(mesh.faces)} faces, all views", "median")
    for name, unit, values in (("PSNR of a rendered image", "dB", found[:, 0]), ("surface", "", found[:, 1])):
        rows.add(name, {"median": float(np.median(values)), "least": float(values.min())}, unit)
    yield rows
