"""The reference libraries, each imported where it is first asked for something, by its adapters alone.

A library that is missing, does not load, or no longer answers as its adapters expect raises
:class:`NoReference` there, in a sentence, and nowhere else: what needs another library runs on.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any

__all__ = ["Library", "NoReference", "cv2", "load", "one_thread", "open3d", "poselib", "pycolmap", "refuse"]

PACKAGES = {
    "cv2": "opencv-contrib-python-headless",
    "pycolmap": "pycolmap",
    "poselib": "poselib",
    "open3d": "open3d",
}
"""Reference libraries: what Python calls them, and what pip does."""
NAMES = {"cv2": "OpenCV", "pycolmap": "pycolmap", "poselib": "PoseLib", "open3d": "Open3D"}

_refused: dict[str, str] = {}


class NoReference(ImportError):
    """A reference library that cannot be asked; the text says which, why, and what to do."""


class Library:
    """The library ``module``, imported when something of it is first used.

    Every use raises :class:`NoReference` where it cannot be had.
    """

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(load(self._module), name)


def load(module: str) -> ModuleType:
    """The reference library ``module``, one of :data:`PACKAGES`.

    Raises :class:`NoReference` where it is refused, missing, or does not load.
    """
    if module in _refused:
        raise NoReference(_refused[module])
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name == module:
            raise NoReference(f"{NAMES[module]} is not installed: pip install {PACKAGES[module]}") from None
        raise NoReference(f"{NAMES[module]} does not load: {error}") from error
    except (ImportError, OSError) as error:
        raise NoReference(f"{NAMES[module]} does not load: {error}") from error


def refuse(libraries: Mapping[str, str]) -> None:
    """From now on these libraries raise :class:`NoReference` with these sentences, and no others do."""
    _refused.clear()
    _refused.update(libraries)


def one_thread() -> None:
    """Let OpenCV, which takes all cores by itself, use one."""
    cv2.setNumThreads(1)


if TYPE_CHECKING:
    import cv2
    import poselib
    import pycolmap

    # The types that it brings do not describe it.
    open3d: Any
else:
    cv2, open3d, poselib, pycolmap = map(Library, ("cv2", "open3d", "poselib", "pycolmap"))
