"""From uncalibrated photographs to metric cameras and points: the classical algorithms, from scratch.

The front doors are loaded when they are first used, so that importing the package costs next to nothing.
"""

from __future__ import annotations

# Not of typing, which takes longer to load than all of this.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from thesisrecon.api import match_pair, match_rectified, self_calibrate
    from thesisrecon.camera import Camera
    from thesisrecon.config import PipelineConfig
    from thesisrecon.epipolar.locally_optimised import estimate_fundamental
    from thesisrecon.geometry.triangulation import triangulate
    from thesisrecon.pipeline.outputs import upgrade_affine
    from thesisrecon.pipeline.reconstruction import reconstruct
    from thesisrecon.view_interpolation import interpolate_view
    from thesisrecon.view_synthesis import synthesize_view
    from thesisrecon.views.render import render

__version__ = "0.1.0"

_HOME_OF = {
    "Camera": "camera",
    "PipelineConfig": "config",
    "estimate_fundamental": "epipolar.locally_optimised",
    "interpolate_view": "view_interpolation",
    "match_pair": "api",
    "match_rectified": "api",
    "reconstruct": "pipeline.reconstruction",
    "render": "views.render",
    "self_calibrate": "api",
    "synthesize_view": "view_synthesis",
    "triangulate": "geometry.triangulation",
    "upgrade_affine": "pipeline.outputs",
}

__all__ = [
    "Camera",
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
