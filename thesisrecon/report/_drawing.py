"""Drawings of the report: thumbnails, image pairs, depth maps and the held-out comparison."""

import base64
import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.geometry.two_view import clip_line
from thesisrecon.records import HeldOut, Image, TwoView

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


def _small(picture: PillowImage.Image, side: int) -> EmbeddedImage:
    picture.thumbnail((side, side), PillowImage.Resampling.BOX)
    return embed_jpeg(picture, quality=86)
