"""Standard deviations of the intrinsics, and the hierarchical prior of cameras of the same kind.

The covariance of bundle adjustment assumes independent noise and an exact camera model. It is inflated by the
disagreement of blocks of the scene (:mod:`thesisrecon.optimize.bundle.scatter`). Errors common to all blocks
do not show there; a floor stands for them, applied only if the data show lack of fit.

Images of the same size are likely from the same kind of lens. With per-camera estimates q_i of variance s_i^2
the values of a kind are modelled as N(mu, tau^2), mu and tau unknown (random-effects model; tau by restricted
maximum likelihood, Harville 1977). A poorly determined camera is shrunk towards the others if tau is small;
with zoomed images tau is large and has no effect. Outliers are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.camera import angles_of_view
from thesisrecon.errors import Notice
from thesisrecon.metric._adjustment import CENTRE_DOF, HierarchicalPrior, MetricAdjustment
from thesisrecon.metric._model import ASPECT, CENTRE, DECENTRING, FOCAL, K1, SKEW, WIDTH, MetricEstimate
from thesisrecon.optimize.bundle.projection import calibrations
from thesisrecon.optimize.bundle.scatter import BlockScatter, PoseUncertainty
from thesisrecon.optimize.least_squares import MAD_FACTOR, student_factor
from thesisrecon.records import IntrinsicInterval

USUAL_INFLATION = 4.0  # inflation of standard deviations if it cannot be measured; measured values are 2 to 5
MODEL_FLOOR_REL = 1e-3
"""Floor of standard deviations, relative to the focal length, if the data show lack of fit: pixels are square
to one or two parts in a thousand."""
MIN_BLOCKS = 4  # fewer blocks give no inflation
UNVERIFIED_SHARING = "shared focal length that the images cannot verify: small zoom differences allowed for"
FAULTS = "bundle adjustment; the interval contains errors of a fixed aspect ratio, skew and decentring"
CAMERA_MODEL = "bundle adjustment; the interval contains the difference to a richer camera model"
_COLUMNS = {
    "focal_px": FOCAL, "aspect": ASPECT, "skew_px": SKEW,
    "principal_x_px": CENTRE[0], "principal_y_px": CENTRE[1],
    "k1": K1, "k2": K1 + 1, "k3": K1 + 2, "k4": K1 + 3, "p1": DECENTRING[0], "p2": DECENTRING[1],
}  # fmt: skip


def intrinsic_columns(width: int) -> Mapping[str, int]:
    """Columns by name of a table of ``width`` columns."""
    return {name: column for name, column in _COLUMNS.items() if column < width}


Intervals = Sequence[Mapping[str, IntrinsicInterval]]
"""Intrinsics of each view by name, as in ``MetricResult``; empty where the view is not registered."""


def lack_of_fit(scatter: BlockScatter, tail: float) -> float:
    """Evidence for an inexact camera or noise model: 0 for normal noise, 1 if certain or not measurable."""
    if scatter.blocks < MIN_BLOCKS or not np.isfinite(scatter.overdispersion):
        return 1.0
    # Values that pure noise does not reach, and those at which the model is certainly inexact; the tail of
    # the residuals is 1 wide for normal noise, 2 to 3 for real images.
    measured = [(scatter.overdispersion, (1.3, 1.8)), (tail, (1.2, 1.6))]
    return max(float(np.clip((value - low) / (high - low), 0.0, 1.0)) for value, (low, high) in measured)


def _std_floor(model: MetricEstimate, scatter: BlockScatter) -> F64:
    """Lower bound of the standard deviations due to model error."""
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = np.maximum(np.nan_to_num(scatter.variance / scatter.shared_variance), 1.0) ** 0.25
    units = np.ones_like(model.cameras.intrinsics)
    units[:, (SKEW, *CENTRE)] = model.cameras.intrinsics[:, :1]
    return np.asarray(MODEL_FLOOR_REL * lack_of_fit(scatter, model.tail) * alone * units)


@dataclass(frozen=True)
class PerCameraEstimates:
    """Intrinsics (G, 8) of each camera from its own matches (focal as log f), with noise and model error."""

    value: F64
    std: F64
    floor: F64
    kind: I64


def per_camera_estimates(
    model: MetricEstimate, adjustment: MetricAdjustment, scatter: BlockScatter
) -> PerCameraEstimates:
    """Intrinsics of each camera, and their scatter without hierarchical prior."""
    group = model.cameras.group
    first = np.unique(group, return_index=True)[1]
    value = model.cameras.intrinsics.copy()
    value[:, FOCAL] = np.log(value[:, FOCAL])
    kind = np.unique(adjustment.prior.kind[first], return_inverse=True)[1].reshape(-1)
    registered = np.isin(np.arange(len(first)), group[model.registered])
    kind = np.where(registered, kind, -1)
    std = scatter.inflation * np.sqrt(np.maximum(scatter.variance, 0.0))
    return PerCameraEstimates(value, std, _std_floor(model, scatter), kind)


def estimate_hierarchical_prior(own: PerCameraEstimates, shared: I64) -> HierarchicalPrior | None:
    """Estimate the scatter of the intrinsics of cameras of a kind; None if no intrinsic has an estimate."""
    kinds = own.kind.copy()
    spread = np.full(own.value.shape, np.inf)
    outside = np.zeros(len(kinds), dtype=bool)
    for column in (FOCAL, *CENTRE, K1):
        for kind in np.unique(kinds[kinds >= 0]):
            index = np.flatnonzero(kinds == kind)
            index = index[np.unique(shared[index, column], return_index=True)[1]]
            value, std = own.value[index, column], own.std[index, column]
            if len(index) < 3 or not (std > 0.0).all():
                continue
            total = np.hypot(std, own.floor[index, column])
            far = find_outliers(value, total)
            if column == FOCAL:
                outside |= np.isin(shared[:, column], shared[index[far], column]) & (kinds == kind)
            spread[kinds == kind, column] = estimate_spread(value[~far], std[~far], total[~far])
    kinds[outside] = -1
    return HierarchicalPrior(kinds, spread) if np.isfinite(spread).any() else None


def find_outliers(value: F64, std: F64) -> B8:
    """Values more than four of their noise and the scatter of all (MAD) from the median."""
    off = np.abs(value - np.median(value))
    scatter = MAD_FACTOR * float(np.median(off))
    return np.asarray(off > 4.0 * np.hypot(scatter, std))


def estimate_spread(value: F64, std: F64, total: F64) -> float:
    """Estimate the standard deviation tau of true values behind noisy ones by REML (Harville 1977).

    At least 0.3 times the median noise ``std``; ``total`` contains the model error; inf for one value.
    """
    if len(value) < 2:
        return np.inf
    low, high = 1e-2 * float(total.min()), 10.0 * float(np.ptp(value)) + 1e-9
    taus = np.concatenate([[0.0], np.geomspace(low, high, 200)])
    variance = taus[:, None] ** 2 + total**2
    weight = 1.0 / variance
    mean = (weight @ value) / weight.sum(axis=1)
    squares = np.sum(weight * (value - mean[:, None]) ** 2, axis=1)
    likelihood = -0.5 * (np.log(variance).sum(axis=1) + np.log(weight.sum(axis=1)) + squares)
    tau = float(taus[int(likelihood.argmax())])
    return max(float(np.hypot(tau, 0.3 * np.median(std))), 1e-6)


@dataclass(frozen=True)
class FocalShrinkage:
    """Relative deviation (V,) of the focal by own matches; weight tau^2 / (tau^2 + s^2), 1 if alone."""

    own_std: F64
    weight: F64

    def is_shrunk(self, view: int, std: float) -> bool:
        """Whether a stated relative ``std`` depends mainly on the other cameras of the kind."""
        return bool(self.weight[view] < 0.5 and self.own_std[view] > std)

    def warnings(self, registered: Sequence[int], least: float) -> tuple[str, ...]:
        """A sentence for each view whose matches determine its focal worse than ``least`` (relative)."""
        rests = "; the stated value rests on the other cameras"
        others = np.where(self.weight < 0.5, rests, ", and the other cameras of its kind hardly constrain it")
        weak = (view for view in registered if self.own_std[view] > least)
        return tuple(Notice("borrowed-focal", view, self.own_std[view], others[view]) for view in weak)


def focal_shrinkage(
    own: PerCameraEstimates, hierarchical: HierarchicalPrior | None, group: I64
) -> FocalShrinkage:
    """Shrinkage of the focal length of each view; ``group`` (V,) = camera of each view."""
    std = own.std[:, FOCAL]
    weight = np.ones(len(std))
    if hierarchical is not None:
        tau = hierarchical.spread[:, FOCAL]
        active = (hierarchical.kind >= 0) & np.isfinite(tau)
        tau = np.where(active, tau, 1.0)
        weight = np.where(active, tau**2 / (tau**2 + std**2), 1.0)
    return FocalShrinkage(np.hypot(std, own.floor[:, FOCAL])[group], weight[group])


def intrinsic_intervals(
    model: MetricEstimate, adjustment: MetricAdjustment, scatter: BlockScatter, shrinkage: FocalShrinkage,
    uncertainty: PoseUncertainty,
) -> Intervals:  # fmt: skip
    """Value, standard deviation and source of each intrinsic of each view; +- 1.96 std is a 95 % interval.

    They contain the errors of a fixed aspect and skew as those of the poses do, and of the decentring that
    the images leave possible, which they determine better than the floor of the model error.
    """
    floors, largest = _std_floor(model, scatter), adjustment.row_prior(model).std
    # The prior of the principal point has longer tails than a normal one.
    tails = np.where(np.isin(np.arange(largest.shape[1]), CENTRE), student_factor(CENTRE_DOF), 1.0)
    largest *= tails
    share = lack_of_fit(scatter, model.tail)
    faults = MODEL_FLOOR_REL * np.sqrt(share) * np.linalg.norm(uncertainty.intrinsic_fault[:, :2], axis=1)
    faults = np.hypot(faults, uncertainty.decentring_change)
    floors[:, CENTRE] = 0.0  # for the principal point these are what the floor stands for
    answer: list[dict[str, IntrinsicInterval]] = [{} for _ in model.registered]
    for view in np.flatnonzero(model.registered).tolist():
        g, intervals = int(model.cameras.group[view]), answer[view]
        row = model.cameras.intrinsics[g]
        for name, column in intrinsic_columns(len(row)).items():
            value, variance = float(row[column]), float(scatter.variance[g, column])
            if not variance > 0.0:
                intervals[name] = IntrinsicInterval(value, 0.0, "assumed")
                continue
            ratios = float(scatter.ratio[g, column]), float(scatter.large_ratio[g, column])
            inflation, floor = _inflation(scatter, *ratios, share), float(floors[g, column])
            # A value that the images leave to its prior is as uncertain as the prior, however they agree.
            part = (tails[column] ** 2 - inflation**2) * scatter.prior_variance[g, column]
            noise = np.sqrt(inflation**2 * variance + max(part, 0.0) + scatter.pull[g, column] ** 2)
            fault = float(faults[uncertainty.number[g, column]])
            measured = float(np.hypot(noise, fault))
            std = min(float(np.hypot(measured, floor)), float(largest[g, column]))
            if floor > measured:
                how = "bundle adjustment; the interval is the camera-model error floor"
                how += f" of {floor:.1%}" if column == FOCAL else ""
            elif fault > noise:
                how = FAULTS
            else:
                factor, why = inflation * adjustment.inflation, "from the scatter between blocks of the scene"
                how = f"bundle adjustment; standard deviation x {factor:.1f} {why}"
            if column == FOCAL and shrinkage.is_shrunk(view, std):
                alone = f"own matches alone: {shrinkage.own_std[view]:.2%} (1 sigma)"
                how = f"shrunk towards the other cameras of its kind; {alone}"
            std *= row[FOCAL] if column == FOCAL else 1.0
            intervals[name] = IntrinsicInterval(value, float(std), how)
    return tuple(answer)


def widen_unverified_focals(intervals: Intervals, focal_std: F64) -> Intervals:
    """Widen the intervals of shared focals by the ``focal_std`` (V,) that the images cannot exclude."""
    answer: list[Mapping[str, IntrinsicInterval]] = []
    for own, rel in zip(intervals, focal_std, strict=True):
        focal = own.get("focal_px")
        if focal is not None and np.isfinite(rel) and rel * focal.value > focal.std:
            own = {**own, "focal_px": IntrinsicInterval(focal.value, rel * focal.value, UNVERIFIED_SHARING)}
        answer.append(own)
    return tuple(answer)


def widen_by_camera_model(intervals: Intervals, difference: Sequence[float], misfit: float) -> Intervals:
    """Add the differences to another camera model to the standard deviations, or scale these by the misfit.

    Of focals, principal points over the focal, and k1; if 0, variances times ``misfit`` (Birge ratio).
    """
    names = ("focal_px",), ("principal_x_px", "principal_y_px"), ("k1",)
    moved = {name: rel for group, rel in zip(names, difference, strict=False) for name in group}
    factor = 1.0 if any(difference) else np.sqrt(misfit)
    answer: list[dict[str, IntrinsicInterval]] = [dict(own) for own in intervals]
    for own in filter(None, answer):
        for name, rel in moved.items():
            if name in own and own[name].std > 0.0 and (rel > 0.0 or factor > 1.0):
                std, off = own[name].std, rel * (1.0 if name == "k1" else own["focal_px"].value)
                # The larger part names the interval.
                source = CAMERA_MODEL if factor > 1.0 or off > std else own[name].source
                own[name] = replace(own[name], std=float(np.hypot(factor * std, off)), source=source)
    return tuple(answer)


def changes_by_expected_lens(
    model: MetricEstimate, adjustment: MetricAdjustment, uncertainty: PoseUncertainty
) -> tuple[float, float, float]:
    """Largest changes of focals (relative), principal points (over the focal), k1 to the expected distortion.

    Of a lens of small distortion, to first order: to the conditional mean given the means of the prior.
    """
    if model.cameras.intrinsics.shape[1] > WIDTH:
        return 0.0, 0.0, 0.0
    number, C = uncertainty.number, uncertainty.covariance
    of_lens = np.unique(number[:, K1:][number[:, K1:] >= 0])
    off = np.zeros(len(C))
    off[number[number >= 0]] = (model.cameras.intrinsics - adjustment.row_prior(model).mean)[number >= 0]
    moved = C[:, of_lens] @ np.linalg.solve(C[np.ix_(of_lens, of_lens)], off[of_lens])
    change = np.abs(np.append(moved, 0.0)[number])
    over_focal = change[:, CENTRE] / model.cameras.intrinsics[:, :1]
    return float(change[:, FOCAL].max()), float(over_focal.max()), float(change[:, K1].max())


def pose_std(
    model: MetricEstimate, poses: PoseUncertainty, scatter: BlockScatter, intervals: Intervals
) -> F64:
    """Standard deviations (V, 6) of rotations and centres as in ``MetricResult.pose_std``.

    They contain the errors of the stated ``intervals`` and of a fixed aspect, skew and decentring. The noise
    of a pose is the larger one of its own scatter between blocks and that of the intrinsics.
    """
    number = poses.number
    std = np.sqrt(np.diag(poses.covariance))
    for view in poses.views:
        for name, column in intrinsic_columns(number.shape[1]).items():
            unknown = number[model.cameras.group[view], column]
            if unknown >= 0:
                own = intervals[view][name]
                std[unknown] = own.std / (own.value if column == FOCAL else 1.0)
    share = lack_of_fit(scatter, model.tail)
    common, fault = _common_inflation(scatter, share), MODEL_FLOOR_REL * np.sqrt(share)
    # Here decentring stands for all smooth errors of a lens: poses absorb them in more ways.
    std = np.hypot(std, fault * np.linalg.norm(poses.intrinsic_fault[:, 2:], axis=1))
    # Errors of a few blocks move some views more than they move the intrinsics.
    noise = np.full((len(poses.views), 2), common)
    for view, part in zip(*np.nonzero(np.isfinite(scatter.pose_ratios[0])), strict=True):
        own, large = (float(ratio) for ratio in scatter.pose_ratios[:, view, part])
        noise[view, part] = max(common, _inflation(scatter, own, large, share))
    answer = np.full((len(model.registered), 6), np.nan)
    answer[poses.views] = np.sqrt(poses.variances(np.repeat(noise, 3, axis=1), std, fault))
    return answer


def with_angles_of_view(
    model: MetricEstimate, poses: PoseUncertainty, scatter: BlockScatter, intervals: Intervals,
    change: tuple[float, float] = (0.0, 0.0),
) -> tuple[Mapping[str, IntrinsicInterval], ...]:  # fmt: skip
    """The intervals with those of the angle of view along the long side and at the farthest corner.

    Scatter, and the step by which the prior moves the intrinsics; errors of the camera model are those by
    which the stated interval of the focal length exceeds its scatter, and the ``change`` of the angles by
    another lens.
    """
    inflation = _common_inflation(scatter, lack_of_fit(scatter, model.tail))
    covariance = inflation**2 * poses.covariance
    answer = [dict(own) for own in intervals]
    found: dict[tuple[int, ...], dict[str, IntrinsicInterval]] = {}
    for view in np.flatnonzero(model.registered).tolist():
        g = int(model.cameras.group[view])
        width, height = (int(side) for side in model.sizes[view])
        if (g, width, height) not in found:
            row, number, focal = model.cameras.intrinsics[g], poses.number[g], answer[view]["focal_px"]
            columns = np.flatnonzero(number >= 0)
            value, slopes = _angles(row, columns, np.sqrt(scatter.variance[g]), (width, height))
            unknown = number[columns]
            variance = np.einsum("ka,kl,la->a", slopes, covariance[np.ix_(unknown, unknown)], slopes)
            variance += (scatter.pull[g, columns] @ slopes) ** 2
            if FOCAL in columns:
                more = (focal.std / focal.value) ** 2 - covariance[number[FOCAL], number[FOCAL]]
                variance += slopes[0] ** 2 * max(more, 0.0)
            variance += np.square(change)
            angles = zip(("angle_of_view_deg", "corner_deg"), value, np.sqrt(variance), strict=True)
            how = "by the intervals of the intrinsics and their correlations"
            found[g, width, height] = {
                name: IntrinsicInterval(float(v), float(s), how)
                for name, v, s in angles
                if np.isfinite(v + s)
            }
        answer[view] |= found[g, width, height]
    return tuple(answer)


def _angles(row: F64, columns: I64, std: F64, size: tuple[int, int]) -> tuple[F64, F64]:
    """Angles of view (2,) of a row of intrinsics, and slopes (K, 2) by ``columns``; the focal as log f."""

    def angles(row: F64) -> F64:
        return np.array(angles_of_view(calibrations(row[None])[0], size, row[K1:]))

    slopes = np.zeros((len(columns), 2))
    for k, column in enumerate(columns):
        # Steps of a thousandth of a standard deviation.
        step, unit = 1e-3 * std[column], row[FOCAL] if column == FOCAL else 1.0
        move = step * unit * (np.arange(len(row)) == column)
        slopes[k] = (angles(row + move) - angles(row - move)) / (2.0 * step)
    return angles(row), slopes


def _common_inflation(scatter: BlockScatter, share: float) -> float:
    """Inflation by the median scatter of all intrinsics."""
    known = [ratio[np.isfinite(ratio)] for ratio in (scatter.ratio, scatter.large_ratio)]
    ratio, large = (float(np.median(values)) if len(values) else np.nan for values in known)
    return _inflation(scatter, ratio, large, share)


def _inflation(scatter: BlockScatter, ratio: float, large: float, share: float) -> float:
    """Inflation by the scatter of many blocks, and with ``share`` (lack of fit) by that of few large ones."""
    if scatter.blocks < MIN_BLOCKS or not np.isfinite(ratio):
        return USUAL_INFLATION
    small = float(np.sqrt(ratio) * student_factor(scatter.blocks - 1))
    wide = float(np.sqrt(max(large, ratio, 1.0)) * student_factor(scatter.large_blocks - 1))
    return (1.0 - share) * small + share * max(small, wide)
