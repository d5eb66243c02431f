"""Errors with advice for the user."""

from __future__ import annotations

import errno
from os import PathLike, fspath

REMEDIES = {
    errno.ENOSPC: "free space there",
    errno.EDQUOT: "free space there, or increase the quota",
    errno.EFBIG: "allow larger files (ulimit -f), or choose a place that takes them",
    errno.EROFS: "make the place writable, or choose another one",
    errno.EACCES: "make the place writable, or choose another one",
    errno.EPERM: "make the place writable, or choose another one",
    errno.EEXIST: "move away the file that stands where a folder belongs",
    errno.ENOTDIR: "move away the file that stands where a folder belongs",
    errno.EISDIR: "move away the folder that stands where a file belongs",
    errno.ENAMETOOLONG: "choose a place with a shorter name",
    errno.EIO: "check the disk, or choose another one",
    errno.ENOENT: "check that the folder still exists",
}
"""Advice for a file that cannot be written."""
WRITE_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors that only writing causes."""


def counted(number: int, noun: str, shown: str = "") -> str:
    """Return a number with its noun, singular or plural.

    Parameters
    ----------
    number : int
    noun : str
        Singular noun.
    shown : str
        Formatted number, if other than ``str(number)``.

    Returns
    -------
    str
        Such as "1 image" or "2 matches".

    Examples
    --------
    >>> counted(1, "image"), counted(2, "match")
    ('1 image', '2 matches')
    """
    ending = "" if number == 1 else "es" if noun.endswith("ch") else "s"
    return f"{shown or number} {noun}{ending}"


class StageFailure(Exception):
    """Data that a stage cannot process (a wrong call is a ``ValueError``); exit code 3 on the command line.

    Parameters
    ----------
    reason : str
        What happened, as one clause ("only 1 image could be read").
    evidence : str
        What was measured, with numbers and units ("at least 2 are needed").
    advice : str
        What to do.

    Examples
    --------
    >>> print(StageFailure("only 1 image could be read", "at least 2 are needed", "add images"))
    only 1 image could be read; at least 2 are needed; add images.
    """

    def __init__(self, reason: str, evidence: str = "", advice: str = "") -> None:
        self.reason = reason
        self.evidence = evidence
        self.advice = advice
        parts = [part.rstrip(".") for part in (reason, evidence, advice) if part]
        super().__init__("; ".join(parts) + ".")

    def __reduce__(self) -> tuple[type[StageFailure], tuple[str, str, str]]:
        return type(self), (self.reason, self.evidence, self.advice)


class UsageError(ValueError):
    """A wrong option, path or setting; exit code 2 on the command line."""


class WorkersLost(UsageError):
    """The workers of a run were killed or cannot be reached; finished work is kept."""


class OutputError(UsageError):
    """A file or folder that cannot be written, for example for a full disk or missing permission.

    Parameters
    ----------
    place : path or str
        File or folder; its old content is unchanged.
    error : OSError
        The cause.
    kept : path
        Run folder to resume from, if any.
    """

    def __init__(self, place: str | PathLike[str], error: OSError, kept: str | PathLike[str] = "") -> None:
        self.place, self.error, self.kept = place, error, kept
        number = error.errno or 0
        reason = error.strerror or str(error)
        sentence = (
            f"{fspath(place)} cannot be written: {reason}; {REMEDIES.get(number, 'choose another place')}"
        )
        if fspath(kept):
            sentence += f", then repeat the command to resume from {fspath(kept)}"
        super().__init__(sentence)

    def __reduce__(
        self,
    ) -> tuple[type[OutputError], tuple[str | PathLike[str], OSError, str | PathLike[str]]]:
        return type(self), (self.place, self.error, self.kept)
