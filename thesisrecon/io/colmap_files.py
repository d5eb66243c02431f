"""Reading and writing the files of a COLMAP sparse model, binary and text.

A folder holds cameras, images and points3D; since COLMAP 3.12 also rigs and frames, which say which images
were taken together. Here every image is taken alone: on writing each camera is its own rig and each image its
own frame, as COLMAP itself does with the older folders; on reading rigs and frames are left alone, because
the images carry their whole poses. Numbers in text have 17 significant digits, so both forms keep every bit.
"""

from __future__ import annotations

from pathlib import Path

from thesisrecon.errors import StageFailure
from thesisrecon.io import colmap_binary, colmap_text
from thesisrecon.io.colmap_model import ColmapModel, broken_file, inconsistency
from thesisrecon.io.files import write_atomically

_NEEDED = ("cameras", "images", "points3D")


def write_colmap_model(path: Path, model: ColmapModel, *, binary: bool = True) -> None:
    """Write ``model`` into the folder ``path`` (made where absent), as .bin or .txt files.

    Each file appears whole or not at all. The same model always gives the same bytes. Raises ``ValueError``
    for a model that breaks a rule of :func:`~thesisrecon.io.colmap_model.inconsistency`, and in text for
    names with blanks, which COLMAP's text reader cuts off; :class:`~thesisrecon.errors.OutputError` where the
    folder cannot be written.
    """
    problem = inconsistency(model)
    if problem:
        raise ValueError(f"write_colmap_model needs a consistent model; {problem}")
    if not binary and any(
        len(image.name.split()) > 1 or image.name != image.name.strip() for image in model.images
    ):
        raise ValueError("a name with blanks cannot be written as COLMAP text; write binary")
    encoders = colmap_binary.ENCODERS if binary else colmap_text.ENCODERS
    for name, encode in encoders.items():
        write_atomically(path / f"{name}{'.bin' if binary else '.txt'}", encode(model))


def read_colmap_model(path: Path) -> ColmapModel:
    """Read the COLMAP model in the folder ``path``; binary files win where both forms stand there.

    Works for folders with and without rigs and frames. Raises :class:`StageFailure` with the file and the
    reason where files are missing, cut short, hold impossible counts, numbers that are not finite, or
    references to what does not exist. Memory stays within a small multiple of the files' size, whatever
    counts they claim.
    """
    suffix = _suffix(path)
    files = [path / f"{name}{suffix}" for name in _NEEDED]
    cameras, images, points = ((_content(file), file) for file in files)
    form = colmap_binary if suffix == ".bin" else colmap_text
    model = ColmapModel(form.read_cameras(*cameras), form.read_images(*images), form.read_points(*points))
    problem = inconsistency(model)
    if problem:
        raise broken_file(path, problem)
    return model


def _suffix(path: Path) -> str:
    for suffix in (".bin", ".txt"):
        if all((path / f"{name}{suffix}").is_file() for name in _NEEDED):
            return suffix
    raise StageFailure(
        f"{path} holds no COLMAP model",
        "cameras, images and points3D are needed, all .bin or all .txt",
        "give the folder that holds these files, often called sparse/0",
    )


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise broken_file(path, error.strerror or "it cannot be read") from error
    except MemoryError:
        raise broken_file(path, "it does not fit in memory") from None
