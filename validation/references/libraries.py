"""Lazy import of the reference libraries for their adapters.

A library that is missing or does not load raises :class:`NoReference` on use; other libraries keep working.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

__all__ = ["Library", "NoReference", "cv2", "load", "one_thread", "open3d", "poselib", "pycolmap"]
PACKAGES = {"cv2": "opencv-contrib-python-headless", "pycolmap": "pycolmap", "poselib": "poselib"}
PACKAGES |= {"open3d": "open3d"}
ESTIMATORS = {"pydegensac": "DEGENSAC", "pymagsac": "MAGSAC++", "pygcransac": "GC-RANSAC"}
ESTIMATORS |= {"pysuperansac": "SupeRANSAC"}
"""Robust estimators of the extra ``estimators``, which have no wheel for each Python."""
INSTALLED = tuple(name for library, name in ESTIMATORS.items() if find_spec(library))
PACKAGES |= {name: name for name in ESTIMATORS}
"""Reference libraries: module names and pip names."""
NAMES = {"cv2": "OpenCV", "pycolmap": "pycolmap", "poselib": "PoseLib", "open3d": "Open3D", **ESTIMATORS}


class NoReference(ImportError):
    """A reference library is unavailable; the message names it, the cause and the remedy."""


class Library:
    """The library ``module``, imported when something of it is first used."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(load(self._module), name)


def load(module: str) -> ModuleType:
    """The reference library ``module``, one of :data:`PACKAGES`."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name == module:
            raise NoReference(f"{NAMES[module]} is not installed: pip install {PACKAGES[module]}") from None
        raise NoReference(f"{NAMES[module]} does not load: {error}") from error
    except (ImportError, OSError) as error:
        raise NoReference(f"{NAMES[module]} does not load: {error}") from error


def one_thread() -> None:
    """Limit OpenCV, which uses all cores by default, to one thread."""
    cv2.setNumThreads(1)


if TYPE_CHECKING:
    import cv2
    import poselib
    import pycolmap

    # The types that it brings do not describe it.
    open3d: Any
else:
    cv2, open3d, poselib, pycolmap = map(Library, ("cv2", "open3d", "poselib", "pycolmap"))
