"""Rows on disk: a JSON file each, named by the key of what it was computed from, written whole or not at all.

Any number of processes may add rows; a row that is there is never computed again.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thesisrecon.errors import OutputError
from thesisrecon.io.files import read_json, write_json

ROWS, STEPS, SHARED, WORK = "rows", "steps", "shared", "work"


@dataclass(frozen=True)
class Outcome:
    """What came of a row.

    ``metrics`` are its numbers; ``failure`` is the sentence that says what went wrong, empty where
    nothing did. ``seconds`` is its own wall time, ``cpu_s`` its own processor time; ``steps`` are the keys of
    the shared steps that it took over from others. ``lost``: the process ended before the row did.
    """

    metrics: Mapping[str, float] = field(default_factory=dict)
    failure: str = ""
    seconds: float = 0.0
    cpu_s: float = 0.0
    steps: tuple[str, ...] = ()
    lost: bool = False


@dataclass(frozen=True)
class Store:
    """The folder of a study."""

    path: Path

    def prepare(self) -> None:
        """Make the folder; :class:`OutputError` where it cannot be written."""
        try:
            for name in (ROWS, STEPS, SHARED, WORK):
                (self.path / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the output folder {self.path}", error) from None

    def load(self, key: str, kind: str = ROWS) -> Outcome | None:
        """The outcome kept under this key, None where it is absent or damaged."""
        told = read_json(self.path / kind / f"{key}.json")
        try:
            numbers = {str(name): float(value) for name, value in told["metrics"].items()}
            return Outcome(
                numbers,
                str(told["failure"]),
                float(told["seconds"]),
                float(told["cpu_s"]),
                tuple(told["steps"]),
            )
        except (TypeError, KeyError, ValueError, AttributeError):
            return None

    def save(self, key: str, outcome: Outcome, told: Mapping[str, Any], kind: str = ROWS) -> None:
        """Keep an outcome with what is ``told`` of its row."""
        found = {
            # JSON has no NaN and no infinity: their words are read back as such.
            "metrics": {k: v if math.isfinite(v) else str(v) for k, v in outcome.metrics.items()},
            "failure": outcome.failure,
            "seconds": outcome.seconds,
            "cpu_s": outcome.cpu_s,
            "steps": list(outcome.steps),
        }
        write_json(self.path / kind / f"{key}.json", {**told, **found})


def finite(metrics: Mapping[str, float], wanted: Collection[str]) -> tuple[dict[str, float], str]:
    """The finite numbers among ``metrics``, and a sentence of those that are ``wanted`` and are none."""
    good = {name: float(v) for name, v in metrics.items() if math.isfinite(float(v))}
    missing = [name for name in wanted if name not in metrics]
    broken = [f"{name} is {float(metrics[name])}" for name in wanted if name in metrics and name not in good]
    told = [f"the task tells no {', no '.join(missing)}"] if missing else []
    return good, "; ".join([*broken, *told])
