"""What every page of ours is made with: a template that escapes, and scripts that are known by their hash.

What only pages need is imported when one is made.

A page of pictures in a row: one large, to turn through, and all of them below; it needs no network.

``report.html``: one file that opens from disk, with its scripts, style and pictures inside.

Nothing on the page may come from elsewhere, and nothing a file is named may run: the template escapes all
text, data for the scripts is JSON that cannot close its element, and a content security policy names the
scripts by their hash and forbids every address but ``data:``.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from thesisrecon.arrays import F64
from thesisrecon.io.files import write_text
from thesisrecon.records import IntrinsicInterval, StageReport, TwoView
from thesisrecon.report.data import (
    ReportData,
    ResidualSummary,
    common_limit_px,
    histogram_shares,
    reprojection_distances,
    summarize_distances,
)
from thesisrecon.report.drawing import (
    DIFFERENCE_LIMIT,
    SCALE,
    DepthPicture,
    EmbeddedPicture,
    depth_side,
    draw_depth,
    draw_held_out,
    draw_pair,
    embed_jpeg,
    thumbnail,
)
from thesisrecon.report.figures import (
    MAX_POINTS,
    build_scene,
    histogram_path,
    pair_matrix_figure,
    scene_figure,
)
from thesisrecon.report.viewer import viewer_data
from thesisrecon.report.wording import (
    chosen_pairs,
    count_of,
    decimals,
    duration,
    first_glance,
    grouped,
    judge,
    model_words,
    named_numbers,
    plus_minus,
    significant,
)

if TYPE_CHECKING:
    import jinja2


def template_environment() -> jinja2.Environment:
    """Jinja with all text escaped, no undefined names, and no NaN in JSON."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # NaN is no JSON: better an error here than a page whose script cannot read its data.
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment


def page_resource(name: str) -> str:
    """A style, script or template of this folder."""
    return files("thesisrecon.report").joinpath(name).read_text(encoding="utf-8")


def plotly_script() -> str:
    """The text of plotly.js that can stand in an element of a page."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs()).replace("</script", "<\\/script")


def script_hashes(scripts: Sequence[str]) -> str:
    """What a content security policy names these scripts by."""
    digests = (hashlib.sha256(script.encode("utf-8")).digest() for script in scripts)
    found = [f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests]
    return " ".join(found) or "'none'"


LONG_SIDE_PX, QUALITY = 960, 85
"""Of the pictures on the page; the files beside it are of full size and without loss."""


def strip_page(
    title: str, frames: Sequence[tuple[str, NDArray[np.uint8]]], *, notes: Sequence[str] = ()
) -> str:
    """The page as text: ``frames`` are captions and pictures (h, w, 3); ``notes`` sentences without full
    stops.

    Raises ``ValueError`` without a picture.
    """
    if not frames:
        raise ValueError("a strip needs at least one picture")
    script = page_resource("strip.js")
    shown = [{"caption": caption, "image": _embedded(rgb)} for caption, rgb in frames]
    template = template_environment().from_string(page_resource("strip.html.j2"))
    return template.render(
        title=title,
        frames=shown,
        notes=list(notes),
        style=page_resource("style.css"),
        script=script,
        hashes=script_hashes([script]),
    )


def _embedded(rgb: NDArray[np.uint8]) -> str:
    picture = PillowImage.fromarray(rgb)
    picture.thumbnail((LONG_SIDE_PX, LONG_SIDE_PX), PillowImage.Resampling.LANCZOS)
    return embed_jpeg(picture, quality=QUALITY).uri


if TYPE_CHECKING:
    import jinja2

HISTOGRAM_WIDTH, HISTOGRAM_HEIGHT = 200.0, 44.0
MAX_LISTED_PAIRS = 120
AFFINE_POINTS = 5_000

INTRINSICS = {
    "focal_px": "Focal (px)",
    "aspect": "Aspect (fy/fx)",
    "skew_px": "Skew (px)",
    "principal_x_px": "Principal x (px)",
    "principal_y_px": "Principal y (px)",
    "k1": "k1",
    "k2": "k2",
    "k3": "k3",
}
ALWAYS_TOLD = ("focal_px", "principal_x_px", "principal_y_px", "k1")


@dataclass(frozen=True)
class Card:
    """A photograph on the page: its state in a word, why, and its residuals where it has a camera."""

    number: int
    name: str
    state: str
    level: str
    reason: str
    size: str
    picture: EmbeddedPicture | None
    residuals: ResidualSummary | None
    bars: str
    intrinsics: Mapping[str, str]


@dataclass(frozen=True)
class DrawnPair:
    """A pair of photographs with its picture and its numbers."""

    title: str
    names: tuple[str, str]
    numbers: tuple[int, int]
    facts: str
    picture: EmbeddedPicture


def write_report(path: str | os.PathLike[str], data: ReportData) -> None:
    """Write the page of a run; the file appears whole or not at all.

    Raises ``UsageError`` where the place cannot be written.
    """
    # File names need not be Unicode: what cannot be encoded becomes a question mark.
    write_text(Path(path), render_report(data))


def render_report(data: ReportData) -> str:
    """The page as text; the same data gives the same text."""
    best = data.best_reconstruction
    working = reprojection_distances(best) if best is not None else [np.zeros(0)] * len(data.photographs)
    distances = [d / photo.scale for d, photo in zip(working, data.photographs, strict=True)]
    everything = np.concatenate([np.zeros(0), *distances])
    overall = summarize_distances(everything)
    limit_px = common_limit_px(everything)
    figures, shown = _figures(data)
    model = _model(data)
    figure_scripts = [plotly_script(), page_resource("page.js")] if figures else []
    model_scripts = [page_resource("viewer.js")] if model is not None else []
    return (
        _environment()
        .from_string(page_resource("template.html.j2"))
        .render(
            data=data,
            verdict=judge(data),
            facts=first_glance(data, overall),
            overall=overall,
            cards=_cards(data, distances, limit_px),
            intrinsic_columns=_intrinsic_columns(data),
            limit_px=limit_px,
            model=model,
            **_pictures_of_the_model(data),
            figures=figures,
            shown_points=shown,
            most_points=MAX_POINTS,
            all_points=int(best.valid.sum()) if best is not None else 0,
            chosen_pairs=chosen_pairs(data),
            drawn_pairs=_drawn_pairs(data),
            listed_pairs=sorted(data.pairs, key=lambda pair: -pair.inliers)[:MAX_LISTED_PAIRS],
            stages=_stages(data.reports),
            warnings=_warnings(data),
            self_check=named_numbers(data.metric.self_check) if data.metric is not None else [],
            summary_text=json.dumps(data.summary, indent=2, ensure_ascii=False, default=str),
            style=page_resource("style.css"),
            figure_scripts=figure_scripts,
            model_scripts=model_scripts,
            script_hashes=script_hashes((*figure_scripts, *model_scripts)),
            histogram_size=(HISTOGRAM_WIDTH, HISTOGRAM_HEIGHT),
        )
    )


def _environment() -> jinja2.Environment:
    environment = template_environment()
    environment.filters.update(grouped=grouped, decimals=decimals, significant=significant)
    environment.globals.update(count_of=count_of)
    return environment


def _figures(data: ReportData) -> tuple[dict[str, Any], int]:
    """The interactive figures by the id of their element, and how many points the 3D one shows.

    The ids are longer than the words "scene" and "matrix" because plotly.js makes elements called "scene".
    """
    names = [photograph.name for photograph in data.photographs]
    figures: dict[str, Any] = {}
    scene = build_scene(data.metric.reconstruction) if data.metric is not None else None
    if scene is not None:
        figures["scene-figure"] = scene_figure(scene, names, data.colours)
    affine = build_scene(data.affine, max_points=AFFINE_POINTS) if data.affine is not None else None
    if scene is not None and affine is not None:
        figures["affine-figure"] = scene_figure(affine, names, data.colours)
    if data.pairs:
        figures["matrix-figure"] = pair_matrix_figure(data.pairs, names)
    return figures, len(scene.points) if scene is not None else 0


def _model(data: ReportData) -> dict[str, Any] | None:
    """What the viewer draws, None without a surface."""
    if data.model is None or not len(data.model.faces) or data.metric is None:
        return None
    return viewer_data(data.model, data.metric.reconstruction, [photo.name for photo in data.photographs])


def _pictures_of_the_model(data: ReportData) -> dict[str, Any]:
    """What the page says of the model beside the viewer, and the pictures of depth and of comparison."""
    return {
        "model_words": model_words(data.model) if data.model is not None else "",
        "depths": _depths(data),
        "held_out": draw_held_out(data.held_out) if data.held_out is not None else None,
        "scale": SCALE,
        "difference_limit": round(DIFFERENCE_LIMIT),
    }


def _depths(data: ReportData) -> list[tuple[int, str, DepthPicture]]:
    """(number, name, picture) of every view with a depth map."""
    side = depth_side(len(data.depth_pictures))
    return [
        (view + 1, data.photographs[view].name, draw_depth(depth, side=side))
        for view, depth in sorted(data.depth_pictures.items())
    ]


def _cards(data: ReportData, distances: list[F64], limit_px: float) -> list[Card]:
    shares = [histogram_shares(d, limit_px) for d in distances]
    tallest = max((float(s.max()) for s in shares if len(s)), default=1.0)
    intrinsics = data.original_intrinsics
    cards = []
    for i, photograph in enumerate(data.photographs):
        state, level, reason = _state(data, i)
        cards.append(
            Card(
                number=i + 1,
                name=photograph.name,
                state=state,
                level=level,
                reason=reason,
                size=_size_words(photograph.original_size, photograph.size),
                picture=thumbnail(photograph, len(data.photographs)),
                residuals=summarize_distances(distances[i]),
                bars=histogram_path(shares[i], tallest, width=HISTOGRAM_WIDTH, height=HISTOGRAM_HEIGHT),
                intrinsics={name: _interval_words(interval) for name, interval in intrinsics[i].items()},
            )
        )
    return cards


def _intrinsic_columns(data: ReportData) -> list[tuple[str, str]]:
    """(name, heading) of the columns of the table of cameras: what is always told, and what else was
    estimated."""
    estimated = {
        name for view in data.original_intrinsics for name, interval in view.items() if interval.std != 0.0
    }
    return [(name, text) for name, text in INTRINSICS.items() if name in ALWAYS_TOLD or name in estimated]


def _state(data: ReportData, i: int) -> tuple[str, str, str]:
    """(word, level, reason) of a view."""
    best, own = data.best_reconstruction, data.photographs[i].reason
    if best is None:
        return ("refused", "bad", own) if own else ("read", "open", "")
    if best.registered[i]:
        # Without a metric camera nothing is known of the view but its rays up to perspective.
        return ("registered", "good", "") if data.metric is not None else ("projective camera", "open", "")
    return "refused", "bad", own or best.reasons[i] or "no reason was recorded"


def _interval_words(interval: IntrinsicInterval) -> str:
    return plus_minus(interval.value, interval.std)


def _size_words(original: tuple[int, int], working: tuple[int, int]) -> str:
    text = f"{original[0]} × {original[1]} px"
    return text if original == working else f"{text}, worked at {working[0]} × {working[1]}"


def _drawn_pairs(data: ReportData) -> list[DrawnPair]:
    """The accepted pairs with most and with fewest verified matches; without any, the best of the refused."""
    accepted = [pair for pair in data.pairs if pair.accepted]
    drawable = accepted or [pair for pair in data.pairs if pair.inliers]
    ranked = sorted(drawable, key=lambda pair: (-pair.inliers, pair.i, pair.j))
    if not ranked:
        return []
    titles = [("Best pair" if accepted else "Best pair, not accepted", ranked[0])]
    if len(accepted) > 1:
        titles.append(("Weakest accepted pair", ranked[-1]))
    drawn = []
    for title, pair in titles:
        first, second = data.photographs[pair.i], data.photographs[pair.j]
        picture = draw_pair(pair, first, second)
        if picture is not None:
            numbers = (pair.i + 1, pair.j + 1)
            drawn.append(DrawnPair(title, (first.name, second.name), numbers, _pair_words(pair), picture))
    return drawn


def _pair_words(pair: TwoView) -> str:
    """The numbers of a pair in a line."""
    share = f" ({100 * pair.inliers / pair.candidates:.0f} %)" if pair.candidates else ""
    words = f"{grouped(pair.inliers)} verified of {grouped(pair.candidates)} candidate matches{share}"
    if np.isfinite(pair.sigma_px):
        words += f", noise {pair.sigma_px:.2f} px per coordinate"
    if np.isfinite(pair.homography_inlier_ratio):
        words += f", one plane explains {100 * pair.homography_inlier_ratio:.0f} %"
    if pair.undetermined and pair.degeneracy is not None:
        words += f"; its epipolar geometry is undetermined: {pair.degeneracy.reasons[0]}"
    return words


def _warnings(data: ReportData) -> list[tuple[str, str]]:
    """(stage, sentence) of every warning; those of the run as a whole stand in its summary only."""
    found = [(report.stage, text) for report in data.reports for text in report.warnings]
    of_run = data.summary.get("warnings")
    if isinstance(of_run, list | tuple):
        known = {text for _, text in found}
        found += [("run", str(text)) for text in of_run if str(text) not in known]
    return found


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
