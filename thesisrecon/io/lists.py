"""Lists of pairs of photographs, as text files.

The photographs of the demo: neighbouring views of the courtyard, which the wheel carries with their truth.

They stand in the repository once, in ``fixtures/courtyard``; the build lays them into the package.
"""

from __future__ import annotations

import shlex
from importlib.resources import files
from pathlib import Path

from thesisrecon.errors import UsageError
from thesisrecon.io.files import read_text, shortened

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


COUNT = 6
"""So many neighbouring views calibrate themselves well, and a wheel that holds them stays small."""


def demo_photographs() -> list[Path]:
    """The photographs, sorted by name: those of the installed package, else those of the source around it.

    Raises :class:`UsageError` where neither is there.
    """
    package = Path(str(files("thesisrecon")))
    for home in (package, package.parent / "fixtures"):
        found = sorted((home / "courtyard" / "images").glob("*.jpg"))[:COUNT]
        if len(found) == COUNT:
            return found
    raise UsageError(
        f"the photographs of the demo are neither in {package / 'courtyard'} nor in fixtures/courtyard of "
        "the source; install the package again, or reconstruct a folder of your own"
    )
