"""The configuration: one field per stage, each holding the object that does its work.

Presets: ``default`` (best results) and ``thesis`` (the pipeline of the thesis). Its text form, TOML and
``--set``, is read and written by :mod:`thesisrecon.config.text`.
"""

import logging
import re
import typing
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.config.plug_ins import FunctionMatcher, as_method
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.ransac import ThesisRansac
from thesisrecon.epipolar.verification import PairVerification
from thesisrecon.errors import UsageError, in_words, require_range, unknown_word
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.matching._prepared import EstimateFundamental, MapAll
from thesisrecon.matching.growth import SeedsAndGrowth
from thesisrecon.matching.pair_selection import AllPairs, ListedPairs, OverlapEstimate, SequenceWindow
from thesisrecon.matching.strength import StrengthOfMatch
from thesisrecon.matching.tracks import AlignedTracks, PlainTracks
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.projective.incremental import IncrementalProjective, SequentialProjective
from thesisrecon.records import (
    DepthMap,
    DisparityMap,
    Features,
    FundamentalFit,
    Image,
    IntrinsicsPrior,
    Matches,
    MetricResult,
    PairChoice,
    PinholeView,
    Reconstruction,
    SelfCalibration,
    TexturedMesh,
    Tracks,
    TwoView,
)
from thesisrecon.selfcalibration.kruppa import KruppaEquations
from thesisrecon.selfcalibration.quadric import HypothesesAndRefinement, LinearQuadric, NonlinearQuadric
from thesisrecon.selfcalibration.stratified import Stratified
from thesisrecon.stereo.correspondence import PairMatching, RectifiedPair
from thesisrecon.stereo.depth import MultiViewScene, MultiViewStereo
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline
from thesisrecon.surface.bspline import BSplineSurface
from thesisrecon.surface.fusion import DepthSheets
from thesisrecon.surface.model import SurfaceModel

# A new method is one word here.
_METHODS: Mapping[str, Sequence[type[Any]]] = {
    "features": (MultiScaleCorners, HarrisCorners),
    "pairs": (AllPairs, OverlapEstimate, SequenceWindow, ListedPairs),
    "matching": (SeedsAndGrowth, StrengthOfMatch),
    "epipolar": (LocallyOptimisedRansac, ThesisRansac),
    "verification": (PairVerification,),
    "tracks": (AlignedTracks, PlainTracks),
    "projective": (IncrementalProjective, SequentialProjective),
    "selfcalibration": (
        HypothesesAndRefinement, Stratified, LinearQuadric, NonlinearQuadric, KruppaEquations,
    ),
    "metric": (MetricRefinement,),
    "dense": (MultiViewStereo,),
    "model": (SurfaceModel,),
}  # fmt: skip


def word_of(kind: type[Any]) -> str:
    """The name of a class in text, in kebab case: "modulus-constraint" for ``ModulusConstraint``."""
    return re.sub(r"(?<!^)(?=[A-Z])", "-", kind.__name__).lower()


KINDS = {stage: {word_of(method): method for method in methods} for stage, methods in _METHODS.items()}
"""Stage -> word in text -> class."""


# `rng` is the source of randomness, which deterministic methods ignore; views are numbered like images.


class Detector(Protocol):
    """Detect the features of one image (4.2.1)."""

    def detect(self, image: Image) -> Features:
        """Detect the corners, strongest first, in pixels of the image, and for some detectors the seeds."""


class PairSelector(Protocol):
    """Select the pairs of images to match."""

    def select(
        self, names: Sequence[str], features: Sequence[Features], *, map_all: MapAll, rng: np.random.Generator
    ) -> PairChoice:
        """Select pairs of images by their names and features; ``map_all`` is a parallel map.

        Features without the seeds that are needed are a ``UsageError``.
        """


class Matcher(Protocol):
    """Match the features of two images (4.2.2)."""

    def prepare(self, image: Image, features: Features) -> Any:
        """Do the work that depends on one image, and return the data of the image that ``match`` needs."""

    def match(
        self, view1: Any, view2: Any, *, pair: tuple[int, int], estimate_fundamental: EstimateFundamental,
        rng: np.random.Generator,
    ) -> Matches:  # fmt: skip
        """Match the corners of two prepared images one-to-one; there may be no matches.

        ``pair`` are the numbers of the views, ``estimate_fundamental`` is the robust estimator of F for
        guided matching. Features without the seeds that are needed are a ``UsageError``.
        """


class FundamentalEstimator(Protocol):
    """Estimate F from matches with outliers (chapter 5)."""

    def estimate(self, xy1: F64, xy2: F64, rng: np.random.Generator) -> FundamentalFit:
        """Estimate F of matched points ``xy1``, ``xy2`` (N, 2), px, with outliers; all numbers are finite.

        A ``StageFailure`` if there are too few or collinear matches, or no F has 8 inliers.
        """


class Verifier(Protocol):
    """Decide whether a pair and its F are accepted, and which matches are inliers."""

    def verify(self, matches: Matches, fit: FundamentalFit, rng: np.random.Generator) -> TwoView:
        """Accept or reject a pair by all of its matches and the F estimated from them."""


class TrackBuilder(Protocol):
    """Join pairwise matches to tracks."""

    def build(
        self, prepared: Sequence[Any], pairs: Sequence[TwoView], *, map_all: MapAll, rng: np.random.Generator
    ) -> Tracks:
        """Join the accepted pairs of prepared images to tracks with at most one corner per view.

        ``map_all`` is a parallel map.
        """


class ProjectiveReconstructor(Protocol):
    """Reconstruction up to a projective transform (chapter 6)."""

    def reconstruct(
        self, tracks: Tracks, pairs: Sequence[TwoView], sizes: I64, *, rng: np.random.Generator,
        attempt: int = 0,
    ) -> Reconstruction:  # fmt: skip
        """Reconstruct cameras and points from a selection of the tracks and verified pairs.

        ``sizes`` (V, 2) are width and height of the images; each ``attempt`` begins with another initial
        pair. A ``StageFailure`` if no pair is accepted, shows parallax or is left.
        """


class SelfCalibrator(Protocol):
    """Self-calibration of a projective reconstruction (chapter 7)."""

    def calibrate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator
    ) -> SelfCalibration:
        """Upgrade a projective reconstruction of at least three cameras by the prior of every view.

        Returns upgrades and calibrations, best first, with the identifiability report. A ``StageFailure`` if
        none places the points in front of the cameras.
        """


class MetricRefiner(Protocol):
    """Refine the metric model: missing cameras, bundle adjustment, intervals and self-check."""

    def refine(
        self, reconstruction: Reconstruction, calibration: SelfCalibration, *, prior: IntrinsicsPrior,
        rng: np.random.Generator, threads: int,
    ) -> MetricResult:  # fmt: skip
        """Refine a projective reconstruction to the metric model; all candidate calibrations are tried.

        Returns cameras, points, intrinsics with intervals, and the self-check, which do not depend on the
        number of ``threads``. A ``StageFailure`` if no candidate gives a metric model.
        """


class StereoMatcher(Protocol):
    """Match two views; :func:`thesisrecon.reconstruct` does not need it."""

    def match_rectified(self, left: Any, right: Any, *, max_disparity_px: float) -> DisparityMap:
        """Compute the disparities of a rectified pair, x_right = x_left - d, NaN = unknown or occluded.

        The images (H, W) or (H, W, 3) have grey levels 0 .. 255, integer or floating point, NaN = no pixel;
        ``max_disparity_px`` is the disparity of the nearest point.
        """

    def match_two_views(
        self, image1: Image, image2: Image, F: F64, xy1: F64, xy2: F64, *, planar: bool = False
    ) -> RectifiedPair:
        """Rectify two images by their F and at least 8 inliers, and match both directions.

        ``planar`` allows homographies only.
        """


class DepthEstimator(StereoMatcher, Protocol):
    """Estimate depth maps view by view (2.5); ``scene`` contains all views or at least ``required_views``."""

    def prepare(
        self, images: Sequence[Image], reconstruction: Reconstruction, *, depth_range: F64 | None = None,
        threads: int = 1,
    ) -> MultiViewScene:  # fmt: skip
        """Undistort the images of a metric reconstruction and select the neighbours of each.

        The depths to search are ``depth_range`` (V, 2), nearest and farthest, else follow from the points of
        the reconstruction, else from the cameras.
        """

    def required_views(self, scene: MultiViewScene, view: int) -> frozenset[int]:
        """Return the views, this one included, that its depth map and the confirmation of it need."""

    def depth_map(self, scene: MultiViewScene, view: int, *, pool: Executor | None = None) -> DepthMap:
        """Compute the depth map of one view from its neighbours; idle threads of ``pool`` may take part.

        NaN = unknown, everywhere if the view has no neighbours or all pairs fail; ``views`` counts the
        neighbours that agree.
        """

    def confirm(self, scene: MultiViewScene, depth_maps: Mapping[int, DepthMap], view: int) -> DepthMap:
        """Complete a result of ``depth_map``, and keep the depths that the maps of other views confirm.

        ``views`` is then the number of confirming views.
        """


class ModelBuilder(Protocol):
    """Fuse depth maps to a textured surface (2.6); the result does not depend on ``threads``."""

    def build(
        self, depth_maps: Sequence[DepthMap], views: Sequence[PinholeView], *, threads: int = 1
    ) -> TexturedMesh:
        """Build the textured surface of a scene.

        A ``StageFailure`` if the maps contain no depths or no view sees the surface.
        """

    def color(self, surface: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1) -> TexturedMesh:
        """Texture a surface from views, perhaps fewer than those of its depth maps."""


@dataclass(frozen=True)
class ImageOptions:
    """How images are read."""

    max_size_px: int = 1600  #: larger images are reduced to this long side
    groups: bool = True  #: reconstruct each group of 3 or more images with too little overlap with the others
    #: maximum number of images (approximately) that are reconstructed together; larger sets are divided into
    #: overlapping parts if a division separates few of the common points; 0: never
    part_views: int = 400
    gps: bool = False  #: move the model to the GPS of EXIF: metres east, north and up of their median
    #: standard deviation of a coordinate of these positions, which are then observations of the adjustment,
    #: too; 0: they determine the frame alone
    gps_std_m: float = 0.0
    #: "auto": without GPS the model is turned until z is up, by vertical lines of the scene if most nearly
    #: vertical ones agree, else by the level sides of the images
    up: Literal["none", "auto"] = "none"
    #: "mask": leave out pixels that look the same at the same place in most of at least four images while
    #: others move: a text, a part of the vehicle, the room around a turntable
    static: Literal["mask", "keep"] = "mask"

    def __post_init__(self) -> None:
        require_range(self, max_size_px="[64, inf)", part_views="[0, inf)", gps_std_m="[0, inf)")
        if self.gps_std_m and not self.gps:
            raise ValueError(f"gps_std_m = {self.gps_std_m} has no effect without gps = true")


@dataclass(frozen=True)
class PipelineConfig:
    """Settings of the whole pipeline; the defaults are the preset ``default``.

    Parameters
    ----------
    images, intrinsics : ImageOptions, IntrinsicsOptions
        How images are read, and prior knowledge of the cameras.
    features, pairs, matching, ... : Detector, PairSelector, Matcher, ...
        The method of each stage: any object with the methods of its ``Protocol``; a ``UsageError`` if it does
        not fit. ``features``, ``matching`` and ``epipolar`` also take a plain function
        (:mod:`thesisrecon.config.plug_ins`).

    Examples
    --------
    >>> from thesisrecon import PipelineConfig
    >>> from thesisrecon.config import ImageOptions
    >>> config = PipelineConfig(images=ImageOptions(max_size_px=800))
    >>> type(config.epipolar).__name__
    'LocallyOptimisedRansac'
    >>> type(PipelineConfig(matching=lambda image1, image2: ([], [])).matching).__name__
    'FunctionMatcher'
    """

    images: ImageOptions = ImageOptions()
    intrinsics: IntrinsicsOptions = field(default_factory=IntrinsicsOptions)
    features: Detector = field(default_factory=MultiScaleCorners)
    pairs: PairSelector = field(default_factory=OverlapEstimate)
    matching: Matcher = field(default_factory=SeedsAndGrowth)
    # Tracks are built from precise matches only.
    epipolar: FundamentalEstimator = field(default_factory=lambda: LocallyOptimisedRansac(inlier_sigmas=2.5))
    verification: Verifier = field(default_factory=PairVerification)
    tracks: TrackBuilder = field(default_factory=AlignedTracks)
    projective: ProjectiveReconstructor = field(default_factory=IncrementalProjective)
    selfcalibration: SelfCalibrator = field(default_factory=HypothesesAndRefinement)
    metric: MetricRefiner = field(default_factory=MetricRefinement)
    dense: DepthEstimator = field(default_factory=MultiViewStereo)
    model: ModelBuilder = field(default_factory=SurfaceModel)

    def __post_init__(self) -> None:
        for stage, kind in typing.get_type_hints(PipelineConfig).items():
            value = getattr(self, stage)
            if stage in KINDS:
                object.__setattr__(self, stage, as_method(stage, value, kind))
            elif not isinstance(value, kind):
                raise UsageError(f"{stage} takes {kind.__name__}(...); got {in_words(value)}")
        if isinstance(self.matching, FunctionMatcher) and self.tracks == AlignedTracks():
            logging.getLogger(__name__).info("matches of a function are not aligned: tracks=PlainTracks()")
            object.__setattr__(self, "tracks", PlainTracks())


PRESETS: Mapping[str, PipelineConfig] = {
    "default": PipelineConfig(),
    "thesis": PipelineConfig(
        features=HarrisCorners(),
        pairs=AllPairs(),
        matching=StrengthOfMatch(),
        epipolar=ThesisRansac(),
        tracks=PlainTracks(),
        projective=SequentialProjective(),
        selfcalibration=Stratified(),
        dense=MultiViewStereo(
            # This matcher also assigns disparities to textureless regions, with low confidence.
            pairs=PairMatching(matcher=MaximumLikelihoodScanline(), min_confidence=0.25),
            sequence_links=4,
            refinement=False,
        ),
        # "By fitting parametric surfaces through the points ... sampled in a fine scale triangular pattern".
        model=SurfaceModel(surface=BSplineSurface(), fusion=DepthSheets()),
        # The thesis has no distortion model and fixes the principal point at the image centre.
        intrinsics=IntrinsicsOptions(principal_point="known", k1="known"),
    ),
}


def preset(name: Any) -> PipelineConfig:
    """Return the preset of a name; an unknown name is a ``UsageError``."""
    if not isinstance(name, str) or name not in PRESETS:
        raise UsageError(unknown_word("preset", name, PRESETS))
    return PRESETS[name]
