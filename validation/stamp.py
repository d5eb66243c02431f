"""Commit and machine that tables are made with."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path


def commit() -> str:
    """Return the commit of this clone, with ``-dirty`` if files have changed since; "unknown" without git."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=10"]
    try:
        root = Path(__file__).parents[1]
        return subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def machine() -> str:
    """Return processor, cores and system of this machine."""
    return f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"


def stamp() -> str:
    """Return the first line of a file of tables."""
    return f"Commit {commit()}; {machine()}; Python {platform.python_version()}."
