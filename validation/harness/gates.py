"""``gates.toml``: every promised limit, with its reason; and the verdict on a number."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

GATES_FILE = Path(__file__).resolve().parents[1] / "gates.toml"


@dataclass(frozen=True)
class Gate:
    """``key`` of the number ("stage/scene/what"), the ``limit`` and the side of it that is good, the
    ``reason`` for the limit, and whether the scene is always there (``real`` scenes need not be)."""

    key: str
    limit: float
    at_most: bool
    reason: str

    def holds(self, value: float | None) -> bool:
        """A number that is missing breaks its gate."""
        if value is None or value != value:
            return False
        return value <= self.limit if self.at_most else value >= self.limit


def read_gates(path: Path = GATES_FILE) -> dict[str, Gate]:
    """The gates by their keys.

    Raises ``ValueError`` for a gate without a reason, or with no limit or two of them.
    """
    gates = {}
    for key, told in tomllib.loads(path.read_text(encoding="utf-8")).items():
        limits = [name for name in ("at_most", "at_least") if name in told]
        unknown = sorted(set(told) - {"at_most", "at_least", "reason"})
        if len(limits) != 1 or unknown or not str(told.get("reason", "")).strip():
            raise ValueError(f"a gate has one of at_most and at_least, and a reason; {key} has {told}")
        if key.count("/") != 2:
            raise ValueError(f"a gate is called stage/scene/number; got {key!r}")
        gates[key] = Gate(key, float(told[limits[0]]), limits[0] == "at_most", str(told["reason"]))
    return gates
