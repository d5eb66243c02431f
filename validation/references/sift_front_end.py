"""OpenCV's SIFT as a front end of the pipeline.

Its matches use our estimator of F and our verification.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.config import EstimateFundamental, PipelineConfig
from thesisrecon.records import Features, Image, Matches
from validation.references.sift import SiftKeypoints, detect_sift, grey_of, match_sift


@dataclass(frozen=True)
class SiftCorners:
    """SIFT keypoints, all of them, in the place of corners."""

    def detect(self, image: Image) -> Features:
        """The keypoints, strongest first."""
        found = detect_sift(grey_of(image))
        order = np.argsort(-found.response, kind="stable")
        return Features(found.xy[order], found.size[order], found.response[order])


@dataclass(frozen=True)
class SiftRatioTest:
    """Matches of SIFT descriptors, each the other's nearest, that pass the ratio test."""

    ratio: float = 0.8

    def prepare(self, image: Image, features: Features) -> SiftKeypoints:  # noqa: ARG002
        """The keypoints with their descriptors."""
        return detect_sift(grey_of(image))

    def match(
        self,
        view1: SiftKeypoints,
        view2: SiftKeypoints,
        *,
        pair: tuple[int, int],
        estimate_fundamental: EstimateFundamental,  # noqa: ARG002
        rng: np.random.Generator,  # noqa: ARG002
    ) -> Matches:
        """Matches by descriptors alone."""
        one, two = match_sift(view1, view2, ratio=self.ratio, mutual=True).T
        affine = np.broadcast_to(np.eye(2), (len(one), 2, 2)).copy()
        score = np.ones(len(one), np.float32)
        return Matches(*pair, one, two, view1.xy[one], view2.xy[two], score, affine)


def sift_front_end(config: PipelineConfig) -> PipelineConfig:
    """The same pipeline with SIFT in the place of corners and correlation."""
    return replace(config, features=SiftCorners(), matching=SiftRatioTest())
