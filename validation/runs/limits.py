"""Limits of gates from measured values: ``measured`` plus or minus ``MARGIN`` times the ``noise``.

The noise is the standard deviation over runs with other seeds and processors. A gate that is ``fixed`` has a
limit by definition (rank 2, 95 %, the number of a reference): its measured value changes, its limit stays.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.io._files import write_text
from validation.runs.results import GATES_FILE, MARGIN, Gate, read_gates
from validation.runs.tables import text_table

LEAST_NOISE = 1e-3
"""Relative, where seeds and processors agree to the last digit."""
STEADY = 5  # Runs that show that the noise is smaller than the entry says
HEAD = """\
# Limits of the gates: "stage/scene/number". Written by `python -m validation check --update` and
# `python -m validation limits OUT ... --write`; {measured}, {noise} and {REFERENCE} in a reason become the
# values of the entry. A limit that is not fixed is measured +- 5 noise (docs/development/gates.md).
"""


@dataclass(frozen=True)
class Move:
    """A gate whose entry changes, before and after."""

    before: Gate
    after: Gate

    @property
    def loosened(self) -> bool:
        """Return whether the new limit accepts values that the old one rejects."""
        return not self.before.holds(self.after.limit)


def read_runs(folders: Sequence[Path]) -> list[Mapping[str, Any]]:
    """Read ``results.json`` of earlier runs; ``ValueError`` names a folder without it."""
    runs = []
    for folder in folders:
        file = folder / "results.json"
        if not file.is_file():
            raise ValueError(f"{folder} holds no results of a check or report (results.json)")
        runs.append(json.loads(file.read_text(encoding="utf-8")))
    return runs


def find_moves(runs: Sequence[Mapping[str, Any]], gates: Mapping[str, Gate]) -> list[Move]:
    """Return the gates whose measured values moved, in the order of ``gates``."""
    moves = []
    for key, gate in gates.items():
        rows = [row for run in runs for row in run["rows"] if row["key"] == key]
        values = [row["value"] for row in rows if row["value"] is not None]
        if values:
            known: dict[str, float] = {}
            for row in rows:
                known |= {name: v for name, v in row["reference"].items() if v is not None}
            after = moved_gate(gate, values, known, share=rows[0].get("unit") == "%")
            if after != gate:
                moves.append(Move(gate, after))
    return moves


def moved_gate(
    gate: Gate, values: Sequence[float], references: Mapping[str, float], *, share: bool = False
) -> Gate:
    """Return the gate measured again; smaller changes than its noise do not count. One run keeps the noise.

    The least noise is relative to the value, or for a ``share`` in per cent to what is missing to 100 if that
    is less.
    """
    measured = float(np.mean(values))
    size = min(abs(measured), abs(100.0 - measured)) if share else abs(measured)
    noise, least = gate.noise or 0.0, LEAST_NOISE * size
    if len(values) > 1:
        noise = float(np.std(values, ddof=1))
    noise = _rounded(noise if gate.fixed else max(noise, least), up=True, digits=2)
    if gate.measured is not None and gate.noise is not None:
        moved = abs(measured - gate.measured) > max(gate.noise, least)
        # Fewer runs may agree by chance.
        steadier = len(values) >= STEADY and noise < gate.noise / 1.5
        if not (moved or steadier) and (len(values) == 1 or noise <= 1.5 * gate.noise):
            measured, noise = gate.measured, gate.noise
    named = {name: _shown(references.get(name, old)) for name, old in gate.references.items()}
    after = replace(gate, measured=_shown(measured), noise=noise, references=named)
    return after if gate.fixed else replace(after, limit=limit_of(after))


def limit_of(gate: Gate) -> float:
    """Return the limit of a gate that is not fixed."""
    assert gate.measured is not None
    assert gate.noise is not None
    sign = 1.0 if gate.at_most else -1.0
    return _rounded(gate.measured + sign * MARGIN * gate.noise, up=gate.at_most)


def _shown(value: float) -> float:
    return float(f"{value:.4g}")


def _rounded(value: float, *, up: bool, digits: int = 4) -> float:
    """Return the next number of so many significant digits at or above (below) ``value``."""
    if value == 0.0 or not math.isfinite(value):
        return value
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - digits + 1)
    steps = math.ceil(value / unit - 1e-9) if up else math.floor(value / unit + 1e-9)
    return float(f"{steps * unit:.{digits}g}")


def moves_table(moves: Sequence[Move]) -> str:
    """Return old and new values as a table; a limit that accepts more is marked."""
    lines = []
    for move in moves:
        old, new = move.before, move.after
        pairs = [(old.measured, new.measured), (old.noise, new.noise), (old.limit, new.limit)]
        cells = [" -> ".join("-" if v is None else f"{v:g}" for v in dict.fromkeys(pair)) for pair in pairs]
        lines.append([old.key, *cells, "looser" if move.loosened else ""])
    return text_table(["gate", "measured", "noise", "limit", ""], lines)


def write_gates(gates: Mapping[str, Gate], path: Path = GATES_FILE) -> None:
    """Write all gates in their order; the file is read again before it replaces the old one's limits."""
    blocks = [HEAD]
    for gate in gates.values():
        lines = [f"[{json.dumps(gate.key)}]", f"{'at_most' if gate.at_most else 'at_least'} = {gate.limit!r}"]
        if gate.measured is not None:
            lines += [f"measured = {gate.measured!r}", f"noise = {gate.noise!r}"]
        if gate.fixed:
            lines.append("fixed = true")
        if gate.references:
            named = ", ".join(f"{json.dumps(name)} = {value!r}" for name, value in gate.references.items())
            lines.append(f"references = {{ {named} }}")
        blocks.append("\n".join([*lines, f"reason = {json.dumps(gate.template)}"]) + "\n")
    write_text(path, "\n".join(blocks))


def move_limits(runs: Sequence[Mapping[str, Any]], *, write: bool, path: Path = GATES_FILE) -> list[Move]:
    """Print the gates that ``runs`` move, old and new, and with ``write`` change the file."""
    gates = read_gates(path)
    moves = find_moves(runs, gates)
    print(moves_table(moves) if moves else "no gate moved by more than its noise")
    if moves and write:
        write_gates(gates | {move.after.key: move.after for move in moves}, path)
        print(f"{path} has {len(moves)} new entries; state in the commit why they moved")
    return moves
