"""``report.html`` of a run, a file without network access.

A page loads nothing from the network, and no file name can run as code: the template escapes all text, data
for scripts is JSON that cannot close its element, and a content security policy lists the scripts by their
hashes and forbids all addresses except ``data:``.
"""

import base64
import gzip
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import Any, Self

import numpy as np

from thesisrecon import __version__
from thesisrecon.arrays import F64
from thesisrecon.camera import Camera
from thesisrecon.errors import made
from thesisrecon.records import StageReport, TexturedMesh, as_mesh
from thesisrecon.report import _assessment as words
from thesisrecon.report import _data
from thesisrecon.report import _figures as figures

_INTRINSICS = {
    "focal_px": "Focal length (px)", "aspect": "Aspect (fy/fx)", "skew_px": "Skew (px)",
    "principal_x_px": "Principal x (px)", "principal_y_px": "Principal y (px)", "k1": "k1", "k2": "k2",
    "k3": "k3", "k4": "k4", "p1": "p1", "p2": "p2", "angle_of_view_deg": "Angle of view (°)",
    "corner_deg": "Corner from the axis (°)",
}  # fmt: skip


def render_page(
    template: str, scripts: Sequence[str], *, filters: Mapping[str, Callable[..., str]] | None = None,
    **content: Any,
) -> str:  # fmt: skip
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
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
    )  # fmt: skip
    # NaN is not JSON: the script of the page could not parse it.
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    environment.filters.update(filters)
    return environment.from_string(template)


def page_resource(name: str) -> str:
    """Read a style, script or template of this folder."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


@cache
def plotly_script() -> str:
    """Return plotly.js as text that can be embedded in a page."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs()).replace("</script", "<\\/script")


@cache
def _packed(script: str) -> str:
    """A script, compressed, as text; a fifth of a second for plotly.js."""
    return base64.b64encode(gzip.compress(script.encode("utf-8"), mtime=0)).decode("ascii")


@dataclass(frozen=True)
class ModelFrame:
    """A page with the viewer of a model, and its frame in a notebook."""

    page: str
    height: int

    @classmethod
    def of(cls, mesh: TexturedMesh, cameras: Mapping[str, Camera] | Iterable[Camera], height: int) -> Self:
        """Make the page of a mesh; without cameras it is seen from the side that most of it faces."""
        mesh = as_mesh("show", mesh)
        named = cameras if isinstance(cameras, Mapping) else {str(k): c for k, c in enumerate(cameras)}
        model = figures.viewer_data(mesh, named or {"overview": figures.overview(mesh)})
        text, viewer = f"{words.model_text(mesh)}. ", page_resource("viewer.js")
        page = page_resource("frame.html.j2")
        return cls(render_page(page, [viewer], model=model, caption=text, note=""), height)

    def __repr__(self) -> str:
        return f"ModelFrame({len(self.page)} characters, shown by a notebook)"

    def _repr_html_(self) -> str:
        frame = f'style="width:100%;height:{self.height}px;border:0" sandbox="allow-scripts"'
        return f'<iframe title="Model" {frame} srcdoc="{escape(self.page)}"></iframe>'


Draw = Callable[..., Any]
"""Makes a picture: its name, the function that draws it, and what that is given; None if it fails."""


def render_report(data: _data.ReportData, warnings: list[str] | None = None) -> str:
    """Render the page of a run; pictures that cannot be drawn are left out, with one of ``warnings``."""
    warnings = [] if warnings is None else warnings

    def make(what: str, draw: Callable[..., Any], *given: Any, **options: Any) -> Any:
        return made(f"{what} in report.html", lambda: draw(*given, **options), warnings, None)

    best, names = data.best_reconstruction, [image.name for image in data.images]
    working = _data.reprojection_distances(best) if best is not None else [np.zeros(0)] * len(data.images)
    distances = [d / photo.scale for d, photo in zip(working, data.images, strict=True)]
    overall = _data.summarize_distances(np.concatenate([np.zeros(0), *distances]))
    plotted, shown = _figures(data, names, make)
    model = held_out = straight = None
    if data.model is not None and len(data.model.faces) and data.metric is not None:
        cameras = figures.numbered_cameras(data.metric.reconstruction, names)
        model = make("the model", figures.viewer_data, data.model, cameras)
    side = figures.depth_side(_sharing(len(data.depths)))
    depths = [
        (i + 1, names[i], picture)
        for i in _data.pictured(len(names))
        if i in data.depths
        and (picture := make("a depth map", figures.draw_depth, data.depths[i], side=side))
    ]
    if data.held_out is not None:
        held_out = make("the held-out image", figures.draw_held_out, data.held_out)
    if data.bent and data.metric is not None:
        first = names.index(next(iter(data.bent)))
        of_first = data.images[first], data.metric.reconstruction, first
        straight = make("the straight image", figures.draw_straight, *of_first)
    scripts = [page_resource("unpack.js"), page_resource("page.js")] if plotted else []
    # page.js adds the unpacked library as a script, which the policy of the page must list too.
    library = plotly_script() if plotted else ""
    allowed = [*scripts, library] if plotted else []
    model_scripts = [page_resource("viewer.js")] if model is not None else []
    cards = _cards(data, distances, make)
    estimated = {"focal_px", "principal_x_px", "principal_y_px", "k1"}.union(
        name for view in data.original_intrinsics for name, found in view.items() if found.std != 0.0
    )
    lists = {name: value for name, value in data.summary.items() if isinstance(value, list)}
    sizes = {name: len(value) for name, value in lists.items() if len(value) > _data.MAX_PICTURED}
    long = {name: f"{size} entries, see summary.json" for name, size in sizes.items()}
    return render_page(
        page_resource("template.html.j2"), [*allowed, *model_scripts],
        filters={name: getattr(words, name) for name in ("grouped", "decimals", "significant")},
        text=words, data=data, version=__version__, overall=overall, cards=cards, depths=depths, model=model,
        intrinsic_columns=[(name, heading) for name, heading in _INTRINSICS.items() if name in estimated],
        held_out=held_out, scale=figures.SCALE, stages=_stages(data.reports), figures=plotted,
        figure_scripts=scripts, plotly=_packed(library), drawn_pairs=_drawn_pairs(data, make),
        difference_limit=round(figures.DIFFERENCE_LIMIT),
        shown_points=shown, most_points=figures.MAX_POINTS,
        most_pyramids=figures.MAX_PYRAMIDS, all_points=int(best.valid.sum()) if best is not None else 0,
        warnings=_warnings(data, warnings), straight=straight, model_scripts=model_scripts,
        summary_text=json.dumps({**data.summary, **long}, indent=2, ensure_ascii=False, default=str),
    )  # fmt: skip


def _sharing(images: int) -> int:
    """Number of thumbnails that share a size budget: that of the images, at most twice ``MAX_PICTURED``."""
    return min(images, 2 * _data.MAX_PICTURED)


def _figures(data: _data.ReportData, names: Sequence[str], make: Draw) -> tuple[dict[str, Any], int]:
    """The figures by id (not "scene", which plotly.js uses), and the number of points in 3D."""
    found: dict[str, Any] = {}
    scene, what = None, "the figure of cameras and points"
    if data.metric is not None and (scene := make(what, figures.build_scene, data.metric.reconstruction)):
        found["scene-figure"] = make(what, figures.scene_figure, scene, names, data.colors)
    if data.bent:
        found["lens-figure"] = make("the lens", figures.lens_figure, data.bent)
    if data.pairs:
        matrix = make("the matrix of pairs", figures.pair_matrix_figure, data.pairs, names)
        found["matrix-figure"] = matrix
    points = len(scene.points) if scene and found.get("scene-figure") else 0
    return {name: figure for name, figure in found.items() if figure is not None}, points


def _cards(data: _data.ReportData, distances: list[F64], make: Draw) -> list[dict[str, Any]]:
    """Each image: its state, the reason, its residuals if it has a camera, and perhaps its picture."""
    cards, intrinsics, count = [], data.original_intrinsics, len(data.images)
    shown = _data.pictured(count)
    for i, image in enumerate(data.images):
        state, level, reason = _state(data, i)
        (width, height), (w, h) = image.original_size, image.size
        processed = "" if (width, height) == (w, h) else f", processed at {w} × {h}"
        masked = "" if image.mask is None else f", {1.0 - image.mask.mean():.0%} masked"
        picture = None
        if i in shown:
            picture = make("a thumbnail", figures.thumbnail, image, _sharing(count))
        card = {"number": i + 1, "name": image.name, "state": state, "level": level, "reason": reason}
        card |= {"size": f"{width} × {height} px{processed}{masked}", "picture": picture}
        card |= {"residuals": _data.summarize_distances(distances[i])}
        estimated = {name: words.plus_minus(v.value, v.std) for name, v in intrinsics[i].items()}
        cards.append({**card, "intrinsics": estimated})
    return cards


def _state(data: _data.ReportData, i: int) -> tuple[str, str, str]:
    best = data.best_reconstruction
    if best is None:
        return "read", "open", ""
    if best.registered[i]:
        # A projective camera has no calibration.
        return ("registered", "good", "") if data.metric is not None else ("projective camera", "open", "")
    return "not registered", "bad", best.reasons[i] or "no reason was recorded"


def _drawn_pairs(data: _data.ReportData, make: Draw) -> list[dict[str, Any]]:
    """Draw the accepted pairs with most and fewest verified matches, else the best rejected one."""
    accepted = [pair for pair in data.pairs if pair.accepted]
    drawable = accepted or [pair for pair in data.pairs if pair.inliers]
    ranked = sorted(drawable, key=lambda pair: (-pair.inliers, pair.i, pair.j))
    titles = [("Best pair" if accepted else "Best pair (rejected)", ranked[0])] if ranked else []
    if len(accepted) > 1:
        titles.append(("Weakest accepted pair", ranked[-1]))
    drawn = []
    for title, pair in titles:
        given = pair, data.images[pair.i], data.images[pair.j]
        sides = {"names": (given[1].name, given[2].name), "numbers": (pair.i + 1, pair.j + 1)}
        if picture := make(f"the picture of the {title.lower()}", figures.draw_pair, *given):
            drawn.append({"title": title, **sides, "facts": words.pair_text(pair), "picture": picture})
    return drawn


def _warnings(data: _data.ReportData, of_page: Sequence[str]) -> list[tuple[str, str]]:
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
            "seconds": words.duration(report.seconds),
            "share": round(100 * report.seconds / longest, 1),
            "numbers": words.named_numbers(report.counts) + words.named_numbers(report.metrics),
        }
        for report in reports
    ]
