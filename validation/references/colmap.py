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

from thesisrecon.errors import StageFailure
from thesisrecon.io._files import write_text
from thesisrecon.records import Reconstruction
from validation.references.colmap_reading import read_colmap_model
from validation.references.libraries import pycolmap

DEFAULT_FOCAL_REL = 1.2


def match_with_pycolmap(
    images: Path, out: Path, *, threads: int = 2, pairs: Path | None = None
) -> dict[str, float]:
    """SIFT and matching of all pairs, or of a list, with their verification; the seconds of both.

    ``images`` is a folder of images, ``out`` a folder that is emptied first and keeps the database and
    the times, ``pairs`` a file with two names of images in each line.
    """
    _begin(out)
    database, seconds, start = out / "database.db", {}, time.perf_counter()

    mode = pycolmap.CameraMode.SINGLE
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    pycolmap.extract_features(
        database, images, camera_mode=mode, extraction_options=extraction, device=pycolmap.Device.cpu
    )
    _guess_focals(database)
    seconds["extract"], start = time.perf_counter() - start, time.perf_counter()

    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    if pairs is None:
        pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    else:
        listed = pycolmap.ImportedPairingOptions(match_list_path=str(pairs))
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=listed, device=pycolmap.Device.cpu
        )
    seconds["match"] = time.perf_counter() - start
    write_text(out / "seconds.json", json.dumps(seconds))
    return seconds


def _begin(out: Path) -> None:
    """Empty the folder and seed COLMAP, which then reports errors only."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value


def _guess_focals(database: Path) -> None:
    """Replace every focal length, including EXIF ones, by a guess."""
    store = pycolmap.Database.open(database)
    for camera in store.read_all_cameras():
        guess = DEFAULT_FOCAL_REL * max(camera.width, camera.height)
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


def map_with_pycolmap(
    images: Path,
    matched: Path,
    out: Path,
    *,
    refine_principal_point: bool = False,
    threads: int = 2,
    mapper: Literal["incremental", "global"] = "incremental",
) -> None:
    """Map the matches of ``match_with_pycolmap`` in ``matched``.

    ``out`` is another folder, emptied first, for :func:`read_run`; the global mapper (GLOMAP) refines what it
    refines by default. Raises :class:`StageFailure` if COLMAP makes no model.
    """
    if not (matched / "seconds.json").is_file():
        raise StageFailure("COLMAP left no matches to start from")
    _begin(out)
    for name in ("database.db", "seconds.json"):
        shutil.copy(matched / name, out / name)
    _map(images, out, refine_principal_point, threads=threads, mapper=mapper)


def read_run(images: Path, out: Path) -> ReferenceRun:
    """Return the mapping in ``out``; :class:`StageFailure` without a model."""
    names = tuple(sorted(path.name for path in images.iterdir() if path.is_file()))
    models = [read_colmap_model(path, names) for path in _model_folders(out)]
    seconds = json.loads((out / "seconds.json").read_text(encoding="utf-8"))
    return ReferenceRun(names, max(models, key=lambda model: model.registered.sum()), seconds)


def _model_folders(out: Path) -> list[Path]:
    folders = sorted(path for path in (out / "sparse").glob("*") if path.is_dir())
    if not folders:
        raise StageFailure("COLMAP made no model of these images")
    return folders


def _map(
    images: Path,
    out: Path,
    refine_principal_point: bool,
    *,
    threads: int,
    mapper: Literal["incremental", "global"],
) -> None:
    """Map the database in ``out``, whose folder "sparse" the models go to, with COLMAP's defaults.

    The models are not read: that is our work, which would count as COLMAP's.
    """
    seconds = json.loads((out / "seconds.json").read_text(encoding="utf-8"))
    pycolmap.set_random_seed(0)
    paths, begun = (out / "database.db", images, out / "sparse"), time.perf_counter()
    if mapper == "global":
        paths[2].mkdir(exist_ok=True)
        pycolmap.global_mapping(*paths, pycolmap.GlobalPipelineOptions(num_threads=threads, random_seed=0))
    else:
        options = pycolmap.IncrementalPipelineOptions(num_threads=threads)
        options.mapper.num_threads = threads
        options.ba_refine_principal_point = refine_principal_point
        pycolmap.incremental_mapping(*paths, options)
    seconds["map"] = time.perf_counter() - begun
    write_text(out / "seconds.json", json.dumps(seconds))
    _model_folders(out)


def reconstruct_with_pycolmap(
    images: Path,
    out: Path,
    *,
    refine_principal_point: bool = False,
    threads: int = 2,
    pairs: Path | None = None,
) -> None:
    """SIFT, matching (of a list of ``pairs``, else of all) and incremental mapping with COLMAP's default
    options, on the CPU.

    ``images`` is a folder of images, ``out`` a folder that is emptied first and keeps the database, the
    models and the times, for :func:`read_run`. Raises ``StageFailure`` if COLMAP makes no model.
    """
    match_with_pycolmap(images, out, threads=threads, pairs=pairs)
    _map(images, out, refine_principal_point, threads=threads, mapper="incremental")


def main() -> None:
    """Run COLMAP once, as a program."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--refine-principal-point", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parsed = parser.parse_args()
    if parsed.out.exists() and any(parsed.out.iterdir()):
        parser.error(f"{parsed.out} is not empty, and would be emptied; choose a new folder")
    refine = parsed.refine_principal_point
    reconstruct_with_pycolmap(
        parsed.images, parsed.out, refine_principal_point=refine, threads=parsed.threads
    )


if __name__ == "__main__":
    main()
