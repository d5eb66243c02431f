"""COLMAP from images to cameras: ``python -m validation.references.colmap_run IMAGES OUT``."""

from __future__ import annotations

import argparse
from pathlib import Path

from validation.references.colmap_mapping import ReferenceRun, map_incrementally, mapper_options
from validation.references.colmap_matching import match_with_pycolmap


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
    """``python -m validation.references.colmap_run IMAGES OUT``: one run as a process of its own."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--refine-principal-point", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only-matches", action="store_true", help="end before the mapping")
    parsed = parser.parse_args()
    if parsed.only_matches:
        match_with_pycolmap(parsed.images, parsed.out, threads=parsed.threads)
        return
    reconstruct_with_pycolmap(
        parsed.images,
        parsed.out,
        refine_principal_point=parsed.refine_principal_point,
        threads=parsed.threads,
    )


if __name__ == "__main__":
    main()


if __name__ == "__main__":
    main()
