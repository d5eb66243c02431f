"""View interpolation beside the truth.

Image 5 of fountain-P11 from 4 and 6, as it is, rotated onto the true camera, and by the best homography.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from thesisrecon import match_pair
from thesisrecon.api.views import prepare_pair
from thesisrecon.arrays import B8, F64, U8
from thesisrecon.geometry._homography import homography_linear, homography_residuals
from thesisrecon.geometry.camera_matrix import camera_centre, camera_from_centre, decompose_camera
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.records import Image
from thesisrecon.views._warping import sample
from thesisrecon.views.interpolation import InterpolatedPair, original_from_rectified
from validation.metrics.pictures import picture_metrics, psnr_db
from validation.scenes.image_files import read_rgb
from validation.scenes.nine_views import dissolved
from validation.studies.runner import Part, Rows, load_scene
from validation.studies.tensor_views import save_beside


def camera_between(pair: InterpolatedPair, P: tuple[F64, F64], s: float) -> F64:
    """The camera (3, 4) that the view at s is of, given those of the images.

    In the rectified frame both have their rows and depths in common up to a scale, so that the interpolated
    place of every point is its image in (1 - s) P_0 + s P_1 (Seitz and Dyer).
    """
    first, second = (H @ camera for H, camera in zip(pair.H, P, strict=True))
    # Equal up to the errors of F.
    scale = float(np.sum(first[1:] * second[1:]) / np.sum(second[1:] ** 2))
    P_s = (1.0 - s) * first + s * scale * second
    return np.asarray(original_from_rectified(pair.H, pair.size, s) @ P_s)


def camera_centre_of(pair: InterpolatedPair, P: tuple[F64, F64], s: float) -> F64:
    """(3,) where the view at s is taken from."""
    C = camera_centre(camera_between(pair, P, s))
    return np.asarray(C[:3] / C[3])


def nearest_place(pair: InterpolatedPair, P: tuple[F64, F64], C: F64) -> float:
    """The s, to a hundredth, whose camera is nearest to C (3,)."""
    places = np.linspace(0.0, 1.0, 101)
    return float(places[np.argmin([np.linalg.norm(camera_centre_of(pair, P, s) - C) for s in places])])


def best_homography(xy1: F64, xy2: F64) -> F64:
    """Least squares over the nine tenths of the points that fit best."""
    kept = np.ones(len(xy1), dtype=bool)
    H = homography_linear(xy1, xy2)
    for _ in range(3):
        off = homography_residuals(H, xy1, xy2)
        kept = off <= np.quantile(off, 0.9)
        H = homography_linear(xy1[kept], xy2[kept])
    return H


def turned(picture: U8, H: F64) -> tuple[U8, B8]:
    """The image through H (3, 3), black outside, and where it has pixels."""
    height, width = picture.shape[:2]
    y, x = np.indices((height, width), dtype=np.float64)
    source = dehomogenize(np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(H).T)
    rgb = sample(picture.astype(np.float32), source.astype(np.float32), threads=2)
    kept = np.isfinite(rgb[..., 0])
    return np.clip(np.rint(np.nan_to_num(rgb)), 0, 255).astype(np.uint8), kept


def interpolation_study(out: Path) -> Iterator[Part]:
    """Compare an interpolated view of fountain-P11 with the true image, which OUT gets beside it."""
    scene = load_scene("fountain-P11")
    if scene is None:
        return
    K, R, C = scene.cameras
    first, wanted, second = (Image(str(k), read_rgb(scene.image_paths[k]), (0, 0)) for k in (4, 5, 6))
    pair = prepare_pair(first, second)
    P4, P6 = (camera_from_centre(K[k], R[k], C[k]) for k in (4, 6))
    s = nearest_place(pair, (P4, P6), C[5])
    view, (width, height) = pair.view(s, threads=2), pair.size
    K_s, R_s, _ = decompose_camera(camera_between(pair, (P4, P6), s))
    # The infinite homography: it relates the images of two cameras at one place.
    infinite = np.linalg.inv(K_s @ R_s @ (R[5].T @ np.linalg.inv(K[5])))
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
    off = np.linalg.norm(camera_centre_of(pair, (P4, P6), s) - C[5]) / np.linalg.norm(C[6] - C[4])
    rows = Rows(metrics[0].scene, "turned best")
    rows.add("PSNR of the inner nine sixteenths", values, "dB")
    rows.add("camera 5 off the baseline", {"as it is": float(off)}, "baselines")
    rows.add("s", {"as it is": s})
    yield [*metrics, *rows]


def _matches(first: U8, second: U8) -> tuple[F64, F64]:
    pair = match_pair(first, second)
    return pair.xy1, pair.xy2
