"""Files that appear under their name when they are whole: every file of this project is written here.

Whoever ends the program in between, in whatever way, leaves the old file or the new one.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.errors import Unwritable
from thesisrecon.io.text import read_bytes

_PARTIAL = ".partial"


def is_partial(name: str) -> bool:
    """Whether a file of this name is what a kill left of one that was being written."""
    return name.startswith(".") and name.endswith(_PARTIAL)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, and on the disk when this returns; its folder is made where absent.

    Raises :class:`Unwritable` where the place cannot be written; what stood there before stays.
    """
    partial = path.with_name(f".{path.name}{_PARTIAL}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # What stands there may be a link to something else, which must not be written over.
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise Unwritable(path, error) from None


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8; what cannot be told in it (half a character of a file name) becomes a question
    mark."""
    write_atomically(path, text.encode("utf-8", "replace"))


def write_json(path: Path, value: Any) -> None:
    """Write JSON for people and machines; NaN and infinity become null."""
    write_text(path, json.dumps(_finite(value), indent=2, ensure_ascii=False, default=_number) + "\n")


def as_read(value: Any) -> Any:
    """What :func:`read_json` finds where this was written."""
    return json.loads(json.dumps(_finite(value), default=_number))


def _number(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _finite(value.tolist())
    if isinstance(value, np.generic):
        return _finite(value.item())
    raise TypeError(f"{type(value).__name__} is not JSON")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def read_json(path: Path) -> Any:
    """The content of a JSON file, None where it is absent, damaged, no regular file or too large."""
    try:
        return json.loads(read_bytes(path).decode("utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def link(source: Path, target: Path) -> None:
    """The file under a second name, whole or not at all: files are only ever replaced, never changed.

    Raises :class:`Unwritable` where the place cannot be written.
    """
    # Several programs may give a file the same name in a shared folder at one time.
    partial = target.with_name(f".{target.name}.{os.getpid()}{_PARTIAL}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial.unlink(missing_ok=True)
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)
        partial.replace(target)
    except OSError as error:
        raise Unwritable(target, error) from None
    finally:
        # Renaming one name of a file to another name of it does nothing at all.
        with suppress(OSError):
            partial.unlink()
