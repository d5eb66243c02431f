"""What the front end finds: photographs, corners, matches, pairs with their epipolar geometry.

Cameras and points, what is assumed of the cameras, and what calibration says of them.

Disparities, depths, views without distortion, surfaces and renderings.

What one run did and found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F32, F64, I64, Stratum


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
    """Corners of several scales with a normalised patch each, matched without a search radius.

    Parameters
    ----------
    xy : ndarray (S, 2)
        Positions, px.
    scale : ndarray (S,)
        Pixels per sample of the pyramid level.
    angle : ndarray (S,)
        Rotation of the patch, rad; 0 = upright.
    patches : ndarray (S, D)
        Patches of zero mean and unit norm, float32.
    """

    xy: F64
    scale: F32
    angle: F32
    patches: F32


@dataclass(frozen=True)
class Features:
    """Corners of one image, strongest first.

    Parameters
    ----------
    xy : ndarray (N, 2)
        Positions, px.
    scale : ndarray (N,)
        Scale of each corner.
    response : ndarray (N,)
        Corner response, float32.
    seeds : Seeds, optional
        Patches for matching without a search radius.
    """

    xy: F64
    scale: F32
    response: F32
    seeds: Seeds | None = None


@dataclass(frozen=True)
class Matches:
    """Matched corners of views i and j.

    Parameters
    ----------
    i, j : int
        View numbers.
    index1, index2 : ndarray (M,) of int
        Indices into ``Features.xy``, each corner at most once.
    xy1, xy2 : ndarray (M, 2)
        Positions after sub-pixel alignment, px.
    score : ndarray (M,)
        Correlation in [-1, 1].
    affine : ndarray (M, 2, 2)
        Local map from image 1 to image 2; identity if it was not estimated.
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
    """The pairs of views to match.

    Parameters
    ----------
    pairs : ndarray (M, 2) of int
        View numbers, the smaller first, sorted.
    how : str
        How the pairs were selected.
    compared : int
        Number of pairs whose overlap was estimated.
    """

    pairs: I64
    how: str
    compared: int = 0


@dataclass(frozen=True)
class DegeneracyReport:
    """Whether the matches of a pair determine its F, with the evidence.

    Parameters
    ----------
    determined : bool
        True if no other F explains the matches as well.
    reasons : tuple of str
        Why F is undetermined.
    off_plane : float
        Inliers off the dominant plane; matches at one position count once.
    contradicted : float
        Those among them that lie between matches of the plane, where no surface can be.
    log10_false_alarms : float
        log10 of how often chance gives as many inliers off the plane.
    competing_margin : float
        Standard errors by which the best competing model explains fewer matches.
    competing_model : ndarray (3, 3), optional
        That model.
    expected_error_px : float
        RMS distance of exact matches to their epipolar lines by the covariance of F.
    """

    determined: bool
    reasons: tuple[str, ...] = ()
    off_plane: float = 0.0
    contradicted: float = 0.0
    log10_false_alarms: float = 0.0
    competing_margin: float = float("inf")
    competing_model: F64 | None = None
    expected_error_px: float = float("inf")


@dataclass(frozen=True)
class FundamentalFit:
    """A robust estimate of F.

    Parameters
    ----------
    F : ndarray (3, 3)
        Fundamental matrix, unit Frobenius norm.
    inliers : ndarray (M,) of bool
        Inliers.
    sigma_px : float
        Standard deviation of one image coordinate, estimated from the inliers.
    covariance : ndarray (9, 9)
        Covariance of vec(F), row-major.
    iterations : int
        Number of samples.
    competing_models : ndarray (K, 3, 3)
        Other results of the search, best first; F is ambiguous if they explain as many matches.
    degeneracy : DegeneracyReport, optional
        Whether the matches determine F; None if not tested.
    """

    F: F64
    inliers: B8
    sigma_px: float
    covariance: F64
    iterations: int = 0
    competing_models: F64 = field(default_factory=lambda: np.empty((0, 3, 3)))
    degeneracy: DegeneracyReport | None = None


@dataclass(frozen=True)
class TwoView:
    """A pair of views with its epipolar geometry and its verified matches.

    A pair may be accepted with an undetermined F: its matches are valid all the same.

    Parameters
    ----------
    i, j : int
        View numbers.
    F : ndarray (3, 3)
        Fundamental matrix.
    sigma_px : float
        Standard deviation of one image coordinate.
    index1, index2 : ndarray (M,) of int
        Corner indices of the verified matches.
    xy1, xy2 : ndarray (M, 2)
        Positions, px.
    affine : ndarray (M, 2, 2)
        Local maps from image 1 to image 2.
    candidates : int
        Number of matches before verification.
    homography_inlier_ratio : float
        Fraction of the verified matches that one homography explains; near 1 for a plane or a pure rotation.
    accepted : bool
        Whether the pair enters the tracks.
    reason : str
        Why it does not.
    configuration : str
        "general", "plane", "pure rotation" or "pure translation"; empty for too few matches.
    degeneracy : DegeneracyReport, optional
        Whether the matches determine F; None if not tested.
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
    homography_inlier_ratio: float
    accepted: bool
    reason: str = ""
    configuration: str = ""
    degeneracy: DegeneracyReport | None = None

    @property
    def inliers(self) -> int:
        """Number of verified matches."""
        return len(self.xy1)

    @property
    def undetermined(self) -> bool:
        """Whether F was tested and other epipolar geometries explain the matches as well."""
        return self.degeneracy is not None and not self.degeneracy.determined


@dataclass(frozen=True)
class Tracks:
    """Observations of scene points, sorted by (point, view).

    Parameters
    ----------
    view_index, point_index : ndarray (K,) of int
        View and point of each observation; a point at most once per view.
    xy : ndarray (K, 2)
        Positions, px.
    n_views, n_points : int
        Number of views and points.
    """

    view_index: I64
    point_index: I64
    xy: F64
    n_views: int
    n_points: int


@dataclass(frozen=True)
class Reconstruction:
    """Cameras and points in one stratum, with the tracks they explain.

    ``P`` (V, 3, 4) (zeros where not ``registered``), ``X`` (N, 4) homogeneous (zeros where not ``valid``);
    ``inlier`` (K,) bool per observation; ``reasons`` per view, empty where registered. In the metric stratum
    ``P = K [R t]`` before distortion, with ``K`` (V, 3, 3) and the coefficients k1, k2, k3 of the lens in
    ``radial`` (V, 3), no distortion where that is None: a normalised image point (x, y) is seen at (x, y) (1
    + k1 r^2 + k2 r^4 + k3 r^6), r^2 = x^2 + y^2, before K; ``X[:, 3] = 1`` where valid.
    """

    stratum: Stratum
    P: F64
    X: F64
    registered: B8
    valid: B8
    inlier: B8
    tracks: Tracks
    sizes: I64
    sigma_px: float
    reasons: tuple[str, ...]
    K: F64 | None = None
    distortion: F64 | None = None


@dataclass(frozen=True)
class Upgrade:
    """One candidate answer of self-calibration: ``metric_from_projective`` (4, 4), ``K`` (V, 3, 3) (zeros
    where not registered), the ``cost`` it reached and the ``method`` it came from.
    """

    metric_from_projective: F64
    K: F64
    cost: float
    method: str


@dataclass(frozen=True)
class IdentifiabilityReport:
    """Whether the photographs determine the calibration under what is assumed, and the critical motion that
    the cameras come nearest to.

    ``motion`` is its name ("pure translation", "turntable", ...; empty where nothing could be measured);
    ``critical`` True where the cameras cannot be told from it by what a photographer does anyhow. A critical
    motion may still be ``identifiable``: what it leaves open, the assumptions may settle. ``evidence`` maps
    the name of each measure to its number; ``sentences`` say what was found, what it means and what to do;
    ``undetermined`` are views whose own focal length is not determined.
    """

    identifiable: bool
    motion: str
    critical: bool
    evidence: Mapping[str, float]
    sentences: tuple[str, ...] = ()
    undetermined: tuple[int, ...] = ()


@dataclass(frozen=True)
class SelfCalibration:
    """The answer of chapter 7: the best upgrade, its rivals (best first, the best included), and how sure it
    is.

    ``K_std`` (V, 3, 3) standard deviations of the entries of K by the method's own residuals: 0 where an
    entry is known, that of the assumption where the method left it as assumed, NaN where nothing is known of
    it. ``identifiable`` False where the motion does not determine the answer, with ``reasons``; ``identifiability``
    is the evidence for that, None where none was gathered.
    """

    metric_from_projective: F64
    K: F64
    K_std: F64
    identifiable: bool
    reasons: tuple[str, ...]
    candidates: tuple[Upgrade, ...] = ()
    identifiability: IdentifiabilityReport | None = None

    @property
    def plane_at_infinity(self) -> F64:
        """Unit (4,) plane at infinity in the projective frame: what the upgrade takes to (0, 0, 0, 1)."""
        plane = self.metric_from_projective[3]
        return np.asarray(plane / np.linalg.norm(plane), dtype=np.float64)


@dataclass(frozen=True)
class IntrinsicInterval:
    """One intrinsic of one view: value and standard deviation (px, or a pure number) and where it is from."""

    value: float
    std: float
    source: str


@dataclass(frozen=True)
class MetricResult:
    """The end of the metric stage: the reconstruction, the intrinsics of each view with intervals, the
    self-check.

    ``intrinsics[i]`` maps "focal_px", "aspect" (fy / fx), "skew_px", "principal_x_px", "principal_y_px",
    "k1", "k2" and "k3" to an interval (empty where view i is not registered; std 0: as assumed).
    ``self_check`` holds measured numbers; ``trusted`` False with ``failed_checks`` where it failed; ``warnings``
    what should be known of a result that is trusted all the same (a focal that is borrowed, a prior that the
    photographs contradict).
    """

    reconstruction: Reconstruction
    intrinsics: tuple[Mapping[str, IntrinsicInterval], ...]
    self_check: Mapping[str, float]
    trusted: bool
    failed_checks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class DisparityMap:
    """Which pixel of the right image of a rectified pair each pixel of the left one is.

    ``disparity`` (H, W) float32: x_right = x_left - d; NaN where it is unknown or the pixel is hidden in the
    right image. ``confidence`` (H, W) float32 in [0, 1], 0 where unknown. ``sigma_px`` is the deviation of a
    confident disparity.
    """

    disparity: F32
    confidence: F32
    sigma_px: float

    def filled(self) -> F32:
        """(H, W): unknown pixels take the smaller disparity of the nearest known ones left and right in their
        row, for what is hidden is behind; a row without any stays NaN."""
        known = np.isfinite(self.disparity)
        columns = np.arange(self.disparity.shape[1])
        left = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
        right = np.minimum.accumulate(np.where(known, columns, len(columns))[:, ::-1], axis=1)[:, ::-1]
        padded = np.pad(self.disparity, ((0, 0), (1, 1)), constant_values=np.nan)
        from_left = np.take_along_axis(padded, left + 1, axis=1)
        from_right = np.take_along_axis(padded, right + 1, axis=1)
        filled: F32 = np.fmin(from_left, from_right)
        return filled


@dataclass(frozen=True)
class DepthMap:
    """Depth of the pixels of one view, distortion removed.

    ``P`` = K [R t] (3, 4) projects into this map's own pixels, which may be fewer than the photograph's.
    ``depth`` (H, W) float32 is z in the camera frame, NaN where unknown; ``std`` (H, W) float32 its
    deviation; ``views`` (H, W) uint8 how many other views confirm it.
    """

    view: int
    P: F64
    depth: F32
    std: F32
    views: NDArray[np.uint8]


@dataclass(frozen=True)
class PinholeView:
    """A photograph with its distortion removed: ``P`` = K [R t] (3, 4), ``rgb`` (H, W, 3) uint8, ``seen``
    (H, W) the pixels that the photograph has."""

    view: int
    P: F64
    rgb: NDArray[np.uint8]
    seen: B8


@dataclass(frozen=True)
class TexturedMesh:
    """A triangulated surface, by itself or with colours.

    ``vertices`` (N, 3); ``faces`` (M, 3) int64, anticlockwise seen from outside. ``colors`` (N, 3) uint8 of
    the vertices, or a texture: ``texture`` (H, W, 3) uint8 with ``uv`` (M, 3, 2) of every corner of every
    face, in texels, x right, y down, (0, 0) the centre of the top-left texel. Either may be None.
    ``untextured`` (M,) marks faces that no view sees.
    """

    vertices: F64
    faces: I64
    colors: NDArray[np.uint8] | None = None
    uv: F64 | None = None
    texture: NDArray[np.uint8] | None = None
    untextured: B8 | None = None


@dataclass(frozen=True)
class RenderedView:
    """What a camera sees of a mesh: ``color`` (H, W, 3) uint8, ``depth`` (H, W) float32 (z in the camera
    frame, NaN where nothing is), ``valid`` (H, W) where there is a surface."""

    color: NDArray[np.uint8]
    depth: F32
    valid: B8


@dataclass(frozen=True)
class HeldOut:
    """A photograph that gave the model no texture, beside the model as its camera sees it.

    ``view`` its number; ``real, rendered`` (H, W, 3) uint8, the photograph without its distortion and the
    picture of the model; ``compared`` (H, W) the pixels that both have and the numbers are of; ``psnr_db``
    peak signal-to-noise ratio in dB; ``ssim`` structural similarity, 1 = the same.

    Raises
    ------
    ValueError
        where the pictures and the mask are not of one size.
    """

    view: int
    real: NDArray[np.uint8]
    rendered: NDArray[np.uint8]
    compared: B8
    psnr_db: float
    ssim: float

    def __post_init__(self) -> None:
        shapes = (self.real.shape, self.rendered.shape, (*self.compared.shape, 3))
        if len(set(shapes)) > 1:
            raise ValueError(f"a held-out comparison needs pictures and a mask of one size; got {shapes}")

    @property
    def share(self) -> float:
        """Part of the pixels that were compared."""
        return float(self.compared.mean()) if self.compared.size else 0.0


@dataclass(frozen=True)
class StageReport:
    """What one stage did: seconds, counts, metrics (name -> number), warnings (sentences)."""

    stage: str
    seconds: float
    counts: Mapping[str, int] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class RunResult:
    """Everything one run found; what lies beyond ``until`` or could not be made is None.

    ``images`` are the V views at working size, ``features`` one per view, ``pairs`` every pair that was
    matched, accepted or not, and ``pair_choice`` how these were chosen. ``refused`` maps the photographs
    that never became a view to the reason; a view that was not registered has its reason in
    ``metric.reconstruction.reasons``. ``groups`` (V,) is the camera number of each view. ``reports`` holds
    one record per stage, ``settings`` the configuration as plain tables (stage -> field -> value),
    ``summary`` what ``summary.json`` says. All coordinates are pixels at working size; ``summary`` and the
    exported model are in original pixels. ``failure`` is the sentence that ended the run early, empty
    otherwise.
    """

    out: Path
    images: tuple[Image, ...]
    refused: Mapping[str, str]
    features: tuple[Features, ...]
    pairs: tuple[TwoView, ...]
    groups: I64
    settings: Mapping[str, Mapping[str, Any]]
    pair_choice: PairChoice | None = None
    tracks: Tracks | None = None
    projective: Reconstruction | None = None
    calibration: SelfCalibration | None = None
    metric: MetricResult | None = None
    views: tuple[PinholeView, ...] = ()
    depth_maps: tuple[DepthMap, ...] = ()
    mesh: TexturedMesh | None = None
    held_out: HeldOut | None = None
    reports: tuple[StageReport, ...] = ()
    warnings: tuple[str, ...] = ()
    summary: Mapping[str, Any] = field(default_factory=dict)
    failure: str = ""
