"""Whether the photographs contradict that they share a camera, and whether they can tell at all: zooms that
differ by a few percent, and crops, bend a model quietly, since each photograph fits points that were bent
with it.

The word is hence tested as a hypothesis: the model is adjusted once more as it is, with a focal length, and
with a principal point of its own for every photograph that shares one, column by column. Twice the cost that
the freedom saves is chi-square where the word is true (a likelihood ratio, which holds in the long valleys
where a bent model lies and single values and their deviations mean little). Where own focal lengths stay open
the photographs cannot tell, and the shared one is as uncertain as that of cameras that were zoomed a little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import CENTRE, FOCAL, MetricModel
from thesisrecon.metric.model_error import USUAL_INFLATION
from thesisrecon.metric.own_fit import OwnFit
from thesisrecon.optimize.metric_bundle import MetricBundleResult
from thesisrecon.types import F64, I64

ALARM = 1e-3
"""Chance of a false alarm where the deviations are right."""
FLOOR = 2e-3
"""Of the deviation of an own focal, relative, or principal point, long sides."""
LEAST_APART = {"focal": 0.01, "centre": 0.015}
"""Relative and in long sides: what differs by less does no harm that a person would mend."""
OPEN = 0.03
"""Own focals that are open by more (relative, one deviation) cannot tell whether they are one."""
ZOOM_STD = 0.03
"""Relative scatter of the focals of photographs that somebody took for those of one zoom, where they cannot
tell."""


@dataclass(frozen=True)
class SharingCheck:
    """``doubts``: a sentence for every set of photographs that contradict what they are said to share.
    ``warnings``: one for every set that cannot tell, whose views have in ``focal_std`` (V,) the relative
    standard deviation of a focal length that may differ between them; NaN elsewhere."""

    doubts: tuple[str, ...]
    warnings: tuple[str, ...]
    focal_std: F64


@dataclass(frozen=True)
class _Set:
    """``places`` among the registered views of those that share a value, or of which one is ``known``."""

    places: I64
    known: bool = False

    @property
    def freedoms(self) -> int:
        return len(self.places) - (0 if self.known else 1)


def check_sharing(model: MetricModel, adjustment: Adjustment) -> SharingCheck:
    """Hold shared focals, and shared or known principal points, against the photographs.

    Sets of less than three views are not looked at. Empty where nothing is shared.
    """
    views = np.flatnonzero(model.registered)
    focal_std = np.full(len(model.registered), np.nan)
    focals, centres = _sets(model, adjustment, views, FOCAL), _sets(model, adjustment, views, CENTRE[0])
    if not focals and not centres:
        return SharingCheck((), (), focal_std)
    fit = OwnFit(model, adjustment, views)
    freed: tuple[int, ...] = (FOCAL,) if focals else ()
    before, doubts, warnings = fit.adjusted(()), list[str](), list[str]()
    if focals:
        alone = fit.adjusted(freed)
        apart = [s for s in _contradicted(before, alone, focals, 1) if _focals_apart(alone, s)]
        doubts += [_focals_differ(views, alone, s) for s in apart]
        for s in [s for s in focals if s not in apart and _focal_std(alone, s).max() > OPEN]:
            focal_std[views[s.places]] = _std_of_a_kind(model, fit, s)
            warnings.append(_cannot_tell(float(_focal_std(alone, s).max())))
        before = alone
        bent = [set(s.places.tolist()) for s in apart]
        centres = [s for s in centres if not any(b & set(s.places.tolist()) for b in bent)]
    if centres:
        both = fit.adjusted((*freed, *CENTRE))
        for s in _contradicted(before, both, centres, 2):
            off = _centres_off(model, adjustment, views, both, s)
            if np.abs(off).max() > LEAST_APART["centre"]:
                doubts.append(_centres_differ(s, off))
    return SharingCheck(tuple(doubts), tuple(warnings), focal_std)


def _sets(model: MetricModel, adjustment: Adjustment, views: I64, column: int) -> list[_Set]:
    """Views that share a column; those whose principal point is known."""
    assert model.cameras.shared is not None
    rows = model.cameras.group[views]
    held = adjustment.prior(model).std[rows, column] == 0.0
    number = model.cameras.shared[rows, column]
    sets = [_Set(np.flatnonzero((number == k) & ~held)) for k in np.unique(number)]
    if column != FOCAL:
        sets.append(_Set(np.flatnonzero(held), known=True))
    return [s for s in sets if len(s.places) >= 3]


def _contradicted(
    before: MetricBundleResult, after: MetricBundleResult, sets: list[_Set], values: int
) -> list[_Set]:
    """All sets where values of their own explain more than chance lets expect, else none."""
    saved = 2.0 * (before.cost - after.cost) / USUAL_INFLATION**2
    return sets if saved > scipy.special.chdtri(values * sum(s.freedoms for s in sets), ALARM) else []


def _focal_std(alone: MetricBundleResult, s: _Set) -> F64:
    """Relative deviations of own focals as photographs need them; infinite where nothing is told."""
    variance = alone.intrinsics_covariance[s.places, FOCAL, FOCAL]
    focal = alone.cameras.intrinsics[s.places, FOCAL]
    std = np.hypot(USUAL_INFLATION * np.sqrt(np.maximum(variance, 0.0)) / focal, FLOOR)
    return np.where(np.isfinite(std) & (variance > 0.0), std, np.inf)


def _focals_apart(alone: MetricBundleResult, s: _Set) -> bool:
    log = np.log(alone.cameras.intrinsics[s.places, FOCAL])
    return bool(np.abs(log - np.median(log)).max() > LEAST_APART["focal"])


def _std_of_a_kind(model: MetricModel, fit: OwnFit, s: _Set) -> float:
    """Relative deviation of the shared focal of a set if its focals scatter by ``ZOOM_STD``."""
    # The scatter is not inflated as the deviations are.
    alike = fit.adjusted((FOCAL,), focal_spread=ZOOM_STD / USUAL_INFLATION)
    rows = model.cameras.group[fit.views[s.places]]
    off = np.log(alike.cameras.intrinsics[s.places, FOCAL] / model.cameras.intrinsics[rows, FOCAL])
    return float(np.hypot(_focal_std(alike, s), off).max())


def _centres_off(
    model: MetricModel, adjustment: Adjustment, views: I64, both: MetricBundleResult, s: _Set
) -> F64:
    """(n, 2) long sides: own principal points from the known one, or from the median of the set."""
    rows = model.cameras.group[views[s.places]]
    off = (both.cameras.intrinsics[s.places] - adjustment.prior(model).mean[rows])[:, CENTRE]
    off /= model.sizes[views[s.places]].max(axis=1, keepdims=True)
    return np.asarray(off if s.known else off - np.median(off, axis=0))


def _focals_differ(views: I64, alone: MetricBundleResult, s: _Set) -> str:
    focal, std = alone.cameras.intrinsics[s.places, FOCAL], _focal_std(alone, s)
    low, high = int(focal.argmin()), int(focal.argmax())
    return (
        f"the photographs contradict that they have one focal length: view {views[s.places[high]]} asks for "
        f"one {focal[high] / focal[low] - 1.0:.1%} longer than view {views[s.places[low]]} (each within "
        f"{max(std[low], std[high]):.1%}, one standard deviation); let every photograph have its own "
        "(cameras = per-image), or leave out those that were zoomed"
    )


def _centres_differ(s: _Set, off: F64) -> str:
    if s.known:
        return (
            "the photographs contradict the principal point that was given: those of "
            f"{len(s.places)} views lie up to {np.abs(off).max():.1%} of the long side off; leave it out, or "
            "where they were cropped one by one let every photograph have its own (cameras = per-image)"
        )
    return (
        f"the photographs contradict that they have one principal point: those of {len(s.places)} views lie "
        f"up to {np.ptp(off, axis=0).max():.1%} of the long side apart, as of photographs cropped one by "
        "one; let every photograph have its own (cameras = per-image)"
    )


def _cannot_tell(std: float) -> str:
    alone = f"open by {std:.0%} (one standard deviation)" if np.isfinite(std) and std < 1.0 else "wide open"
    return (
        f"that they share one focal length cannot be checked from these photographs: alone each leaves its "
        f"own {alone}; the interval allows for zooms that differ by {ZOOM_STD:.0%}; more photographs, from "
        "more directions, would tell"
    )
