"""Check each reference library with known questions before a report, in a process each.

Failures are written to ``libraries.json``; only tasks that use a failed library end with its message.
"""

from __future__ import annotations

import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from thesisrecon.io._files import write_text
from validation.harness.process import failure_of, last_words, own_cores, run_process
from validation.harness.records import ReportOptions
from validation.references.libraries import NAMES

FILE = "libraries.json"
LIMIT_S = 60.0


def ask_canaries(options: ReportOptions) -> dict[str, str]:
    """Return and store the message of each library that fails its check."""
    cores = own_cores()[: options.threads]
    with ThreadPoolExecutor(len(cores)) as pool:
        asked = [
            pool.submit(_ask, options, library, cores[n % len(cores)]) for n, library in enumerate(NAMES)
        ]
        answers = {library: future.result() for library, future in zip(NAMES, asked, strict=True)}
    refused = {library: words for library, words in answers.items() if words}
    options.out.mkdir(parents=True, exist_ok=True)
    write_text(options.out / FILE, json.dumps(refused))
    return refused


def read_refused(out: Path) -> dict[str, str]:
    """Read the messages of :func:`ask_canaries` in a report folder; empty without a check."""
    path = out / FILE
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def _ask(options: ReportOptions, library: str, core: int) -> str:
    log, limit_s = options.out / "canaries" / f"{library}.txt", min(LIMIT_S, options.limit_s)
    process = run_process(
        [sys.executable, "-m", "validation.references.canary", library],
        log=log,
        cores=[core],
        environment={"OMP_NUM_THREADS": "1"},
        limit_s=limit_s,
    )
    if process.timed_out:
        return f"{NAMES[library]} did not answer a small question within {limit_s:.0f} s"
    if process.code < 0:
        return f"{NAMES[library]} {failure_of(process, '', limit_s)} on a small question"
    return failure_of(process, last_words(log), limit_s)
