"""The photographs of the demo: neighbouring views of the courtyard, which the wheel carries with their truth.

They stand in the repository once, in ``fixtures/courtyard``; the build lays them into the package.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from thesisrecon.errors import UsageError

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
