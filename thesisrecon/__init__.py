"""Metric 3D reconstruction from uncalibrated images by the classical algorithms of multiple-view geometry.

The stub ``__init__.pyi`` is the one list of public names and of the modules that define them. A module is
imported when one of its names is first used, so that ``import thesisrecon`` takes no time. Each call raises
``ValueError`` for arrays of a wrong shape, numbers that are not finite and invalid options.
"""

import re
from importlib import import_module
from pathlib import Path

__version__ = "0.2.0"

_STUB = Path(__file__).with_suffix(".pyi").read_text("utf-8")
_MODULES = {name: module for module, name in re.findall(r"(?m)^from (\S+) import (\w+) as", _STUB)}
__all__ = sorted([*_MODULES, "__version__"])


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'thesisrecon' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
