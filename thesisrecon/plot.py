"""Pictures of results: ``from thesisrecon import plot`` (needs the extra ``plot``: matplotlib).

Each function takes records or plain arrays, draws into ``ax`` or a new figure, and returns the figure. The
background is transparent and text is grey, so that pictures fit light and dark pages.
"""

from __future__ import annotations

import base64
import functools
import html as markup
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ParamSpec

import numpy as np

from thesisrecon import records
from thesisrecon.api.pairs import epipolar_lines as lines_of
from thesisrecon.api.views import render
from thesisrecon.arrays import B8, F64, numbers
from thesisrecon.camera import Camera, finite_cameras
from thesisrecon.camera import decompose_camera as camera_parts
from thesisrecon.epipolar.degeneracy import FundamentalEstimate
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import clip_line
from thesisrecon.io._images import read_pixels
from thesisrecon.pipeline.matching import ImageInput
from thesisrecon.report._figures import overview
from thesisrecon.results import ModelComparison, RunResult

P = ParamSpec("P")
STYLE: dict[Any, Any] = {
    "figure.facecolor": "none", "axes.facecolor": "none", "savefig.facecolor": "none", "font.size": 9,
    "text.color": "#808080", "axes.labelcolor": "#808080", "axes.edgecolor": "#808080",
    "xtick.color": "#808080", "ytick.color": "#808080", "axes.titlecolor": "#808080",
    "axes.spines.top": False, "axes.spines.right": False, "axes.titlesize": 10, "legend.framealpha": 0.0,
    "image.cmap": "viridis", "figure.constrained_layout.use": True,
}  # fmt: skip
BLUE, ORANGE, GREEN, GREY = "#3d8bfd", "#f08c2e", "#2fa86a", "#808080"
INTERVAL = 1.96  # standard deviations of 95 %


def _styled(function: Callable[P, Any]) -> Callable[P, Any]:
    """Draw in the style of this module, without a window of pyplot."""

    @functools.wraps(function)
    def draw(*args: P.args, **kwargs: P.kwargs) -> Any:
        import matplotlib

        with matplotlib.rc_context(STYLE):
            return function(*args, **kwargs)

    return draw


def _axis(ax: Any, *, wide: float = 5.0, high: float = 3.6, depth: bool = False) -> Any:
    if ax is not None:
        return ax
    from matplotlib.figure import Figure

    figure = Figure(figsize=(wide, high))
    return figure.add_subplot(projection="3d" if depth else None)


def _show(ax: Any, image: ImageInput) -> tuple[int, int]:
    """Draw an image; its (width, height)."""
    (pixels,) = read_pixels(image)
    ax.imshow(pixels)
    ax.set_axis_off()
    return pixels.shape[1], pixels.shape[0]


@_styled
def matches(
    image1: ImageInput, image2: ImageInput, xy1: F64, xy2: F64, *, inliers: B8 | None = None,
    most: int = 200, ax: Any = None,
) -> Any:  # fmt: skip
    """Draw matches as lines between two images side by side; those that are no inliers are orange."""
    ax = _axis(ax, wide=8.0, high=3.2)
    first, second = read_pixels(image1, image2)
    both = np.full((max(len(first), len(second)), first.shape[1] + second.shape[1], 3), 128, np.uint8)
    both[: len(first), : first.shape[1]] = first
    both[: len(second), first.shape[1] :] = second
    _show(ax, both)
    xy1, xy2 = numbers("plot.matches", xy1=xy1, xy2=xy2)
    good = np.ones(len(xy1), bool) if inliers is None else np.asarray(inliers, dtype=bool)
    some = np.unique(np.linspace(0, len(xy1) - 1, min(most, len(xy1))).astype(int))
    for k in some[np.argsort(good[some], kind="stable")[::-1]]:
        x, y = [xy1[k, 0], xy2[k, 0] + first.shape[1]], [xy1[k, 1], xy2[k, 1]]
        ax.plot(x, y, color=GREEN if good[k] else ORANGE, linewidth=0.6, marker=".", markersize=3, alpha=0.7)
    ax.set_title(f"{good.sum()} of {len(good)} matches" if inliers is not None else f"{len(good)} matches")
    return ax.figure


@_styled
def epipolar_lines(
    image2: ImageInput, F: F64 | FundamentalEstimate, xy1: F64, xy2: F64 | None = None, *,
    covariance: F64 | None = None, ax: Any = None,
) -> Any:  # fmt: skip
    """Draw the lines F x1 in image 2, with 95 % bands by the covariance of F (HZ 11.11).

    A point x at s along a line lies x' C x off it in variance, with C = A S A' of l = F x1 = A f.
    """
    ax = _axis(ax)
    if isinstance(F, FundamentalEstimate):
        covariance = F.covariance if covariance is None else covariance
        F = F.F
    (xy1,) = numbers("plot.epipolar_lines", xy1=xy1)
    width, height = _show(ax, image2)
    raw = homogenize(xy1) @ np.asarray(F).T
    for k, line in enumerate(lines_of(F, xy1)):
        ends = clip_line(line, width, height)
        if ends is None:
            continue
        color = f"C{k % 10}"
        ax.plot(*np.reshape(ends, (2, 2)).T, color=color, linewidth=1.0)
        if covariance is not None and np.isfinite(covariance).all():
            A = np.kron(np.eye(3), homogenize(xy1[k]))
            start, end = np.reshape(ends, (2, 2))
            x = homogenize(start + np.linspace(0.0, 1.0, 60)[:, None] * (end - start))
            C = A @ covariance @ A.T
            off = INTERVAL * np.sqrt(np.einsum("ni,ij,nj->n", x, C, x)) / np.linalg.norm(raw[k, :2])
            upper, lower = (x[:, :2] + side * off[:, None] * line[:2] for side in (1, -1))
            ax.fill(*np.concatenate([upper, lower[::-1]]).T, color=color, alpha=0.3, linewidth=0)
    if xy2 is not None:
        ax.scatter(*np.asarray(xy2).T, s=12, facecolors="none", edgecolors="white", linewidths=1.0)
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    return ax.figure


@_styled
def corners(image: ImageInput, xy: F64 | records.Features, *, ax: Any = None) -> Any:
    """Draw corners; those of records are coloured by their response."""
    ax = _axis(ax)
    _show(ax, image)
    color: Any = GREEN
    if isinstance(xy, records.Features):
        color, xy = np.log(np.maximum(np.asarray(xy.response), 1e-12)), xy.xy
    ax.scatter(*np.asarray(xy).T, s=4, c=color)
    ax.set_title(f"{len(xy)} corners")
    return ax.figure


@_styled
def cameras(
    cameras: Any, X: F64 | None = None, *, colors: Any = None, covariance: F64 | None = None,
    sigmas: float = INTERVAL, most: int = 4000, ax: Any = None,
) -> Any:  # fmt: skip
    """Draw cameras and points in space, with ellipsoids of the points if covariances (N, 3, 3) are given.

    ``cameras`` is a sequence or mapping of :class:`thesisrecon.Camera`, a run, or P (V, 3, 4).
    """
    ax = _axis(ax, high=4.2, depth=True)
    if isinstance(cameras, RunResult):
        cameras, X = cameras.cameras, cameras.points if X is None else X
    if isinstance(cameras, Mapping):
        cameras = list(cameras.values())
    frames = [(c.K, c.R, c.centre, c.size) if isinstance(c, Camera) else _frame(c) for c in cameras]
    C = np.array([centre for _, _, centre, _ in frames]).reshape(-1, 3)
    X = np.zeros((0, 3)) if X is None else np.asarray(X, dtype=np.float64)
    # Far points would make all else small.
    middle = np.median(np.concatenate([X, C]), axis=0)
    near = np.linalg.norm(X - middle, axis=1)
    reach = max(np.quantile(near, 0.9) if len(X) else 0.0, *np.linalg.norm(C - middle, axis=1), 1e-300)
    some = np.flatnonzero(near <= 1.5 * reach)[:: max(1, len(X) // most)]
    color = GREY if colors is None else np.asarray(colors)[some] / (255.0 if np.max(colors) > 1 else 1.0)
    if covariance is None:
        ax.scatter(*_drawn(X[some]).T, s=1.5, c=color, alpha=0.7)
    else:
        _ellipsoids(ax, X[some], np.asarray(covariance)[some], sigmas)
    for K, R, centre, (width, height) in frames:
        border = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], dtype=float) - 0.5
        rays = homogenize(border) @ np.linalg.inv(K).T
        frame = _drawn(centre + 0.12 * reach * rays / np.linalg.norm(rays, axis=1).max() @ R)
        for line in [frame, *(np.stack([_drawn(centre), corner]) for corner in frame[:4])]:
            ax.plot(*line.T, color=BLUE, linewidth=0.8)
    shown = _drawn(np.concatenate([C, X[some]]))
    ax.set_box_aspect(np.maximum(np.ptp(shown, axis=0), 0.05 * np.ptp(shown, axis=0).max()))
    ax.view_init(25, -60)
    _quiet_axes(ax)
    return ax.figure


def _quiet_axes(ax: Any) -> None:
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_pane_color((0.5, 0.5, 0.5, 0.05))
        axis.set_ticklabels([])


def _frame(P: F64) -> tuple[F64, F64, F64, tuple[int, int]]:
    K, R, t = camera_parts(np.asarray(P, dtype=np.float64))
    return K, R, -R.T @ t, (round(2 * K[0, 2]), round(2 * K[1, 2]))


def _drawn(X: F64) -> F64:
    """Axes x, z, -y: the vertical of images points up."""
    return np.asarray(X @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))


def _ellipsoids(ax: Any, X: F64, covariance: F64, sigmas: float) -> None:
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 9), np.linspace(0, np.pi, 6))
    sphere = np.stack([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)], axis=-1)
    for x, C in zip(X, covariance, strict=True):
        if np.isfinite(C).all():
            values, vectors = np.linalg.eigh(C)
            surface = x + sphere @ (vectors * sigmas * np.sqrt(np.maximum(values, 0.0))).T
            ax.plot_surface(*np.moveaxis(_drawn(surface), 2, 0), color=ORANGE, alpha=0.5, linewidth=0)


def _arrows(ax: Any, xy: F64, step: F64, *values: F64, **given: Any) -> None:
    ax.quiver(*xy.T, *step.T, *values, angles="xy", scale_units="xy", scale=1, width=0.003, **given)


@_styled
def residuals(
    xy: F64, residual_px: F64, *, size: tuple[int, int] | None = None, most: int = 1500, ax: Any = None
) -> Any:
    """Draw residuals (..., 2) at their pixels as arrows, enlarged as the title says; NaN are left out."""
    ax = _axis(ax)
    xy, r = (np.asarray(a, dtype=np.float64).reshape(-1, 2) for a in (xy, residual_px))
    there = np.isfinite(xy).all(axis=1) & np.isfinite(r).all(axis=1)
    xy, r = xy[there], r[there]
    some = slice(None, None, max(1, len(r) // most))
    rms = float(np.sqrt(np.mean(np.sum(r**2, axis=1)))) if len(r) else 0.0
    scale = 0.04 * np.ptp(xy, axis=0).max() / max(rms, 1e-300) if len(r) else 1.0
    _arrows(ax, xy[some], scale * r[some], np.linalg.norm(r[some], axis=1))
    ax.set_title(f"RMS {rms:.3g} px, arrows {scale:.3g} times as long")
    ax.set_aspect("equal")
    if size is not None:
        ax.set_xlim(0, size[0])
        ax.set_ylim(size[1], 0)
    else:
        ax.invert_yaxis()
    return ax.figure


@_styled
def depth(values: F64 | records.DepthMap | records.DisparityMap, *, ax: Any = None) -> Any:
    """Draw a depth map or disparity in colours; unknown pixels are empty."""
    ax = _axis(ax)
    disparity = isinstance(values, records.DisparityMap)
    of = values.disparity if isinstance(values, records.DisparityMap) else getattr(values, "depth", values)
    of = np.asarray(of)
    known = of[np.isfinite(of)]
    low, high = np.quantile(known, [0.01, 0.99]) if len(known) else (0.0, 1.0)
    drawn = ax.imshow(of, vmin=low, vmax=high)
    ax.set_axis_off()
    ax.figure.colorbar(drawn, ax=ax, label="disparity, px" if disparity else "depth", shrink=0.8)
    ax.set_title(f"{np.isfinite(of).mean():.0%} known")
    return ax.figure


@_styled
def lens(camera: Camera, *, ax: Any = None) -> Any:
    """Draw where a lens moves the pixels of a pinhole camera, as a grid; the axis is a cross."""
    ax = _axis(ax)
    width, height = camera.size
    x, y = np.meshgrid(np.linspace(0, width - 1, 25), np.linspace(0, height - 1, 19))
    grid = np.stack([x, y], axis=-1)
    rays = homogenize(grid.reshape(-1, 2)) @ np.linalg.inv(camera.K).T
    moved = camera.project(rays @ camera.R + camera.centre).reshape(grid.shape)
    for lines, color in ((grid, "#80808060"), (moved, BLUE)):
        for each in (*lines, *lines.swapaxes(0, 1)):
            ax.plot(*each.T, color=color, linewidth=0.7)
    ax.plot(*camera.K[:2, 2], "+", color=ORANGE, markersize=10)
    ax.set_aspect("equal")
    ax.set_xlim(-0.05 * width, 1.05 * width)
    ax.set_ylim(1.05 * height, -0.05 * height)
    along, corner = camera.angles_of_view
    ax.set_title(f"{camera.lens}: {along:.1f}° along the long side, corners {corner:.1f}° from the axis")
    return ax.figure


@_styled
def strata(reconstructions: Mapping[str, Any] | Sequence[Any]) -> Any:
    """Draw the points of reconstructions, or X (N, 3) or (N, 4), of several strata side by side."""
    from matplotlib.figure import Figure

    named = (
        reconstructions if isinstance(reconstructions, Mapping)
        else {getattr(one, "stratum", str(i)): one for i, one in enumerate(reconstructions)}
    )  # fmt: skip
    figure = Figure(figsize=(3.2 * len(named), 3.2))
    for k, (name, one) in enumerate(named.items(), 1):
        X = one.X[one.valid] if isinstance(one, records.Reconstruction) else np.asarray(one)
        with np.errstate(divide="ignore", invalid="ignore"):
            X = dehomogenize(X) if X.shape[1] == 4 else X
        X = X[np.isfinite(X).all(axis=1)]
        off = np.abs(X - np.median(X, axis=0))
        near = off <= 4 * np.quantile(off, 0.8, axis=0)
        ax = figure.add_subplot(1, len(named), k, projection="3d")
        ax.scatter(*_drawn(X[near.all(axis=1)]).T, s=1.5, c=BLUE)
        if name != "projective":
            ax.set_aspect("equal")
        ax.set_title(name)
        _quiet_axes(ax)
    return figure


@_styled
def focal(
    value: Mapping[str, float] | F64 | RunResult, std: F64 | None = None, *, truth: float | None = None,
    ax: Any = None,
) -> Any:  # fmt: skip
    """Draw focal lengths, px, with 95 % intervals, and the truth as a line."""
    ax = _axis(ax)
    if isinstance(value, RunResult):
        every = value.cameras
        std = np.array([(one.std or {}).get("focal_px", np.nan) for one in every.values()])
        value = {name: float(one.K[0, 0]) for name, one in every.items()}
    names = list(value) if isinstance(value, Mapping) else [str(k) for k in range(len(value))]
    centre = np.array(list(value.values()) if isinstance(value, Mapping) else value, dtype=np.float64)
    bars = None if std is None else INTERVAL * np.asarray(std)
    ax.errorbar(np.arange(len(centre)), centre, bars, fmt="o", color=BLUE, capsize=3, markersize=4)
    if truth is not None:
        ax.axhline(truth, color=ORANGE, linestyle="--", linewidth=1, label=f"truth {truth:g} px")
        ax.legend()
    ax.set_xticks(np.arange(len(centre)), names, rotation=60 if len(names) > 4 else 0)
    ax.set_ylabel("focal length, px")
    return ax.figure


@_styled
def _errors(comparison: ModelComparison) -> Any:
    ax = _axis(None)
    known = np.isfinite(comparison.centre_error).all()
    ax.bar(
        np.arange(len(comparison.names)),
        comparison.centre_error if known else comparison.rotation_error_deg, color=BLUE,
    )  # fmt: skip
    ax.set_xticks(np.arange(len(comparison.names)), comparison.names, rotation=60)
    ax.set_ylabel("centre error, units of b" if known else "rotation error, degrees")
    return ax.figure


@_styled
def _mesh(mesh: records.TexturedMesh) -> Any:
    ax = _axis(None)
    view = render(mesh, overview(mesh))
    ax.imshow(np.dstack([view.color, 255 * view.valid.astype(np.uint8)]))
    ax.set_axis_off()
    return ax.figure


@_styled
def _matches_of(fit: FundamentalEstimate) -> Any:
    """The motion of the matches, those that are no inliers in orange."""
    ax = _axis(None)
    for use, color in ((fit.inliers, GREEN), (~fit.inliers, ORANGE)):
        _arrows(ax, fit.xy1[use], (fit.xy2 - fit.xy1)[use], color=color)
    ax.update_datalim(np.concatenate([fit.xy1, fit.xy2]))
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.invert_yaxis()
    ax.set_title("from image 1 to image 2, px")
    return ax.figure


def _of_reconstruction(r: records.Reconstruction) -> Any:
    if r.stratum != "metric":
        return strata([r])
    good = r.registered & finite_cameras(r.P)
    return cameras(r.P[good], dehomogenize(r.X[r.valid]))


def _facts(record: Any) -> tuple[Callable[[], Any], dict[str, Any]]:
    """The picture of a record, and its numbers; ``KeyError`` if it has no picture."""
    if isinstance(record, RunResult):
        best = record.best_reconstruction
        facts = {"images": len(record.images), "failure": record.failure or "none"}
        if record.metric is not None:
            one = next(iter(record.cameras.values()))
            facts |= {"registered": len(record.cameras), "points": len(record.points),
                      "focal length": f"{one.K[0, 0]:.1f} ± {(one.std or {}).get('focal_px', 0.0):.1f} px",
                      "trusted": record.metric.trusted}  # fmt: skip
            return lambda: cameras(record), facts
        return (lambda: _of_reconstruction(best)) if best is not None else _nothing, facts
    if isinstance(record, Camera):
        names = ("focal_px", "principal_x_px", "principal_y_px")
        values, std = (record.K[0, 0], *record.K[:2, 2]), record.std or {}
        facts = {name: f"{v:.2f} ± {std[name]:.2f}" if name in std else f"{v:.2f}"
                 for name, v in zip(names, values, strict=True)}  # fmt: skip
        return lambda: lens(record), facts | {"size": record.size, "centre": record.centre.round(4).tolist()}
    if isinstance(record, records.Reconstruction):
        facts = {"stratum": record.stratum, "registered": f"{record.registered.sum()} of {len(record.P)}",
                 "points": int(record.valid.sum()), "noise": f"{record.sigma_px:.3f} px"}  # fmt: skip
        return lambda: _of_reconstruction(record), facts
    if isinstance(record, FundamentalEstimate):
        inliers = f"{record.inliers.sum()} of {len(record.inliers)}"
        facts = {"inliers": inliers, "noise": f"{record.sigma_px:.3f} px", "determined": record.determined,
                 "reasons": "; ".join(record.reasons) or "none"}  # fmt: skip
        return lambda: _matches_of(record), facts
    if isinstance(record, records.DepthMap):
        known = record.depth[np.isfinite(record.depth)]
        median = f"{np.median(known):.4g}" if len(known) else "none"
        facts = {"view": record.view, "median depth": median}
        return lambda: depth(record), facts
    if isinstance(record, records.TexturedMesh):
        return lambda: _mesh(record), {"vertices": len(record.vertices), "faces": len(record.faces)}
    if isinstance(record, ModelComparison):
        facts = {f"{name}, median": f"{one['median']:.4g}" for name, one in record.summary.items()}
        return lambda: _errors(record), {"cameras": len(record.names)} | facts
    raise KeyError(type(record).__name__)


def _nothing() -> Any:
    raise ImportError


def html(record: Any) -> str | None:
    """Return a picture and the numbers of a record as HTML, as notebooks show them; None: it has none."""
    try:
        draw, facts = _facts(record)
    except KeyError:
        return None
    picture = ""
    try:
        figure, content = draw(), io.BytesIO()
        figure.savefig(content, format="png", dpi=100)
        code = base64.b64encode(content.getvalue()).decode()
        picture = (
            f'<img alt="{type(record).__name__}" style="max-width:100%" src="data:image/png;base64,{code}">'
        )
    except ImportError:
        pass  # without matplotlib the numbers alone
    rows = "".join(f"<tr><td>{markup.escape(name)}</td><td>{markup.escape(str(value))}</td></tr>"
                   for name, value in facts.items())  # fmt: skip
    table = f"<table><caption>{type(record).__name__}</caption>{rows}</table>"
    return f'<div style="display:flex;gap:1em;align-items:center;flex-wrap:wrap">{picture}{table}</div>'
