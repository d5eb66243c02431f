"""COLMAP's incremental reconstruction (Schönberger and Frahm, CVPR 2016) through pycolmap, in our types.

Prior-free: the focal length in a photograph's EXIF is forgotten and COLMAP's default guess, 1.2 times the
long side, takes its place, to be refined freely.
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

from thesisrecon.errors import StageFailure
from thesisrecon.io.colmap import read_colmap_model, reconstruction_from_colmap
from thesisrecon.types import F64, Reconstruction
from validation.references.libraries import pycolmap

_DEFAULT_FOCAL_REL = 1.2


@dataclass(frozen=True)
class ReferenceRun:
    """What COLMAP made of a folder of photographs: ``names[i]`` is view i of ``reconstruction`` (its largest
    model, in our pixel convention), ``seconds`` of "extract", "match" and "map"."""

    names: tuple[str, ...]
    reconstruction: Reconstruction
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Start:
    """What COLMAP starts from and refines: a focal length of ``focal_rel`` long sides, and the principal
    point only where that is wished; or ``K`` (3, 3) by the name of the photograph, pixels as ours, taken for
    exact (the cameras of the photographs must be their own then)."""

    refine_principal_point: bool = False
    focal_rel: float = _DEFAULT_FOCAL_REL
    K: Mapping[str, F64] | None = None


def match_with_pycolmap(
    images: Path, out: Path, *, shared_camera: bool = True, threads: int = 2
) -> dict[str, float]:
    """SIFT and exhaustive matching of all pairs with their verification; the seconds of both.

    ``images`` is a folder of photographs, ``out`` a folder that is emptied first and keeps the database and
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
    _forget_focal_priors(database)
    seconds["extract"], start = time.perf_counter() - start, time.perf_counter()

    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    seconds["match"] = time.perf_counter() - start
    (out / "seconds.json").write_text(json.dumps(seconds), encoding="utf-8")
    return seconds


def reconstruct_with_pycolmap(
    images: Path,
    out: Path,
    *,
    shared_camera: bool = True,
    refine_principal_point: bool = False,
    threads: int = 2,
) -> ReferenceRun:
    """SIFT, exhaustive matching and incremental mapping with COLMAP's default options, on the CPU.

    ``images`` is a folder of photographs, ``out`` a folder that is emptied first and keeps the database, the
    models and the times. Raises :class:`StageFailure` where COLMAP makes no model.
    """
    match_with_pycolmap(images, out, shared_camera=shared_camera, threads=threads)
    return _map(images, out, _options(threads, refine_principal_point))


def map_with_pycolmap(
    images: Path,
    matched: Path,
    out: Path,
    *,
    start: Start | None = None,
    threads: int = 2,
    mapper: Literal["incremental", "global"] = "incremental",
) -> ReferenceRun:
    """Mapping of what :func:`match_with_pycolmap` left in ``matched``, as ``start`` has it.

    ``out`` is another folder, emptied first; the global mapper (GLOMAP) refines what it refines by default.
    Raises :class:`StageFailure` where COLMAP makes no model.
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
    options = _options(threads, start.refine_principal_point)
    _forget_focal_priors(out / "database.db", start.focal_rel)
    if start.K is not None:
        _give_calibration(out / "database.db", start.K)
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
    if mapper == "global":
        return _map_globally(images, out, threads)
    return _map(images, out, options)


def _options(threads: int, refine_principal_point: bool) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=threads, ba_refine_principal_point=refine_principal_point
    )
    options.mapper.num_threads = threads
    return options


def _map(images: Path, out: Path, options: pycolmap.IncrementalPipelineOptions) -> ReferenceRun:
    seconds = json.loads((out / "seconds.json").read_text(encoding="utf-8"))
    start = time.perf_counter()
    pycolmap.incremental_mapping(out / "database.db", images, out / "sparse", options)
    seconds["map"] = time.perf_counter() - start
    (out / "seconds.json").write_text(json.dumps(seconds), encoding="utf-8")
    return read_run(images, out)


def _map_globally(images: Path, out: Path, threads: int) -> ReferenceRun:
    seconds = json.loads((out / "seconds.json").read_text(encoding="utf-8"))
    start = time.perf_counter()
    options = pycolmap.GlobalPipelineOptions(num_threads=threads, random_seed=0)
    (out / "sparse").mkdir(exist_ok=True)
    pycolmap.global_mapping(out / "database.db", images, out / "sparse", options)
    seconds["map"] = time.perf_counter() - start
    (out / "seconds.json").write_text(json.dumps(seconds), encoding="utf-8")
    return read_run(images, out)


def read_run(images: Path, out: Path) -> ReferenceRun:
    """What :func:`reconstruct_with_pycolmap` left in ``out``; :class:`StageFailure` without a model."""
    folders = sorted(path for path in (out / "sparse").glob("*") if path.is_dir())
    if not folders:
        raise StageFailure("COLMAP made no model of these photographs")
    largest = max((read_colmap_model(path) for path in folders), key=lambda model: len(model.images))
    names = tuple(sorted(path.name for path in images.iterdir() if path.is_file()))
    seconds = json.loads((out / "seconds.json").read_text(encoding="utf-8"))
    return ReferenceRun(names, reconstruction_from_colmap(largest, names=names), seconds)


def _forget_focal_priors(database: Path, focal_rel: float = _DEFAULT_FOCAL_REL) -> None:
    """Put a guess in the place of every focal length, also of those that came from EXIF."""
    store = pycolmap.Database.open(database)
    for camera in store.read_all_cameras():
        guess = focal_rel * max(camera.width, camera.height)
        camera.params = [guess, *camera.params[1:]]
        camera.has_prior_focal_length = False
        store.update_camera(camera)
    store.close()


def _give_calibration(database: Path, K: Mapping[str, F64]) -> None:
    """Put the true calibration in the place of every camera."""
    store = pycolmap.Database.open(database)
    for image in store.read_all_images():
        camera, known = store.read_camera(image.camera_id), K[image.name]
        camera.model = pycolmap.CameraModelId.PINHOLE
        # COLMAP's pixels have their origin at the corner of the first one.
        camera.params = [known[0, 0], known[1, 1], known[0, 2] + 0.5, known[1, 2] + 0.5]
        camera.has_prior_focal_length = True
        store.update_camera(camera)
    store.close()


def main() -> None:
    """``python -m validation.references.pycolmap_reference IMAGES OUT``: one run as a process of its own."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--refine-principal-point", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only-matches", action="store_true", help="end before the mapping")
    wishes = parser.parse_args()
    if wishes.only_matches:
        match_with_pycolmap(wishes.images, wishes.out, threads=wishes.threads)
        return
    reconstruct_with_pycolmap(
        wishes.images,
        wishes.out,
        refine_principal_point=wishes.refine_principal_point,
        threads=wishes.threads,
    )


if __name__ == "__main__":
    main()
