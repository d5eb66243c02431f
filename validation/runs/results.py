"""``results.json`` and the tables as CSV: numbers with limits and references."""

from __future__ import annotations

import json
import platform
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from thesisrecon.io._files import write_text
from validation.references.libraries import PACKAGES
from validation.runs.records import Judgement, Outcome, ReportOptions
from validation.runs.tables import Metric, commit, finite, key_of, machine, write_csv

ROUNDING = 1e-9  # Errors below it have no ratio
MARGIN = 5.0
"""Distance of a limit from the measured value in units of noise: one false alarm in three million runs of
normal noise, and less than one in a thousand where the noise is known from five runs only."""
GATES_FILE = Path(__file__).resolve().parents[1] / "gates.toml"


@dataclass(frozen=True)
class Gate:
    """``key`` of the number ("stage/scene/name"), ``limit``, its direction, and the reason: a ``template``
    with {measured}, {noise} and names of ``references``. ``fixed``: the limit does not follow ``measured``.
    """

    key: str
    limit: float
    at_most: bool
    template: str
    measured: float | None = None
    noise: float | None = None
    fixed: bool = True
    references: Mapping[str, float] = field(default_factory=dict)

    @property
    def reason(self) -> str:
        """The reason with the measured values; ``KeyError`` for a name that the gate does not have."""
        known = {"measured": self.measured, "noise": self.noise, **self.references}
        return self.template.format_map({name: f"{v:.3g}" for name, v in known.items() if v is not None})

    def holds(self, value: float | None) -> bool:
        """Return whether a number meets the limit; a missing number does not."""
        if value is None or value != value:
            return False
        return value <= self.limit if self.at_most else value >= self.limit

    def verdict(self, value: float | None) -> str:
        """Return "missed"; "moved" if the number is better than measured by more than noise explains, since a
        limit about the old value would not see a fault of that size; else "reached".
        """
        if not self.holds(value) or value is None:
            return "missed"
        if self.fixed or self.measured is None or self.noise is None:
            return "reached"
        better = (self.measured - value) * (1.0 if self.at_most else -1.0)
        return "moved" if better > MARGIN * self.noise else "reached"


@cache
def camera_limit(scene: str, name: str) -> float | None:
    """Return the limit of a number of the stage "cameras", None where nothing is promised."""
    gate = read_gates().get(f"cameras/{scene}/{name}")
    return None if gate is None else gate.limit


def read_gates(path: Path = GATES_FILE) -> dict[str, Gate]:
    """Read the gates by key."""
    gates = {}
    for key, entry in tomllib.loads(path.read_text(encoding="utf-8")).items():
        limits = [name for name in ("at_most", "at_least") if name in entry]
        unknown = sorted(set(entry) - {*limits, "reason", "measured", "noise", "fixed", "references"})
        if len(limits) != 1 or unknown or not str(entry.get("reason", "")).strip():
            raise ValueError(f"a gate has one of at_most and at_least, and a reason; {key} has {entry}")
        if ("measured" in entry) != ("noise" in entry) or not (entry.get("fixed") or "measured" in entry):
            raise ValueError(f"a gate has measured and noise, or a fixed limit; {key} has {entry}")
        if key.count("/") != 2:
            raise ValueError(f"a gate is called stage/scene/number; got {key!r}")
        more = {name: entry[name] for name in ("measured", "noise", "references") if name in entry}
        limit, fixed = float(entry[limits[0]]), bool(entry.get("fixed", False))
        gate = Gate(key, limit, limits[0] == "at_most", str(entry["reason"]), fixed=fixed, **more)
        try:
            assert gate.reason
        except KeyError as name:
            raise ValueError(f"the reason of {key} names {name}, which the gate does not have") from None
        gates[key] = gate
    return gates


@dataclass(frozen=True)
class Row:
    """A number of ours (``value``) and the references; ``direction`` is the good side of the ``limit``."""

    key: str
    scene: str
    name: str
    value: float | None
    unit: str
    direction: str
    limit: float | None
    reference: Mapping[str, float | None]
    definition: str
    verdict: str
    reason: str = ""
    ranked: bool = True

    @property
    def best(self) -> float | None:
        """The number of the best reference, None without one or where neither side is better."""
        others = [v for name, v in self.reference.items() if v is not None and not name.startswith("ours")]
        if not others or not self.ranked:
            return None
        return max(others) if self.direction == "at least" else min(others)

    @property
    def ratio(self) -> float | None:
        """Ours over the best reference, inverted where more is better; None if one is but rounding."""
        if self.value is None or self.best is None:
            return None
        pair = (self.value, self.best)
        over, under = pair[::-1] if self.direction == "at least" else pair
        return over / under if min(over, under) > ROUNDING else None


@dataclass(frozen=True)
class Results:
    """A whole report."""

    rows: Sequence[Row]
    missing: Sequence[str]
    failures: Mapping[str, str]
    environment: Mapping[str, Any]
    options: Mapping[str, Any]
    not_run: Sequence[str] = ()

    @property
    def broken(self) -> list[Row]:
        return [row for row in self.rows if row.verdict in ("missed", "moved")]


def row_of(stage: str, metric: Metric, gate: Gate | None) -> Row:
    """Return the row of a metric with the limit of its gate."""
    others = {name: finite(v) for name, v in metric.values.items() if name != metric.judged}
    at_most = metric.at_most if gate is None else gate.at_most
    value = finite(metric.values.get(metric.judged))
    verdict = "reported" if gate is None else gate.verdict(value)
    direction, limit = "at most" if at_most else "at least", None if gate is None else gate.limit
    reason = "" if gate is None else gate.reason
    given = (metric.unit, direction, limit, others, metric.definition, verdict, reason, metric.ranked)
    return Row(key_of(stage, metric), metric.scene, metric.name, value, *given)


def collect(
    options: ReportOptions,
    judged: Mapping[tuple[str, str], tuple[Judgement, Mapping[str, Outcome]]],
    gates: Mapping[str, Gate],
) -> Results:
    """Collect all rows of a run; gates without a reported number are ``missing``, or ``not_run`` if --quick
    left their method out and no other failed there.
    """
    rows = []
    for (stage, _), (judgement, _outcomes) in judged.items():
        rows += [row_of(stage, m, gates.get(key_of(stage, m))) for m in judgement.metrics]
    reported = {row.key for row in rows}
    absent = sorted(k for k in gates if tuple(k.split("/")[:2]) in set(judged) and k not in reported)
    failures = {
        f"{stage}/{scene}/{method}": outcome.failure
        for (stage, scene), (_, outcomes) in judged.items()
        for method, outcome in outcomes.items()
        if not outcome.ok
    }
    failed = {key.rpartition("/")[0] for key in failures}
    not_run = [k for k in absent if options.quick and k.rpartition("/")[0] not in failed]
    missing = [k for k in absent if k not in not_run]
    return Results(rows, missing, failures, environment(options), options.to_json(), not_run)


def environment(options: ReportOptions) -> dict[str, Any]:
    """Return the environment of the run."""
    versions = {}
    for name in ("thesisrecon", "numpy", "scipy", "numba", *PACKAGES.values()):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "missing"
    head = {"commit": commit(), "machine": machine(), "python": platform.python_version()}
    threads = f"{options.threads} parallel tasks, one thread each"
    return {**head, **versions, "threads": threads, "seed": options.seed}


def write_results(out: Path, results: Results) -> None:
    """Write ``results.json`` and ``tables/STAGE.csv``."""
    write_text(out / "results.json", json.dumps(asdict(results), indent=1, allow_nan=False))
    for stage in dict.fromkeys(row.key.split("/")[0] for row in results.rows):
        rows = [row for row in results.rows if row.key.startswith(f"{stage}/")]
        references = dict.fromkeys(name for row in rows for name in row.reference)
        records = [
            {"key": row.key, "unit": row.unit, "ours": row.value}
            | {name: row.reference.get(name) for name in references}
            | {"direction": row.direction, "limit": row.limit, "verdict": row.verdict}
            | {"definition": row.definition, "reason": row.reason}
            for row in rows
        ]
        write_csv(out / "tables" / f"{stage}.csv", records)
