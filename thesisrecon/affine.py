"""The affine stratum of a reconstruction: the front door to it, and what a run keeps of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thesisrecon.assumptions import assume
from thesisrecon.config import PipelineConfig, seeing
from thesisrecon.io.pointcloud import write_point_cloud
from thesisrecon.run import stream
from thesisrecon.selfcalibration import Stratified, affine_camera_centres, upgrade_to_affine
from thesisrecon.types import F64, Image, Reconstruction, RunResult

U8 = NDArray[np.uint8]

FARTHEST_AFFINE = 1e3
"""Points of the affine file are within this many standard deviations of the bulk of them."""


def upgrade_affine(
    reconstruction: Reconstruction,
    plane: F64 | None = None,
    *,
    config: PipelineConfig | None = None,
    photographs: Sequence[Image] = (),
    seed: int = 0,
) -> Reconstruction:
    """A projective reconstruction in an affine frame: parallels and ratios along them are those of the scene.

    ``plane`` (4,) is the plane at infinity in the projective frame. Without one it is located: by the plane's
    way alone where ``config.selfcalibration`` is :class:`~thesisrecon.selfcalibration.Stratified`, so that no
    calibration is needed, else as that of :func:`self_calibrate`. Raises :class:`StageFailure` where none is
    found.
    """
    if plane is None:
        config = config or PipelineConfig()
        variant = seeing(config.selfcalibration, photographs) if photographs else config.selfcalibration
        rng = stream(seed, "selfcalibration")
        assumed = assume(reconstruction, config.intrinsics)
        if isinstance(variant, Stratified):
            plane = variant.locate(reconstruction, assumed=assumed, rng=rng)
        else:
            plane = variant.calibrate(reconstruction, assumed=assumed, rng=rng).plane_at_infinity
    return upgrade_to_affine(reconstruction, plane)


def affine_of(result: RunResult) -> Reconstruction | None:
    """The affine stratum that the run passed through, None where it got to none.

    That is its projective reconstruction under the plane at infinity of self-calibration."""
    if result.projective is None or result.calibration is None:
        return None
    return upgrade_to_affine(result.projective, result.calibration.plane_at_infinity)


def write_affine(path: Path, affine: Reconstruction | None, colours: U8) -> None:
    """Points in their colours (N, 3) and the camera centres in red, in an affine frame; the nearer part of
    them, since points near infinity have no place in a viewer. Nothing without a reconstruction."""
    if affine is None:
        return
    X = affine.X[:, :3]
    near = affine.valid & (np.abs(X) < FARTHEST_AFFINE).all(axis=1)
    centres = affine_camera_centres(affine)
    centres = centres[np.isfinite(centres).all(axis=1)]
    red = np.tile(np.array([255, 0, 0], dtype=np.uint8), (len(centres), 1))
    write_point_cloud(path, np.concatenate([X[near], centres]), np.concatenate([colours[near], red]))
