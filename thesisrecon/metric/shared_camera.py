"""A finished model adjusted once more with values of their own for the photographs, to hold against what they
are said to share.

Whether the photographs contradict that they share a camera, and whether they can tell at all: zooms that
differ by a few percent, and crops, bend a model quietly, since each photograph fits points that were bent
with it.

The word is hence tested as a hypothesis: the model is adjusted once more as it is, with a focal length, and
with a principal point of its own for every photograph that shares one, column by column. Twice the cost that
the freedom saves is chi-square where the word is true (a likelihood ratio, which holds in the long valleys
where a bent model lies and single values and their deviations mean little). Where own focal lengths stay open
the photographs cannot tell, and the shared one is as uncertain as that of cameras that were zoomed a little.

Whether the photographs contradict what was said of a focal length: a wrong word bends a model quietly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.arrays import F64, I64
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import CENTRE, FOCAL, WIDTH, MetricModel
from thesisrecon.metric.uncertainty import LEAST_BLOCKS, USUAL_INFLATION
from thesisrecon.numerics.block_scatter import BlockScatter
from thesisrecon.numerics.metric_bundle import MetricBundleResult, refine_metric_bundle
from thesisrecon.numerics.metric_cameras import MetricCameras
from thesisrecon.numerics.observations import Observations

CENTRE_STD = 0.1
"""Long sides; a photograph may be cut out of a larger one anywhere."""
MOST_OBSERVATIONS = 15000
ROUNDS = 30
"""A model that is bent lies in a long valley: a dozen rounds leave the values where they were."""


def part_of_explained(model: MetricModel) -> I64:
    """Explained observations, those of every n-th point where they are many."""
    index = np.flatnonzero(model.ok)
    point = model.tracks.point_index[index]
    chosen = np.zeros(model.tracks.n_points, dtype=bool)
    chosen[np.unique(point)[:: int(np.ceil(len(index) / MOST_OBSERVATIONS))]] = True
    return np.asarray(index[chosen[point]], dtype=np.int64)


@dataclass(frozen=True)
class PerViewFit:
    """The registered ``views`` of a model; rows of every answer are in their order."""

    model: MetricModel
    adjustment: Adjustment
    views: I64

    def adjusted(self, columns: tuple[int, ...], *, focal_spread: float = np.inf) -> MetricBundleResult:
        """With a value of its own in ``columns`` for every view, of which nothing is known but, where it is
        finite, the ``focal_spread`` (relative) of the focals that were shared about one that is not
        known."""
        model, views, adjustment = self.model, self.views, replace(self.adjustment, population=None)
        t, cameras, index = model.tracks, model.cameras, part_of_explained(model)
        assert cameras.shared is not None
        rows = cameras.group[views]
        shared, own = cameras.shared[rows].copy(), np.arange(len(views), dtype=np.int64)
        prior, free = adjustment.row_prior(model), adjustment.free(model)
        std = prior.std[rows].copy()
        for column in columns:
            shared[:, column], free[column] = own, True
            longest = model.sizes[views].max(axis=1)
            std[:, column] = CENTRE_STD * longest if column in CENTRE else np.inf
        known = IntrinsicsPrior.unshared(prior.mean[rows], std)
        if np.isfinite(focal_spread):
            spread = np.where(np.arange(WIDTH) == FOCAL, focal_spread, np.inf)
            known = replace(known, kind=cameras.shared[rows, FOCAL], spread=spread)
        options = replace(adjustment, inflation=1.0).options(model, iterations=ROUNDS)
        return refine_metric_bundle(
            MetricCameras(cameras.R[views], cameras.t[views], cameras.intrinsics[rows], own, shared),
            model.X,
            Observations(np.searchsorted(views, t.view_index[index]), t.point_index[index], t.xy[index]),
            free=free,
            prior=known,
            options=replace(options, covariance=True, noise_floor_px=model.sigma_px),
        )


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
class SharedCameraTest:
    """``failed_checks``: a sentence for every set of photographs that contradict what they are said to share.
    ``warnings``: one for every set that cannot tell, whose views have in ``focal_std`` (V,) the relative
    standard deviation of a focal length that may differ between them; NaN elsewhere."""

    failed_checks: tuple[str, ...]
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


def check_shared_cameras(model: MetricModel, adjustment: Adjustment) -> SharedCameraTest:
    """Hold shared focals, and shared or known principal points, against the photographs.

    Sets of less than three views are not looked at. Empty where nothing is shared.
    """
    views = np.flatnonzero(model.registered)
    focal_std = np.full(len(model.registered), np.nan)
    focals, centres = _sets(model, adjustment, views, FOCAL), _sets(model, adjustment, views, CENTRE[0])
    if not focals and not centres:
        return SharedCameraTest((), (), focal_std)
    fit = PerViewFit(model, adjustment, views)
    freed: tuple[int, ...] = (FOCAL,) if focals else ()
    before, failed_checks, warnings = fit.adjusted(()), list[str](), list[str]()
    if focals:
        alone = fit.adjusted(freed)
        apart = [s for s in _contradicted(before, alone, focals, 1) if _focals_apart(alone, s)]
        failed_checks += [_focals_differ(views, alone, s) for s in apart]
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
                failed_checks.append(_centres_differ(s, off))
    return SharedCameraTest(tuple(failed_checks), tuple(warnings), focal_std)


def _sets(model: MetricModel, adjustment: Adjustment, views: I64, column: int) -> list[_Set]:
    """Views that share a column; those whose principal point is known."""
    assert model.cameras.shared is not None
    rows = model.cameras.group[views]
    held = adjustment.row_prior(model).std[rows, column] == 0.0
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


def _std_of_a_kind(model: MetricModel, fit: PerViewFit, s: _Set) -> float:
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
    off = (both.cameras.intrinsics[s.places] - adjustment.row_prior(model).mean[rows])[:, CENTRE]
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


MAX_SIGMAS = 3.0
LEAST_DIFFERENCE = 0.01
"""A prior wrong by less than a hundredth does no harm that a person would mend."""
MAX_CENTRE_SIGMAS = 5.0
MOST_CONTRADICTION = 8.0
"""Variance ratio of blocks over points; right models of photographs have 1.5 to 5, bent ones 11 to 28."""
WIDEN = "leave it out, or give it a larger focal_std_rel"


def contradicted_focals(model: MetricModel, adjustment: Adjustment) -> list[str]:
    """A sentence for every focal length of which something was said that the photographs contradict.

    The model is adjusted once more with nothing known of any focal, from where it is; what comes out is
    compared with what was said, both uncertainties together. Empty where nothing was said.
    """
    prior = adjustment.prior
    said = np.flatnonzero(prior.focal_known & model.registered)
    if len(said) == 0:
        return []
    number = _numbers_when_free(model, adjustment)
    focal, std = _free_focals(model, adjustment, number)
    number = number[model.cameras.group]
    failed_checks = []
    for k in np.unique(number[said]):
        view = int(said[number[said] == k][0])
        mean, deviation = float(prior.mean[view, 0]), float(prior.std[view, 0])
        off = float(np.log(focal[view] / mean))
        if abs(off) > LEAST_DIFFERENCE and abs(off) > MAX_SIGMAS * float(np.hypot(std[view], deviation)):
            whose = "" if len(np.unique(number[said])) == 1 else f" of view {view}"
            failed_checks.append(
                f"the photographs contradict the focal length{whose} that was given: they ask for one "
                f"{abs(np.expm1(off)):.1%} {'longer' if off > 0 else 'shorter'} (within {std[view]:.1%}, one "
                f"standard deviation); {'leave it out' if deviation == 0.0 else WIDEN}"
            )
    return failed_checks


def centre_of_a_bent_model(model: MetricModel, adjustment: Adjustment, scatter: BlockScatter) -> list[str]:
    """A sentence where a principal point lies far off what was said of it and parts of the scene contradict
    each other as well: photographs cropped alike do the first, but not the second."""
    views = np.flatnonzero(model.registered)
    if scatter.blocks < LEAST_BLOCKS or not scatter.overdispersion > MOST_CONTRADICTION:
        return []
    said = adjustment.prior.std[views][:, CENTRE]
    values = model.cameras.intrinsics[model.cameras.group[views]][:, CENTRE]
    off = np.abs(values - adjustment.prior.mean[views][:, CENTRE])
    sigmas = np.where(said > 0.0, off / np.where(said > 0.0, said, 1.0), 0.0).max(axis=1)
    worst = int(sigmas.argmax())
    if not sigmas[worst] > MAX_CENTRE_SIGMAS:
        return []
    share = float(off[worst].max() / model.sizes[views[worst]].max())
    return [
        f"the principal point lies {share:.0%} of the long side off ({sigmas[worst]:.0f} standard deviations "
        f"of what is said of it) and parts of the scene contradict each other by {scatter.overdispersion:.0f} "
        "times what their points let expect: photographs were zoomed or cropped one by one, or the model is "
        "bent"
    ]


def _numbers_when_free(model: MetricModel, adjustment: Adjustment) -> I64:
    """(G,) numbers of the focals when nothing is known of them: known ones, which are not tied, are one where
    one value was given for them."""
    assert model.cameras.shared is not None
    prior, number = adjustment.row_prior(model), model.cameras.shared[:, FOCAL].copy()
    known = np.flatnonzero(prior.std[:, FOCAL] == 0.0)
    number[known] = number.max() + 1 + np.unique(prior.mean[known, FOCAL], return_inverse=True)[1].reshape(-1)
    return np.asarray(number)


def _free_focals(model: MetricModel, adjustment: Adjustment, number: I64) -> tuple[F64, F64]:
    """Focals (V,) and relative deviations (V,) when nothing is known of them; rows of one ``number`` share
    theirs."""
    t, cameras = model.tracks, model.cameras
    index = part_of_explained(model)
    assert cameras.shared is not None
    shared = cameras.shared.copy()
    shared[:, FOCAL] = number
    prior = adjustment.row_prior(model)
    std, free = prior.std.copy(), adjustment.free(model)
    std[:, FOCAL], free[FOCAL] = np.inf, True
    result = refine_metric_bundle(
        replace(cameras, shared=shared), model.X,
        Observations(t.view_index[index], t.point_index[index], t.xy[index]), free=free,
        prior=IntrinsicsPrior.unshared(prior.mean, std),
        options=replace(
            adjustment.options(model, iterations=ROUNDS), covariance=True, noise_floor_px=model.sigma_px
        ),
    )  # fmt: skip
    focal = result.cameras.intrinsics[:, FOCAL]
    variance = np.maximum(result.intrinsics_covariance[:, FOCAL, FOCAL], 0.0)
    deviation = np.hypot(USUAL_INFLATION * np.sqrt(variance) / focal, FLOOR)
    return focal[cameras.group], deviation[cameras.group]
