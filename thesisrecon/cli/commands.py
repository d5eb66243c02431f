"""The commands: ``reconstruct``, ``demo`` and ``inspect`` of runs, and those on their results."""

from __future__ import annotations

import io
import json
import logging
import math
import os
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from thesisrecon import __version__
from thesisrecon.cli import common
from thesisrecon.errors import Notice, UsageError, counted
from thesisrecon.io._files import printable, read_json
from thesisrecon.runtime._signals import set_error_stream

if TYPE_CHECKING:
    from thesisrecon.results import ModelComparison

_DEMO_SETTINGS = {"dense.max_side": 512, "dense.match_side": 512}
"""Small depth maps: the demo should show a model soon."""
Images = Annotated[
    Path | None, common.folder_argument("IMAGES", "Folder of images; with --every also a video.")
]
_EVERY_HELP = "Take the sharpest of each N frames of a video or folder."
Every = Annotated[int | None, typer.Option("--every", min=1, metavar="N", help=_EVERY_HELP)]
_SOURCE_HELP = (
    "Take the matches of a COLMAP database, or the tracks of a COLMAP sparse model; its cameras are not used."
)
Source = Annotated[Path | None, common.folder_option(_SOURCE_HELP, "--from", metavar="DATABASE|SPARSE")]
_IMAGES_HELP = "With --from: the folder of the images, for colours and the model."
ImagesFolder = Annotated[Path | None, common.folder_option(_IMAGES_HELP, "--images")]
Masks = Annotated[Path | None, common.folder_option("Folder of masks: black pixels are left out.", "--masks")]
_PRESET_HELP = "Pipeline to start from (default: default)."
Preset = Annotated[Literal["default", "thesis"] | None, typer.Option("--preset", help=_PRESET_HELP)]
_CAMERAS_HELP = "One camera per image size and folder (shared), per size, or per image."
Cameras = Annotated[
    Literal["shared", "per-size", "per-image"] | None, typer.Option("--cameras", help=_CAMERAS_HELP)
]
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
_EXECUTORS = "local|processes|dask://HOST:PORT|tls://HOST:PORT"
Executor = Annotated[str, typer.Option("--executor", metavar=_EXECUTORS, help=_EXECUTOR_HELP)]
_GPS_HELP = "Move the model to the GPS positions of the images: metres east, north, up."
Gps = Annotated[bool, typer.Option("--gps", help=_GPS_HELP)]
_UP_HELP = "Turn the model until z is up, by vertical lines or the level sides of the images."
Up = Annotated[Literal["none", "auto"], typer.Option("--up", help=_UP_HELP)]
_KNOWN_HELP = "Cameras that are known: cameras.json, COLMAP model, run, or another file of cameras."
Known = Annotated[Path | None, common.folder_option(_KNOWN_HELP, "--known", metavar="MODEL")]
_REFINE_HELP = "With --known and --into: adjust these cameras, too."
Refine = Annotated[bool, typer.Option("--refine", help=_REFINE_HELP)]
_INTO_HELP = "In place of -o: add the images to this finished run."
Into = Annotated[Path | None, common.folder_option(_INTO_HELP, "--into", metavar="OUT")]
Out = Annotated[Path | None, common.folder_option("Output folder.")]
_OVERWRITE_HELP = "Replace another run, or changed result files, in the output folder."
OverwriteRun = Annotated[bool, typer.Option("--overwrite", help=_OVERWRITE_HELP)]


def reconstruct(
    images: Images = None, out: Out = None, into: Into = None, every: Every = None, source: Source = None,
    images_folder: ImagesFolder = None, masks: Masks = None, known: Known = None, refine: Refine = False,
    gps: Gps = False, up: Up = "none", preset: Preset = None, cameras: Cameras = None,
    config: Config = None, settings: Settings = None, seed: common.Seed = 0, threads: common.Threads = 0,
    max_size: common.MaxSize = None, pairs: Pairs = None, until: Until = None, executor: Executor = "local",
    overwrite: OverwriteRun = False,
) -> None:  # fmt: skip
    """Reconstruct cameras, points and a textured model from images."""
    common.cap_threads(threads)
    chosen: dict[str, Any] = {"config": config, "preset": preset, "cameras": cameras, "pairs": pairs}
    frame = [*(["images.gps=true"] if gps else []), *(["images.up=auto"] if up == "auto" else [])]
    chosen |= {"max_size": max_size, "set": [*(settings or []), *frame], "masks": masks}
    options = {"until": until, "threads": threads or None, "executor": executor, "overwrite": overwrite}
    if (out is None) == (into is None):
        raise UsageError(Notice("no-output-folder"))
    if into is not None:
        others = [*chosen.values(), source, images_folder, every, known, seed, overwrite]
        if images is None or any(others):
            raise UsageError(Notice("options-of-into"))
        del options["overwrite"]
        _run("add_images", (into, images), into, {"refine": refine} | options)
        return
    if refine and known is None:
        raise UsageError("--refine adjusts the cameras of --known or --into; give one of them")
    assert out is not None
    chosen["seed"] = seed
    if source is None:
        if images is None or images_folder is not None:
            raise UsageError(Notice("no-source"))
        chosen |= {"every": every, "known": known, "refine": refine}
        _run("reconstruct", (images, out), out, chosen | options)
        return
    if images is not None or chosen.pop("pairs") is not None or every is not None or known is not None:
        raise UsageError(Notice("images-of-source"))
    _run("reconstruct_from_colmap", (source, out), out, chosen | options | {"images": images_folder})


def demo(
    out: common.OutputFolder = Path("out/demo"), threads: common.Threads = 0, overwrite: OverwriteRun = False
) -> None:
    """Reconstruct the courtyard images that come with the package."""
    common.cap_threads(threads)
    from thesisrecon.io._images import demo_images

    options = {"threads": threads or None, "overwrite": overwrite}
    _run("reconstruct", (demo_images(), out), out, {"set": _DEMO_SETTINGS} | options)


def _run(call: str, given: tuple[Any, Any], out: Path, options: Mapping[str, Any]) -> None:
    """Make a call that writes a run to ``out``, and print its summary."""
    import thesisrecon

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    advice = f"repeat the command to resume from {printable(str(out))}"
    with common.interruptible(advice), common.progress_bars() as progress:
        result = getattr(thesisrecon, call)(*given, progress=progress, **options)
    typer.echo(summary_text(result.summary, out))


def inspect(
    out: Annotated[Path, common.folder_argument("OUT", "Output folder of a run.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print summary.json.")] = False,
) -> None:
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
    typer.echo(json.dumps(summary, indent=1) if as_json else text)


def summary_text(summary: Mapping[str, Any], out: Path) -> str:
    """Format ``summary.json`` for a terminal, one fact per line, without control characters."""
    lines = [_result(summary)]
    rms, median = summary["reprojection_rms_px"], summary["reprojection_median_px"]
    if rms is not None:
        lines.append(f"reprojection residual {rms:.3f} px RMS, {median:.3f} px median")
    lines += _intrinsic_lines(summary["cameras"])
    if summary.get("model"):
        lines.append(f"model with {counted(summary['model']['faces'], 'triangle')}: {out / 'model.glb'}")
        if (whole := out / "model-full.glb").is_file():
            lines.append(f"reduced there; all triangles are in {whole}")
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
    total = summary["seconds"]["total"]
    cached = f" ({total:.1f} s including cached stages)" if summary["resumed"] else ""
    lines.append(f"{summary.get('elapsed_seconds', total):.1f} s{cached}; report: {out / 'report.html'}")
    return "\n".join(printable(line) for line in lines)


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
        text = (
            f"camera {view['camera']}: focal length {focal['value']:.1f} ± {focal['std']:.1f} px "
            f"({focal['source']}), principal point ({x['value']:.1f} ± {x['std']:.1f}, "
            f"{y['value']:.1f} ± {y['std']:.1f}) px"
        )
        for name, label, digits, unit in (("aspect", "aspect ratio", 5, ""), ("skew_px", "skew", 2, " px")):
            # Only if it was estimated.
            if (found := view.get(name)) is not None and found["std"] != 0.0:
                text += f", {label} {found['value']:.{digits}f} ± {found['std']:.{digits}f}{unit}"
        lines.setdefault((view["camera"], focal["value"]), text)
    return list(lines.values())


_KINDS = "folder of a run, COLMAP model, cameras.json, or trajectory (TUM or KITTI)"
BEYOND_LIMIT = 4


def _limit(option: str, what: str) -> Any:
    return typer.Option(option, min=0.0, help=f"Largest error of a {what}; else exit code {BEYOND_LIMIT}.")


_TO_HELP = "colmap, colmap-undistorted or nerfstudio."
_ORIGINALS_HELP = "Folder of the original images (default: that of the run)."
_MASKS_HELP = "Folder of the masks of the images (default: that of the run)."
_SCALE_HELP = "Known distance of the cameras of two images."
_SCALE = typer.Option("--scale", metavar="NAME1 NAME2 DISTANCE", help=_SCALE_HELP)
_POINTS_HELP = "Known distance of two points: a CSV of name,x1,y1,x2,y2, their pixels in two or more images."
_POINTS = typer.Option("--scale-points", metavar="FILE DISTANCE", help=_POINTS_HELP)
_ALIGN_HELP = "Known camera positions: a CSV of name,x,y,z or name,lat,lon,alt."


def compare(
    a: Annotated[Path, common.folder_argument("A", f"Model: {_KINDS}.")],
    b: Annotated[Path, common.folder_argument("B", "Reference: any of these.")],
    json: Annotated[Path | None, typer.Option("--json", help="Write all numbers to this file.")] = None,
    max_time_difference: Annotated[
        float, typer.Option("--max-time-difference", min=0.0, help="Largest difference of paired times, s.")
    ] = 0.01,
    time_offset: Annotated[float, typer.Option("--time-offset", help="Added to the times of B, s.")] = 0.0,
    max_centre_error: Annotated[float | None, _limit("--max-centre-error", "centre, in units of B")] = None,
    max_rotation_error: Annotated[float | None, _limit("--max-rotation-error", "rotation, degrees")] = None,
    max_focal_error: Annotated[float | None, _limit("--max-focal-error", "focal length, per cent")] = None,
    overwrite: common.Overwrite = False,
) -> None:
    """Compare two models of the same images after a similarity alignment; exit code 4 beyond a limit."""
    common.cap_threads(0)
    from thesisrecon.api.models import compare_models
    from thesisrecon.io._files import json_text, write_new
    from thesisrecon.report._assessment import camera_table, headline, point_table, summary_table

    times = {"max_time_difference": max_time_difference, "time_offset": time_offset}
    found = compare_models(a, b, **times)
    lines = [f"A: {a}", f"B: {b} (reference)", headline(found), *(f"note: {note}" for note in found.notes)]
    cameras, most = camera_table(found), 60
    for rows in filter(None, [summary_table(found), point_table(found), cameras[: most + 1]]):
        # The first column flush left, the others flush right.
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        padded = ([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])] for row in rows)
        lines += ["", *("  ".join(cells).rstrip() for cells in padded)]
    if len(cameras) > most + 1:
        lines.append(f"and {len(cameras) - 1 - most} more cameras; --json writes all")
    if json is not None:
        text = json_text({"a": str(a), "b": str(b), **found.as_table()})
        write_new(json, text, overwrite=overwrite)
    limits = [
        ("centre error", found.centre_error, max_centre_error),
        ("rotation error in degrees", found.rotation_error_deg, max_rotation_error),
        ("focal error in per cent", 100.0 * found.focal_error_rel, max_focal_error),
    ]
    exceeded = [text for name, errors, limit in limits for text in _exceeded(found, name, errors, limit)]
    if found.only_b and any(limit is not None for *_, limit in limits):
        exceeded.append(
            f"{counted(len(found.only_b), 'camera')} of B missing in A, such as {found.only_b[0]}"
        )
    typer.echo("\n".join(printable(line) for line in [*lines, *(f"limit: {text}" for text in exceeded)]))
    if exceeded:
        raise typer.Exit(BEYOND_LIMIT)


def _exceeded(found: ModelComparison, name: str, errors: Any, limit: float | None) -> list[str]:
    """A sentence if the largest error is beyond the limit, or an error is not known."""
    sizes = [abs(error) if error == error else math.inf for error in errors.tolist()]
    worst = max(range(len(sizes)), key=sizes.__getitem__)
    if limit is None or sizes[worst] <= limit:
        return []
    return [f"the {name} of {found.names[worst]} is {sizes[worst]:.4g}, the limit is {limit:g}"]


def export(
    model: Annotated[Path, common.folder_argument("OUT", "Folder of a run, or a COLMAP model.")],
    folder: common.OutputFolder, to: Annotated[str, typer.Option("--to", metavar="FORMAT", help=_TO_HELP)],
    images: Annotated[Path | None, common.folder_option(_ORIGINALS_HELP, "--images")] = None,
    masks: Annotated[Path | None, common.folder_option(_MASKS_HELP, "--masks")] = None,
    scale: Annotated[tuple[str, str, float] | None, _SCALE] = None,
    scale_points: Annotated[tuple[Path, float] | None, _POINTS] = None,
    align: Annotated[Path | None, typer.Option("--align", metavar="FILE", help=_ALIGN_HELP)] = None,
    threads: common.Threads = 0, overwrite: common.Overwrite = False,
) -> None:  # fmt: skip
    """Write cameras, points and undistorted images for another program."""
    common.cap_threads(threads)
    if sum(one is not None for one in (scale, scale_points, align)) > 1:
        raise UsageError("--scale, --scale-points and --align exclude each other; give one of them")
    from thesisrecon.api.export import export as write_export
    from thesisrecon.api.export import recorded_images, recorded_masks, require_separate
    from thesisrecon.api.models import align_to_positions, scaled, scaled_by_points
    from thesisrecon.io._models import read_model

    if folder.resolve() == model.resolve():
        raise UsageError(f"the folder {folder} holds the model; export to another folder")
    # Checked here, because `export` gets the model from memory and cannot compare its folder.
    require_separate(folder, to, model=model)
    found = read_model(model)
    if scale is not None:
        found = scaled(found, *scale)
    if scale_points is not None:
        found = scaled_by_points(found, *scale_points)
    if align is not None:
        found, report = align_to_positions(found, align)
        typer.echo("\n".join(map(printable, str(report).splitlines())))
    with common.interruptible("repeat the command to write all files"):
        lost = list[str]()
        if masks is None:
            masks, lost = recorded_masks(model, to)
        written = write_export(
            found, folder, to=to, images=images or recorded_images(model), masks=masks, threads=threads,
            overwrite=overwrite,
        )  # fmt: skip
    for note in (*lost, *written.notes):
        typer.echo(f"note: {note}")
    typer.echo(f"{len(found.views)} images and {len(found.X)} points: {printable(str(written.file))}")


_ACTION = typer.Argument(
    metavar="list|show|check", help="List all, print one with its skeleton, or grade a file."
)
_NAME = typer.Argument(metavar="NAME", help="An exercise of the list.")
_FILE = typer.Argument(metavar="FILE", help="Your solution: a Python file with the function NAME.")
_SECONDS = typer.Option("--seconds", min=1, help="Time limit of check.")


def exercises(
    action: Annotated[Literal["list", "show", "check"], _ACTION] = "list",
    name: Annotated[str, _NAME] = "",
    file: Annotated[Path | None, _FILE] = None,
    seconds: Annotated[int, _SECONDS] = 60,
) -> None:
    """Exercises on multiple-view geometry: check prints the accuracy or the mistake (exit code 4)."""
    common.cap_threads(1)
    import runpy
    import subprocess

    home = next((h / "exercises" for h in Path(__file__).parents[1:3] if (h / "exercises").is_dir()), None)
    if home is None:
        raise UsageError("the exercises are not installed with this copy of the package; install it again")
    titles = runpy.run_path(str(home / "grader.py"))["titles"]()
    if action == "list":
        typer.echo("\n".join(f"{one:20}{title}" for one, title in titles.items()))
        return
    if name not in titles:
        raise UsageError(f"there is no exercise {name!r}; the exercises are {', '.join(titles)}")
    if action == "show":
        typer.echo((home / f"{name}.py").read_text("utf-8"), nl=False)
        return
    if file is None or not file.is_file():
        raise UsageError(Notice("no-solution-file", name, file))
    # A process of its own: an endless loop can be ended.
    command = [sys.executable, str(home / "grader.py"), name, str(file)]
    try:
        code = subprocess.run(command, timeout=seconds, check=False).returncode
    except subprocess.TimeoutExpired:
        typer.echo(f"{name}: not solved\nit did not end within {seconds} s: is there an endless loop?")
        code = BEYOND_LIMIT
    if code:
        raise typer.Exit(code)


app = typer.Typer(
    name="thesisrecon", help="From uncalibrated images to metric cameras, points and a textured model.",
    context_settings={"help_option_names": ["-h", "--help"]}, rich_markup_mode=None,
    pretty_exceptions_enable=False,
)  # fmt: skip
for _command in (reconstruct, demo, inspect, compare, export, exercises):
    app.command()(_command)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        typer.echo(f"thesisrecon {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit


def run_command(arguments: list[str]) -> int:
    """Run one command line (without the program name); an error becomes one sentence on stderr."""
    with warnings.catch_warnings():
        # Unreadable images are reported by this program, in one sentence.
        warnings.filterwarnings("ignore", module=r"PIL\.")
        return common.exit_code_of(lambda: app(arguments, standalone_mode=False))


def _silence_c_libraries() -> None:
    """Discard messages of C libraries on stderr: libtiff prints a line for each damaged byte."""
    try:
        ours, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:
        # stderr is closed.
        return
    os.dup2(nowhere, 2)
    os.close(nowhere)
    set_error_stream(ours)
    encoding = getattr(sys.stderr, "encoding", None)
    sys.stderr = os.fdopen(ours, "w", buffering=1, encoding=encoding, errors="backslashreplace")


def main() -> None:
    """Run the command line of this process and exit with its code."""
    # File names may hold characters that the terminal cannot encode.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    if not os.environ.get(common.DEBUG_VARIABLE):
        _silence_c_libraries()
    sys.exit(run_command(sys.argv[1:]))
