"""What the front end finds: photographs, corners, matches, pairs with their epipolar geometry."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thesisrecon.types.arrays import B8, F32, F64, I64


@dataclass(frozen=True)
class Image:
    """One photograph at working size.

    ``rgb`` (H, W, 3) uint8; ``original_size`` (width, height) of the file after EXIF rotation.
    """

    name: str
    rgb: NDArray[np.uint8]
    original_size: tuple[int, int]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) at working size."""
        return self.rgb.shape[1], self.rgb.shape[0]

    @property
    def scale(self) -> float:
        """Working pixels per original pixel along x and y: ``xy = (xy_original + 0.5) scale - 0.5``."""
        return max(self.size) / max(self.original_size)

    @property
    def gray(self) -> F32:
        """(H, W) float32 luminance, 0 to 255 (ITU-R BT.601 weights)."""
        weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
        return np.ascontiguousarray(self.rgb.astype(np.float32) @ weights)


@dataclass(frozen=True)
class Seeds:
    """Corners of several scales with a small normalised patch each: matched without a search radius.

    ``xy`` (S, 2) px; ``scale`` (S,) px per sample unit of the level they were found on; ``angle`` (S,) rad
    of the patch (0 = upright); ``patches`` (S, D) float32, zero mean and unit norm.
    """

    xy: F64
    scale: F32
    angle: F32
    patches: F32


@dataclass(frozen=True)
class Features:
    """Corners of one photograph: ``xy`` (N, 2) px, ``scale`` (N,), ``response`` (N,) float32, strongest
    first.
    """

    xy: F64
    scale: F32
    response: F32
    seeds: Seeds | None = None


@dataclass(frozen=True)
class Matches:
    """Corners of view i taken for the same scene point as corners of view j.

    ``index1, index2`` (M,) into ``Features.xy``, each corner at most once; ``xy1, xy2`` (M, 2) px the
    positions after sub-pixel alignment of the pair; ``score`` (M,) correlation in [-1, 1]; ``affine``
    (M, 2, 2) the local map of image 1 to image 2 around the match (identity where it was not estimated).
    """

    i: int
    j: int
    index1: I64
    index2: I64
    xy1: F64
    xy2: F64
    score: F32
    affine: F64


@dataclass(frozen=True)
class PairChoice:
    """Which pairs of views are matched: ``pairs`` (M, 2) view numbers, the smaller first, sorted.

    ``how`` says in a clause how they were chosen, ``compared`` of how many pairs the overlap was estimated.
    """

    pairs: I64
    how: str
    compared: int = 0


@dataclass(frozen=True)
class Certainty:
    """Whether the matches of a pair determine its F, with the evidence; ``reasons`` say why not.

    ``off_plane`` is the number of inliers off the dominant plane (matches that share a place count as one),
    ``contradicted`` how many of these lie amid matches of the plane where no surface could;
    ``log10_false_alarms`` of how often chance gives as many. ``rival`` (3, 3) is the other F that comes
    nearest to explaining as many matches, None without one, ``rival_margin`` by how many standard errors it
    explains fewer; ``expected_error_px`` the RMS distance of exact matches to their lines after the
    covariance of F.
    """

    determined: bool
    reasons: tuple[str, ...] = ()
    off_plane: float = 0.0
    contradicted: float = 0.0
    log10_false_alarms: float = 0.0
    rival_margin: float = float("inf")
    rival: F64 | None = None
    expected_error_px: float = float("inf")


@dataclass(frozen=True)
class FundamentalFit:
    """A robust estimate of F: ``F`` (3, 3) unit Frobenius norm, ``inliers`` (M,) bool, ``sigma_px`` the
    standard deviation of one image coordinate estimated from the inliers, ``covariance`` (9, 9) of vec(F)
    row-major. ``rivals`` (K, 3, 3) are other matrices that the search ended at, the best first: where they
    explain about as many matches, F is one of several. ``certainty`` says whether the matches determine it,
    None where nobody asked.
    """

    F: F64
    inliers: B8
    sigma_px: float
    covariance: F64
    iterations: int = 0
    rivals: F64 = field(default_factory=lambda: np.empty((0, 3, 3)))
    certainty: Certainty | None = None


@dataclass(frozen=True)
class TwoView:
    """A pair of views with its epipolar geometry; the arrays hold the verified matches only.

    ``accepted`` says whether the pair enters the tracks, ``reason`` why not. ``homography_share`` is the
    share of the verified matches that one homography explains (near 1: a plane or a pure rotation).
    ``configuration`` names what the matches show ("general", "plane", "pure rotation", "pure translation"),
    empty where they are too few to tell, and ``certainty`` whether they determine F, None where that was not
    judged. A pair may be accepted with an F that is not determined: its matches are good all the same.
    """

    i: int
    j: int
    F: F64
    sigma_px: float
    index1: I64
    index2: I64
    xy1: F64
    xy2: F64
    affine: F64
    candidates: int
    homography_share: float
    accepted: bool
    reason: str = ""
    configuration: str = ""
    certainty: Certainty | None = None

    @property
    def inliers(self) -> int:
        """Number of verified matches."""
        return len(self.xy1)

    @property
    def undetermined(self) -> bool:
        """Whether F was judged and found open: other epipolar geometries explain the matches as well."""
        return self.certainty is not None and not self.certainty.determined
