"""The demo images."""

from importlib.resources import files
from pathlib import Path

from thesisrecon.errors import UsageError

DEMO_IMAGES = 6
"""Enough neighbouring views for self-calibration, and a small wheel."""


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
