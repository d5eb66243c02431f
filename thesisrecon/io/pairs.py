"""Lists of pairs of photographs, as text files."""

from __future__ import annotations

import shlex
from pathlib import Path

from thesisrecon.errors import UsageError
from thesisrecon.io.text import read_text, shortened

LONGEST_LINE = 2**14
"""Characters; two names with their folders are shorter on every system."""


def read_pairs(path: Path) -> list[tuple[str, str]]:
    """The pairs of file names of a text file: two names on a line, apart by blanks or one tab.

    A name with blanks stands in quotes, or the two are apart by a tab. Empty lines and lines that begin with
    # count for nothing; COLMAP's lists of pairs are read. Raises :class:`UsageError` with the number of the
    line that holds no pair.
    """
    pairs = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        names = _names(line)
        if len(names) != 2:
            raise UsageError(
                f"line {number} of {path} takes two file names, in quotes where they have blanks; "
                f"got {shortened(line.strip())!r}"
            )
        pairs.append((names[0], names[1]))
    return pairs


def _names(line: str) -> list[str]:
    if len(line) > LONGEST_LINE:
        return []
    if "\t" in line and '"' not in line:
        return [name.strip() for name in line.strip().split("\t")]
    try:
        return shlex.split(line)
    except ValueError:
        # A quote that never ends.
        return []
