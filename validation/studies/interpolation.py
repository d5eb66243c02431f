"""View interpolation beside the truth.

Image 5 of fountain-P11 from 4 and 6, as it is, rotated onto the true camera, and by the best homography.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from thesisrecon import match_pair
from thesisrecon.arrays import F64, U8
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.records import Image
from thesisrecon.view_interpolation import prepare_pair
from validation.metrics.pictures import picture_metrics, psnr_db
from validation.scenes.between import (
    best_homography,
    camera_between,
    camera_centre_of,
    nearest_place,
    pose_of,
    turned,
)
from validation.scenes.image_files import read_rgb
from validation.scenes.nine_views import dissolved
from validation.studies.runner import Part, Rows, load_scene
from validation.studies.tensor_views import save_beside


def interpolation_study(out: Path) -> Iterator[Part]:
    """Compare an interpolated view of fountain-P11 with the true image, which OUT gets beside it."""
    scene = load_scene("fountain-P11")
    if scene is None or scene.K is None or scene.R is None or scene.C is None:
        return
    first, wanted, second = (Image(str(k), read_rgb(scene.image_paths[k]), (0, 0)) for k in (4, 5, 6))
    pair = prepare_pair(first, second)
    P4, P6 = (camera_from_centre(scene.K[k], scene.R[k], scene.C[k]) for k in (4, 6))
    s = nearest_place(pair, (P4, P6), scene.C[5])
    view, (width, height) = pair.view(s, threads=2), pair.size
    rays = scene.R[5].T @ np.linalg.inv(scene.K[5])
    seen = pose_of(camera_between(pair, (P4, P6), s))
    # The infinite homography: it relates the images of two cameras at one place.
    infinite = np.linalg.inv(seen.K @ seen.R @ rays)
    best = best_homography(*_matches(view, wanted.rgb))
    pictures = {
        "as it is": view,
        "turned as camera 5": pair.view(s, turn=infinite, threads=2),
        "turned best": pair.view(s, turn=best, threads=2),
    }
    pictures["cross-dissolve"] = dissolved(first.rgb, second.rgb, s)
    ends = [turned(one.rgb, best_homography(*_matches(one.rgb, wanted.rgb)))[0] for one in (first, second)]
    pictures["cross-dissolve, both turned best"] = dissolved(ends[0], ends[1], s)
    save_beside(out / "fountain-5.jpg", [wanted.rgb, pictures["turned best"], pictures["cross-dissolve"]])
    inner = np.zeros((height, width), dtype=bool)
    inner[height // 8 : -height // 8, width // 8 : -width // 8] = True
    metrics = picture_metrics("fountain-P11, 5 from 4 and 6", pictures, wanted.rgb)
    values: dict[str, float | None] = {n: psnr_db(p, wanted.rgb, where=inner) for n, p in pictures.items()}
    off = np.linalg.norm(camera_centre_of(pair, (P4, P6), s) - scene.C[5]) / np.linalg.norm(
        scene.C[6] - scene.C[4]
    )
    rows = Rows(metrics[0].scene, "turned best")
    rows.add("PSNR of the inner nine sixteenths", values, "dB")
    rows.add("camera 5 off the baseline", {"as it is": float(off)}, "baselines")
    rows.add("s", {"as it is": s})
    yield [*metrics, *rows]


def _matches(first: U8, second: U8) -> tuple[F64, F64]:
    pair = match_pair(first, second)
    return pair.xy1, pair.xy2
