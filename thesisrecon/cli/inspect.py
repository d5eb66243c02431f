"""The summary of a run in lines of text, for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from thesisrecon.errors import counted
from thesisrecon.io.files import printable


def summary_text(summary: Mapping[str, Any], out: Path) -> str:
    """What the command says of a run whose folder is ``out``, a fact a line.

    ``summary`` is what ``summary.json`` holds; ``KeyError`` or ``TypeError`` where it is something else.
    """
    lines = [_found(summary)]
    if summary["reprojection_rms_px"] is not None:
        lines.append(
            f"reprojection residual {summary['reprojection_rms_px']:.3f} px RMS, "
            f"{summary['reprojection_median_px']:.3f} px median"
        )
    lines += intrinsic_lines(summary["cameras"])
    if summary.get("model"):
        lines.append(f"model of {counted(summary['model']['faces'], 'triangle')}: {out / 'model.glb'}")
    lines += [f"refused: {refused['name']}: {refused['reason']}" for refused in summary["refused"]]
    lines += [f"warning: {warning}" for warning in summary["warnings"]]
    if summary["failure"]:
        lines.append(f"failed: {summary['failure']}")
    lines.append(f"{time_taken(summary)}; the page is {out / 'report.html'}")
    return "\n".join(printable(line) for line in lines)


def time_taken(summary: Mapping[str, Any]) -> str:
    """What this run took; where stages were kept, also what all of them took when they were computed."""
    total = summary["seconds"]["total"]
    took = f"{summary.get('elapsed_seconds', total):.1f} s"
    return f"{took} ({total:.1f} s with what was kept of an earlier run)" if summary["resumed"] else took


def _found(summary: Mapping[str, Any]) -> str:
    """What the last stage that found something found."""
    images, pairs = summary["images"], summary["pairs"]
    if summary["stratum"] is not None:
        kind = " in projective cameras" if summary["stratum"] == "projective" else ""
        found = f"{summary['registered']} of {counted(images, 'photograph')} registered"
        return f"{found}{kind}, {counted(summary['points'], 'point')}"
    if pairs["matched"]:
        possible = pairs.get("possible", pairs["matched"])
        chosen = f" ({possible} are possible)" if possible > pairs["matched"] else ""
        return (
            f"{pairs['accepted']} of {counted(pairs['matched'], 'pair')} of photographs accepted{chosen}, "
            f"{counted(pairs['verified_matches'], 'verified match')}"
        )
    corners = [view["corners"] for view in summary["cameras"] if view["corners"] is not None]
    if corners:
        return f"{counted(sum(corners), 'corner')} in {counted(len(corners), 'photograph')}"
    return f"{len(summary['cameras'])} of {counted(images, 'photograph')} read"


def intrinsic_lines(views: list[Mapping[str, Any]]) -> list[str]:
    """One line per camera: focal length, principal point and what else of K was estimated, with their
    standard deviations."""
    lines: dict[tuple[int, float], str] = {}
    for view in views:
        if "focal_px" not in view:
            continue
        focal, x, y = (view[name] for name in ("focal_px", "principal_x_px", "principal_y_px"))
        lines.setdefault(
            (view["camera"], focal["value"]),
            f"camera {view['camera']}: "
            f"focal {focal['value']:.1f} +- {focal['std']:.1f} px ({focal['source']}), "
            f"principal point ({x['value']:.1f} +- {x['std']:.1f}, {y['value']:.1f} +- {y['std']:.1f}) px"
            + _shape_of_pixels(view),
        )
    return list(lines.values())


def _shape_of_pixels(view: Mapping[str, Any]) -> str:
    """Aspect and skew, where they were estimated."""
    words = ""
    for name, text, digits, unit in (("aspect", "aspect", 5, ""), ("skew_px", "skew", 2, " px")):
        interval = view.get(name)
        if interval is not None and interval["std"] != 0.0:
            words += f", {text} {interval['value']:.{digits}f} +- {interval['std']:.{digits}f}{unit}"
    return words
