"""Examples on the pages of records."""

RETURNED_BY = {
    "BundleAdjustment": "bundle_adjust",
    "DepthMap": "depth_maps",
    "DisparityMap": "match_rectified",
    "FundamentalEstimate": "estimate_fundamental",
    "FundamentalFit": "estimate_fundamental",
    "ModelComparison": "compare_models",
    "Reconstruction": "upgrade_affine",
    "RunResult": "reconstruct_from_matches",
    "SelfCalibration": "self_calibrate",
    "TexturedMesh": "fuse_depth_maps",
    "Tracks": "reconstruct_from_tracks",
    "TwoView": "match_pair",
}
"""Exported records without an example of their own, and the function whose example makes or takes one."""
