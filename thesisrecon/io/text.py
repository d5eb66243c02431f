"""Small text files of the user."""

from __future__ import annotations

from pathlib import Path

from thesisrecon.errors import UsageError


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, without the mark some editors begin it with; :class:`UsageError` where it
    cannot be read."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise UsageError(f"{path} is not a UTF-8 text") from None
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}") from None
