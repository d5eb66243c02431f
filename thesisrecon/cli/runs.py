"""The commands ``reconstruct``, ``demo`` and ``inspect``: run folders and their summaries."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from thesisrecon.cli.common import (
    MaxSize,
    OutputFolder,
    Seed,
    Threads,
    cap_threads,
    folder_argument,
    folder_option,
    interruptible,
    progress_bars,
)
from thesisrecon.errors import UsageError, counted
from thesisrecon.io._files import printable, read_json

_DEMO_SETTINGS = {"dense.max_side": 512, "dense.match_side": 512}
"""Small depth maps: the demo should show a model soon."""
Images = Annotated[Path | None, folder_argument("IMAGES", "Folder of images; with --every also a video.")]
_EVERY_HELP = "Take the sharpest of each N frames of a video or folder."
Every = Annotated[int | None, typer.Option("--every", min=1, metavar="N", help=_EVERY_HELP)]
_SOURCE_HELP = (
    "Take the matches of a COLMAP database, or the tracks of a COLMAP sparse model; its cameras are not used."
)
Source = Annotated[Path | None, folder_option(_SOURCE_HELP, "--from", metavar="DATABASE|SPARSE")]
_IMAGES_HELP = "With --from: the folder of the images, for colours and the model."
ImagesFolder = Annotated[Path | None, folder_option(_IMAGES_HELP, "--images")]
Masks = Annotated[Path | None, folder_option("Folder of masks: black pixels are left out.", "--masks")]
_PRESET_HELP = "Pipeline to start from (default: default)."
Preset = Annotated[Literal["default", "thesis"] | None, typer.Option("--preset", help=_PRESET_HELP)]
_CAMERAS_HELP = "One camera per image size, or one per image."
Cameras = Annotated[Literal["shared", "per-image"] | None, typer.Option("--cameras", help=_CAMERAS_HELP)]
_CONFIG_HELP = "TOML file of settings that override the preset."
Config = Annotated[Path | None, typer.Option("--config", help=_CONFIG_HELP)]
_SET_HELP = "One setting as stage.field=value; may be repeated."
Settings = Annotated[list[str] | None, typer.Option("--set", help=_SET_HELP)]
_PAIRS_HELP = (
    "Image pairs to match: all, those that seem to overlap (the default above 30 images), each image with "
    "the next N by name, or the pairs of a file with two names per line."
)
_PAIRS = "all|overlap|window:N|FILE"
Pairs = Annotated[str | None, typer.Option("--pairs", metavar=_PAIRS, help=_PAIRS_HELP)]
_UNTIL_HELP = "Last stage to run: features, matches, projective, metric, dense or model (the default)."
Until = Annotated[str | None, typer.Option("--until", help=_UNTIL_HELP)]
_EXECUTOR_HELP = "Run workers as threads (local), as processes, or on a Dask cluster."
_EXECUTORS = "local|processes|dask://HOST:PORT"
Executor = Annotated[str, typer.Option("--executor", metavar=_EXECUTORS, help=_EXECUTOR_HELP)]
_OVERWRITE_HELP = "Replace another run, or changed result files, in the output folder."
OverwriteRun = Annotated[bool, typer.Option("--overwrite", help=_OVERWRITE_HELP)]


def reconstruct(
    out: OutputFolder,
    images: Images = None,
    every: Every = None,
    source: Source = None,
    images_folder: ImagesFolder = None,
    masks: Masks = None,
    preset: Preset = None,
    cameras: Cameras = None,
    config: Config = None,
    settings: Settings = None,
    seed: Seed = 0,
    threads: Threads = 0,
    max_size: MaxSize = None,
    pairs: Pairs = None,
    until: Until = None,
    executor: Executor = "local",
    overwrite: OverwriteRun = False,
) -> None:
    """Reconstruct cameras, points and a textured model from images."""
    cap_threads(threads)
    chosen: dict[str, Any] = {"config": config, "preset": preset, "cameras": cameras, "pairs": pairs}
    chosen |= {"max_size": max_size, "set": settings or [], "masks": masks}
    options = {"until": until, "threads": threads or None, "executor": executor, "overwrite": overwrite}
    if source is None:
        if images is None or images_folder is not None:
            raise UsageError(
                "give the folder of the images, or --from DATABASE|SPARSE with or without --images"
            )
        _run(images, out, seed, chosen | options | {"every": every})
        return
    if images is not None or chosen.pop("pairs") is not None or every is not None:
        raise UsageError(
            "with --from the images are given by --images, and images and pairs are those of the source"
        )
    _run(source, out, seed, chosen | options | {"images": images_folder}, matched=True)


def demo(out: OutputFolder = Path("out/demo"), threads: Threads = 0, overwrite: OverwriteRun = False) -> None:
    """Reconstruct the courtyard images that come with the package."""
    cap_threads(threads)
    from thesisrecon.io._images import demo_images

    options = {"threads": threads or None, "overwrite": overwrite}
    _run(demo_images(), out, 0, {"set": _DEMO_SETTINGS} | options)


def _run(source: Any, out: Path, seed: int, options: Mapping[str, Any], *, matched: bool = False) -> None:
    from thesisrecon.api import from_matches, reconstruct

    function: Callable[..., Any] = reconstruct.reconstruct
    if matched:
        function = from_matches.reconstruct_from_colmap
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    advice = f"repeat the command to resume from {printable(str(out))}"
    with interruptible(advice), progress_bars() as progress:
        result = function(source, out, seed=seed, progress=progress, **options)
    typer.echo(summary_text(result.summary, out))


def inspect(out: Annotated[Path, folder_argument("OUT", "Output folder of a run.")]) -> None:
    """Print the summary of a run, or where it stands if it has not finished."""
    from thesisrecon.pipeline.run import run_position
    from thesisrecon.runtime._run_folder import is_running

    summary = read_json(out / "summary.json")
    position = run_position(out) if summary is None or is_running(out) else ""
    if position:
        typer.echo(printable(position))
        return
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
        if (tiles := out / "tiles" / "tiles.json").is_file():
            lines.append(f"reduced there; all triangles are in the tiles of {tiles}")
    groups = summary.get("groups", ())
    elsewhere = {name for group in groups for name in group["names"] if name not in group["missing"]}
    refused = [one for one in summary["refused"] if one["name"] not in elsewhere]
    lines += [f"not registered: {one['name']}: {one['reason']}" for one in refused]
    for group in groups:
        count = f"{group['registered']} of {counted(group['images'], 'image')} registered"
        found = group["failure"] or count + (", not trusted" if group["trusted"] is False else "")
        page = out / group["folder"] / "report.html"
        lines.append(f"{group['folder']}: {found.removesuffix('.')}; report: {page}")
    lines += [f"camera model: {text}" for text in summary.get("limitations", ())]
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
