"""The command ``inspect``: print the summary of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from thesisrecon.cli.common import parse_folder
from thesisrecon.errors import UsageError, counted
from thesisrecon.io._files import printable, read_json


def inspect(
    out: Annotated[Path, typer.Argument(parser=parse_folder, metavar="OUT", help="Output folder of a run.")],
) -> None:
    """Print the summary of a run."""
    summary = read_json(out / "summary.json")
    if not isinstance(summary, dict):
        raise UsageError(f"{out} holds no summary.json; no run has finished in this folder")
    try:
        text = summary_text(summary, out)
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError, RecursionError):
        raise UsageError(f"{out / 'summary.json'} is not a summary written by thesisrecon") from None
    typer.echo(text)


def summary_text(summary: Mapping[str, Any], out: Path) -> str:
    """Format ``summary.json`` for a terminal, one fact per line, without control characters."""
    lines = [_result(summary)]
    rms, median = summary["reprojection_rms_px"], summary["reprojection_median_px"]
    if rms is not None:
        lines.append(f"reprojection residual {rms:.3f} px RMS, {median:.3f} px median")
    lines += _intrinsic_lines(summary["cameras"])
    if summary.get("model"):
        lines.append(f"model with {counted(summary['model']['faces'], 'triangle')}: {out / 'model.glb'}")
    lines += [f"not registered: {refused['name']}: {refused['reason']}" for refused in summary["refused"]]
    lines += [f"warning: {warning}" for warning in summary["warnings"]]
    if summary["failure"]:
        lines.append(f"failed: {summary['failure']}")
    lines.append(f"{_duration(summary)}; report: {out / 'report.html'}")
    return "\n".join(printable(line) for line in lines)


def _duration(summary: Mapping[str, Any]) -> str:
    """Time of this run and, if stages were cached, the computing time of all of them."""
    total = summary["seconds"]["total"]
    elapsed = f"{summary.get('elapsed_seconds', total):.1f} s"
    return f"{elapsed} ({total:.1f} s including cached stages)" if summary["resumed"] else elapsed


def _result(summary: Mapping[str, Any]) -> str:
    """Result of the last stage that has one."""
    images, pairs = summary["images"], summary["pairs"]
    if summary["stratum"] is not None:
        kind = " in projective cameras" if summary["stratum"] == "projective" else ""
        registered = f"{summary['registered']} of {counted(images, 'image')} registered"
        return f"{registered}{kind}, {counted(summary['points'], 'point')}"
    if pairs["matched"]:
        possible = pairs.get("possible", pairs["matched"])
        chosen = f" ({possible} are possible)" if possible > pairs["matched"] else ""
        accepted = f"{pairs['accepted']} of {counted(pairs['matched'], 'image pair')} accepted{chosen}"
        return f"{accepted}, {counted(pairs['verified_matches'], 'verified match')}"
    corners = [view["corners"] for view in summary["cameras"] if view["corners"] is not None]
    if corners:
        return f"{counted(sum(corners), 'corner')} in {counted(len(corners), 'image')}"
    return f"{len(summary['cameras'])} of {counted(images, 'image')} read"


def _intrinsic_lines(views: list[Mapping[str, Any]]) -> list[str]:
    """One line per camera: the estimated entries of K with their standard deviations."""
    lines: dict[tuple[int, float], str] = {}
    for view in views:
        if "focal_px" not in view:
            continue
        focal, x, y = (view[name] for name in ("focal_px", "principal_x_px", "principal_y_px"))
        lines.setdefault(
            (view["camera"], focal["value"]),
            f"camera {view['camera']}: focal length {focal['value']:.1f} ± {focal['std']:.1f} px "
            f"({focal['source']}), principal point ({x['value']:.1f} ± {x['std']:.1f}, "
            f"{y['value']:.1f} ± {y['std']:.1f}) px" + _aspect_and_skew(view),
        )
    return list(lines.values())


def _aspect_and_skew(view: Mapping[str, Any]) -> str:
    """Aspect ratio and skew, each only if it was estimated."""
    text = ""
    for name, label, digits, unit in (("aspect", "aspect ratio", 5, ""), ("skew_px", "skew", 2, " px")):
        interval = view.get(name)
        if interval is not None and interval["std"] != 0.0:
            text += f", {label} {interval['value']:.{digits}f} ± {interval['std']:.{digits}f}{unit}"
    return text
