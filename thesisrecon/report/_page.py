"""``report.html`` of a run and ``strip.html`` of a view sequence: single files without network access.

A page loads nothing from the network, and no file name can run as code: the template escapes all text, data
for scripts is JSON that cannot close its element, and a content security policy lists the scripts by their
hashes and forbids all addresses except ``data:``.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from thesisrecon.arrays import F64, U8
from thesisrecon.errors import made
from thesisrecon.records import Reconstruction, StageReport, TwoView
from thesisrecon.report._assessment import (
    assess,
    count_of,
    decimals,
    duration,
    grouped,
    key_facts,
    model_text,
    named_numbers,
    pair_selection_text,
    plus_minus,
    significant,
)
from thesisrecon.report._data import (
    MAX_PICTURED,
    ReportData,
    pictured,
    point_colors,
    reprojection_distances,
    summarize_distances,
)
from thesisrecon.report._drawing import (
    DIFFERENCE_LIMIT,
    SCALE,
    depth_side,
    draw_depth,
    draw_held_out,
    draw_pair,
    embed_jpeg,
    thumbnail,
)
from thesisrecon.report._figures import (
    MAX_POINTS,
    MAX_PYRAMIDS,
    Figure,
    build_scene,
    histograms,
    pair_matrix_figure,
    scene_figure,
)
from thesisrecon.report._viewer import viewer_data

_FRAME_SIDE_PX, _FRAME_QUALITY = 960, 85
"""Size and JPEG quality of the frames on a strip page; the files beside it have full size and quality."""
_HISTOGRAM_WIDTH, _HISTOGRAM_HEIGHT = 200.0, 44.0
_MAX_LISTED_PAIRS = 120
_AFFINE_POINTS = 5_000
_INTRINSICS = {
    "focal_px": "Focal length (px)",
    "aspect": "Aspect (fy/fx)",
    "skew_px": "Skew (px)",
    "principal_x_px": "Principal x (px)",
    "principal_y_px": "Principal y (px)",
    "k1": "k1",
    "k2": "k2",
    "k3": "k3",
}
T = TypeVar("T")
_ALWAYS_SHOWN = ("focal_px", "principal_x_px", "principal_y_px", "k1")


def render_page(
    template: str,
    scripts: Sequence[str],
    *,
    filters: Mapping[str, Callable[..., str]] | None = None,
    **content: Any,
) -> str:
    """Render a page: text is escaped, names are defined, JSON has no NaN, and only these scripts run."""
    digests = (hashlib.sha256(script.encode("utf-8")).digest() for script in scripts)
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)
    given = {"style": page_resource("style.css"), "scripts": scripts, "hashes": hashes or "'none'"}
    return str(_compiled(template, tuple((filters or {}).items())).render(**given, **content))


@cache
def _compiled(template: str, filters: tuple[tuple[str, Callable[..., str]], ...]) -> Any:
    """The template in executable form, made once in a process."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # NaN is not JSON: the script of the page could not parse it.
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    environment.filters.update(filters)
    return environment.from_string(template)


def page_resource(name: str) -> str:
    """Read a style, script or template of this folder."""
    return files("thesisrecon.report").joinpath(name).read_text(encoding="utf-8")


@cache
def plotly_script() -> str:
    """Return plotly.js as text that can be embedded in a page."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs()).replace("</script", "<\\/script")


@cache
def _packed(script: str) -> str:
    """A script, compressed, as text; a fifth of a second for plotly.js."""
    return base64.b64encode(gzip.compress(script.encode("utf-8"), mtime=0)).decode("ascii")


def figure_content(figures: Mapping[str, Any]) -> tuple[list[str], dict[str, Any]]:
    """Return the scripts that draw plotly.js figures by element id, and their values for the template."""
    library = plotly_script() if figures else ""
    scripts = [page_resource("unpack.js"), page_resource("page.js")] if figures else []
    # page.js adds the unpacked library as a script, which the policy of the page must list too.
    allowed = [*scripts, library] if figures else []
    return allowed, {"figures": figures, "figure_scripts": scripts, "plotly": _packed(library)}


def strip_page(
    title: str, frames: Sequence[tuple[str, NDArray[np.uint8]]], *, notes: Sequence[str] = ()
) -> str:
    """Render the page of a view sequence."""
    if not frames:
        raise ValueError("a strip page needs at least one frame")
    script = page_resource("strip.js")
    shown = [{"caption": caption, "image": _embedded(rgb)} for caption, rgb in frames]
    template = page_resource("strip.html.j2")
    return render_page(template, [script], title=title, frames=shown, notes=list(notes), script=script)


def _embedded(rgb: NDArray[np.uint8]) -> str:
    picture = PillowImage.fromarray(rgb)
    picture.thumbnail((_FRAME_SIDE_PX, _FRAME_SIDE_PX), PillowImage.Resampling.LANCZOS)
    return embed_jpeg(picture, quality=_FRAME_QUALITY).uri


class _Pictures:
    """Makes the pictures of a page, each on its own; ``warnings`` are about those that failed."""

    def __init__(self, warnings: list[str]) -> None:
        self.warnings = warnings

    def make(self, what: str, draw: Callable[..., T], *given: Any, **options: Any) -> T | None:
        return made(f"{what} in report.html", lambda: draw(*given, **options), self.warnings, None)


def render_report(data: ReportData, warnings: list[str] | None = None) -> str:
    """Render the page of a run; the same data gives the same text.

    Pictures that cannot be drawn are left out and added to ``warnings``.
    """
    pictures = _Pictures([] if warnings is None else warnings)
    best = data.best_reconstruction
    working = reprojection_distances(best) if best is not None else [np.zeros(0)] * len(data.images)
    distances = [d / photo.scale for d, photo in zip(working, data.images, strict=True)]
    everything = np.concatenate([np.zeros(0), *distances])
    overall = summarize_distances(everything)
    size = {"width": _HISTOGRAM_WIDTH, "height": _HISTOGRAM_HEIGHT}
    drawn = pictures.make("the histograms of the residuals", histograms, distances, **size)
    limit_px, bars = drawn or (1.0, [""] * len(distances))
    figures, shown, omitted = _figures(data, pictures)
    model = None
    if data.model is not None and len(data.model.faces) and data.metric is not None:
        names = [image.name for image in data.images]
        model = pictures.make("the model", viewer_data, data.model, data.metric.reconstruction, names)
    side = depth_side(_sharing(len(data.depth_maps)))
    depths = [
        (i + 1, data.images[i].name, picture)
        for i in pictured(len(data.images))
        if i in data.depth_maps
        and (picture := pictures.make("a depth map", draw_depth, data.depth_maps[i], side=side))
    ]
    held_out = None
    if data.held_out is not None:
        held_out = pictures.make("the held-out image", draw_held_out, data.held_out)
    drawn_pairs = _drawn_pairs(data, pictures)
    figure_scripts, drawing = figure_content(figures)
    model_scripts = [page_resource("viewer.js")] if model is not None else []
    cards = _cards(data, distances, bars, pictures)
    return render_page(
        page_resource("template.html.j2"),
        [*figure_scripts, *model_scripts],
        filters={"grouped": grouped, "decimals": decimals, "significant": significant},
        count_of=count_of,
        data=data,
        assessment=assess(data),
        facts=key_facts(data, overall),
        overall=overall,
        cards=cards,
        unpictured=[card for card in cards if card["picture"] is None],
        intrinsic_columns=_intrinsic_columns(data),
        limit_px=limit_px,
        model=model,
        model_text=model_text(data.model) if data.model is not None else "",
        depths=depths,
        held_out=held_out,
        scale=SCALE,
        difference_limit=round(DIFFERENCE_LIMIT),
        **drawing,
        shown_points=shown,
        omitted=omitted,
        most_points=MAX_POINTS,
        most_pyramids=MAX_PYRAMIDS,
        all_points=int(best.valid.sum()) if best is not None else 0,
        pair_selection=pair_selection_text(data),
        drawn_pairs=drawn_pairs,
        listed_pairs=sorted(data.pairs, key=lambda pair: -pair.inliers)[:_MAX_LISTED_PAIRS],
        stages=_stages(data.reports),
        warnings=_warnings(data, pictures.warnings),
        limit_known=drawn is not None,
        self_check=named_numbers(data.metric.self_check) if data.metric is not None else [],
        summary_text=json.dumps(_shortened(data.summary), indent=2, ensure_ascii=False, default=str),
        model_scripts=model_scripts,
        histogram_size=(_HISTOGRAM_WIDTH, _HISTOGRAM_HEIGHT),
    )


def _sharing(images: int) -> int:
    """Number of thumbnails that share a size budget: that of the images, at most twice ``MAX_PICTURED``."""
    return min(images, 2 * MAX_PICTURED)


def _shortened(summary: Mapping[str, object]) -> dict[str, object]:
    """The summary without lists of more than ``MAX_PICTURED`` entries."""
    return {
        name: f"{len(value)} entries, see summary.json"
        if isinstance(value, list) and len(value) > MAX_PICTURED
        else value
        for name, value in summary.items()
    }


def _figures(data: ReportData, pictures: _Pictures) -> tuple[dict[str, Any], int, int]:
    """The figures by element id (not "scene", which plotly.js uses), the points in 3D, the cameras left out.

    The cameras that are left out are those of the affine figure.
    """
    names = [image.name for image in data.images]
    figures: dict[str, Any] = {}
    points = omitted = 0

    def draw_scene(best: Reconstruction, colors: U8 | None, most: int) -> tuple[Figure | None, int, int]:
        scene, cameras = build_scene(best, max_points=most), int(best.registered.sum())
        if scene is None:
            return None, 0, cameras
        return scene_figure(scene, names, colors), len(scene.points), cameras - len(scene.views)

    if data.metric is not None:
        best = data.metric.reconstruction
        drawn = pictures.make("the figure of cameras and points", draw_scene, best, data.colors, MAX_POINTS)
        if drawn is not None:
            figures["scene-figure"], points, _ = drawn
    if data.metric is not None and (affine := data.affine) is not None:
        drawn = pictures.make(
            "the figure of the affine stratum",
            lambda: draw_scene(affine, point_colors(affine, data.images), _AFFINE_POINTS),
        )
        if drawn is not None:
            figures["affine-figure"], _, omitted = drawn
    if data.pairs:
        matrix = pictures.make("the matrix of pairs", pair_matrix_figure, data.pairs, names)
        figures["matrix-figure"] = matrix
    return {name: figure for name, figure in figures.items() if figure is not None}, points, omitted


def _cards(
    data: ReportData, distances: list[F64], bars: list[str], pictures: _Pictures
) -> list[dict[str, Any]]:
    """Each image: its state, the reason, its residuals if it has a camera, and perhaps its picture."""
    cards, intrinsics = [], data.original_intrinsics
    shown = pictured(len(data.images))
    for i, image in enumerate(data.images):
        state, level, reason = _state(data, i)
        (width, height), (w, h) = image.original_size, image.size
        processed = "" if (width, height) == (w, h) else f", processed at {w} × {h}"
        masked = "" if image.mask is None else f", {1.0 - image.mask.mean():.0%} masked"
        card = {
            "number": i + 1,
            "name": image.name,
            "state": state,
            "level": level,
            "reason": reason,
            "size": f"{width} × {height} px{processed}{masked}",
            "picture": pictures.make("a thumbnail", thumbnail, image, _sharing(len(data.images)))
            if i in shown
            else None,
            "residuals": summarize_distances(distances[i]),
            "bars": bars[i],
            "intrinsics": {name: plus_minus(v.value, v.std) for name, v in intrinsics[i].items()},
        }
        cards.append(card)
    return cards


def _intrinsic_columns(data: ReportData) -> list[tuple[str, str]]:
    """Return (name, heading) of the table columns: the usual intrinsics and all estimated ones."""
    views = data.original_intrinsics
    estimated = {name for view in views for name, interval in view.items() if interval.std != 0.0}
    return [(name, text) for name, text in _INTRINSICS.items() if name in _ALWAYS_SHOWN or name in estimated]


def _state(data: ReportData, i: int) -> tuple[str, str, str]:
    best = data.best_reconstruction
    if best is None:
        return "read", "open", ""
    if best.registered[i]:
        # A projective camera has no calibration.
        return ("registered", "good", "") if data.metric is not None else ("projective camera", "open", "")
    return "not registered", "bad", best.reasons[i] or "no reason was recorded"


def _drawn_pairs(data: ReportData, pictures: _Pictures) -> list[dict[str, Any]]:
    """Draw the accepted pairs with most and fewest verified matches, else the best rejected one."""
    accepted = [pair for pair in data.pairs if pair.accepted]
    drawable = accepted or [pair for pair in data.pairs if pair.inliers]
    ranked = sorted(drawable, key=lambda pair: (-pair.inliers, pair.i, pair.j))
    titles = [("Best pair" if accepted else "Best pair (rejected)", ranked[0])] if ranked else []
    if len(accepted) > 1:
        titles.append(("Weakest accepted pair", ranked[-1]))
    drawn = []
    for title, pair in titles:
        first, second = data.images[pair.i], data.images[pair.j]
        sides = {"names": (first.name, second.name), "numbers": (pair.i + 1, pair.j + 1)}
        if picture := pictures.make(f"the picture of the {title.lower()}", draw_pair, pair, first, second):
            drawn.append({"title": title, **sides, "facts": _pair_text(pair), "picture": picture})
    return drawn


def _pair_text(pair: TwoView) -> str:
    share = f" ({100 * pair.inliers / pair.candidates:.0f} %)" if pair.candidates else ""
    words = f"{grouped(pair.inliers)} verified of {grouped(pair.candidates)} candidate matches{share}"
    if np.isfinite(pair.sigma_px):
        words += f", noise {pair.sigma_px:.2f} px per coordinate"
    if np.isfinite(pair.homography_inlier_ratio):
        words += f", {100 * pair.homography_inlier_ratio:.0f} % homography inliers"
    if pair.undetermined and pair.degeneracy is not None:
        words += f"; degenerate epipolar geometry: {pair.degeneracy.reasons[0]}"
    return words


def _warnings(data: ReportData, of_page: Sequence[str]) -> list[tuple[str, str]]:
    """Return (stage, sentence) of every warning; those of the whole run are only in its summary."""
    found = [(report.stage, text) for report in data.reports for text in report.warnings]
    of_run, known = data.summary.get("warnings"), {text for _, text in found}
    rest = [*(of_run if isinstance(of_run, list | tuple) else ()), *of_page]
    return found + [("run", str(text)) for text in rest if str(text) not in known]


def _stages(reports: tuple[StageReport, ...]) -> list[dict[str, Any]]:
    longest = max((report.seconds for report in reports), default=0.0) or 1.0
    return [
        {
            "name": report.stage,
            "seconds": duration(report.seconds),
            "share": round(100 * report.seconds / longest, 1),
            "numbers": named_numbers(report.counts) + named_numbers(report.metrics),
        }
        for report in reports
    ]
