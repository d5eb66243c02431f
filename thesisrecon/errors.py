"""Failures that a person can act on."""

from __future__ import annotations

import errno
from os import PathLike, fspath

MEND = {
    errno.ENOSPC: "make room there",
    errno.EDQUOT: "make room there, or ask for more",
    errno.EFBIG: "allow larger files (ulimit -f), or choose a place that takes them",
    errno.EROFS: "make the place writable, or choose another one",
    errno.EACCES: "make the place writable, or choose another one",
    errno.EPERM: "make the place writable, or choose another one",
    errno.EEXIST: "move away the file that stands where a folder belongs",
    errno.ENOTDIR: "move away the file that stands where a folder belongs",
    errno.EISDIR: "move away the folder that stands where a file belongs",
    errno.ENAMETOOLONG: "choose a place with a shorter name",
    errno.EIO: "see whether the disk is sound, or choose another one",
    errno.ENOENT: "see whether the folder is still there",
}
"""What helps where a file cannot be written."""
DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors that only writing can end in."""


def counted(number: int, noun: str, shown: str = "") -> str:
    """``1 photograph``, ``2 photographs``, ``2 matches``; the number is ``shown`` as that says."""
    ending = "" if number == 1 else "es" if noun.endswith("ch") else "s"
    return f"{shown or number} {noun}{ending}"


class StageFailure(Exception):
    """Data that a stage cannot work with: what was found, what it needs, what to try.

    A wrong *call* is a ``ValueError``; data that cannot be reconstructed is this. The command line
    prints the text and ends with exit code 3.

    Parameters
    ----------
    reason : what is wrong, as one clause ("only 1 photograph could be read").
    evidence : what was measured, with numbers and units ("needed at least 2").
    advice : what the user can do.
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
    """A wrong wish of the user (an option, a path, a config key); exit code 2 on the command line."""


class WorkersLost(UsageError):
    """The workers of a run are gone: killed, or no longer reached. What was done is kept."""


class OutputError(UsageError):
    """A ``place`` that cannot be written as ``error`` tells: its disk is full, or it is not for us to write.

    What stood there before is still there. With ``kept``, the folder of a run, the sentence says how the run
    goes on.
    """

    def __init__(self, place: str | PathLike[str], error: OSError, kept: str | PathLike[str] = "") -> None:
        self.place, self.error, self.kept = place, error, kept
        number = error.errno or 0
        reason = error.strerror or str(error)
        sentence = f"{fspath(place)} cannot be written: {reason}; {MEND.get(number, 'choose another place')}"
        if fspath(kept):
            sentence += f", then the same command goes on from what is kept in {fspath(kept)}"
        super().__init__(sentence)

    def __reduce__(
        self,
    ) -> tuple[type[OutputError], tuple[str | PathLike[str], OSError, str | PathLike[str]]]:
        return type(self), (self.place, self.error, self.kept)
