"""Failures that a person can act on."""

from __future__ import annotations


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
