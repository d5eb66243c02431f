"""What the page says: the verdict, the facts, and numbers written as people read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from thesisrecon.errors import counted
from thesisrecon.records import IntrinsicInterval, TexturedMesh, TwoView
from thesisrecon.report.data import ReportData, ResidualSummary

Level = Literal["good", "doubt", "open", "bad"]
THIN = "\u202f"  # a narrow space that does not break groups thousands in any language

STAGE_WORDS = {
    "features": "corners were found",
    "matches": "pairs of photographs were matched",
    "projective": "a projective reconstruction was made (shapes up to perspective, no focal yet)",
    "metric": "metric cameras and points were made",
}
UNITS = {"px": "px", "deg": "°", "s": "s", "mb": "MB", "gb": "GB"}


@dataclass(frozen=True)
class Verdict:
    """How far the run got and how sure it is: a word, a sentence, and the reasons behind it."""

    level: Level
    word: str
    sentence: str
    reasons: tuple[str, ...] = ()
    advice: str = ""


@dataclass(frozen=True)
class Fact:
    """One number of the first glance, with what it needs to be understood."""

    label: str
    value: str
    note: str = ""


def judge(data: ReportData) -> Verdict:
    """The honest word on a run: trusted, doubtful, ended early as asked, or failed."""
    total = len(data.photographs)
    if data.failure is not None:
        last = (
            f"the last stage that finished was {data.reports[-1].stage}"
            if data.reports
            else "no stage finished"
        )
        evidence = tuple(_sentence(text) for text in (data.failure.evidence, last) if text)
        return Verdict(
            "bad", "Failed", _sentence(data.failure.reason), evidence, _sentence(data.failure.advice)
        )
    if data.metric is None:
        done = STAGE_WORDS.get(data.until or "", "the stages below were run")
        return Verdict("open", "Ended early", f"As asked, the run ended there: {done}.")
    registered = int(data.metric.reconstruction.registered.sum())
    have = "has a metric camera" if registered == 1 else "have a metric camera"
    found = f"{registered} of {count_of(total, 'photograph')} {have}."
    if not data.metric.trusted:
        failed_checks = tuple(_sentence(doubt) for doubt in data.metric.failed_checks) or (
            "The self-check failed.",
        )
        return Verdict(
            "doubt",
            "Doubtful",
            f"{found} Do not rely on the result before you have looked at it.",
            failed_checks,
        )
    if registered < total:
        return Verdict(
            "good", "Trusted, but incomplete", f"{found} The self-check found nothing to doubt in these."
        )
    return Verdict("good", "Trusted", f"{found} The self-check found nothing to doubt.")


def first_glance(data: ReportData, overall: ResidualSummary | None) -> list[Fact]:
    """The facts above everything else, as far as the run got: cameras, intrinsics, residuals, time."""
    facts = [_registered(data)]
    if data.metric is not None:
        facts += _intrinsic_facts(data)
    elif data.pairs:
        facts.append(_pair_fact(data.pairs))
    if overall is not None:
        note = f"{overall.rms_px:.2f} px RMS over {count_of(overall.count, 'observation')}"
        scales = {photograph.scale for photograph in data.photographs}
        if len(scales) == 1 and scales != {1.0}:
            note += f"; at working size {overall.median_px * scales.pop():.2f} px median"
        facts.append(Fact("Reprojection error", f"{overall.median_px:.2f} px median", note))
    best = data.best_reconstruction
    if best is not None:
        facts.append(_point_fact(int(best.valid.sum()), overall))
    seconds = sum(report.seconds for report in data.reports)
    if data.reports:
        slowest = max(data.reports, key=lambda report: report.seconds)
        share = round(100 * slowest.seconds / seconds) if seconds > 0 else 0
        facts.append(
            Fact(
                "Computing time of this result",
                duration(seconds),
                f"longest stage: {slowest.stage}, {share} %",
            )
        )
    return facts


def _registered(data: ReportData) -> Fact:
    total, best = len(data.photographs), data.best_reconstruction
    unread = f"{count_of(len(data.unread), 'file')} could not be read" if data.unread else ""
    if best is None:
        return Fact("Photographs", str(total), unread)
    registered = int(best.registered.sum())
    refused = f"{total - registered} refused" if registered < total else "all of them"
    label = "Cameras registered" if data.metric is not None else "Projective cameras"
    note = ", ".join(part for part in (refused, unread) if part)
    return Fact(label, f"{registered} of {total}", note)


def _pair_fact(pairs: Sequence[TwoView]) -> Fact:
    accepted = [pair for pair in pairs if pair.accepted]
    note = f"{count_of(sum(pair.inliers for pair in accepted), 'verified match')} in them"
    if undetermined := sum(pair.undetermined for pair in accepted):
        leave = "leaves its" if undetermined == 1 else "leave their"
        note += f"; {undetermined} {leave} epipolar geometry undetermined"
    return Fact("Pairs accepted", f"{len(accepted)} of {len(pairs)}", note)


def chosen_pairs(data: ReportData) -> str:
    """How many of the possible pairs were tried and how they were chosen, as a sentence; '' if unsaid."""
    if data.pair_choice is None:
        return ""
    views = len(data.photographs)
    possible, tried = views * (views - 1) // 2, len(data.pairs)
    were = "was" if tried == 1 else "were"
    return f"{grouped(tried)} of {count_of(possible, 'pair')} {were} tried: {data.pair_choice.how}."


def model_words(mesh: TexturedMesh) -> str:
    """How large the model on the page is, and what of it nobody saw."""
    words = count_of(len(mesh.faces), "triangle")
    if mesh.texture is not None and mesh.uv is not None:
        words += f" with a texture of {mesh.texture.shape[1]} × {mesh.texture.shape[0]} texels"
    elif mesh.colors is not None:
        words += " with coloured corners"
    unseen = float(mesh.untextured.mean()) if mesh.untextured is not None and len(mesh.untextured) else 0.0
    if unseen >= 0.001:
        words += f"; {100 * unseen:.1f} % of them are in no photograph and coloured like their surroundings"
    return words


def _point_fact(points: int, overall: ResidualSummary | None) -> Fact:
    seen = f"seen in {overall.count / points:.1f} photographs on average" if overall and points else ""
    return Fact("Points", grouped(points), seen)


def _intrinsic_facts(data: ReportData) -> list[Fact]:
    known = [
        (view, photo) for view, photo in zip(data.original_intrinsics, data.photographs, strict=True) if view
    ]
    focal = [view["focal_px"] for view, _ in known if "focal_px" in view]
    facts = []
    if focal:
        widths = np.array(
            [photo.original_size[0] for view, photo in known if "focal_px" in view], dtype=float
        )
        angle = np.degrees(2 * np.arctan(widths / (2 * np.array([f.value for f in focal]))))
        sizes = {photo.original_size for _, photo in known}
        where = "×".join(str(n) for n in sizes.pop()) + " px" if len(sizes) == 1 else "each its own size"
        note = f"{np.median(angle):.1f}° wide, at {where}. {source_of(focal)}"
        facts.append(Fact("Focal length", interval_of(focal, "px"), note))
    centre_x = [view["principal_x_px"] for view, _ in known if "principal_x_px" in view]
    centre_y = [view["principal_y_px"] for view, _ in known if "principal_y_px" in view]
    if centre_x and centre_y:
        middles = (
            np.array([photo.original_size for view, photo in known if "principal_x_px" in view]) - 1.0
        ) / 2
        offset = np.stack([[p.value for p in centre_x], [p.value for p in centre_y]], axis=1) - middles
        away = float(np.median(np.linalg.norm(offset, axis=1)))
        note = f"x, y; {away:.1f} px off the middle of the photograph. {source_of([*centre_x, *centre_y])}"
        value = f"{interval_of(centre_x, '')}, {interval_of(centre_y, 'px')}"
        facts.append(Fact("Principal point", value, note))
    return facts


def interval_of(intervals: Sequence[IntrinsicInterval], unit: str) -> str:
    """One value ± its standard deviation where all views share it, else the range over the views."""
    values = np.array([interval.value for interval in intervals])
    std = float(np.median([interval.std for interval in intervals]))
    tail = f"{THIN}{unit}" if unit else ""
    if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
        return plus_minus(float(values[0]), std) + tail
    digits = _decimals(std)
    return f"{values.min():.{digits}f} to {values.max():.{digits}f}{tail} (± {std:.{digits}f})"


def source_of(intervals: Sequence[IntrinsicInterval]) -> str:
    """Where the values come from, each source once."""
    return "From: " + ", ".join(dict.fromkeys(interval.source for interval in intervals)) + "."


def plus_minus(value: float, std: float) -> str:
    """``1520.3 ± 1.8``, with as many decimals as the standard deviation deserves; fixed values say so."""
    if not np.isfinite(std):
        return f"{value:.4g} (not determined)"
    if std == 0:
        return f"{value:.6g} (fixed)"
    digits = _decimals(std)
    return f"{value:.{digits}f} ± {std:.{digits}f}"


def _decimals(std: float) -> int:
    if not np.isfinite(std) or std <= 0:
        return 1
    # Two digits of an uncertainty that starts with 1 or 2, one of any other: the customary rounding.
    exponent = int(np.floor(np.log10(std)))
    return int(np.clip((1 if std < 3 * 10.0**exponent else 0) - exponent, 0, 6))


def grouped(number: int) -> str:
    """12345 as 12 345."""
    return f"{number:,}".replace(",", THIN)


def decimals(value: float, digits: int) -> str:
    """A number with so many decimals, a dash where it is not known."""
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"


def significant(value: float) -> str:
    """A length in three digits, a dash where it is not known."""
    return f"{value:.3g}" if np.isfinite(value) else "–"


def duration(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 60:
        return f"{seconds:.1f}{THIN}s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}{THIN}h {minutes:02d}{THIN}min" if hours else f"{minutes}{THIN}min {rest:02d}{THIN}s"


def named_number(name: str, value: float) -> tuple[str, str]:
    """A key as words and its value with the unit of its suffix: ``sigma_px`` -> ("sigma", "0.31 px")."""
    stem, _, suffix = name.rpartition("_")
    text = grouped(int(value)) if float(value).is_integer() and abs(value) < 1e15 else _short(value)
    if stem and suffix in UNITS:
        return stem.replace("_", " "), f"{text}{THIN}{UNITS[suffix]}"
    if stem and suffix == "rel":
        return stem.replace("_", " "), f"{100 * value:.3g}{THIN}%"
    return name.replace("_", " "), text


def _short(value: float) -> str:
    """Three digits, more only where they stand before the point."""
    return f"{value:.3g}" if not abs(value) >= 1000 else f"{value:.0f}"


def named_numbers(numbers: Mapping[str, float] | Mapping[str, int]) -> list[tuple[str, str]]:
    """:func:`named_number` of a whole mapping, in its order."""
    return [named_number(name, float(value)) for name, value in numbers.items()]


def count_of(number: int, noun: str) -> str:
    """``1 file``, ``2 files``."""
    return counted(number, noun, grouped(number))


def _sentence(text: str) -> str:
    """A clause with a capital and a full stop, empty where there is nothing to say."""
    text = text.strip()
    return text[:1].upper() + text[1:].rstrip(".") + "." if text else ""
