"""What one run did and found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thesisrecon.types.arrays import I64
from thesisrecon.types.dense import DepthMap, HeldOut, PinholeView, TexturedMesh
from thesisrecon.types.front_end import Features, Image, PairChoice, TwoView
from thesisrecon.types.reconstruction import MetricResult, Reconstruction, SelfCalibration, Tracks


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
