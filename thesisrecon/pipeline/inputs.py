"""What a run begins with: the photographs, whether the wishes fit them, and what makes two runs the same."""

from __future__ import annotations

from typing import Any

from thesisrecon.config import tables_from_config
from thesisrecon.errors import UsageError
from thesisrecon.intrinsics import camera_numbers, check_sizes, prior_warnings
from thesisrecon.io.images import ImageSet, ImageSource, read_images
from thesisrecon.records import RunResult
from thesisrecon.runtime.run import Run


def read_set(run: Run, images: ImageSource) -> ImageSet:
    with run.clock("images"):
        size = run.config.images.max_size_px
        photographs = read_images(images, max_size_px=size, map_all=run.workers.map_all)
    found, refused = len(photographs.decoded), len(photographs.refused)
    if found + refused == 0:
        raise UsageError("no images")
    check_sizes(run.config.intrinsics, [image.original_size for image in photographs.images])
    notes = [f"{p.image.name}: {p.note}" for p in photographs.decoded if p.note]
    refusals = [f"{name} is left out: it {reason}" for name, reason in photographs.refused.items()]
    warnings = [*notes, *refusals, *prior_warnings(run.config.intrinsics, photographs.exif_focal_px)]
    run.finish("images", counts={"read": found, "refused": refused}, warnings=warnings)
    return photographs


def check_pairs(run: Run, photographs: ImageSet, until: str) -> None:
    """Refuse a choice of pairs that does not fit, before the folder becomes that of this run: a list that is
    mended must find it as it was."""
    if until != "features" and len(photographs.images) >= 2:
        run.config.pairs.check([image.name for image in photographs.images], photographs.refused)


def wishes(run: Run) -> dict[str, Any]:
    """What of a run's identity is known before its photographs are read."""
    return {"version": 1, "seed": run.seed, "settings": tables_from_config(run.config)}


def identity(run: Run, photographs: ImageSet) -> dict[str, Any]:
    """What makes two runs the same: settings, seed and the content of the photographs."""
    digests = {p.image.name: p.digest for p in photographs.decoded}
    refused = {name: f"refused: {reason}" for name, reason in photographs.refused.items()}
    return wishes(run) | {"photographs": digests | refused}


def empty_result(run: Run, photographs: ImageSet) -> RunResult:
    sizes = [image.original_size for image in photographs.images]
    groups = camera_numbers(sizes, run.config.intrinsics, photographs.exif_focal_px)
    return RunResult(
        out=run.directory.path,
        images=photographs.images,
        refused=photographs.refused,
        features=(),
        pairs=(),
        groups=groups,
        settings=tables_from_config(run.config),
    )
