"""Pictures of the page, drawn with Pillow: thumbnails, two photographs with their epipolar geometry, depth
maps, and a photograph beside the model.
"""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.records import HeldOut, TwoView
from thesisrecon.report.data import ReportImage

THUMBNAIL_BYTES = 2_000_000
PANEL_LONG_SIDE = 640
GAP = 8
# Hues of similar lightness that stay apart on a photograph; the numbers serve those who see them as equal.
HUES = (
    "#ffd166", "#06d6a0", "#4cc9f0", "#ff7096", "#f9844a", "#b8f35a",
    "#c77dff", "#80ffdb", "#ffadad", "#72b0ff", "#fdffb6", "#ff9ff3",
)  # fmt: skip

DEPTH_BYTES = 1_500_000
DEPTH_SIDE = 360
HELD_OUT_SIDE = 640
DIFFERENCE_LIMIT = 64.0
"""Grey levels; larger differences look alike."""

# Lightness rises by 5 of 100 from colour to colour (CIELAB), so that equal steps look equal and their order
# survives grey printing and colour blindness; hue runs from violet to yellow in Oklch (Ottosson 2020).
SCALE = (
    "#290272", "#201c81", "#05308d", "#02457e", "#04557e", "#006483", "#057287", "#00818d", "#058f90",
    "#019f91", "#00b08e", "#04c082", "#58cc78", "#87d86f", "#b1e167", "#d7e962", "#fcf265",
)  # fmt: skip
UNKNOWN = (201, 208, 214)


@dataclass(frozen=True)
class EmbeddedPicture:
    """A JPEG as a ``data:`` address, with its size in px for a page that does not jump while loading."""

    uri: str
    width: int
    height: int


def thumbnail(photograph: ReportImage, how_many: int) -> EmbeddedPicture | None:
    """A small JPEG of a photograph; all ``how_many`` of them together take about ``THUMBNAIL_BYTES``.

    None where the pixels are not known.
    """
    if photograph.rgb is None or 0 in photograph.rgb.shape:
        return None
    share = THUMBNAIL_BYTES / max(how_many, 1)
    # A JPEG of this quality spends about a quarter byte on a pixel, a third more in base64, noise more.
    side = float(np.clip(np.sqrt(1.5 * share / 0.33), 64, 360))
    while True:
        picture = PillowImage.fromarray(photograph.rgb)
        picture.thumbnail((round(side), round(side)), PillowImage.Resampling.LANCZOS)
        embedded = embed_jpeg(picture, quality=80)
        if len(embedded.uri) <= 1.5 * share or side < 64:
            return embedded
        side *= 0.75


def embed_jpeg(picture: PillowImage.Image, *, quality: int) -> EmbeddedPicture:
    """A picture as a JPEG in a ``data:`` address."""
    buffer = io.BytesIO()
    picture.convert("RGB").save(buffer, format="JPEG", quality=quality, optimize=True)
    text = base64.b64encode(buffer.getvalue()).decode("ascii")
    return EmbeddedPicture(f"data:image/jpeg;base64,{text}", picture.width, picture.height)


def draw_pair(pair: TwoView, first: ReportImage, second: ReportImage) -> EmbeddedPicture | None:
    """Both photographs side by side, with their verified matches and epipolar lines.

    Every match is a dot; a few spread ones are numbered and come with their partner's epipolar line: F x1
    in the second photograph, F' x2 in the first. None where the pixels of one are not known.
    """
    if first.rgb is None or second.rgb is None:
        return None
    chosen = spread_matches(pair.xy1, len(HUES))
    left = _draw_half(first, pair.xy1, chosen, pair.xy2[chosen] @ pair.F[:2] + pair.F[2])
    right = _draw_half(second, pair.xy2, chosen, pair.xy1[chosen] @ pair.F[:, :2].T + pair.F[:, 2])
    sheet = PillowImage.new("RGB", (left.width + GAP + right.width, max(left.height, right.height)), "white")
    sheet.paste(left, (0, 0))
    sheet.paste(right, (left.width + GAP, 0))
    return embed_jpeg(sheet, quality=84)


def spread_matches(xy: F64, count: int) -> I64:
    """Indices of up to ``count`` points (N, 2) far from each other: each next one is the farthest from those
    chosen, the first the nearest to the middle."""
    if len(xy) == 0:
        return np.zeros(0, dtype=np.int64)
    chosen = [int(np.argmin(np.linalg.norm(xy - xy.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(xy - xy[chosen[0]], axis=1)
    while len(chosen) < min(count, len(xy)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.int64)


def clip_line(
    line: F64, width: float, height: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Where a line (3,) a x + b y + c = 0 enters and leaves a photograph; None where it passes by."""
    a, b, c = (float(v) for v in line)
    low, right, bottom = -0.5, width - 0.5, height - 0.5
    hits: list[tuple[float, float]] = []
    if b != 0:
        hits += [(x, -(a * x + c) / b) for x in (low, right)]
    if a != 0:
        hits += [(-(b * y + c) / a, y) for y in (low, bottom)]
    slack = 1e-6 * max(width, height)
    inside = [
        (x, y) for x, y in hits if low - slack <= x <= right + slack and low - slack <= y <= bottom + slack
    ]
    if len(inside) < 2:
        return None
    return min(inside), max(inside)


def _draw_half(photograph: ReportImage, xy: F64, chosen: I64, lines: F64) -> PillowImage.Image:
    """One photograph with dots, numbers and lines; drawn twice as large and shrunk, which smooths edges."""
    assert photograph.rgb is not None
    picture, s = _faded(photograph)
    draw = ImageDraw.Draw(picture)
    width, height = photograph.size
    r = 3 if len(xy) <= 600 else 2
    for x, y in _to_drawing(xy, s):
        draw.ellipse((x - r, y - r, x + r, y + r), fill="#ffffff", outline="#1b2733")
    for n, line in enumerate(lines):
        ends = clip_line(line, width, height)
        if ends is not None:
            draw.line([tuple(p) for p in _to_drawing(np.array(ends), s)], fill=HUES[n], width=3)
    font = ImageFont.load_default(size=30)
    for n, (x, y) in enumerate(_to_drawing(xy[chosen], s)):
        draw.ellipse((x - 10, y - 10, x + 10, y + 10), fill=HUES[n], outline="#101418", width=3)
        _write_number(draw, n + 1, (x, y), picture.size, font)
    return picture.resize((picture.width // 2, picture.height // 2), PillowImage.Resampling.LANCZOS)


def _write_number(
    draw: ImageDraw.ImageDraw,
    number: int,
    at: tuple[float, float],
    size: tuple[int, int],
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
) -> None:
    """The number beside a dot, on the side where there is room."""
    x = at[0] + 15 if at[0] < size[0] - 64 else at[0] - 50
    y = min(max(at[1] - 34, 2), size[1] - 38)
    draw.text((x, y), str(number), font=font, fill="white", stroke_width=3, stroke_fill="#101418")


def _faded(photograph: ReportImage) -> tuple[PillowImage.Image, float]:
    """The photograph at twice the panel's size, paler and darker, and the scale from working pixels."""
    assert photograph.rgb is not None
    width, height = photograph.size
    s = 2.0 * PANEL_LONG_SIDE / max(width, height)
    even = (max(2, 2 * round(s * width / 2)), max(2, 2 * round(s * height / 2)))
    colour = PillowImage.fromarray(photograph.rgb).resize(even, PillowImage.Resampling.BILINEAR)
    grey = colour.convert("L").convert("RGB")
    return PillowImage.blend(grey, colour, 0.45).point(lambda v: 0.78 * v), s


def _to_drawing(xy: F64, s: float) -> list[tuple[float, float]]:
    """Pixels of the photograph as Pillow's drawing coordinates at scale s."""
    return [(float(x), float(y)) for x, y in (xy + 0.5) * s - 0.5]


@dataclass(frozen=True)
class DepthPicture:
    """A coloured depth map: ``near`` (the brightest) and ``far`` (the darkest) in units of the scene, NaN
    where there is no depth at all; ``share`` of the pixels that have one."""

    picture: EmbeddedPicture
    near: float
    far: float
    share: float


def draw_depth(depth: F32, *, side: int = DEPTH_SIDE) -> DepthPicture:
    """A depth map (H, W), NaN where unknown, as a small picture: near is bright, far dark, unknown grey.

    The scale runs from the 1 % to the 99 % quantile of the known depths, so that strays do not take it all.
    """
    known = np.isfinite(depth)
    near, far = np.quantile(depth[known], (0.01, 0.99)).tolist() if known.any() else (np.nan, np.nan)
    closeness = (far - depth.astype(np.float64)) / max(far - near, 1e-12 * abs(far), 1e-300)
    colored = PillowImage.fromarray(paint_scale(closeness))
    return DepthPicture(_small(colored, side), float(near), float(far), float(known.mean()))


def paint_scale(values: F64) -> NDArray[np.uint8]:
    """Colours (..., 3) of numbers (...) from 0 (dark) to 1 (bright); beyond is cut, NaN is grey."""
    table = np.array([[int(code[k : k + 2], 16) for k in (1, 3, 5)] for code in SCALE], dtype=np.float64)
    at = np.linspace(0.0, 1.0, len(table))
    known = np.isfinite(values)
    place = np.where(known, values, 0.0)
    colors = np.stack([np.interp(place, at, table[:, d]) for d in range(3)], axis=-1)
    colors[~known] = UNKNOWN
    return np.asarray(np.rint(colors), dtype=np.uint8)


def depth_side(how_many: int) -> int:
    """Long side of each of so many depth pictures, all of which together take about ``DEPTH_BYTES``."""
    return int(np.clip(np.sqrt(DEPTH_BYTES / max(how_many, 1) / 0.33), 96, DEPTH_SIDE))


def draw_held_out(held_out: HeldOut) -> tuple[EmbeddedPicture, EmbeddedPicture, EmbeddedPicture]:
    """The photograph, the model in its place, and the mean difference of their channels (dark = alike).

    What is not compared is grey in the last two.
    """
    difference = np.abs(held_out.real.astype(np.float64) - held_out.rendered).mean(axis=2)
    difference = np.where(held_out.compared, difference / DIFFERENCE_LIMIT, np.nan)
    rendered = np.where(held_out.compared[..., None], held_out.rendered, np.array(UNKNOWN, np.uint8))
    real, model, apart = (
        _small(PillowImage.fromarray(pixels), HELD_OUT_SIDE)
        for pixels in (held_out.real, rendered, paint_scale(difference))
    )
    return real, model, apart


def _small(picture: PillowImage.Image, side: int) -> EmbeddedPicture:
    picture.thumbnail((side, side), PillowImage.Resampling.BOX)
    return embed_jpeg(picture, quality=86)
