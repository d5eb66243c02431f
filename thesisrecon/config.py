"""The configuration: one field per stage, each holding the object that does its work.

Presets: ``default`` (best results) and ``thesis`` (the pipeline of the thesis). In TOML and ``--set`` a stage
is a table: ``kind`` selects the method, the other keys are its fields.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.ransac import ThesisRansac
from thesisrecon.epipolar.verification import PairVerification
from thesisrecon.errors import UsageError
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.intrinsics import IntrinsicsOptions, IntrinsicsPrior
from thesisrecon.matching.growth import SeedsAndGrowth
from thesisrecon.matching.overlap import MapAll
from thesisrecon.matching.pair_selection import AllPairs, ListedPairs, OverlapEstimate, SequenceWindow
from thesisrecon.matching.strength import StrengthOfMatch
from thesisrecon.matching.tracks import AlignedTracks, PlainTracks
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.projective.factorization import Factorization
from thesisrecon.projective.incremental import IncrementalProjective
from thesisrecon.projective.sequential import SequentialProjective
from thesisrecon.records import (
    DepthMap,
    DisparityMap,
    Features,
    FundamentalFit,
    Image,
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
from thesisrecon.selfcalibration.focal_scan import FocalScan
from thesisrecon.selfcalibration.focals_from_fundamental import FocalsFromFundamental
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from thesisrecon.selfcalibration.kruppa import KruppaEquations
from thesisrecon.selfcalibration.quadric import LinearQuadric, NonlinearQuadric, ScannedQuadric
from thesisrecon.selfcalibration.stratified import Stratified
from thesisrecon.settings import (
    Table,
    dataclass_from_table,
    in_words,
    parse_word,
    table_from_dataclass,
    toml_from_tables,
    unknown_setting,
    unknown_word,
)
from thesisrecon.stereo.correspondence import PairMatching, RectifiedPair
from thesisrecon.stereo.depth import MultiViewScene, MultiViewStereo
from thesisrecon.stereo.depth_fusion import SequenceLinking
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline
from thesisrecon.surface.bspline import BSplineSurface
from thesisrecon.surface.fusion import DepthSheets
from thesisrecon.surface.model import SurfaceModel

PRECISE_SIGMAS = 2.5
"""Inlier gate of the default estimator: tracks are built from precise matches only."""

MAX_DEPTH = 16
"""Maximum nesting of a setting, from its stage to its field."""

EstimateFundamental = Callable[[F64, F64, np.random.Generator], FundamentalFit]

# Stage -> word in text -> class. A new method is one line here.
KINDS: Mapping[str, Mapping[str, type[Any]]] = {
    "features": {"multi-scale-corners": MultiScaleCorners, "harris-corners": HarrisCorners},
    "pairs": {
        "all-pairs": AllPairs,
        "overlap-estimate": OverlapEstimate,
        "sequence-window": SequenceWindow,
        "listed-pairs": ListedPairs,
    },
    "matching": {"seeds-and-growth": SeedsAndGrowth, "strength-of-match": StrengthOfMatch},
    "epipolar": {"locally-optimised-ransac": LocallyOptimisedRansac, "thesis-ransac": ThesisRansac},
    "verification": {"pair-verification": PairVerification},
    "tracks": {"aligned-tracks": AlignedTracks, "plain-tracks": PlainTracks},
    "projective": {
        "incremental-projective": IncrementalProjective,
        "sequential-projective": SequentialProjective,
        "factorization": Factorization,
    },
    "selfcalibration": {
        "hypotheses-and-refinement": HypothesesAndRefinement,
        "stratified": Stratified,
        "linear-quadric": LinearQuadric,
        "scanned-quadric": ScannedQuadric,
        "nonlinear-quadric": NonlinearQuadric,
        "kruppa-equations": KruppaEquations,
        "focals-from-fundamental": FocalsFromFundamental,
        "focal-scan": FocalScan,
    },
    "metric": {"metric-refinement": MetricRefinement},
    "dense": {"multi-view-stereo": MultiViewStereo},
    "model": {"surface-model": SurfaceModel},
}


class Detector(Protocol):
    """Detect the features of one image (4.2.1)."""

    def detect(self, image: Image) -> Features: ...


class PairSelector(Protocol):
    """Select the pairs of images to match; ``check`` refuses invalid settings before anything is computed."""

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None: ...

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice: ...


class Matcher(Protocol):
    """Match the features of two images (4.2.2); ``prepare`` does the work that depends on one image."""

    def prepare(self, image: Image, features: Features) -> Any: ...

    def match(
        self,
        view1: Any,
        view2: Any,
        *,
        pair: tuple[int, int],
        estimate_fundamental: EstimateFundamental,
        rng: np.random.Generator,
    ) -> Matches: ...


class FundamentalEstimator(Protocol):
    """Estimate F from matches with outliers (chapter 5)."""

    def estimate(self, xy1: F64, xy2: F64, rng: np.random.Generator) -> FundamentalFit: ...


class Verifier(Protocol):
    """Decide whether a pair and its F are accepted, and which matches are inliers."""

    def verify(self, matches: Matches, fit: FundamentalFit, rng: np.random.Generator) -> TwoView: ...


class TrackBuilder(Protocol):
    """Join pairwise matches to tracks."""

    def build(
        self, prepared: Sequence[Any], pairs: Sequence[TwoView], rng: np.random.Generator
    ) -> Tracks: ...


class ProjectiveReconstructor(Protocol):
    """Reconstruct up to a projective transform (chapter 6); ``attempt`` is the rank of the initial pair."""

    def reconstruct(
        self,
        tracks: Tracks,
        pairs: Sequence[TwoView],
        sizes: I64,
        *,
        rng: np.random.Generator,
        attempt: int = 0,
    ) -> Reconstruction: ...


class SelfCalibrator(Protocol):
    """Self-calibration of a projective reconstruction (chapter 7)."""

    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,
    ) -> SelfCalibration:
        """Upgrade a projective reconstruction to a metric one.

        Parameters
        ----------
        reconstruction : Reconstruction
            Projective reconstruction of at least three cameras.
        prior : IntrinsicsPrior
            Prior of the intrinsics of every view.
        rng : numpy.random.Generator
            Source of randomness; not used by deterministic methods.

        Returns
        -------
        SelfCalibration
            Upgrades and calibrations, best first, with the identifiability report.

        Raises
        ------
        StageFailure
            If no calibration places the points in front of the cameras.
        """


def with_images(method: SelfCalibrator, images: Sequence[Image]) -> SelfCalibrator:
    """Give the images to a self-calibration method that detects parallel lines in them.

    Parameters
    ----------
    method : SelfCalibrator
        Any method.
    images : sequence of Image
        One per view.

    Returns
    -------
    SelfCalibrator
        The method with the images, or unchanged if it does not use them.
    """
    given = getattr(method, "with_images", None)
    return method if given is None else cast(SelfCalibrator, given(images))


class MetricRefiner(Protocol):
    """Refine the metric model: missing cameras, bundle adjustment, intervals and self-check."""

    def refine(
        self,
        reconstruction: Reconstruction,
        calibration: SelfCalibration,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,
    ) -> MetricResult: ...


class DepthEstimator(Protocol):
    """Estimate depth maps one view at a time (2.5).

    ``match_rectified`` matches a rectified pair; ``match_two_views`` rectifies two images by their F (by
    homographies if ``planar``) and matches both directions. ``required_views`` returns the views that the map
    of one view needs, including itself.
    """

    def match_rectified(self, left: Any, right: Any, *, max_disparity_px: float) -> DisparityMap: ...

    def match_two_views(
        self, image1: Image, image2: Image, F: F64, xy1: F64, xy2: F64, *, planar: bool = False
    ) -> RectifiedPair: ...

    def prepare(self, images: Sequence[Image], reconstruction: Reconstruction) -> MultiViewScene: ...

    def required_views(self, scene: MultiViewScene, view: int) -> frozenset[int]: ...

    def depth_map(self, scene: MultiViewScene, view: int) -> DepthMap: ...

    def confirm(self, scene: MultiViewScene, depth_maps: Mapping[int, DepthMap], view: int) -> DepthMap: ...


class ModelBuilder(Protocol):
    """Fuse depth maps to a textured surface (2.6)."""

    def build(
        self, depth_maps: Sequence[DepthMap], views: Sequence[PinholeView], *, threads: int = 1
    ) -> TexturedMesh: ...

    def color(
        self,
        surface: TexturedMesh,
        views: Sequence[PinholeView],
        *,
        without: int | None = None,
        threads: int = 1,
    ) -> TexturedMesh: ...


@dataclass(frozen=True)
class ImageOptions:
    """How images are read.

    Parameters
    ----------
    max_size_px : int
        Larger images are reduced to this long side.
    """

    max_size_px: int = 1600

    def __post_init__(self) -> None:
        if self.max_size_px < 64:
            raise ValueError(f"max_size_px must be at least 64; got {self.max_size_px}")


def _precise_ransac() -> LocallyOptimisedRansac:
    return LocallyOptimisedRansac(inlier_sigmas=PRECISE_SIGMAS)


@dataclass(frozen=True)
class PipelineConfig:
    """Settings of the whole pipeline; the defaults are the preset ``default``.

    Parameters
    ----------
    images : ImageOptions
    intrinsics : IntrinsicsOptions
        Prior knowledge of the cameras.
    features : Detector
        Feature detection.
    pairs : PairSelector
        Selection of the pairs to match.
    matching : Matcher
        Matching of two images.
    epipolar : FundamentalEstimator
        Robust estimation of F.
    verification : Verifier
        Acceptance of pairs.
    tracks : TrackBuilder
    projective : ProjectiveReconstructor
        Projective reconstruction.
    selfcalibration : SelfCalibrator
        Self-calibration.
    metric : MetricRefiner
        Metric refinement.
    dense : DepthEstimator
        Depth maps.
    model : ModelBuilder
        Surface model.

    Examples
    --------
    >>> from thesisrecon import PipelineConfig
    >>> from thesisrecon.config import ImageOptions
    >>> config = PipelineConfig(images=ImageOptions(max_size_px=800))
    >>> type(config.epipolar).__name__
    'LocallyOptimisedRansac'
    """

    images: ImageOptions = ImageOptions()
    intrinsics: IntrinsicsOptions = field(default_factory=IntrinsicsOptions)
    features: Detector = field(default_factory=MultiScaleCorners)
    pairs: PairSelector = field(default_factory=OverlapEstimate)
    matching: Matcher = field(default_factory=SeedsAndGrowth)
    epipolar: FundamentalEstimator = field(default_factory=_precise_ransac)
    verification: Verifier = field(default_factory=PairVerification)
    tracks: TrackBuilder = field(default_factory=AlignedTracks)
    projective: ProjectiveReconstructor = field(default_factory=IncrementalProjective)
    selfcalibration: SelfCalibrator = field(default_factory=HypothesesAndRefinement)
    metric: MetricRefiner = field(default_factory=MetricRefinement)
    dense: DepthEstimator = field(default_factory=MultiViewStereo)
    model: ModelBuilder = field(default_factory=SurfaceModel)


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
            linker=SequenceLinking(),
            refinement=None,
            completion=None,
        ),
        # "By fitting parametric surfaces through the points ... sampled in a fine scale triangular pattern".
        model=SurfaceModel(surface=BSplineSurface(), fusion=DepthSheets()),
        # The thesis has no distortion model and fixes the principal point at the image centre.
        intrinsics=IntrinsicsOptions(principal_point="known", k1="known"),
    ),
}


def preset(name: Any) -> PipelineConfig:
    """Return a preset configuration.

    Parameters
    ----------
    name : str
        "default" or "thesis".

    Returns
    -------
    PipelineConfig

    Raises
    ------
    UsageError
        If the name is unknown.

    Examples
    --------
    >>> from thesisrecon.config import preset
    >>> type(preset("thesis").features).__name__
    'HarrisCorners'
    """
    if not isinstance(name, str) or name not in PRESETS:
        raise UsageError(unknown_word("preset", name, PRESETS))
    return PRESETS[name]


def kind_of(stage: str, variant: Any) -> str:
    """Return the word for a method in text.

    Parameters
    ----------
    stage : str
        Field of the config.
    variant : object
        The method.

    Returns
    -------
    str
        Its word in :data:`KINDS`, else its class name.
    """
    return next((k for k, cls in KINDS[stage].items() if cls is type(variant)), type(variant).__name__)


def tables_from_config(config: PipelineConfig) -> dict[str, Table]:
    """Return the complete configuration as plain tables.

    Parameters
    ----------
    config : PipelineConfig

    Returns
    -------
    dict
        Stage -> field -> value.
    """
    tables = {}
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        head = {"kind": kind_of(item.name, value)} if item.name in KINDS else {}
        tables[item.name] = head | table_from_dataclass(value)
    return tables


def toml_from_config(config: PipelineConfig) -> str:
    """Return the configuration as TOML, which :func:`config_from_toml` reads back.

    Parameters
    ----------
    config : PipelineConfig

    Returns
    -------
    str
        TOML text.
    """
    return toml_from_tables(tables_from_config(config))


def config_from_toml(
    text: str,
    base: PipelineConfig | None = None,
    *,
    fixed_preset: bool = False,
    changes: Sequence[Mapping[str, Any]] = (),
) -> PipelineConfig:
    """Read a configuration.

    All tables are merged before values are checked, so settings that need each other may come from different
    tables.

    Parameters
    ----------
    text : str
        TOML. A line ``preset = "thesis"`` at its top selects the base.
    base : PipelineConfig, optional
        Base; None: the preset ``default``.
    fixed_preset : bool
        Ignore the preset of the text.
    changes : sequence of mapping
        Further tables, later ones override.

    Returns
    -------
    PipelineConfig

    Raises
    ------
    UsageError
        For invalid TOML, unknown stages, kinds or settings, and values of the wrong type.

    Examples
    --------
    >>> from thesisrecon.config import config_from_toml
    >>> config_from_toml("[images]\\nmax_size_px = 800").images.max_size_px
    800
    """
    try:
        tables = tomllib.loads(text)
    except ValueError as error:
        raise UsageError(f"the configuration is not TOML: {error}") from None
    except RecursionError:
        raise UsageError("the configuration is nested too deeply") from None
    name = tables.pop("preset", None)
    if name is not None and not fixed_preset:
        base = preset(name)
    base = base or PipelineConfig()
    merged: dict[str, Any] = {}
    for change in (tables, *changes):
        merged = _merged_stages(merged, change, base)
    return config_from_tables(merged, base)


def _merged_stages(under: Mapping[str, Any], over: Mapping[str, Any], base: PipelineConfig) -> dict[str, Any]:
    """``over`` merged into ``under``; another kind drops the settings of the old one."""
    merged = dict(under)
    for stage, table in over.items():
        old = under.get(stage)
        if isinstance(old, Mapping) and isinstance(table, Mapping):
            kind = old.get("kind", kind_of(stage, getattr(base, stage))) if stage in KINDS else None
            merged[stage] = table if table.get("kind", kind) != kind else _merged(old, table)
        else:
            merged[stage] = table
    return merged


def _merged(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``over`` merged into ``under``, table by table."""
    merged = dict(under)
    for key, value in over.items():
        old = merged.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        merged[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return merged


def config_from_tables(tables: Mapping[str, Any], base: PipelineConfig | None = None) -> PipelineConfig:
    """Change a configuration by plain tables.

    Parameters
    ----------
    tables : mapping
        Stage -> field -> value.
    base : PipelineConfig, optional
        Base; None: the preset ``default``.

    Returns
    -------
    PipelineConfig

    Raises
    ------
    UsageError
        As :func:`config_from_toml`.
    """
    config = base or PipelineConfig()
    stages = [item.name for item in dataclasses.fields(config)]
    for stage, table in tables.items():
        if stage not in stages:
            raise UsageError(unknown_word("stage", stage, ["preset", *stages]))
        if not isinstance(table, Mapping):
            raise UsageError(f"{stage} takes a table of settings; got {in_words(table)}")
        config = dataclasses.replace(
            config, **{stage: _stage_from_table(stage, table, getattr(config, stage))}
        )
    return config


def _stage_from_table(stage: str, table: Mapping[str, Any], current: Any) -> Any:
    if stage not in KINDS:
        return dataclass_from_table(type(current), table, stage, current)
    fields = {key: value for key, value in table.items() if key != "kind"}
    kind = table.get("kind", kind_of(stage, current))
    if not isinstance(kind, str) or (kind not in KINDS[stage] and type(current).__name__ != kind):
        raise UsageError(unknown_word(f"kind of {stage}", kind, KINDS[stage]))
    variant = KINDS[stage].get(kind, type(current))
    names = [item.name for item in dataclasses.fields(variant)]
    for key in fields:
        if key not in names:
            raise unknown_setting(stage, key, ["kind", *names])
    return dataclass_from_table(variant, fields, stage, current if type(current) is variant else None)


def tables_from_settings(settings: Sequence[str]) -> dict[str, Any]:
    """Parse the values of ``--set``.

    Parameters
    ----------
    settings : sequence of str
        ``stage.field=value``, or ``stage.field.field=value`` for nested ones; later ones override.

    Returns
    -------
    dict
        Tables for :func:`config_from_tables`.

    Raises
    ------
    UsageError
        If a text has another form.

    Examples
    --------
    >>> from thesisrecon.config import tables_from_settings
    >>> tables_from_settings(["features.kind=harris-corners", "images.max_size_px=800"])
    {'features': {'kind': 'harris-corners'}, 'images': {'max_size_px': 800}}
    """
    tables: dict[str, Any] = {}
    for setting in settings:
        place, equals, text = setting.partition("=")
        path = place.strip().split(".")
        if not equals or not 2 <= len(path) <= MAX_DEPTH or not all(path):
            raise UsageError(
                "--set takes stage.field=value, for example features.kind=harris-corners; "
                f"got {in_words(setting)}"
            )
        value = parse_word(text)
        for key in reversed(path):
            value = {key: value}
        tables = _merged(tables, value)
    return tables
