"""Error measures of cameras, images and surfaces, and the bounds of what is possible.

The names here are for studies of your own.
"""

from validation.metrics.cameras import (
    area_under_recall,
    mean_accuracy,
    measure_cameras,
    measure_reprojection,
    pose_pair_errors,
    recall,
    relative_pose_errors,
)
from validation.metrics.depth import bad_pixels
from validation.metrics.focal_bound import focal_bound
from validation.metrics.fundamental_precision import (
    epipolar_distance_interval,
    fundamental_bound,
    rms_epipolar_distance,
)
from validation.metrics.searches import traced

__all__ = [
    "area_under_recall",
    "bad_pixels",
    "epipolar_distance_interval",
    "focal_bound",
    "fundamental_bound",
    "mean_accuracy",
    "measure_cameras",
    "measure_reprojection",
    "pose_pair_errors",
    "recall",
    "relative_pose_errors",
    "rms_epipolar_distance",
    "traced",
]
