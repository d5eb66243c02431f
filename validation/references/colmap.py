"""COLMAP from images to cameras: ``python -m validation.references.colmap IMAGES OUT``.

SIFT, exhaustive matching and mapping (Schönberger and Frahm, CVPR 2016; Pan et al., ECCV 2024). Prior-free:
EXIF focal lengths are replaced by COLMAP's default, 1.2 times the long side, and refined. Models come back in
our types and pixels.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.io._files import write_text
from thesisrecon.records import Reconstruction
from validation.references.colmap_reading import read_colmap_model
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


@dataclass(frozen=True)
class ReferenceRun:
    """Result of COLMAP: ``names[i]`` is view i of ``reconstruction`` (its largest
    model, in our pixel convention), ``seconds`` of "extract", "match" and "map"."""

    names: tuple[str, ...]
    reconstruction: Reconstruction
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Start:
    """Start of COLMAP: a focal length of ``focal_rel`` long sides, and optionally the principal
    point; or ``K`` (3, 3) by the name of the image, pixels as ours, assumed
    exact (the cameras of the images must be their own then)."""

    refine_principal_point: bool = False
    focal_rel: float = DEFAULT_FOCAL_REL
    K: Mapping[str, F64] | None = None


def map_with_pycolmap(
    images: Path,
    matched: Path,
    out: Path,
    *,
    start: Start | None = None,
    threads: int = 2,
    mapper: Literal["incremental", "global"] = "incremental",
) -> ReferenceRun:
    """Map the matches of ``match_with_pycolmap`` in ``matched`` from ``start``.

    ``out`` is another folder, emptied first; the global mapper (GLOMAP) refines what it refines by default.
    Raises :class:`StageFailure` if COLMAP makes no model.
    """
    start = start or Start()
    pycolmap.set_random_seed(0)
    if not (matched / "seconds.json").is_file():
        raise StageFailure("COLMAP left no matches to start from")
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for name in ("database.db", "seconds.json"):
        shutil.copy(matched / name, out / name)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    options = mapper_options(threads, start.refine_principal_point)
    forget_focal_priors(out / "database.db", start.focal_rel)
    if start.K is not None:
        give_calibration(out / "database.db", start.K)
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
    if mapper == "global":
        return _map_globally(images, out, threads)
    return map_incrementally(images, out, options)


def read_run(images: Path, out: Path) -> ReferenceRun:
    """Return the mapping in ``out``; :class:`StageFailure` without a model."""
    folders = sorted(path for path in (out / "sparse").glob("*") if path.is_dir())
    if not folders:
        raise StageFailure("COLMAP made no model of these images")
    names = tuple(sorted(path.name for path in images.iterdir() if path.is_file()))
    models = [read_colmap_model(path, names) for path in folders]
    seconds = json.loads((out / "seconds.json").read_text(encoding="utf-8"))
    return ReferenceRun(names, max(models, key=lambda model: model.registered.sum()), seconds)


def mapper_options(threads: int, refine_principal_point: bool = False) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's defaults for so many threads, optionally with the principal point."""
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=threads, ba_refine_principal_point=refine_principal_point
    )
    options.mapper.num_threads = threads
    return options


def map_database(
    database: Path, images: Path, out: Path, options: pycolmap.IncrementalPipelineOptions
) -> int:
    """Incremental mapping of a database into folders of models in ``out``; images in the largest."""
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    models = pycolmap.incremental_mapping(database, images, out, options)
    return max((model.num_reg_images() for model in models.values()), default=0)


def map_incrementally(images: Path, out: Path, options: pycolmap.IncrementalPipelineOptions) -> ReferenceRun:
    """Incremental mapping of the database in ``out``, whose folder "sparse" the models go to."""
    seconds = json.loads((out / "seconds.json").read_text(encoding="utf-8"))
    start = time.perf_counter()
    map_database(out / "database.db", images, out / "sparse", options)
    seconds["map"] = time.perf_counter() - start
    write_text(out / "seconds.json", json.dumps(seconds))
    return read_run(images, out)


def _map_globally(images: Path, out: Path, threads: int) -> ReferenceRun:
    seconds = json.loads((out / "seconds.json").read_text(encoding="utf-8"))
    start = time.perf_counter()
    options = pycolmap.GlobalPipelineOptions(num_threads=threads, random_seed=0)
    (out / "sparse").mkdir(exist_ok=True)
    pycolmap.global_mapping(out / "database.db", images, out / "sparse", options)
    seconds["map"] = time.perf_counter() - start
    write_text(out / "seconds.json", json.dumps(seconds))
    return read_run(images, out)


def give_calibration(database: Path, K: Mapping[str, F64]) -> None:
    """Set the true calibration of every camera."""
    store = pycolmap.Database.open(database)
    for image in store.read_all_images():
        camera, known = store.read_camera(image.camera_id), K[image.name]
        camera.model = pycolmap.CameraModelId.PINHOLE
        # COLMAP's pixels have their origin at the corner of the first one.
        camera.params = [known[0, 0], known[1, 1], known[0, 2] + 0.5, known[1, 2] + 0.5]
        camera.has_prior_focal_length = True
        store.update_camera(camera)
    store.close()


def reconstruct_with_pycolmap(
    images: Path,
    out: Path,
    *,
    shared_camera: bool = True,
    refine_principal_point: bool = False,
    threads: int = 2,
) -> ReferenceRun:
    """SIFT, exhaustive matching and incremental mapping with COLMAP's default options, on the CPU.

    ``images`` is a folder of images, ``out`` a folder that is emptied first and keeps the database, the
    models and the times. Raises ``StageFailure`` if COLMAP makes no model.
    """
    match_with_pycolmap(images, out, shared_camera=shared_camera, threads=threads)
    return map_incrementally(images, out, mapper_options(threads, refine_principal_point))


def main() -> None:
    """One run as a process of its own."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--refine-principal-point", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parsed = parser.parse_args()
    refine = parsed.refine_principal_point
    reconstruct_with_pycolmap(
        parsed.images, parsed.out, refine_principal_point=refine, threads=parsed.threads
    )


if __name__ == "__main__":
    main()
