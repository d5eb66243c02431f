"""Small files of the user as text, and text that is safe to show."""

from __future__ import annotations

import stat
import unicodedata
from pathlib import Path

from thesisrecon.errors import UsageError

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
