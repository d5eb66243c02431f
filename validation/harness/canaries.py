"""Before a report: whether each reference library is there and answers what is known, in a process each.

What is wrong with a library stands in ``libraries.json``; every task that asks that library then ends with
this sentence, and no other task does.
"""

from __future__ import annotations

import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from thesisrecon.io.files import write_text
from validation.harness.process import failure_of, last_words, own_cores, run_process
from validation.harness.records import Wishes
from validation.references.libraries import NAMES

FILE = "libraries.json"
LIMIT_S = 60.0


def ask_canaries(wishes: Wishes) -> dict[str, str]:
    """What is wrong with each library that is not as it should be, also written for the tasks to read."""
    cores = own_cores()[: wishes.threads]
    with ThreadPoolExecutor(len(cores)) as pool:
        asked = [pool.submit(_ask, wishes, library, cores[n % len(cores)]) for n, library in enumerate(NAMES)]
        told = {library: future.result() for library, future in zip(NAMES, asked, strict=True)}
    refused = {library: words for library, words in told.items() if words}
    wishes.out.mkdir(parents=True, exist_ok=True)
    write_text(wishes.out / FILE, json.dumps(refused))
    return refused


def read_refused(out: Path) -> dict[str, str]:
    """What :func:`ask_canaries` found in this folder of a report; nothing where nobody asked."""
    path = out / FILE
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def _ask(wishes: Wishes, library: str, core: int) -> str:
    log, limit_s = wishes.out / "canaries" / f"{library}.txt", min(LIMIT_S, wishes.limit_s)
    process = run_process(
        [sys.executable, "-m", "validation.references.canary", library],
        log=log,
        cores=[core],
        environment={"OMP_NUM_THREADS": "1"},
        limit_s=limit_s,
    )
    if process.timed_out:
        return f"{NAMES[library]} gives no answer to a small question within {limit_s:.0f} s"
    if process.code < 0:
        return f"{NAMES[library]} {failure_of(process, '', limit_s)} when asked a small question"
    return failure_of(process, last_words(log), limit_s)
