"""Client of the installed package: mypy --strict checks it, ``assert_type`` states every returned type."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import assert_type

import numpy as np

import thesisrecon
from thesisrecon.arrays import F64, U8
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.records import DisparityMap, RenderedView, SelfCalibration, TexturedMesh, TwoView
from thesisrecon.results import RunResult


def points_of_two(first: Path, second: Path) -> F64:
    """Return space points of two images in a projective frame."""
    pair = thesisrecon.match_pair(first, second, seed=1)
    assert_type(pair, TwoView)
    assert_type(pair.sigma_px, float)
    fit = thesisrecon.estimate_fundamental(pair.xy1, pair.xy2, threshold_px=1.0)
    assert_type(fit.F, F64)
    P = np.stack([np.eye(3, 4), np.eye(3, 4)])
    X = thesisrecon.triangulate(P, np.stack([pair.xy1, pair.xy2]), method="polynomial")
    return assert_type(X, F64)


def focal_lengths(images: Path, out: Path) -> dict[str, float]:
    """Return the focal length (px) of every image of a folder, by the run and by its projective part."""
    config = thesisrecon.PipelineConfig()
    result = thesisrecon.reconstruct(images, out, config=config, seed=0, until="metric", threads=2)
    assert_type(result, RunResult)
    if result.projective is not None:
        calibration = thesisrecon.self_calibrate(result.projective, config=config)
        assert_type(calibration, SelfCalibration)
        assert_type(calibration.reasons, tuple[str, ...])
    if result.metric is None or result.metric.reconstruction.K is None:
        return {}
    K = assert_type(result.metric.reconstruction.K, F64)
    return {image.name: float(k[0, 0]) for image, k in zip(result.images, K, strict=True)}


def pictures(left: U8, right: U8, mesh: TexturedMesh) -> list[U8]:
    """Render views between two rectified images, beside them, and of a model."""
    found = thesisrecon.match_rectified(left, right, max_disparity_px=64)
    assert_type(found, DisparityMap)
    between = thesisrecon.interpolate_view(left, right, 0.5, disparity=found)
    beside = thesisrecon.synthesize_view(left, right, np.eye(3), np.zeros(3))
    camera = thesisrecon.Camera(np.diag([500.0, 500.0, 1.0]), np.eye(3), np.zeros(3), (640, 480))
    drawn = thesisrecon.render(mesh, camera)
    assert_type(drawn, RenderedView)
    return [assert_type(between, U8), assert_type(beside, U8), assert_type(drawn.color, U8)]


def main() -> int:
    """Describe the result of a folder of images, or its failure."""
    try:
        for name, focal_px in focal_lengths(Path(sys.argv[1]), Path(sys.argv[2])).items():
            print(f"{name}: {focal_px:.1f} px")
    except (StageFailure, UsageError) as error:
        print(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
