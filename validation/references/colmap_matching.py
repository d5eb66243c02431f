"""COLMAP's SIFT and exhaustive matching through pycolmap, into a database.

Prior-free: EXIF focal lengths are replaced by COLMAP's default, 1.2 times the long side, and refined.
"""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

from thesisrecon.io._files import write_text
from validation.references.libraries import pycolmap

DEFAULT_FOCAL_REL = 1.2


def match_with_pycolmap(
    images: Path, out: Path, *, shared_camera: bool = True, threads: int = 2
) -> dict[str, float]:
    """SIFT and exhaustive matching of all pairs with their verification; the seconds of both.

    ``images`` is a folder of images, ``out`` a folder that is emptied first and keeps the database and
    the times.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    database, seconds, start = out / "database.db", {}, time.perf_counter()

    mode = pycolmap.CameraMode.SINGLE if shared_camera else pycolmap.CameraMode.PER_IMAGE
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    pycolmap.extract_features(
        database, images, camera_mode=mode, extraction_options=extraction, device=pycolmap.Device.cpu
    )
    forget_focal_priors(database)
    seconds["extract"], start = time.perf_counter() - start, time.perf_counter()

    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    seconds["match"] = time.perf_counter() - start
    write_text(out / "seconds.json", json.dumps(seconds))
    return seconds


def forget_focal_priors(database: Path, focal_rel: float = DEFAULT_FOCAL_REL) -> None:
    """Replace every focal length, including EXIF ones, by a guess."""
    store = pycolmap.Database.open(database)
    for camera in store.read_all_cameras():
        guess = focal_rel * max(camera.width, camera.height)
        camera.params = [guess, *camera.params[1:]]
        camera.has_prior_focal_length = False
        store.update_camera(camera)
    store.close()
