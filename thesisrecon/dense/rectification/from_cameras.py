"""Planar rectification of two metric cameras: both turn about their centres to one common orientation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thesisrecon.dense.rectification.pair import EpipolarPair
from thesisrecon.dense.rectification.planar import FrameLimits, PlanarRectification, frame
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera import camera_centre, principal_ray


@dataclass(frozen=True)
class CommonOrientation:
    """Fusiello, Trucco and Verri, "A compact algorithm for rectification of stereo pairs", MVA 12(1), 2000.

    H = K R (K_i R_i)^-1 with x of the new orientation R along the baseline. They take the first camera's
    axis for the new one's plane; here it is the mean of both, so that neither photograph is turned more than
    it must. K is common but for the principal point: with the focal length f of the frame a point at depth z
    (in the new orientation) has the disparity f B / z less the difference of both origins.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """The two homographies; ``StageFailure`` without cameras and for infinite images."""
        if pair.cameras is None:
            raise StageFailure("a common orientation needs metric cameras", "", "rectify from F")
        P = pair.cameras
        centres = np.stack([camera_centre(camera) for camera in P])
        baseline = np.diff(centres[:, :3] / centres[:, 3:], axis=0)[0]
        x = baseline / np.linalg.norm(baseline)
        axis = principal_ray(P).sum(axis=0)
        z = axis - (axis @ x) * x
        if not np.linalg.norm(z) > 1e-6:
            raise StageFailure("both cameras look along the baseline", "", "rectify in polar coordinates")
        z = z / np.linalg.norm(z)
        orientation = np.stack([x, np.cross(z, x), z])
        return frame(pair, np.asarray(orientation @ np.linalg.inv(P[:, :, :3])), self.limits)
