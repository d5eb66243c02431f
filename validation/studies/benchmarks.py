"""Times of the benchmarks: ratios to those of references, and to ours at an earlier commit, with intervals.

Medians of pytest-benchmark are read from a file of ``scripts/benchmark`` or measured. Machines differ and
are noisy: only times of one machine and one hour can be compared. Each version runs its own benchmarks, one
after the other in alternate order, ``rounds`` times; work of one name is compared. The median ratio of all
work, which a busy machine changes too, is a row of its own and taken off from the others. Intervals are
Student's over the rounds, p is adjusted for all rows (Holm). ``scripts/benchmark`` also stores each run in
``.benchmarks``, which ``pytest-benchmark compare`` reads; ``--trend`` draws what is there.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from thesisrecon.errors import UsageError
from thesisrecon.io._files import write_text
from validation.ablation.statistics import holm, paired_interval
from validation.runs.page import plot_at, write_page
from validation.runs.study import Part, report_progress
from validation.runs.tables import number, plot, scatter, stamp, text_table

ROOT = Path(__file__).parents[2]
STORE = ROOT / ".benchmarks"
SLOWER = 0.05
"""Largest adjusted p of a change that is named."""
ENOUGH = 8
"""Pieces of work whose median is what all have in common."""
ALL = "all work: the median, taken off from each of the others"
Times = Mapping[str, float]
"""Median seconds of ours by piece of work."""


def benchmark_against_study(
    out: Path, against: str = "", rounds: int = 11, choose: str = "", trend: bool = False
) -> Iterator[Part]:
    """Compare our times with those of another commit, or draw the stored ones over time."""
    if trend:
        page = write_trend(sorted(STORE.rglob("*.json")), out)
        yield f"the trend is {page}"
    if not against:
        if not trend:
            raise UsageError("give --against REVISION, --trend or both")
        return
    if rounds < 3:
        raise UsageError(f"--rounds must be at least 3; got {rounds}")
    with _worktree(against) as then:
        yield compare_trees(
            {"then": then, "now": ROOT}, rounds, lambda root, file: _measure(root, file, choose), out
        )


def compare_trees(
    trees: Mapping[str, Path], rounds: int, measure: Callable[[Path, Path], Times], out: Path
) -> str:
    """Table of the ratios of the second of two trees over the first; the order alternates."""
    found: dict[str, list[Times]] = {name: [] for name in trees}
    for k in range(rounds):
        order = list(trees) if k % 2 == 0 else list(trees)[::-1]
        for name in order:
            found[name].append(measure(trees[name], out / f"{name}-{k}.json"))
        report_progress(f"round {k + 1} of {rounds}")
    return ratio_table(*found.values())


def ratio_table(then: Sequence[Times], now: Sequence[Times]) -> str:
    """Markdown of the pieces of work that both have, slower ones first."""
    works = [name for name in now[0] if all(name in times for times in (*then, *now))]
    differences = np.array([[math.log(b[w] / a[w]) for a, b in zip(then, now, strict=True)] for w in works])
    if len(works) >= ENOUGH:
        # A busy machine slows all work of a process alike.
        common = np.median(differences, axis=0)
        differences, works = np.vstack([differences - common, common]), [*works, ALL]
    intervals = [paired_interval([d], "draws") for d in differences]
    adjusted = holm([i.p for i in intervals])
    rows, order = [], sorted(range(len(works)), key=lambda k: -intervals[k].mean)
    for k in order:
        i = intervals[k]
        shown = math.isfinite(adjusted[k]) and adjusted[k] <= SLOWER
        word = ("slower" if i.mean > 0.0 else "faster") if shown else ""
        some = [[1e3 * times.get(works[k], math.nan) for times in runs] for runs in (then, now)]
        ms = ["" if works[k] == ALL else f"{np.median(values):.3g}" for values in some]
        ratio = f"{math.exp(i.mean):.3f} [{math.exp(i.low):.3f}, {math.exp(i.high):.3f}]"
        rows.append([works[k], *ms, f"**{ratio}**" if word else ratio, number(adjusted[k]), word])
    head = ["", "then, ms", "now, ms", "now / then, 95 %", "p (Holm)", ""]
    return (
        f"{text_table(head, rows)}\n\n{sum(row[-1] == 'slower' for row in rows)} slower, {len(then)} rounds"
    )


def _measure(root: Path, file: Path, choose: str) -> Times:
    """Run the benchmarks of ours of a tree."""
    run_benchmarks(file, root, f"ours and ({choose})" if choose else "ours")
    return {group: times["ours"] for group, times in read_benchmarks(file).items() if "ours" in times}


@contextmanager
def _worktree(revision: str) -> Iterator[Path]:
    """The tree of a commit in a temporary folder, which the repository forgets afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "then"
        command = ["git", "worktree", "add", "--detach", "--quiet", str(place), revision]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            raise UsageError(f"--against {revision}: {done.stderr.strip().splitlines()[-1]}")
        try:
            yield place
        finally:
            forget = ["git", "worktree", "remove", "--force", str(place)]
            subprocess.run(forget, cwd=ROOT, capture_output=True, check=False)


def write_trend(files: Sequence[Path], out: Path) -> Path:
    """Draw median times of ours over stored runs, and over the best reference of the same run."""
    runs = []
    for file in files:
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            commit = str(content["commit_info"]["id"])[:10]
            machine = str(content["machine_info"]["cpu"]["brand_raw"])
            runs.append((str(content["datetime"]), f"{commit} on {machine}", read_benchmarks(file)))
        except (OSError, ValueError, KeyError, TypeError, UsageError):
            report_progress(f"{file} is no run of our benchmarks, left out")
    if not runs:
        raise UsageError(f"{STORE} holds no run of our benchmarks; run scripts/benchmark first")
    runs.sort(key=lambda run: run[0])
    works = dict.fromkeys(name for *_, groups in runs for name, times in groups.items() if "ours" in times)
    plots = []
    for work in works:
        here = [(words, groups[work]) for _, words, groups in runs if "ours" in groups.get(work, {})]
        x, text = list(range(1, len(here) + 1)), [words for words, _ in here]
        more = {"text": text, "hoverinfo": "text+y"}
        traces = [scatter("ours, ms", x, [1e3 * times["ours"] for _, times in here], "lines+markers", **more)]
        best = [
            min((v for k, v in times.items() if not k.startswith("ours")), default=None) for _, times in here
        ]
        if any(best):
            traces.append(
                scatter("best reference, ms", x, [b and 1e3 * b for b in best], "lines+markers", **more)
            )
        plots.append(plot(work, traces, "stored run", "median, ms", height=300))
    section = {
        "id": "trend",
        "title": "Median times",
        "definition": "Runs of scripts/benchmark by date; labels name the commit and the processor.",
        "plots": [plot_at(f"trend-{n}", p) for n, p in enumerate(plots)],
        **dict.fromkeys(("rows", "references", "pictures", "notes"), ()),
    }
    verdict = {"level": "open", "word": "Stored", "sentence": f"{len(runs)} runs.", "reasons": ()}
    page, template = out / "trend.html", ROOT / "validation" / "runs" / "report.html.j2"
    values = {"title": "Speed over time", "links": (), "verdict": verdict, "several": False, "failures": ()}
    write_page(page, template, [section], environment=[("made", stamp())], about="", **values)
    return page


def ratios_to_ours(groups: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return group -> reference -> our time over its time; groups without ours are left out."""
    return {
        group: {name: times["ours"] / seconds for name, seconds in times.items() if name != "ours"}
        for group, times in groups.items()
        if "ours" in times
    }


def reference_table(groups: Mapping[str, Mapping[str, float]]) -> str:
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
    yield reference_table(groups)
    if ratios is not None:
        content = {"seconds": groups, "ours_over": ratios_to_ours(groups)}
        write_text(ratios, json.dumps(content, indent=1))
