"""Ratios of times: parallel efficiency and benchmark tables.

``parallel``: features and matches of the same images by one thread, two threads and two processes. Efficiency
by the clock is T1 / (2 T2); efficiency by work is processor time of one worker over that of two, which other
load disturbs less.
``benchmark-table``: ratios of the least times in a JSON file of pytest-benchmark.
"""

from __future__ import annotations

import json
import resource
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from thesisrecon.errors import UsageError
from thesisrecon.io._files import write_text
from thesisrecon.pipeline.reconstruction import reconstruct
from validation.metrics.record import Metric
from validation.scenes.many_views import write_views
from validation.studies.measuring import call_apart
from validation.studies.runner import Part, Rows, text_table

KINDS = {"one thread": (1, "local"), "two threads": (2, "local"), "two processes": (2, "processes")}
MIN_EFFICIENCY = 0.85
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
Seconds = tuple[float, float]
"""Wall and processor seconds."""


# ---------------------------------------------------------------- parallel efficiency


def time_front_end(images: str, kind: str, count: int) -> Seconds:
    """Time features and matches of the first images in this process, its kernels loaded before."""
    threads, executor = KINDS[kind]
    paths = sorted(Path(images).glob("*.png"))[:count]
    with tempfile.TemporaryDirectory() as place:
        reconstruct(paths[:3], Path(place) / "warm", until="matches", threads=1)
        start, before = time.perf_counter(), _processor_s()
        reconstruct(paths, Path(place) / "run", until="matches", threads=threads, executor=executor)
        return time.perf_counter() - start, _processor_s() - before


def _processor_s() -> float:
    """Return the processor seconds of this process and of its ended children."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in used)


def efficiency_rows(name: str, found: Mapping[str, Sequence[Seconds]]) -> list[Metric]:
    """Return medians over the repeats and both efficiencies."""
    wall, cpu = ({k: float(np.median([s[c] for s in v])) for k, v in found.items()} for c in (0, 1))
    one = "one thread"
    others = [kind for kind in found if kind != one]
    rows = Rows(name, "two processes")
    rows.add("wall", wall, "s")
    rows.add("processor", cpu, "s")
    rows.add("efficiency by the clock", {kind: wall[one] / (2.0 * wall[kind]) for kind in others})
    work = {kind: cpu[one] / cpu[kind] for kind in others}
    rows.add("efficiency by work", work, at_least=MIN_EFFICIENCY)
    return rows


def parallel_study(out: Path, count: int = 30, long_side: int = 480, repeats: int = 3) -> Iterator[Part]:
    """Measure the efficiency of two workers on features and matches.

    Parameters
    ----------
    count : int
        Number of images.
    """
    write_views(out, count, size=(long_side, long_side * 3 // 4))
    found: dict[str, list[Seconds]] = {kind: [] for kind in KINDS}
    for _ in range(repeats):
        for kind, seconds in found.items():
            seconds.append(tuple(call_apart(time_front_end, out, kind, count, environment=ONE_THREAD)[0]))
    yield efficiency_rows(f"{count} images", found)


# ---------------------------------------------------------------- benchmark


def ratios_to_ours(groups: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return group -> reference -> our time over its time; groups without ours are left out."""
    return {
        group: {name: times["ours"] / seconds for name, seconds in times.items() if name != "ours"}
        for group, times in groups.items()
        if "ours" in times
    }


def ratio_table(groups: Mapping[str, Mapping[str, float]]) -> str:
    """Return a row for each group and method."""
    ratios, rows = ratios_to_ours(groups), []
    for group, times in groups.items():
        for name, seconds in times.items():
            ratio = ratios.get(group, {}).get(name)
            rows.append([group, name, f"{1e3 * seconds:.3g}", "" if ratio is None else f"**{ratio:.2f}**"])
    return text_table(["", "method", "ms a call", "ours / this"], rows)


def benchmark_table_study(benchmark: Path, ratios: Path | None = None) -> Iterator[Part]:
    """Compare the least times of the benchmarks with those of the references.

    Parameters
    ----------
    benchmark : Path
        JSON file of pytest-benchmark.
    ratios : Path
        JSON file for the ratios.
    """
    groups: dict[str, dict[str, float]] = {}
    try:
        for entry in json.loads(benchmark.read_text(encoding="utf-8"))["benchmarks"]:
            times = groups.setdefault(entry["group"], {})
            times[entry["extra_info"]["method"]] = float(entry["stats"]["min"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{benchmark} is not a JSON file of our benchmarks: {error}") from error
    yield ratio_table(groups)
    if ratios is not None:
        content = {"seconds": groups, "ours_over": ratios_to_ours(groups)}
        write_text(ratios, json.dumps(content, indent=1))
