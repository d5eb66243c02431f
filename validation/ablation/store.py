"""Store rows on disk, one JSON file each, named by the key of its inputs and written atomically.

Any number of processes may add rows; a stored row is never recomputed.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thesisrecon.errors import OutputError
from thesisrecon.io._files import read_json, write_json

ROWS, STEPS, SHARED, WORK = "rows", "steps", "shared", "work"


@dataclass(frozen=True)
class Outcome:
    """Result of a row.

    ``metrics`` are its numbers; ``failure`` is the error message or empty. ``seconds`` is its wall time,
    ``cpu_s`` its processor time; ``steps`` are the keys of reused shared steps. ``lost``: the process ended
    before the row.
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
        """Create the folder; :class:`OutputError` if it cannot be written."""
        try:
            for name in (ROWS, STEPS, SHARED, WORK):
                (self.path / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the output folder {self.path}", error) from None

    def load(self, key: str, kind: str = ROWS) -> Outcome | None:
        """Return the outcome of this key, or None if absent or damaged."""
        record = read_json(self.path / kind / f"{key}.json")
        try:
            numbers = {str(name): float(value) for name, value in record["metrics"].items()}
            return Outcome(
                numbers,
                str(record["failure"]),
                float(record["seconds"]),
                float(record["cpu_s"]),
                tuple(record["steps"]),
            )
        except (TypeError, KeyError, ValueError, AttributeError):
            return None

    def save(self, key: str, outcome: Outcome, record: Mapping[str, Any], kind: str = ROWS) -> None:
        """Store an outcome with the ``record`` of its row."""
        found = {
            # JSON has no NaN and no infinity; store them as words.
            "metrics": {k: v if math.isfinite(v) else str(v) for k, v in outcome.metrics.items()},
            "failure": outcome.failure,
            "seconds": outcome.seconds,
            "cpu_s": outcome.cpu_s,
            "steps": list(outcome.steps),
        }
        write_json(self.path / kind / f"{key}.json", {**record, **found}, cached=True)


def finite(metrics: Mapping[str, float], wanted: Collection[str]) -> tuple[dict[str, float], str]:
    """Return the finite numbers of ``metrics`` and a message about missing ``wanted`` ones."""
    good = {name: float(v) for name, v in metrics.items() if math.isfinite(float(v))}
    missing = [name for name in wanted if name not in metrics]
    broken = [f"{name} is {float(metrics[name])}" for name in wanted if name in metrics and name not in good]
    absent = [f"the task returned no {', no '.join(missing)}"] if missing else []
    return good, "; ".join([*broken, *absent])
