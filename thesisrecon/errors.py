"""Errors with advice for the user, and the words of messages."""

from __future__ import annotations

import difflib
import errno
import tomllib
from collections.abc import Callable, Iterable
from functools import cache
from os import PathLike, environ, fspath
from pathlib import Path
from typing import Any, TypeVar

WRITE_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # Errors that only writing causes
NOT_MADE = "output-not-made"
"""Code of the warning about a figure, page or file that could not be made; the result is complete without."""
STRICT_VARIABLE = "THESISRECON_STRICT"
"""Environment variable that makes these warnings errors, as in the tests of this package."""
T = TypeVar("T")


def counted(number: int, noun: str, shown: str = "") -> str:
    """Return a number with its noun, such as "1 image" or "2 matches"; ``shown``: the formatted number."""
    ending = "" if number == 1 else "es" if noun.endswith("ch") else "s"
    return f"{shown or number} {noun}{ending}"


def require_range(method: object, **intervals: str) -> None:
    """Raise ``ValueError`` if a setting of a method is outside its interval, as "[1, inf)" or "(0, 1)"."""
    for name, interval in intervals.items():
        value, (low, high) = getattr(method, name), map(float, interval[1:-1].split(","))
        # Comparisons with NaN are false.
        if low < value < high or (value == low and "[" in interval) or (value == high and "]" in interval):
            continue
        rule = f"lie between {low:g} and {high:g}"
        if high == float("inf"):
            rule = f"be at least {low:g}" if "[" in interval else "be positive"
        raise ValueError(f"{name} must {rule}; got {value}")


def in_words(value: Any) -> str:
    """Return the ``repr`` of a value for a message, shortened."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        # Python refuses to print numbers of thousands of digits and infinite nesting.
        text = f"{type(value).__name__} too large to print"
    return shortened(text, 120)


def shortened(text: str, longest: int = 60) -> str:
    """Cut the end of a long text."""
    return text if len(text) <= longest else text[: longest - 3] + "..."


def unknown_word(what: str, word: Any, known: Iterable[str]) -> str:
    """Return a message about an unknown word of a kind with the nearest known ones, or all."""
    known = list(known)
    near = difflib.get_close_matches(word, known, n=3, cutoff=0.6) if isinstance(word, str) else []
    hint = f"did you mean {' or '.join(near)}?" if near else f"known are {', '.join(known)}"
    return f"unknown {what} {in_words(word)}; {hint}"


def require_word(what: str, word: Any, known: Iterable[str]) -> str:
    """Return a known word; UsageError of :func:`unknown_word` for anything else."""
    if not isinstance(word, str) or word not in known:
        raise UsageError(unknown_word(what, word, known))
    return word


class Notice(str):
    """Text of the key ``code`` of ``messages.toml``, which states cause and remedy too, with its values."""

    code: str

    def __new__(cls, code: str, *values: object) -> Notice:
        return cls.of(code, _entries()[code][0].format(*values))

    @classmethod
    def of(cls, code: str, text: str) -> Notice:
        """Return a text as the message of a code."""
        notice = super().__new__(cls, text)
        notice.code = code
        return notice

    def __reduce__(self) -> tuple[Callable[[str, str], Notice], tuple[str, str]]:
        return Notice.of, (self.code, str(self))


@cache
def _entries() -> dict[str, list[str]]:
    """Texts of each code; "{}" stands for a value."""
    tables = tomllib.loads(Path(__file__).with_name("messages.toml").read_text(encoding="utf-8"))
    entries = {code: entry for table in tables.values() for code, entry in table.items()}
    return {code: [entry] if isinstance(entry, str) else entry for code, entry in entries.items()}


def remedies() -> dict[int, str]:
    """Advice for a file that cannot be written by the number of the error."""
    return {number: _entries()[name][0] for number, name in errno.errorcode.items() if name in _entries()}


class StageFailure(Exception):
    """Data that a stage cannot process (a wrong call is a ``ValueError``); exit code 3 on the command line.

    Parameters
    ----------
    reason, evidence, advice : str
        What happened, what was measured (with numbers and units), and what to do, as clauses. A reason of
        ``messages.toml`` is a ``Notice``.

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

    @classmethod
    def of(cls, code: str, *values: object) -> StageFailure:
        """Return the failure of a code of ``messages.toml``.

        Parameters
        ----------
        code, *values : str, object
            Key of reason, evidence and advice, and the values of their texts.

        Returns
        -------
        StageFailure
        """
        reason, *others = (text.format(*values) for text in _entries()[code])
        return cls(Notice.of(code, reason), *others)

    def __reduce__(self) -> tuple[type[StageFailure], tuple[str, str, str]]:
        return type(self), (self.reason, self.evidence, self.advice)


class UsageError(ValueError):
    """A wrong option, path or setting; exit code 2 on the command line.

    Examples
    --------
    >>> from thesisrecon import reconstruct
    >>> reconstruct("images", "out", preset="best")
    Traceback (most recent call last):
    thesisrecon.errors.UsageError: unknown preset 'best'; known are default, thesis
    """


class WorkersLost(UsageError):
    """The workers of a run were killed or cannot be reached; finished work is kept."""

    task: int | None = None  #: number of the task on which they died


class OutputError(UsageError):
    """A file or folder, whose old content is unchanged, cannot be written; ``kept``: run to resume from."""

    def __init__(self, place: str | PathLike[str], error: OSError, kept: str | PathLike[str] = "") -> None:
        self.place, self.error, self.kept = place, error, kept
        remedy = remedies().get(error.errno or 0, "choose another place")
        sentence = f"{fspath(place)} cannot be written: {error.strerror or error}; {remedy}"
        if fspath(kept):
            sentence += f", then repeat the command to resume from {fspath(kept)}"
        super().__init__(sentence)

    def __reduce__(self) -> tuple[type[OutputError], tuple[Any, ...]]:
        return type(self), (self.place, self.error, self.kept)


def made(what: str, make: Callable[[], T], warnings: list[str], otherwise: T) -> T:
    """Make the output ``what``; an error costs a warning, not the result, which is then ``otherwise``.

    The warning has the code ``output-not-made``; one is enough for outputs of the same name. A
    ``UsageError``, if another program changed files of the folder in the meantime, is raised.
    """
    try:
        return make()
    except Exception as error:
        refused = isinstance(error, UsageError) and not isinstance(error, OutputError)
        if refused or environ.get(STRICT_VARIABLE):
            raise
        said = " ".join(str(error).split())
        reason = said if isinstance(error, OutputError) else f"{type(error).__name__}: {said}".rstrip(": ")
        text = Notice("output-not-made", what, reason)
        if not any(known.split(" (")[0] == text.split(" (")[0] for known in warnings):
            warnings.append(text)
        return otherwise
