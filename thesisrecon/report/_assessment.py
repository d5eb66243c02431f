"""Sentences, tables and numbers of the pages: the assessment of a run, its key facts, a comparison."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from thesisrecon.errors import counted
from thesisrecon.records import IntrinsicInterval, TexturedMesh, TwoView
from thesisrecon.report._data import ReportData, ResidualSummary
from thesisrecon.results import THRESHOLDS, ModelComparison

Level = Literal["good", "doubt", "open", "bad"]
_THIN = "\u202f"  # narrow no-break space

_STAGE_RESULTS = {
    "features": "corners were detected",
    "matches": "image pairs were matched",
    "projective": "a projective reconstruction was computed (without focal lengths and angles)",
    "metric": "metric cameras and points were computed",
}


@dataclass(frozen=True)
class Assessment:
    """How far the run got and whether its result is trusted; ``level`` is the colour of the page."""

    level: Level
    word: str
    sentence: str
    reasons: tuple[str, ...] = ()
    advice: str = ""


@dataclass(frozen=True)
class Fact:
    """One key number with its explanation."""

    label: str
    value: str
    note: str = ""


def assess(data: ReportData) -> Assessment:
    """Assess a run: trusted, not trusted, stopped early or failed."""
    total = len(data.images)
    if data.end is not None:
        failure, done = data.end, "no stage finished"
        if data.reports:
            done = f"the last stage that finished was {data.reports[-1].stage}"
        evidence = tuple(_sentence(text) for text in (failure.evidence, done) if text)
        return Assessment("bad", "Failed", _sentence(failure.reason), evidence, _sentence(failure.advice))
    if data.metric is None:
        done = _STAGE_RESULTS.get(data.until or "", "the stages below were run")
        return Assessment("open", "Stopped early", f"The run ended as requested: {done}.")
    registered = int(data.metric.reconstruction.registered.sum())
    have = "has" if registered == 1 else "have"
    found = f"{registered} of {count_of(total, 'image')} {have} a metric camera."
    if not data.metric.trusted:
        reasons = tuple(_sentence(check) for check in data.metric.failed_checks or ("the self-check failed",))
        return Assessment("doubt", "Not trusted", f"{found} Inspect the result before you use it.", reasons)
    passed = f"{found} The result passed the self-check."
    word = "Trusted, but incomplete" if registered < total else "Trusted"
    if data.metric.limitations:
        passed += " The images differ from the camera model; the stated intervals allow for it."
        word = "Trusted, simple camera model" if registered == total else word
    return Assessment("good", word, passed, tuple(_sentence(text) for text in data.metric.limitations))


def key_facts(data: ReportData, overall: ResidualSummary | None) -> list[Fact]:
    """Key facts of a run, if available: cameras, intrinsics, residuals, points and time."""
    facts, best = [_registered(data)], data.best_reconstruction
    if data.metric is not None:
        facts += _intrinsic_facts(data)
    elif data.pairs:
        accepted = [pair for pair in data.pairs if pair.accepted]
        note = count_of(sum(pair.inliers for pair in accepted), "verified match")
        if undetermined := sum(pair.undetermined for pair in accepted):
            note += f"; {count_of(undetermined, 'pair')} with degenerate epipolar geometry"
        facts.append(Fact("Pairs accepted", f"{len(accepted)} of {len(data.pairs)}", note))
    if overall is not None:
        note = f"{overall.rms_px:.2f} px RMS over {count_of(overall.count, 'observation')}"
        scales = {image.scale for image in data.images}
        if len(scales) == 1 and scales != {1.0}:
            note += f"; at working size {overall.median_px * scales.pop():.2f} px median"
        facts.append(Fact("Reprojection residual", f"{overall.median_px:.2f} px median", note))
    if best is not None:
        points = int(best.valid.sum())
        seen = f"{overall.count / points:.1f} observations per point" if overall and points else ""
        facts.append(Fact("Points", grouped(points), seen))
    seconds = sum(report.seconds for report in data.reports)
    if data.reports:
        slowest = max(data.reports, key=lambda report: report.seconds)
        share = round(100 * slowest.seconds / seconds) if seconds > 0 else 0
        facts.append(Fact("Computing time", duration(seconds), f"longest stage: {slowest.stage}, {share} %"))
    return facts


def _registered(data: ReportData) -> Fact:
    total, best = len(data.images), data.best_reconstruction
    unread = f"{count_of(len(data.unread), 'file')} could not be read" if data.unread else ""
    if best is None:
        return Fact("Images", str(total), unread)
    registered = int(best.registered.sum())
    refused = f"{total - registered} not registered" if registered < total else ""
    label = "Cameras registered" if data.metric is not None else "Projective cameras"
    note = ", ".join(part for part in (refused, unread) if part)
    return Fact(label, f"{registered} of {total}", note)


def pair_text(pair: TwoView) -> str:
    """Matches, noise and degeneracy of a pair."""
    share = f" ({100 * pair.inliers / pair.candidates:.0f} %)" if pair.candidates else ""
    text = f"{grouped(pair.inliers)} verified of {grouped(pair.candidates)} candidate matches{share}"
    if np.isfinite(pair.sigma_px):
        text += f", noise {pair.sigma_px:.2f} px per coordinate"
    if np.isfinite(pair.homography_inlier_ratio):
        text += f", {100 * pair.homography_inlier_ratio:.0f} % homography inliers"
    if pair.undetermined and pair.degeneracy is not None:
        text += f"; degenerate epipolar geometry: {pair.degeneracy.reasons[0]}"
    return text


def pair_selection_text(data: ReportData) -> str:
    """How many of the possible pairs were matched and how they were selected; empty if unknown."""
    if data.pair_choice is None:
        return ""
    tried, views = len(data.pairs), len(data.images)
    share = f"{grouped(tried)} of {count_of(views * (views - 1) // 2, 'pair')}"
    return f"{share} {'was' if tried == 1 else 'were'} matched: {data.pair_choice.how}."


def model_text(mesh: TexturedMesh) -> str:
    """Size of the displayed model and its untextured part."""
    words = count_of(len(mesh.faces), "triangle")
    if mesh.texture is not None and mesh.uv is not None:
        words += f" with a texture of {mesh.texture.shape[1]} × {mesh.texture.shape[0]} texels"
    elif mesh.colors is not None:
        words += " with vertex colours"
    unseen = float(mesh.untextured.mean()) if mesh.untextured is not None and len(mesh.untextured) else 0.0
    if unseen >= 0.001:
        words += f"; {100 * unseen:.1f} % are visible in no image and have the colour of their surroundings"
    return words


def _intrinsic_facts(data: ReportData) -> list[Fact]:
    known = [(view, photo) for view, photo in zip(data.original_intrinsics, data.images, strict=True) if view]
    if not known:
        return []
    names = ("focal_px", "principal_x_px", "principal_y_px")
    focal, x, y = ([view[name] for view, _ in known] for name in names)
    sizes = np.array([photo.original_size for _, photo in known], dtype=float)
    angles = [view["angle_of_view_deg"] for view, _ in known if "angle_of_view_deg" in view]
    distinct = {photo.original_size for _, photo in known}
    width, height = known[0][1].original_size
    where = f"images of {width}×{height} px" if len(distinct) == 1 else "images of several sizes"
    field = f"angle of view {_interval_text(angles, '°')} along the long side; " if angles else ""
    field += f"{where}. {_source_of(focal)}"
    offset = np.array([[p.value for p in x], [p.value for p in y]]).T - (sizes - 1.0) / 2
    away = float(np.median(np.linalg.norm(offset, axis=1)))
    centre = f"x, y; {away:.1f} px from the image centre. {_source_of([*x, *y])}"
    return [
        Fact("Focal length", _interval_text(focal, "px"), field),
        Fact("Principal point", f"{_interval_text(x, '')}, {_interval_text(y, 'px')}", centre),
    ]


def _interval_text(intervals: Sequence[IntrinsicInterval], unit: str) -> str:
    """Format one value ± its standard deviation, or the range if the views differ."""
    values = np.array([interval.value for interval in intervals])
    std = float(np.median([interval.std for interval in intervals]))
    tail = f"{_THIN}{unit}" if unit else ""
    if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
        return plus_minus(float(values[0]), std) + tail
    digits = _decimals(std)
    return f"{values.min():.{digits}f} to {values.max():.{digits}f}{tail} (± {std:.{digits}f})"


def _source_of(intervals: Sequence[IntrinsicInterval]) -> str:
    """List the sources of the values, each once."""
    return "Source: " + ", ".join(dict.fromkeys(interval.source for interval in intervals)) + "."


def plus_minus(value: float, std: float) -> str:
    """Format a value with the decimals that its standard deviation (0 = fixed) justifies: "1520.3 ± 1.8"."""
    if not np.isfinite(std):
        return f"{value:.4g} (not determined)"
    if std == 0:
        return f"{value:.6g} (fixed)"
    digits = _decimals(std)
    return f"{value:.{digits}f} ± {std:.{digits}f}"


def _decimals(std: float) -> int:
    if not np.isfinite(std) or std <= 0:
        return 1
    # The usual rounding: two digits of an uncertainty that starts with 1 or 2, else one.
    exponent = int(np.floor(np.log10(std)))
    return int(np.clip((1 if std < 3 * 10.0**exponent else 0) - exponent, 0, 6))


def grouped(number: int) -> str:
    """Group the digits of an integer: 12345 as 12 345."""
    return f"{number:,}".replace(",", _THIN)


def decimals(value: float, digits: int) -> str:
    """Format a number with fixed decimals; a dash if it is not finite."""
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"


def significant(value: float, digits: int = 3) -> str:
    """Format a length with significant digits; a dash if it is not finite."""
    return f"{value:.{digits}g}" if np.isfinite(value) else "–"


def duration(seconds: float) -> str:
    """Format a duration: "7.3 s", "4 min 05 s" or "1 h 02 min"."""
    if seconds < 60:
        return f"{seconds:.1f}{_THIN}s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}{_THIN}h {minutes:02d}{_THIN}min" if hours else f"{minutes}{_THIN}min {rest:02d}{_THIN}s"


def _named_number(name: str, value: float) -> tuple[str, str]:
    """Format a key and its value with the unit of its suffix: sigma_px -> ("sigma", "0.31 px")."""
    stem, _, suffix = name.rpartition("_")
    units = {"px": "px", "deg": "°", "s": "s", "mb": "MB", "gb": "GB", "rel": "%"}
    unit = units.get(suffix) if stem else None
    text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    if unit == "%":
        text = f"{100 * value:.3g}"
    elif float(value).is_integer() and abs(value) < 1e15:
        text = grouped(int(value))
    return (name if unit is None else stem).replace("_", " "), f"{text}{_THIN}{unit}" if unit else text


def named_numbers(numbers: Mapping[str, float] | Mapping[str, int]) -> list[tuple[str, str]]:
    """Format the keys and values of a mapping with the units of their suffixes."""
    return [_named_number(name, float(value)) for name, value in numbers.items()]


def count_of(number: int, noun: str) -> str:
    """Format a count with its noun: "1 file" or "2 files"."""
    return counted(number, noun, grouped(number))


def _sentence(text: str) -> str:
    """Capitalize a clause and end it with a full stop."""
    text = text.strip()
    return text[:1].upper() + text[1:].rstrip(".") + "." if text else ""


_four_digits = partial(significant, digits=4)
_COLUMNS = {
    "centre_error": ("centre (unit of B)", 1.0),
    "rotation_error_deg": ("rotation (deg)", 1.0),
    "focal_error_rel": ("focal length (%)", 100.0),
    "principal_point_error_px": ("principal point (px)", 1.0),
}

Table = list[list[str]]


def summary_table(comparison: ModelComparison) -> Table:
    """Statistics of the absolute errors that are known, with a head row."""
    rows = [["error of A", "median", "mean", "RMS", "largest"]]
    for name, statistics in comparison.summary.items():
        label, factor = _COLUMNS[name]
        rows.append([label, *(_four_digits(factor * value) for value in statistics.values())])
    return rows


def camera_table(comparison: ModelComparison) -> Table:
    """Errors of each common camera, with a head row."""
    rows = [["camera", *(label for label, _ in _COLUMNS.values())]]
    errors = [factor * getattr(comparison, name) for name, (_, factor) in _COLUMNS.items()]
    columns = zip(comparison.names, *errors, strict=True)
    return rows + [[name, *map(_four_digits, numbers)] for name, *numbers in columns]


def point_table(comparison: ModelComparison) -> Table:
    """Distances of the points in both directions, with a head row; empty without them."""
    found = comparison.points
    if found is None:
        return []
    rows = [["points", "A to nearest of B", "B to nearest of A"]]
    rows.append(["median distance (unit of B)", _four_digits(found.a_to_b), _four_digits(found.b_to_a)])
    columns = (THRESHOLDS, found.thresholds, found.a_within, found.b_within)
    for share, limit, *within in zip(*columns, strict=True):
        label = f"within {_four_digits(limit)} ({100 * share:g} % of the scene)"
        rows.append([label, *(f"{100 * part:.1f} %" for part in within)])
    return rows


def headline(comparison: ModelComparison) -> str:
    """Number of common cameras, and of those of one model only."""
    text = count_of(len(comparison.names), "common camera")
    for which, only in (("A", comparison.only_a), ("B", comparison.only_b)):
        if only:
            text += f", {len(only)} only in {which}"
    scale = comparison.similarity
    return text if scale is None else f"{text}; one unit of A is {_four_digits(scale.scale)} units of B"
