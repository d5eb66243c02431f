"""Read ``gates.toml``: limits with their reasons, and check numbers against them."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

GATES_FILE = Path(__file__).resolve().parents[1] / "gates.toml"


@dataclass(frozen=True)
class Gate:
    """``key`` of the number ("stage/scene/name"), ``limit``, its direction and the ``reason``."""

    key: str
    limit: float
    at_most: bool
    reason: str

    def holds(self, value: float | None) -> bool:
        """Return whether a number meets the limit; a missing number does not."""
        if value is None or value != value:
            return False
        return value <= self.limit if self.at_most else value >= self.limit


def camera_limit(scene: str, name: str) -> float | None:
    """Return the limit of a number of the stage "cameras", None where nothing is promised."""
    gate = _shipped_gates().get(f"cameras/{scene}/{name}")
    return None if gate is None else gate.limit


@cache
def _shipped_gates() -> dict[str, Gate]:
    return read_gates()


def read_gates(path: Path = GATES_FILE) -> dict[str, Gate]:
    """Read the gates by key.

    Raises ``ValueError`` for a gate without a reason, or without exactly one limit.
    """
    gates = {}
    for key, entry in tomllib.loads(path.read_text(encoding="utf-8")).items():
        limits = [name for name in ("at_most", "at_least") if name in entry]
        unknown = sorted(set(entry) - {"at_most", "at_least", "reason"})
        if len(limits) != 1 or unknown or not str(entry.get("reason", "")).strip():
            raise ValueError(f"a gate has one of at_most and at_least, and a reason; {key} has {entry}")
        if key.count("/") != 2:
            raise ValueError(f"a gate is called stage/scene/number; got {key!r}")
        gates[key] = Gate(key, float(entry[limits[0]]), limits[0] == "at_most", str(entry["reason"]))
    return gates
