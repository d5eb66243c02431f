"""Figures of the report: plotly.js mappings, data of the model for ``viewer.js``, drawings.

The scene is drawn upright and without outliers. Plain mappings instead of plotly's classes work with every
version of plotly. Drawings are thumbnails, image pairs, depth maps and the held-out comparison.
"""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from thesisrecon.arrays import B8, F32, F64, I64, distinct_corners
from thesisrecon.camera import Camera, decompose_camera, finite_cameras, viewing_rays
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import clip_line
from thesisrecon.imaging.pinholes import camera_of_image, is_divided, pinhole_numbers, pinhole_view
from thesisrecon.lens import angles_from_axis
from thesisrecon.records import HeldOut, Image, Reconstruction, TexturedMesh, TwoView
from thesisrecon.report._data import pictured

MAX_POINTS = 25_000
_ACCENT = "#ff9f43"
# Lightness falls evenly, so that the order is visible in grey and for colour-blind readers.
_PAIR_SCALE = [[0.0, "#e6f2f1"], [0.25, "#a9d6d2"], [0.5, "#5cb1ad"], [0.75, "#1f8089"], [1.0, "#0b4a5c"]]
MAX_MATRIX, MAX_CELLS = 200, 100
"""Largest number of views in the matrix of pairs, and cells per side for more."""
MAX_PYRAMIDS = 250  # Cameras that are drawn as pyramids; of more, these are evenly spread
HUES_OF_LENSES = ("#0b6e7f", "#c4560b", "#6a3d9a", "#4d7a18")


@dataclass(frozen=True)
class Scene:
    """Content of the 3D view, z up."""

    points: F64  # (M, 3)
    index: I64  # (M,) numbers of the points in X
    views: I64  # (C,) registered views
    centres: F64  # (C, 3)
    corners: F64  # (C, 4, 3) of the pyramids; the first two are on the upper image edge
    low: F64
    high: F64


def build_scene(reconstruction: Reconstruction, *, max_points: int = MAX_POINTS) -> Scene | None:
    """3D view of a metric reconstruction without far points; None without a camera."""
    views = np.flatnonzero(reconstruction.registered & finite_cameras(reconstruction.P)).astype(np.int64)
    if len(views) == 0:
        return None
    parts = [decompose_camera(reconstruction.P[i]) for i in views]
    rotations = np.stack([R for _, R, _ in parts])
    upright = upright_rotation(rotations)
    index = _kept_points(reconstruction.X, reconstruction.valid, max_points)
    points = reconstruction.X[index, :3] @ upright.T
    centres = dehomogenize(camera_centre(reconstruction.P[views])) @ upright.T
    depth = _pyramid_depth(centres, points)
    rays = [_corner_rays(K, size) for (K, _, _), size in zip(parts, reconstruction.sizes[views], strict=True)]
    views_of = zip(centres, rotations, rays, strict=True)
    corners = np.stack([c + depth * own @ R @ upright.T for c, R, own in views_of])
    everything = np.concatenate([points, centres, corners.reshape(-1, 3)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.03 * float((high - low).max()) or 1.0
    return Scene(points, index, views, centres, corners, low - margin, high + margin)


def upright_rotation(rotations: F64) -> F64:
    """Rotation (3, 3) of the world that puts z up and the mean viewing direction along +y.

    Cameras are assumed to be held level: up is orthogonal to their x axes, else to the optical axes.
    """
    x_axes, y_axes, z_axes = rotations[:, 0], rotations[:, 1], rotations[:, 2]
    _, vectors = np.linalg.eigh(x_axes.T @ x_axes + 0.1 * z_axes.T @ z_axes)
    up = vectors[:, 0] if vectors[:, 0] @ y_axes.sum(axis=0) <= 0 else -vectors[:, 0]
    ahead = z_axes.sum(axis=0)
    ahead = ahead - (ahead @ up) * up
    if np.linalg.norm(ahead) < 0.1 * len(z_axes):  # cameras all around the object: use the first one
        ahead = z_axes[0] - (z_axes[0] @ up) * up
    if np.linalg.norm(ahead) < 1e-6:  # it looks straight down: use its upward image direction
        ahead = -y_axes[0] + (y_axes[0] @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up])


def _kept_points(X: F64, valid: B8, max_points: int) -> I64:
    kept = np.flatnonzero(valid & np.isfinite(X).all(axis=1))
    if len(kept) == 0:
        return kept
    distance = np.linalg.norm(X[kept, :3] - np.median(X[kept, :3], axis=0), axis=1)
    near: I64 = kept[distance <= 4.0 * np.quantile(distance, 0.8)]
    return near[:: max(1, -(-len(near) // max_points))]


def _corner_rays(K: F64, size: NDArray[np.int64]) -> F64:
    """Return rays (4, 3) through the image corners, clockwise from the top left, of unit depth or shorter."""
    width, height = float(size[0]), float(size[1])
    xy = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    rays = homogenize(xy) @ np.linalg.inv(K).T
    # No edge is longer than 3 depths, as with a field of view of 140 degrees.
    return np.asarray(rays / max(1.0, float(np.linalg.norm(rays, axis=1).max()) / 3.0))


def _pyramid_depth(centres: F64, points: F64) -> float:
    """Choose a depth that separates neighbouring pyramids, 4 to 15 % of the scene radius."""
    reach = float(np.linalg.norm(np.ptp(np.concatenate([centres, points]), axis=0))) / 2 or 1.0
    if len(centres) < 2:
        return 0.15 * reach
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    return float(np.clip(0.4 * np.median(gaps.min(axis=1)), 0.04 * reach, 0.15 * reach))


Figure = dict[str, Any]


def scene_figure(scene: Scene, names: Sequence[str], colors: NDArray[np.uint8] | None) -> Figure:
    """Cameras and points as a plotly.js figure; ``colors`` are those of the points X."""
    # About the middle: WebGL draws in single precision, too coarse far from the origin.
    parts, middle = ("points", "centres", "corners", "low", "high"), 0.5 * (scene.low + scene.high)
    scene = replace(scene, **{name: getattr(scene, name) - middle for name in parts})
    # Decimals that keep 1e-4 of the size.
    largest = float((scene.high - scene.low).max())
    digits = int(np.clip(4 - np.floor(np.log10(max(largest, 1e-12))), 0, 15))
    paint = "#9fb4c7" if colors is None else [f"#{bytes(rgb).hex()}" for rgb in colors[scene.index]]
    marks = [f"{i + 1} · {escape(names[i])}" for i in scene.views]
    hover = {"text": marks, "hovertemplate": "%{text}<extra></extra>"}
    points = _markers("points", 2, paint, _xyz(scene.points, digits)) | {"hoverinfo": "skip"}
    centres = _markers("centres", 4, _ACCENT, _xyz(scene.centres, digits)) | hover
    extent = scene.high - scene.low
    aspect = 1.7 * extent / max(float(extent.max()), 1e-12)
    ranges = zip("xyz", scene.low.tolist(), scene.high.tolist(), strict=True)
    axes = {f"{name}axis": {"visible": False, "range": [low, high]} for name, low, high in ranges}
    ratio = dict(zip("xyz", aspect.tolist(), strict=True))
    layout = {
        "paper_bgcolor": "#131a22",
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": False,
        "scene": {**axes, "aspectmode": "manual", "aspectratio": ratio, "dragmode": "turntable"},
        "hoverlabel": {"font": {"family": "system-ui, sans-serif"}},
    }
    return {"data": [points, _pyramids(scene, digits), centres], "layout": layout}


def _markers(name: str, size: int, color: object, xyz: Figure) -> Figure:
    marker = {"size": size, "color": color, "line": {"width": 0}}
    return {"type": "scatter3d", "mode": "markers", "name": name, "marker": marker, **xyz}


def _pyramids(scene: Scene, digits: int) -> Figure:
    """Draw pyramids as one line trace: rim, roof over the upper edge, four edges; None interrupts it."""
    rows: list[list[float] | None] = []
    shown = pictured(len(scene.centres), MAX_PYRAMIDS)
    for centre, corners in zip(scene.centres[shown], scene.corners[shown], strict=True):
        top = corners[:2].mean(axis=0) + 0.25 * (corners[:2].mean(axis=0) - corners.mean(axis=0))
        strokes = [[*corners, corners[0]], [corners[0], top, corners[1]]]
        strokes += [[centre, corner] for corner in corners]
        for stroke in strokes:
            rows += [np.round(vertex, digits).tolist() for vertex in stroke]
            rows.append(None)
    columns = {name: [None if row is None else row[d] for row in rows] for d, name in enumerate("xyz")}
    line = {"color": _ACCENT, "width": 2.5}
    kind = {"type": "scatter3d", "mode": "lines", "name": "cameras", "hoverinfo": "skip", "line": line}
    return {**kind, **columns}


def pair_matrix_figure(pairs: Sequence[TwoView], names: Sequence[str]) -> Figure:
    """Matrix of verified matches on a logarithmic scale, rejected pairs in red, of many views by blocks."""
    block = 1 if len(names) <= MAX_MATRIX else -(-len(names) // MAX_CELLS)
    # plotly.js interprets some HTML in labels.
    labels = [
        f"{k + 1} · {escape(names[k])}" if block == 1 else f"views {k + 1}–{min(k + block, len(names))}"
        for k in range(0, len(names), block)
    ]
    # The largest number of verified matches per cell, -1 without pairs.
    accepted, refused = (np.full((len(labels), len(labels)), -1, dtype=np.int64) for _ in range(2))
    for pair in pairs:
        best, (a, b) = accepted if pair.accepted else refused, (pair.i // block, pair.j // block)
        best[a, b] = best[b, a] = max(int(best[a, b]), pair.inliers)
    refused[accepted >= 0] = -1
    counts = accepted[accepted >= 0] if (accepted >= 0).any() else refused[refused >= 0]
    # The scale spans at least a factor of ten, so that small differences look small.
    high = max(1.0, float(np.log10(counts.max(initial=10))))
    low = max(0.0, min(float(np.log10(max(counts.min(initial=10**9), 1))), high - 1.0))
    ticks = [1, 3, 10, 30, 100, 200, 300, 500, 1000, 2000, 3000, 5000, 10_000, 30_000]
    values = [round(float(np.log10(n)), 3) for n in ticks]
    bar: Figure = {
        "tickvals": values, "ticktext": [str(n) for n in ticks], "thickness": 12, "outlinewidth": 0,
    }  # fmt: skip
    bar |= {"x": 1.01, "xpad": 4, "len": 1.0}
    good = _heat(accepted, labels, "", "verified matches") | {"colorscale": _PAIR_SCALE, "colorbar": bar}
    bad = _heat(refused, labels, "× ", "verified matches, not accepted")
    bad |= {"colorscale": [[0.0, "#f9dcd7"], [1.0, "#f0a99f"]], "showscale": False}
    scale = {"zmin": low, "zmax": high}
    return {"data": [good | scale, bad | scale], "layout": _matrix_layout(labels, block)}


def _heat(counts: I64, labels: list[str], mark: str, words: str) -> Figure:
    rows = counts.tolist()
    gap = 2 if len(labels) <= 30 else (1 if len(labels) <= 80 else 0)
    heat: Figure = {"type": "heatmap", "x": labels, "y": labels, "xgap": gap, "ygap": gap}
    heat["z"] = [[None if n < 0 else round(float(np.log10(max(n, 1))), 3) for n in row] for row in rows]
    heat["customdata"] = [[None if n < 0 else n for n in row] for row in rows]
    heat["hoverongaps"] = False
    heat["hovertemplate"] = "%{y}<br>%{x}<br><b>%{customdata}</b> " + words + "<extra></extra>"
    if len(labels) <= 14:
        heat["text"] = [["" if n < 0 else f"{mark}{n}" for n in row] for row in rows]
        heat["texttemplate"] = "%{text}"
    return heat


def _matrix_layout(labels: list[str], block: int) -> Figure:
    step = max(1, -(-len(labels) // 20))
    numbers = [str(first * block + 1) for first in range(0, len(labels), step)]
    axis: Figure = {"type": "category", "showgrid": False, "zeroline": False, "fixedrange": True}
    axis |= {"constrain": "domain", "tickmode": "array", "tickvals": labels[::step], "ticktext": numbers}
    axis |= {"tickangle": 0, "ticks": ""}
    return {
        "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "#e9edf0",
        "margin": {"l": 34, "r": 8, "t": 30, "b": 8},
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": "#1b2733"}, "showlegend": False,
        "xaxis": {**axis, "side": "top"}, "yaxis": {**axis, "autorange": "reversed", "scaleanchor": "x"},
    }  # fmt: skip


def lens_figure(cameras: Mapping[str, Camera]) -> Figure:
    """Angle from the axis against the distance from the principal point, by name, and that of pinholes.

    The bars are 95 % intervals: of half the angle of view, and of the farthest corner.
    """
    traces = list[Figure]()
    for (name, camera), color in zip(cameras.items(), cycle(HUES_OF_LENSES), strict=False):
        corners = np.array([[x, y] for x in (0, camera.size[0]) for y in (0, camera.size[1])]) - 0.5
        far = max(corners - camera.K[:2, 2], key=lambda corner: float(np.linalg.norm(corner)))
        radii, steps = np.linspace(0.0, np.linalg.norm(far), 65), np.linspace(0.0, 1.0, 65)
        rays = viewing_rays(camera.K, camera.K[:2, 2] + steps[:, None] * far, camera.lens_row)
        pinhole = np.arctan(radii / camera.K[0, 0])
        for label, angle, line in (
            (escape(name), angles_from_axis(rays), {"color": color}),
            ("pinhole", pinhole, {"color": color, "dash": "dot", "width": 1}),
        ):
            known = [None if np.isnan(v) else round(float(v), 3) for v in np.degrees(angle)]
            curve = {"x": np.round(radii, 1).tolist(), "y": known, "name": label, "line": line}
            traces.append({"type": "scatter", "mode": "lines", "hoverinfo": "skip", **curve})
        half = np.array(camera.angles_of_view) * [0.5, 1.0]
        std = [(camera.std or {}).get(key, np.nan) for key in ("angle_of_view_deg", "corner_deg")]
        bars, at = 1.96 * np.array(std) * [0.5, 1.0], np.array([max(camera.size) / 2.0, radii[-1]])
        shown = np.isfinite(half + bars)
        traces.append({
            "type": "scatter", "mode": "markers", "x": at[shown].tolist(), "y": half[shown].tolist(),
            "marker": {"color": color, "size": 7}, "showlegend": False,
            "error_y": {"type": "data", "array": bars[shown].tolist(), "thickness": 2},
            "hovertemplate": "%{y:.2f} degrees<extra></extra>",
        })  # fmt: skip
    axis = {"rangemode": "tozero", "gridcolor": "#d5dbe0", "fixedrange": True}
    layout = {
        "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "#f4f6f7",
        "margin": {"l": 56, "r": 8, "t": 8, "b": 46}, "legend": {"x": 0.02, "y": 0.98},
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": "#1b2733"},
        "xaxis": {**axis, "title": {"text": "distance from the principal point (px)"}},
        "yaxis": {**axis, "title": {"text": "angle from the axis (degrees)"}},
    }  # fmt: skip
    return {"data": traces, "layout": layout}


def _xyz(points: F64, digits: int) -> Figure:
    return {name: np.round(points[:, d], digits).tolist() for d, name in enumerate("xyz")}


LEVELS = 65535  # Quantization levels along each axis of the bounding box and of the texture
MAX_TEXELS = 2100 * 2100
"""Larger textures are reduced: with 45,000 faces they then add less than 3 MB to the page."""
_DIRECTIONS = (
    ("Behind the cameras", (0.35, -1.45, 0.6)),
    ("From above", (0.0, -0.01, 1.9)),
    ("From the left", (-1.3, -0.9, 0.5)),
    ("From the right", (1.3, -0.9, 0.5)),
)
"""Viewing directions; z is up and the mean viewing direction of the cameras is along y."""


def numbered_cameras(reconstruction: Reconstruction, names: Sequence[str]) -> dict[str, Camera]:
    """Return the registered cameras by number and name."""
    P, sizes = reconstruction.P, reconstruction.sizes.astype(int)
    return {
        f"{i + 1} · {names[i]}": Camera(*decompose_camera(P[i]), tuple(sizes[i].tolist()))
        for i in np.flatnonzero(reconstruction.registered).tolist()
    }


def overview(mesh: TexturedMesh) -> Camera:
    """Return a camera before the side that most of the surface faces."""
    middle = np.median(mesh.vertices, axis=0)
    reach = float(np.quantile(np.linalg.norm(mesh.vertices - middle, axis=1), 0.9))
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    away = np.cross(b - a, c - a).sum(axis=0) + 1e-9 * np.array([0.5, -0.5, -2.2])
    away *= 2.2 * reach / np.linalg.norm(away)
    z = -away / np.linalg.norm(away)
    x = np.cross([0.0, 1.0, 0.01], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.01], z))
    R = np.array([x, np.cross(z, x), z])
    K = np.array([[480.0, 0, 239.5], [0, 480, 179.5], [0, 0, 1]])
    return Camera(K, R, -R @ (middle + away), (480, 360))


def viewer_data(mesh: TexturedMesh, cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """Build the JSON data of the 3D viewer; z is up.

    ``positions`` (N, 3) uint16 in the box ``low`` to ``high``, ``uv`` (N, 2) uint16 or ``colors`` (N, 3)
    uint8, ``indices`` (M, 3) uint32, each little-endian in base64; ``texture`` is a JPEG.
    """
    distance = np.linalg.norm(mesh.vertices - np.median(mesh.vertices, axis=0), axis=1)
    keep = (distance <= 8.0 * np.quantile(distance, 0.95))[mesh.faces].all(axis=1)
    if keep.any():
        # Far faces would leave few quantization levels for the rest.
        mesh = replace(mesh, faces=mesh.faces[keep], uv=None if mesh.uv is None else mesh.uv[keep])
    upright = upright_rotation(np.stack([camera.R for camera in cameras.values()]))
    vertices = mesh.vertices @ upright.T
    low, high = (end(vertices[mesh.faces], axis=(0, 1)) for end in (np.min, np.max))
    steps = np.where(high > low, high - low, 1.0) / LEVELS
    positions = np.rint(np.clip((vertices - low) / steps, 0, LEVELS)).astype("<u2")
    color, faces, vertex = _colored(mesh)
    names = list(cameras)
    places = [_viewpoint(mesh, names[k], cameras[names[k]], upright) for k in pictured(len(names))]
    eyes = np.array([place["eye"] for place in places])
    middle = int(np.argmin(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1)))
    return {
        "low": low.tolist(), "high": (low + steps * LEVELS).tolist(), "positions": _packed(positions[vertex]),
        "indices": _packed(faces.astype("<u4")), **color, "viewpoints": places, "start": middle,
        "directions": [{"name": name, "from": list(direction)} for name, direction in _DIRECTIONS],
    }  # fmt: skip


def _colored(mesh: TexturedMesh) -> tuple[dict[str, Any], I64, I64]:
    """Return the colour data, the faces (M, 3) and the vertex of each corner."""
    every = np.arange(len(mesh.vertices))
    if mesh.texture is None or mesh.uv is None:
        colors = mesh.colors
        if colors is None:
            colors = np.tile(np.full(3, 200, dtype=np.uint8), (len(mesh.vertices), 1))
        return {"colors": _packed(colors)}, mesh.faces, every
    height, width = mesh.texture.shape[:2]
    # (0, 0) is the centre of the first texel; WebGL counts from its corner.
    uv = np.clip((mesh.uv + 0.5) / (width, height), 0.0, 1.0)
    vertex, levels = mesh.faces.ravel(), np.rint(LEVELS * uv.reshape(-1, 2)).astype(np.int64)
    first, index = distinct_corners(vertex, levels)
    picture = PillowImage.fromarray(mesh.texture)
    scale = np.sqrt(MAX_TEXELS / (picture.width * picture.height))
    if scale < 1.0:
        size = max(1, int(scale * picture.width)), max(1, int(scale * picture.height))
        picture = picture.resize(size, PillowImage.Resampling.BOX)
    texture = embed_jpeg(picture, quality=82).uri
    color = {"uv": _packed(levels[first].astype("<u2")), "texture": texture}
    return color, index.reshape(-1, 3), vertex[first]


def _viewpoint(mesh: TexturedMesh, name: str, camera: Camera, upright: F64) -> dict[str, Any]:
    """A viewpoint at a camera, in the axes of the viewer, with target and field of view."""
    field = np.array(camera.size) / 2 / np.diag(camera.K)[:2]
    local = mesh.vertices @ camera.R.T + camera.t
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = (local[:, 2] > 0) & (np.abs(local[:, :2] / local[:, 2:]) < field).all(axis=1)
    depth = float(np.median(local[seen, 2])) if seen.any() else float(np.linalg.norm(camera.t)) or 1.0
    eye = upright @ camera.centre
    target = eye + depth * (upright @ camera.R[2])
    return {"name": name, "eye": eye.tolist(), "target": target.tolist(), "field": field.tolist()}


def _packed(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


Point = tuple[float, float]

_GAP = 8
# Distinct hues of similar lightness; the drawn numbers serve colour-blind readers.
HUES = (
    "#ffd166", "#06d6a0", "#4cc9f0", "#ff7096", "#f9844a", "#b8f35a",
    "#c77dff", "#80ffdb", "#ffadad", "#72b0ff", "#fdffb6", "#ff9ff3",
)  # fmt: skip

DIFFERENCE_LIMIT = 64.0  # Grey levels; larger differences have one colour

# CIELAB lightness rises by 5 per colour: perceptually uniform, ordered in grey and for colour-blind readers;
# the hue runs from violet to yellow in Oklch (Ottosson 2020).
SCALE = (
    "#290272", "#201c81", "#05308d", "#02457e", "#04557e", "#006483", "#057287", "#00818d", "#058f90",
    "#019f91", "#00b08e", "#04c082", "#58cc78", "#87d86f", "#b1e167", "#d7e962", "#fcf265",
)  # fmt: skip
UNKNOWN = (201, 208, 214)
CUBE = ((1, 1), (0, 1), (2, 1), (1, 0), (1, 2))
"""Columns and rows of the pinhole views of a wide image: front, left, right, up, down."""


@dataclass(frozen=True)
class EmbeddedImage:
    """A JPEG as a ``data:`` address, with its size (px), so that the page does not jump while loading."""

    uri: str
    width: int
    height: int


def thumbnail(image: Image, how_many: int) -> EmbeddedImage:
    """A small JPEG of an image; all ``how_many`` of the page together take about 2 MB."""
    share = 2_000_000 / max(how_many, 1)
    # A JPEG of this quality takes about 0.25 bytes per pixel, 0.33 in base64, more for noise.
    side = float(np.clip(np.sqrt(1.5 * share / 0.33), 64, 360))
    while True:
        picture = _sampled(image)
        picture.thumbnail((round(side), round(side)), PillowImage.Resampling.LANCZOS)
        embedded = embed_jpeg(picture, quality=80)
        if len(embedded.uri) <= 1.5 * share or side < 64:
            return embedded
        side *= 0.75


def embed_jpeg(picture: PillowImage.Image, *, quality: int) -> EmbeddedImage:
    """Encode an image as JPEG in a ``data:`` address."""
    buffer = io.BytesIO()
    picture.convert("RGB").save(buffer, format="JPEG", quality=quality, optimize=True)
    text = base64.b64encode(buffer.getvalue()).decode("ascii")
    return EmbeddedImage(f"data:image/jpeg;base64,{text}", picture.width, picture.height)


def _sampled(image: Image) -> PillowImage.Image:
    step = max(1, max(image.size) // 800)
    return PillowImage.fromarray(image.rgb[::step, ::step])


def draw_pair(pair: TwoView, first: Image, second: Image) -> EmbeddedImage:
    """Draw two images side by side with their matches, some of them with their epipolar lines."""
    chosen = _spread_matches(pair.xy1, len(HUES))
    left = _draw_half(first, pair.xy1, chosen, pair.xy2[chosen] @ pair.F[:2] + pair.F[2])
    right = _draw_half(second, pair.xy2, chosen, pair.xy1[chosen] @ pair.F[:, :2].T + pair.F[:, 2])
    sheet = PillowImage.new("RGB", (left.width + _GAP + right.width, max(left.height, right.height)), "white")
    sheet.paste(left, (0, 0))
    sheet.paste(right, (left.width + _GAP, 0))
    return embed_jpeg(sheet, quality=84)


def _spread_matches(xy: F64, count: int) -> I64:
    """Select up to ``count`` indices of distant points (N, 2): the most central, then always the farthest."""
    if len(xy) == 0:
        return np.zeros(0, dtype=np.int64)
    chosen = [int(np.argmin(np.linalg.norm(xy - xy.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(xy - xy[chosen[0]], axis=1)
    while len(chosen) < min(count, len(xy)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.int64)


def _draw_half(image: Image, xy: F64, chosen: I64, lines: F64) -> PillowImage.Image:
    """Draw dots, numbers and lines on one image; at twice the size, then reduced for smooth edges."""
    width, height = image.size
    s, colour = 2.0 * 640 / max(width, height), _sampled(image)
    faded = PillowImage.blend(colour.convert("L").convert("RGB"), colour, 0.45).point(lambda v: 0.78 * v)
    even = (max(2, 2 * round(s * width / 2)), max(2, 2 * round(s * height / 2)))
    picture = faded.resize(even, PillowImage.Resampling.BILINEAR)
    draw = ImageDraw.Draw(picture)
    r = 3 if len(xy) <= 600 else 2
    for x, y in _to_drawing(xy, s):
        draw.ellipse((x - r, y - r, x + r, y + r), fill="#ffffff", outline="#1b2733")
    for n, line in enumerate(lines):
        if (ends := clip_line(line, width, height)) is not None:
            draw.line([tuple(p) for p in _to_drawing(ends, s)], fill=HUES[n], width=3)
    font = ImageFont.load_default(size=30)
    for n, (x, y) in enumerate(_to_drawing(xy[chosen], s)):
        draw.ellipse((x - 10, y - 10, x + 10, y + 10), fill=HUES[n], outline="#101418", width=3)
        # Beside the dot, inside the image.
        at = (x + 15 if x < picture.width - 64 else x - 50, min(max(y - 34, 2), picture.height - 38))
        draw.text(at, str(n + 1), font=font, fill="white", stroke_width=3, stroke_fill="#101418")
    return picture.reduce(2)


def _to_drawing(xy: F64, s: float) -> list[Point]:
    """Convert working pixels to Pillow's drawing coordinates at scale s."""
    return [(float(x), float(y)) for x, y in (xy + 0.5) * s - 0.5]


@dataclass(frozen=True)
class DepthImage:
    """A coloured depth map; near is bright, far is dark, unknown is grey."""

    picture: EmbeddedImage
    near: float  #: ends of the colour scale in scene units, NaN without depths
    far: float
    share: float  #: fraction of the pixels with a depth


def draw_depth(depth: F32, *, side: int) -> DepthImage:
    """Colour a depth map (H, W), NaN = unknown; the scale covers the 1 % to 99 % quantiles."""
    known = np.isfinite(depth)
    near, far = np.quantile(depth[known], (0.01, 0.99)).tolist() if known.any() else (np.nan, np.nan)
    closeness = (far - depth.astype(np.float64)) / max(far - near, 1e-12 * abs(far), 1e-300)
    colored = PillowImage.fromarray(_paint_scale(closeness))
    return DepthImage(_small(colored, side), float(near), float(far), float(known.mean()))


def _paint_scale(values: F64) -> NDArray[np.uint8]:
    """Colour numbers (...) from 0 (dark) to 1 (bright) as (..., 3); NaN becomes grey."""
    table = np.array([[int(code[k : k + 2], 16) for k in (1, 3, 5)] for code in SCALE], dtype=np.float64)
    at = np.linspace(0.0, 1.0, len(table))
    known = np.isfinite(values)
    place = np.where(known, values, 0.0)
    colors = np.stack([np.interp(place, at, table[:, d]) for d in range(3)], axis=-1)
    colors[~known] = UNKNOWN
    return np.asarray(np.rint(colors), dtype=np.uint8)


def depth_side(how_many: int) -> int:
    """Long side (px) of the depth images, which together take about 1.5 MB."""
    return int(np.clip(np.sqrt(1_500_000 / max(how_many, 1) / 0.33), 96, 360))


def draw_held_out(held_out: HeldOut) -> tuple[EmbeddedImage, EmbeddedImage, EmbeddedImage]:
    """Draw the held-out image, the model in its place and their mean difference (dark = equal)."""
    difference = np.abs(held_out.real.astype(np.float64) - held_out.rendered).mean(axis=2)
    difference = np.where(held_out.compared, difference / DIFFERENCE_LIMIT, np.nan)
    rendered = np.where(held_out.compared[..., None], held_out.rendered, np.array(UNKNOWN, np.uint8))
    sheets = map(PillowImage.fromarray, (held_out.real, rendered, _paint_scale(difference)))
    real, model, apart = (_small(sheet, 640) for sheet in sheets)
    return real, model, apart


def draw_straight(
    image: Image, reconstruction: Reconstruction, number: int
) -> tuple[EmbeddedImage, EmbeddedImage]:
    """Draw an image and what dense stages see of it: a pinhole view, or several as an unfolded cube."""
    alone = replace(reconstruction, registered=np.arange(len(reconstruction.P)) == number)
    views = [pinhole_view(image, alone, k, max_side=480) for k in pinhole_numbers(alone)]
    sheet = views[0].rgb
    if is_divided(*camera_of_image(alone, number)):
        K = [decompose_camera(view.P)[0] for view in views]
        focal, size = K[0][0, 0], int(6.0 * K[0][0, 0])
        sheet, seen = np.full((size, size, 3), 255, np.uint8), np.zeros((size, size), bool)
        for view, own in zip(views, K, strict=True):
            cell = CUBE[view.view // len(alone.P)]
            x, y = np.rint(focal * (2.0 * np.array(cell) + 1.0) - own[:2, 2]).astype(np.int64)
            height, width = view.seen.shape
            part = slice(y, y + height), slice(x, x + width)
            sheet[part][view.seen], seen[part] = view.rgb[view.seen], view.seen
        rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
        sheet = sheet[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return _small(_sampled(image), 480), _small(PillowImage.fromarray(sheet), 640)


def _small(picture: PillowImage.Image, side: int) -> EmbeddedImage:
    picture.thumbnail((side, side), PillowImage.Resampling.BOX)
    return embed_jpeg(picture, quality=86)
