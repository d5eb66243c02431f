"""Forward warping of an image, nearer pixels in front in any order (thesis, sections 1.2 and 1.3)."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon._numba import kernel
from thesisrecon.arrays import F32, F64, I16, I32, I64
from thesisrecon.imaging.raster import run_in_strips
from thesisrecon.imaging.resampling import sample_cubic

SLACK = 1e-7
"""Barycentric distance by which a triangle extends beyond its edges, so that rounding leaves no gaps."""
MIN_AREA = 1e-9  #: twice the area (px^2) of the smallest triangle that is drawn
STRETCH, ENLARGED = 3.0, 2.0
"""Neighbouring pixels of one surface come at most this far apart (px), or so many times their median
distance in an enlarged view."""
Corner = tuple[float, float, float, float, float]
"""Position in a view, inverse depth, and pixel of the source."""
SPARSE = 16  #: subsampling step for the median


@kernel
def _joined(target: F64, inverse_depth: F32, a: tuple[int, int], b: tuple[int, int], limits: F64) -> bool:
    """Whether two neighbouring pixels belong to one surface; False if one has no position."""
    # Comparisons with NaN are false.
    near = abs(inverse_depth[a] - inverse_depth[b]) <= limits[0]
    dx, dy = target[a[0], a[1], 0] - target[b[0], b[1], 0], target[a[0], a[1], 1] - target[b[0], b[1], 1]
    return bool(near and abs(dx) <= limits[1] and abs(dy) <= limits[1])


@kernel
def _corner(target: F64, inverse_depth: F32, at: tuple[int, int]) -> Corner:
    y, x = at
    return target[y, x, 0], target[y, x, 1], float(inverse_depth[at]), float(x), float(y)


@kernel
def _draw(
    corners: tuple[Corner, Corner, Corner], centred: bool, rows: tuple[int, int], source: F32, front: F32
) -> None:
    """Draw a triangle, or the parallelogram of its sides ``centred`` at the first corner; no back faces."""
    (ax, ay, an, au, av), b, c = corners
    bx, by, bn, bu, bv = b[0] - ax, b[1] - ay, b[2] - an, b[3] - au, b[4] - av
    cx, cy, cn, cu, cv = c[0] - ax, c[1] - ay, c[2] - an, c[3] - au, c[4] - av
    area = bx * cy - by * cx
    if area < MIN_AREA:
        return
    high_x, high_y = max(0.0, bx, cx), max(0.0, by, cy)
    low_x, low_y = min(0.0, bx, cx), min(0.0, by, cy)
    if centred:
        high_x, high_y = 0.5 * (abs(bx) + abs(cx)), 0.5 * (abs(by) + abs(cy))
        low_x, low_y = -high_x, -high_y
    top, left = int(np.ceil(ay + low_y - SLACK)), int(np.ceil(ax + low_x - SLACK))
    bottom, right = int(np.floor(ay + high_y + SLACK)), int(np.floor(ax + high_x + SLACK))
    for y in range(max(top, rows[0]), min(bottom + 1, rows[1])):
        for x in range(max(left, 0), min(right + 1, front.shape[1])):
            px, py = x - ax, y - ay
            s, t = (px * cy - py * cx) / area, (bx * py - by * px) / area
            if (0.5 - max(abs(s), abs(t)) if centred else min(s, t, 1.0 - s - t)) < -SLACK:
                continue
            near = np.float32(an + s * bn + t * cn)
            # The comparison is false only where something nearer is there.
            if front[y, x] >= near:
                continue
            front[y, x] = near
            source[y, x, 0] = au + s * bu + t * cu
            source[y, x, 1] = av + s * bv + t * cv


@kernel
def _slope(
    target: F64, inverse_depth: F32, at: tuple[int, int], step: tuple[int, int], limits: F64
) -> tuple[int, float, float, float]:
    """Number of neighbours used, and the change of position and inverse depth per ``step``."""
    height, width = inverse_depth.shape
    ahead, behind = (at[0] + step[0], at[1] + step[1]), (at[0] - step[0], at[1] - step[1])
    has_ahead = ahead[0] < height and ahead[1] < width and _joined(target, inverse_depth, at, ahead, limits)
    has_behind = behind[0] >= 0 and behind[1] >= 0 and _joined(target, inverse_depth, at, behind, limits)
    to, fro = (ahead if has_ahead else at), (behind if has_behind else at)
    count = int(has_ahead) + int(has_behind)
    a, b = target[to], target[fro]
    each = max(count, 1)
    return count, (a[0] - b[0]) / each, (a[1] - b[1]) / each, (inverse_depth[to] - inverse_depth[fro]) / each


@kernel
def _draw_footprint(
    target: F64, inverse_depth: F32, at: tuple[int, int], limits: F64, rows: tuple[int, int], source: F32,
    front: F32,
) -> None:  # fmt: skip
    """Draw the parallelogram onto which a pixel maps, from the positions of its neighbours."""
    n_across, ax, ay, an = _slope(target, inverse_depth, at, (0, 1), limits)
    n_down, dx, dy, dn = _slope(target, inverse_depth, at, (1, 0), limits)
    if n_across == 2 and n_down == 2:
        return
    # A pixel without neighbours keeps its known shape.
    if n_across == 0:
        ax, ay = (dy, -dx) if n_down else (1.0, 0.0)
    if n_down == 0:
        dx, dy = -ay, ax
    x, y, near, u, v = middle = _corner(target, inverse_depth, at)
    beside, under = (x + ax, y + ay, near + an, u + 1.0, v), (x + dx, y + dy, near + dn, u, v + 1.0)
    _draw((middle, beside, under), True, rows, source, front)


@kernel
def _outside_rows(target: F64, a: tuple[int, int], reach: float, rows: tuple[int, int]) -> bool:
    """Whether four pixels lie farther above or below the rows than a pixel of one surface reaches."""
    least, most = np.inf, -np.inf
    for y in range(a[0], min(a[0] + 2, target.shape[0])):
        for x in range(a[1], min(a[1] + 2, target.shape[1])):
            # A comparison with NaN is false.
            least = target[y, x, 1] if target[y, x, 1] < least else least
            most = target[y, x, 1] if target[y, x, 1] > most else most
    return bool(most < rows[0] - reach - 1.0 or least > rows[1] + reach)


@kernel
def _draw_surface(
    target: F64, inverse_depth: F32, limits: F64, rows: tuple[int, int], source: F32, front: F32
) -> None:
    """Draw the surface of an image's pixels into some rows of another view, nearest in front."""
    # `limits`: largest differences of inverse depth and position (px) on one surface. Four pixels form two
    # triangles, three connected ones form one; at discontinuities and borders a pixel covers half a pixel to
    # each side.
    height, width = inverse_depth.shape
    for y in range(height):
        for x in range(width):
            a, b, c, d = (y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)
            # Skip pixels without position or depth (NaN).
            if np.isnan(inverse_depth[a] + target[y, x, 0] + target[y, x, 1]):
                continue
            if _outside_rows(target, a, limits[1], rows):
                continue
            right = x + 1 < width and _joined(target, inverse_depth, a, b, limits)
            below = y + 1 < height and _joined(target, inverse_depth, a, c, limits)
            if x + 1 < width and y + 1 < height:
                across = _joined(target, inverse_depth, c, d, limits)
                down = _joined(target, inverse_depth, b, d, limits)
                p, q = _corner(target, inverse_depth, a), _corner(target, inverse_depth, b)
                r, s = _corner(target, inverse_depth, c), _corner(target, inverse_depth, d)
                both = right and below and across and down
                if right and below:
                    _draw((p, q, r), False, rows, source, front)
                if across and down:
                    _draw((s, r, q), False, rows, source, front)
                # These two reach over the diagonal that the others leave.
                if right and down and not both:
                    _draw((q, s, p), False, rows, source, front)
                if below and across and not both:
                    _draw((r, p, s), False, rows, source, front)
            inner = right and below and x > 0 and y > 0
            if not (
                inner
                and _joined(target, inverse_depth, a, (y, x - 1), limits)
                and _joined(target, inverse_depth, a, (y - 1, x), limits)
            ):
                _draw_footprint(target, inverse_depth, a, limits, rows, source, front)


@kernel
def _count_steps(inverse_depth: F32, steps: I32, distance: I16) -> None:
    """Count ``steps`` (K, 2) from each pixel to the next known one: 0 at known pixels, -1 for none."""
    height, width = inverse_depth.shape
    for k in range(steps.shape[0]):
        dy, dx = steps[k]
        # From where the step leads to where it comes from.
        for i in range(height):
            y = height - 1 - i if dy > 0 or (dy == 0 and dx > 0) else i
            for j in range(width):
                x = width - 1 - j if dx > 0 else j
                v, u = y + dy, x + dx
                if not np.isnan(inverse_depth[y, x]):
                    distance[k, y, x] = 0
                elif 0 <= v < height and 0 <= u < width and distance[k, v, u] >= 0:
                    distance[k, y, x] = distance[k, v, u] + 1
                else:
                    distance[k, y, x] = -1


DIRECTIONS = np.array(
    [(a, b) for a in range(-2, 3) for b in range(-2, 3) if np.gcd(a, b) == 1], dtype=np.int32
)
"""Sixteen directions (down, right) in which known pixels around a hole are searched."""


def distances_to_known(inverse_depth: F32) -> I16:
    """Steps (16, H, W) from each pixel to the next known one by direction; 0 at known pixels, -1 for none."""
    distance = np.empty((len(DIRECTIONS), *inverse_depth.shape), dtype=np.int16)
    _count_steps(inverse_depth, DIRECTIONS, distance)
    return distance


def forward_map(
    target_xy: F64 | F32, inverse_depth: F64 | F32, *, size: tuple[int, int], step: float = np.inf,
    threads: int = 1,
) -> tuple[F32, F32]:  # fmt: skip
    """Position of an image that each pixel of another view shows, and its inverse depth; NaN for none."""
    # `target_xy` (h, w, 2): position of each pixel in the view; `inverse_depth` (h, w): larger is in front,
    # in any unit. Pixels are corners of small triangles. Neighbours belong to one surface if they come at
    # most 3 px apart, or twice their median distance, and their inverse depth differs by at most `step`. Back
    # faces are not drawn.
    target = np.ascontiguousarray(target_xy, dtype=np.float64)
    near = np.ascontiguousarray(inverse_depth, dtype=np.float32)
    source = np.full((size[1], size[0], 2), np.nan, dtype=np.float32)
    front = np.full((size[1], size[0]), np.nan, dtype=np.float32)
    limits = np.array([step, max(STRETCH, ENLARGED * _median_distance(target))])
    run_in_strips(lambda rows: _draw_surface(target, near, limits, rows, source, front), size[1], threads)
    return np.clip(source, 0.0, np.array(near.shape[::-1], np.float32) - 1.0, out=source), front


def _median_distance(target: F64) -> float:
    """Median distance (px, along either axis) of neighbouring pixels in the view; 0 without any."""
    pairs = (target[:, 1:], target[:, :-1]), (target[1:], target[:-1])
    apart = [np.abs(a[::SPARSE, ::SPARSE] - b[::SPARSE, ::SPARSE]).max(axis=2).ravel() for a, b in pairs]
    distances = np.concatenate(apart)
    known = distances[np.isfinite(distances)]
    return float(np.median(known)) if len(known) else 0.0


def sample(image: ArrayLike, source_xy: F32, *, threads: int = 1) -> F32:
    """Sample an image (h, w, C) at pixels (H, W, 2) by cubic convolution, NaN outside."""
    levels = np.ascontiguousarray(image, dtype=np.float32)
    places = np.ascontiguousarray(source_xy, dtype=np.float64)
    out = np.empty((*places.shape[:2], levels.shape[2]), dtype=np.float32)

    def work(rows: tuple[int, int]) -> None:
        # Adjacent positions may belong to different surfaces.
        sample_cubic(levels, places[slice(*rows)], False, out[slice(*rows)])

    run_in_strips(work, len(out), threads)
    return out


def known_around(inverse_depth: F32, distance: I16) -> Iterator[tuple[I64, tuple[I64, I64], I64]]:
    """By direction: the holes with a known pixel there, by number, that pixel, and its squared distance."""
    y, x = np.nonzero(np.isnan(inverse_depth))
    for (down, right), steps in zip(DIRECTIONS.tolist(), distance, strict=True):
        hole = np.flatnonzero(steps[y, x] > 0)
        n = steps[y[hole], x[hole]].astype(np.int64)
        yield hole, (y[hole] + n * down, x[hole] + n * right), n * n * (down**2 + right**2)


def fill_holes(rgb: F32, inverse_depth: F32, *, step: float) -> F32:
    """Fill holes (NaN inverse depth) with the background around them: occluded surfaces are background."""
    # The nearest known pixels in sixteen directions, at most `step` or 0.4 of the range above the smallest
    # inverse depth (a single far pixel may be an outlier), are averaged with weights 1 / distance^2.
    background_fraction = 0.4
    holes, distance = np.isnan(inverse_depth), distances_to_known(inverse_depth)
    count = int(holes.sum())
    least, most = np.full(count, np.inf), np.full(count, -np.inf)
    for hole, at, _ in known_around(inverse_depth, distance):
        least[hole] = np.minimum(least[hole], inverse_depth[at])
        most[hole] = np.maximum(most[hole], inverse_depth[at])
    with np.errstate(invalid="ignore", divide="ignore"):
        behind = least + np.maximum(step, background_fraction * (most - least))
        colors, total = np.zeros((count, rgb.shape[2])), np.zeros(count)
        for hole, at, squared in known_around(inverse_depth, distance):
            weight = np.where(inverse_depth[at] > behind[hole], 0.0, 1.0 / squared)
            total[hole] += weight
            colors[hole] += weight[:, None] * rgb[at]
        filled = rgb.copy()
        filled[holes] = colors / total[:, None]
    return filled
