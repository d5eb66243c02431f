"""Ratios of the median times of pytest-benchmark, read from a file of ``scripts/benchmark`` or measured."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from thesisrecon.errors import UsageError
from thesisrecon.io._files import write_text
from validation.runs.study import Part
from validation.runs.tables import text_table


def ratios_to_ours(groups: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return group -> reference -> our time over its time; groups without ours are left out."""
    return {
        group: {name: times["ours"] / seconds for name, seconds in times.items() if name != "ours"}
        for group, times in groups.items()
        if "ours" in times
    }


def ratio_table(groups: Mapping[str, Mapping[str, float]]) -> str:
    ratios, rows = ratios_to_ours(groups), []
    for group, times in groups.items():
        for name, seconds in times.items():
            ratio = ratios.get(group, {}).get(name)
            rows.append([group, name, f"{1e3 * seconds:.3g}", "" if ratio is None else f"**{ratio:.2f}**"])
    return text_table(["", "method", "ms a call", "ours / this"], rows)


OPTIONS = [
    "--benchmark-only",
    "--benchmark-min-rounds=7",
    "--benchmark-max-time=0.7",
    "--benchmark-timer=time.process_time",
]
"""Equal for all methods; the median does not depend on the number of rounds, as the least time does."""


ROOT = Path(__file__).parents[2]


def run_benchmarks(file: Path, root: Path = ROOT, words: str = "") -> None:
    """Run the benchmarks of a tree whose names match, on one thread, with processor times, into a file."""
    command = [sys.executable, "-m", "pytest", "benchmarks", "-q", *OPTIONS, f"--benchmark-json={file}"]
    environment = os.environ | {"PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command += ["-k", words] if words else []
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UsageError(f"the benchmarks of {root} failed: {(done.stdout + done.stderr).strip()[-800:]}")


def read_benchmarks(file: Path) -> dict[str, dict[str, float]]:
    """Return group -> method -> median seconds of a file of pytest-benchmark."""
    groups: dict[str, dict[str, float]] = {}
    try:
        for entry in json.loads(file.read_text(encoding="utf-8"))["benchmarks"]:
            times = groups.setdefault(entry["group"], {})
            times[entry["extra_info"]["method"]] = float(entry["stats"]["median"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{file} is not a JSON file of our benchmarks: {error}") from error
    return groups


def benchmark_table_study(
    out: Path, benchmark: Path | None = None, ratios: Path | None = None
) -> Iterator[Part]:
    """Compare the median times of the benchmarks with those of the references."""
    if benchmark is None:
        benchmark = out / "benchmark.json"
        run_benchmarks(benchmark)
    groups = read_benchmarks(benchmark)
    yield ratio_table(groups)
    if ratios is not None:
        content = {"seconds": groups, "ours_over": ratios_to_ours(groups)}
        write_text(ratios, json.dumps(content, indent=1))
