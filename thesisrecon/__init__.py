"""Metric 3D reconstruction from uncalibrated images by the classical algorithms of multiple-view geometry."""

from __future__ import annotations

# Not from typing, whose import takes longer than that of this package.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from thesisrecon.api import *  # noqa: F403

__version__ = "0.1.0"

__all__ = [  # noqa: F405
    "BundleAdjustment", "Camera", "DepthMap", "DisparityMap", "FundamentalEstimate", "FundamentalFit",
    "Image", "ModelComparison", "PipelineConfig", "Reconstruction", "RunResult", "SelfCalibration",
    "StageFailure", "TexturedMesh", "Tracks", "TwoView", "UsageError", "__version__", "absolute_dual_quadric",
    "align_to_positions", "bundle_adjust", "cheirality", "compare_models", "depth_maps",
    "draw_epipolar_lines", "epipolar_lines", "estimate_fundamental", "estimate_homography",
    "estimate_trifocal", "export", "fuse_depth_maps", "interpolate_view", "kruppa", "load", "match_pair",
    "match_rectified", "plane_at_infinity", "read_cameras", "reconstruct", "reconstruct_from_colmap",
    "reconstruct_from_matches", "reconstruct_from_tracks", "rectify", "render", "resect", "scaled",
    "self_calibrate", "synthesize_view", "texture", "triangulate", "upgrade_affine", "write_mesh",
]  # fmt: skip

_HOMES = {
    "BundleAdjustment": "bundle_adjustment",
    "Camera": "camera",
    "DepthMap": "records",
    "FundamentalEstimate": "epipolar.estimation",
    "ModelComparison": "comparison",
    "Reconstruction": "records",
    "RunResult": "results",
    "StageFailure": "errors",
    "Tracks": "records",
    "UsageError": "errors",
    "align_to_positions": "alignment",
    "bundle_adjust": "bundle_adjustment",
    "cheirality": "geometry.camera_matrix",
    "compare_models": "comparison",
    "depth_maps": "dense_model",
    "epipolar_lines": "geometry.two_view",
    "estimate_fundamental": "epipolar.estimation",
    "estimate_homography": "epipolar.homography",
    "estimate_trifocal": "epipolar.trifocal_estimation",
    "export": "model_export",
    "fuse_depth_maps": "dense_model",
    "kruppa": "selfcalibration.kruppa",
    "read_cameras": "io._models",
    "resect": "geometry.robust_resection",
    "scaled": "alignment",
    "texture": "dense_model",
    "triangulate": "geometry.triangulation",
    "write_mesh": "io._meshes",
}
"""Modules of the names that do not import the configuration, which takes long; the others are in `api`."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'thesisrecon' has no attribute {name!r}")
    # Imported on first use, so that `import thesisrecon` takes no time.
    from importlib import import_module

    return getattr(import_module(f"thesisrecon.{_HOMES.get(name, 'api')}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
