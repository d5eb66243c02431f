"""Text files of image pairs, and the images of the demo.

The demo images are in ``fixtures/courtyard`` of the repository; the build copies them into the package.
"""

from __future__ import annotations

import shlex
from importlib.resources import files
from pathlib import Path

from thesisrecon.errors import UsageError
from thesisrecon.io.files import read_text, shortened

_MAX_LINE = 2**14
"""Characters; two file names with folders are shorter on every system."""
DEMO_IMAGES = 6
"""Enough neighbouring views for self-calibration, and a small wheel."""


def read_pairs(path: Path) -> list[tuple[str, str]]:
    """Read the image pairs of a text file: two file names per line, as in COLMAP's pair lists.

    A name with blanks is quoted, or the names are separated by a tab. Empty lines and lines that begin with #
    are ignored.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    list of tuple
        Pairs of file names, in the order of the file.

    Raises
    ------
    UsageError
        With the number of the line that holds no pair.
    """
    pairs = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        names = _names(line)
        if len(names) != 2:
            raise UsageError(
                f"line {number} of {path} must hold two file names, quoted if they contain blanks; "
                f"got {shortened(line.strip())!r}"
            )
        pairs.append((names[0], names[1]))
    return pairs


def _names(line: str) -> list[str]:
    if len(line) > _MAX_LINE:
        return []
    if "\t" in line and '"' not in line:
        return [name.strip() for name in line.strip().split("\t")]
    try:
        return shlex.split(line)
    except ValueError:  # No closing quote.
        return []


def demo_images() -> list[Path]:
    """Locate the demo images, in the installed package or in the source tree around it.

    Returns
    -------
    list of Path
        ``DEMO_IMAGES`` files, sorted by name.

    Raises
    ------
    UsageError
        If they are in neither place.
    """
    package = Path(str(files("thesisrecon")))
    for home in (package, package.parent / "fixtures"):
        found = sorted((home / "courtyard" / "images").glob("*.jpg"))[:DEMO_IMAGES]
        if len(found) == DEMO_IMAGES:
            return found
    raise UsageError(
        f"the demo images are neither in {package / 'courtyard'} nor in fixtures/courtyard of the source "
        "tree; reinstall the package, or reconstruct a folder of your own"
    )
