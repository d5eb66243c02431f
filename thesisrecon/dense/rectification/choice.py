"""The front doors of rectification, and the choice among its methods by what they do to the photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from thesisrecon.dense.rectification.from_cameras import CommonOrientation
from thesisrecon.dense.rectification.from_fundamental import Hartley, LeastDistortion, LoopZhang
from thesisrecon.dense.rectification.pair import EpipolarPair, Size, pair_of_cameras, pair_of_fundamental
from thesisrecon.dense.rectification.planar import FrameLimits, PlanarRectification, disparity_bounds
from thesisrecon.dense.rectification.polar import Polar, PolarRectification
from thesisrecon.dense.rectification.quality import RectificationQuality, measure_quality
from thesisrecon.errors import StageFailure
from thesisrecon.types import F64

AnyRectification = PlanarRectification | PolarRectification
Method = Literal["best", "hartley", "loop-zhang", "least-distortion", "polar", "metric"]


class Rectifier(Protocol):
    """A way of rectifying a pair."""

    def rectify(self, pair: EpipolarPair) -> AnyRectification:
        """Both maps; ``StageFailure`` where the pair cannot be rectified so."""


@dataclass(frozen=True)
class LeastDistorted:
    """The one of several methods that distorts a pair least, measured by ``RectificationQuality.distortion``.

    Methods that keep the angle of a photograph's midlines within ``angle_deg`` of a right one and their ratio
    within ``aspect`` of its own come before the others, and methods that fail for a pair are passed over.
    Added are ``bending`` for polar frames, which bend straight lines, and ``size`` times the log of the
    frame's pixels over the photograph's, which cost time and tell nothing new.
    """

    methods: tuple[Rectifier, ...]
    angle_deg: float = 5.0
    aspect: float = 0.1
    bending: float = 0.03
    size: float = 0.05

    def rectify(self, pair: EpipolarPair) -> AnyRectification:
        """The best of those that succeed; the last one's ``StageFailure`` where none does."""
        best: AnyRectification | None = None
        least, failure = (True, np.inf), None
        for method in self.methods:
            try:
                found = method.rectify(pair)
            except StageFailure as reason:
                failure = reason
                continue
            cost = self._cost(found, measure_quality(found, pair))
            if best is None or cost < least:
                best, least = found, cost
        if best is None:
            raise failure if failure is not None else ValueError("a choice needs methods to choose from")
        return best

    def _cost(self, found: AnyRectification, quality: RectificationQuality) -> tuple[bool, float]:
        # A midline through the epipole of a polar frame has no angle.
        turned = max((abs(a - 90.0) for a in quality.orthogonality_deg if np.isfinite(a)), default=0.0)
        aspect = max((abs(a - 1.0) for a in quality.aspect if np.isfinite(a)), default=0.0)
        bent = self.bending if isinstance(found, PolarRectification) else 0.0
        cost = quality.distortion + bent + self.size * np.log(quality.growth)
        return turned > self.angle_deg or aspect > self.aspect, float(cost)


def _methods(limits: FrameLimits) -> Mapping[Method, Rectifier]:
    return {
        "hartley": Hartley(limits),
        "loop-zhang": LoopZhang(limits),
        "least-distortion": LeastDistortion(limits),
        "polar": Polar(limits),
        "metric": CommonOrientation(limits),
    }


def rectify(
    pair: EpipolarPair, *, method: Method = "best", limits: FrameLimits | None = None
) -> AnyRectification:
    """Rectify a pair by one method, or by whichever of those it has the data for distorts least.

    Raises ``ValueError`` for an unknown method, ``StageFailure`` for a pair that it cannot rectify.
    """
    limits = FrameLimits() if limits is None else limits
    methods = _methods(limits)
    if method == "best":
        bare = Polar(limits, most_scale=0.0, most_shear=0.0)
        return LeastDistorted((*methods.values(), bare)).rectify(pair)
    if method not in methods:
        raise ValueError(f"a method of rectification is one of {['best', *methods]}; got {method!r}")
    return methods[method].rectify(pair)


def rectify_pair(
    F: F64, xy1: F64, xy2: F64, size1: Size, size2: Size, *, method: Method = "best"
) -> AnyRectification:
    """Rectify two photographs of which only F and its inliers are known (thesis, section 2.5).

    Parameters
    ----------
    F : (3, 3) with x2' F x1 = 0. xy1, xy2 : (N >= 8, 2) px matches that obey it.
    size1, size2 : (width, height) px.
    method : "hartley", "loop-zhang", "least-distortion" (planar), "polar", or the "best" of them.

    Returns
    -------
    Maps between either photograph and a frame common to both in which epipolar lines are rows, side 0 the
    first photograph and side 1 the second: x_right = x_left - d, d larger for nearer points. With the
    focal lengths unknown, "nearer" is judged with usual ones.

    Raises ``ValueError`` for wrong shapes and sizes, ``StageFailure`` for pairs without parallax, too few or
    contradictory matches, and for planar methods where the epipole is in a photograph.
    """
    return rectify(pair_of_fundamental(F, xy1, xy2, size1, size2), method=method)


def rectify_cameras(
    P1: F64,
    P2: F64,
    size1: Size,
    size2: Size,
    *,
    xy1: F64 | None = None,
    xy2: F64 | None = None,
    method: Method = "best",
) -> AnyRectification:
    """Rectify two photographs without lens distortion taken by metric cameras P = K [R t] (3, 4).

    As :func:`rectify_pair`, with "metric" (a common orientation) as one more method. Matches (N, 2) px that
    obey the cameras crop the frame to what both see, and "hartley" needs them.
    """
    return rectify(pair_of_cameras(P1, P2, size1, size2, xy1=xy1, xy2=xy2), method=method)


def disparity_range(
    rectification: AnyRectification, xy1: F64, xy2: F64, *, margin: float = 0.15
) -> tuple[int, int]:
    """Whole disparities (least, greatest) to search in, from matches (N, 2), (N, 2) px of the photographs.

    The 1 and 99 % quantiles of those inside the frame, widened at either end by ``margin`` times their
    difference and 2 px. Raises ``StageFailure`` where no match is inside.
    """
    left = rectification.rectified_from_original(0, xy1)
    right = rectification.rectified_from_original(1, xy2)
    d = left[:, 0] - right[:, 0]
    d = d[np.isfinite(d)]
    if len(d) == 0:
        raise StageFailure(
            "the range of disparities is not known", "no match is inside the rectified frame", "give one"
        )
    low, high = disparity_bounds(d, margin=margin)
    return int(np.floor(low)) - 2, int(np.ceil(high)) + 2
