"""Small files of the user as text, and text that is safe to show.

Files that appear under their name when they are whole: every file of this project is written here.

Whoever ends the program in between, in whatever way, leaves the old file or the new one.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import stat
import unicodedata
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from thesisrecon.errors import OutputError, UsageError

LARGEST_TEXT = 2**26
"""Bytes of the largest text that is read: far above any list of pairs, and far below what fills a memory."""

NO_FILE = "a pipe, a device or a socket"
"""What has a name like a file and is none."""

_CONTROLS = ("Cc", "Zl", "Zp")
"""Unicode's categories of control characters and of what ends lines and paragraphs."""
_TURNS = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""Marks that turn the direction of whatever is written after them."""


def printable(name: str) -> str:
    """A file name as text that can be shown anywhere, in one line and in its own order: bytes that are no
    UTF-8, line ends, other control characters and turns of the direction become their codes.
    """
    text = name.encode("utf-8", "surrogateescape" if _from_bytes(name) else "backslashreplace")
    return "".join(_shown(c) for c in text.decode("utf-8", "backslashreplace"))


def _from_bytes(name: str) -> bool:
    """Whether the halves of characters in a text are bytes of a file name, if there are any."""
    return all("\udc80" <= c <= "\udcff" for c in name if "\ud800" <= c <= "\udfff")


def _shown(c: str) -> str:
    if unicodedata.category(c) not in _CONTROLS and c not in _TURNS:
        return c
    return f"\\x{ord(c):02x}" if ord(c) < 256 else f"\\u{ord(c):04x}"


def shortened(text: str, longest: int = 60) -> str:
    """The text, or its beginning where it is long."""
    return text if len(text) <= longest else text[: longest - 3] + "..."


def without_middle(text: str, longest: int = 600) -> str:
    """The text, or where it is long its beginning and its end, which often tells the rule."""
    if len(text) <= longest:
        return text
    return f"{text[: longest - longest // 4 - 5]} ... {text[-(longest // 4) :]}"


def read_bytes(path: Path, *, largest: int = LARGEST_TEXT) -> bytes:
    """The content of a regular file of at most ``largest`` bytes.

    Nothing else is waited for: a pipe may never speak and a device never end. Raises ``OSError`` whose
    ``strerror`` says why not.
    """
    found = path.stat()
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
        raise OSError(0, f"it is {NO_FILE}, not a file", str(path))
    if found.st_size > largest:
        raise OSError(0, f"it is larger than {largest / 2**20:.0f} MiB", str(path))
    with path.open("rb") as file:
        # Files of the system claim no size, and some of them have no end.
        return file.read(found.st_size or largest)


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, without the mark some editors begin it with; :class:`UsageError` where it
    cannot be read."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UsageError(f"{path} is not a UTF-8 text") from None
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}") from None


_PARTIAL = ".partial"


def is_partial(name: str) -> bool:
    """Whether a file of this name is what a kill left of one that was being written."""
    return name.startswith(".") and name.endswith(_PARTIAL)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, and on the disk when this returns; its folder is made where absent.

    Raises :class:`OutputError` where the place cannot be written; what stood there before stays.
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
        raise OutputError(path, error) from None


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
    # NumPy takes long to import: `thesisrecon --help` does without.
    if hasattr(value, "tolist"):
        return _finite(value.tolist())
    raise TypeError(f"{type(value).__name__} is not JSON")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_json(path: Path) -> Any:
    """The content of a JSON file, None where it is absent, damaged, no regular file or too large."""
    try:
        return json.loads(read_bytes(path).decode("utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def link(source: Path, target: Path) -> None:
    """The file under a second name, whole or not at all: files are only ever replaced, never changed.

    Raises :class:`OutputError` where the place cannot be written.
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
        raise OutputError(target, error) from None
    finally:
        # Renaming one name of a file to another name of it does nothing at all.
        with suppress(OSError):
            partial.unlink()
