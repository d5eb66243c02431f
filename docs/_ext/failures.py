"""Every failure, warning and failed check of `thesisrecon/messages.toml`, with cause and remedy."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from pathlib import Path

from _ext.code import PACKAGE, write

TABLES = tomllib.loads((PACKAGE / "messages.toml").read_text(encoding="utf-8"))
"""Heading -> code -> text and remedy."""
CALLS: dict[str, str] = TABLES.pop("Wrong calls")
"""Code -> text, which contains the remedy."""
PLACES: dict[str, str] = TABLES.pop("Places that cannot be written")
"""Name of the error -> remedy."""
ADVISED: dict[str, tuple[str, str, str]] = TABLES.pop("Failures with advice")
"""Code -> reason, evidence and advice."""
EXPLAINED = "Failures of several stages"


def page() -> str:
    """Return the page of all failures and warnings."""
    lines = [HEAD]
    for title, messages in TABLES.items():
        rows = [(f"`{code}`", shown(text), why) for code, (text, why) in messages.items()]
        lines += [FAILURES] if title == EXPLAINED else []
        lines += table(title, ("code", "message", "cause and remedy"), rows)
    failures = [(f"`{code}`", *map(shown, texts)) for code, texts in ADVISED.items()]
    lines += table("Failures with advice", ("code", "reason", "evidence", "what to do"), failures)
    calls = [(f"`{code}`", shown(text)) for code, text in CALLS.items()]
    lines += table("Wrong calls", ("code", "message"), calls)
    lines += table("Places that cannot be written", ("error", "what to do"), PLACES.items())
    return "\n".join(lines)


def shown(text: str) -> str:
    """A text with "…" for every value."""
    return re.sub("{[^}]*}", "…", text)


def table(title: str, head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    """Lines of a table."""
    cells = [[" ".join(text.split()).replace("|", r"\|") for text in row] for row in rows]
    return [
        f"### {title}",
        "",
        *(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *cells]),
        "",
    ]


HEAD = """# When a run fails or warns

This page is made from the code, so it holds every message; "…" stands for a value. Search it for a
few words of your message, or for its code: a warning of `result.warnings` is a `str` with the attribute
`code`, unless it was read from a file.

A run ends in one of four ways:

- `"trusted": true` in `summary.json`: all checks passed. Read the warnings all the same.
- `"trusted": false`: cameras and points are written, and `failed_checks` names what is wrong with them.
- A failure, exit code 3: the images cannot be reconstructed. The report and `summary.json` are written up to
  the last stage that finished, and the message says what was measured and what to do. In Python it is a
  {py:class}`~thesisrecon.StageFailure` with `reason`, `evidence` and `advice`.
- Wrong options or settings, exit code 2 ({py:class}`~thesisrecon.UsageError`): the message names the rule and
  what to do; nothing was computed.

Most failures are caused by the images: too little overlap, no sideways motion, or one of the {term}`critical
motions <critical motion>` of [how to take good images](photographing.md).

**Why one image is missing**: see `report.html`, table "Images", or in Python `result.refused` (name ->
reason). An image is *left out* if it cannot be read or used at all ([reasons](#images-that-are-left-out)),
and *not registered* if it was read but has no camera in the model
([reasons](#images-that-are-not-registered)). This does not affect the rest of the model.

## Warnings and failed checks
"""
FAILURES = """## Failures

A failure says what happened (reason), what was measured (evidence) and what to do.
Two different images suffice for matching; a calibration needs three
([why](photographing.md#why-three-views)). Functions of two images (`rectify`, `draw_epipolar_lines` and
others) refuse a file that cannot be read with the reasons of the first table.

"""


def setup(app):
    """Write the page before the sources are read."""
    app.connect("builder-inited", lambda app: write(Path(app.srcdir) / "start" / "failures.md", page()))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
