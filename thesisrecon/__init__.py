"""From uncalibrated photographs to metric cameras and points: the classical algorithms, from scratch.

The front doors are loaded when they are first used, so that importing the package costs next to nothing.
"""

from __future__ import annotations

# Not of typing, which takes longer to load than all of this.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from thesisrecon.between import interpolate_view
    from thesisrecon.beyond import synthesize_view
    from thesisrecon.config import PipelineConfig
    from thesisrecon.doors import (
        estimate_fundamental,
        match_pair,
        match_rectified,
        self_calibrate,
        upgrade_affine,
    )
    from thesisrecon.geometry.pinhole import PinholeCamera
    from thesisrecon.geometry.triangulation import triangulate
    from thesisrecon.pipeline import reconstruct
    from thesisrecon.views import render

__version__ = "0.1.0"

_HOME_OF = {
    "PinholeCamera": "geometry.pinhole",
    "PipelineConfig": "config",
    "estimate_fundamental": "doors",
    "interpolate_view": "between",
    "match_pair": "doors",
    "match_rectified": "doors",
    "reconstruct": "pipeline",
    "render": "views",
    "self_calibrate": "doors",
    "synthesize_view": "beyond",
    "triangulate": "geometry.triangulation",
    "upgrade_affine": "doors",
}

__all__ = [
    "PinholeCamera",
    "PipelineConfig",
    "__version__",
    "estimate_fundamental",
    "interpolate_view",
    "match_pair",
    "match_rectified",
    "reconstruct",
    "render",
    "self_calibrate",
    "synthesize_view",
    "triangulate",
    "upgrade_affine",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'thesisrecon' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"thesisrecon.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
