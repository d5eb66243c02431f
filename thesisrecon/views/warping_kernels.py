"""Compiled loops of forward warping; each has a plain twin in the tests."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F32, F64, I16, I32
from thesisrecon.geometry.raster import cubic_weights

SLACK = 1e-7
"""Barycentric distance by which a triangle reaches beyond its edges, so that no rounding opens a crack."""

BEHIND = 0.4
"""Around a hole what is in this farther part of the range of inverse depth is behind it: a single far pixel is not
all there is."""

LEAST_AREA = 1e-9
"""Twice the area (px^2) of the least triangle that is drawn."""


@njit(cache=True, nogil=True)
def _joined(target: F64, inverse_depth: F32, a: tuple[int, int], b: tuple[int, int], limits: F64) -> bool:
    """Whether two neighbouring pixels are of one surface; False where one of them is nowhere."""
    # Comparisons with NaN are false.
    near = abs(inverse_depth[a] - inverse_depth[b]) <= limits[0]
    dx, dy = target[a[0], a[1], 0] - target[b[0], b[1], 0], target[a[0], a[1], 1] - target[b[0], b[1], 1]
    return bool(near and abs(dx) <= limits[1] and abs(dy) <= limits[1])


@njit(cache=True, nogil=True)
def _draw_triangle(
    target: F64,
    inverse_depth: F32,
    corners: tuple[int, int, int, int, int, int],
    rows: tuple[int, int],
    source: F32,
    front: F32,
) -> None:
    """Draw the triangle of three source pixels (y, x, y, x, y, x), clockwise in the photograph; what is seen
    from behind is not drawn."""
    ya, xa, yb, xb, yc, xc = corners
    ax, ay = target[ya, xa, 0], target[ya, xa, 1]
    bx, by = target[yb, xb, 0] - ax, target[yb, xb, 1] - ay
    cx, cy = target[yc, xc, 0] - ax, target[yc, xc, 1] - ay
    area = bx * cy - by * cx
    if area < LEAST_AREA:
        return
    low_y, high_y = min(0.0, by, cy) + ay - SLACK, max(0.0, by, cy) + ay + SLACK
    low_x, high_x = min(0.0, bx, cx) + ax - SLACK, max(0.0, bx, cx) + ax + SLACK
    na = inverse_depth[ya, xa]
    nb, nc = inverse_depth[yb, xb] - na, inverse_depth[yc, xc] - na
    first, last = max(int(np.ceil(low_y)), rows[0]), min(int(np.floor(high_y)) + 1, rows[1])
    left, right = max(int(np.ceil(low_x)), 0), min(int(np.floor(high_x)) + 1, front.shape[1])
    for y in range(first, last):
        for x in range(left, right):
            px, py = x - ax, y - ay
            b, c = (px * cy - py * cx) / area, (bx * py - by * px) / area
            if b < -SLACK or c < -SLACK or b + c > 1.0 + SLACK:
                continue
            near = np.float32(na + b * nb + c * nc)
            # The comparison is false only where something nearer is there.
            if front[y, x] >= near:
                continue
            front[y, x] = near
            source[y, x, 0] = xa + b * (xb - xa) + c * (xc - xa)
            source[y, x, 1] = ya + b * (yb - ya) + c * (yc - ya)


@njit(cache=True, nogil=True)
def _slope(
    target: F64, inverse_depth: F32, at: tuple[int, int], step: tuple[int, int], limits: F64, out: F64
) -> int:
    """Change of place and inverse depth (3,) per pixel towards ``step``, from the neighbours of the same surface;
    how many of the two these are."""
    height, width = inverse_depth.shape
    ahead, behind = (at[0] + step[0], at[1] + step[1]), (at[0] - step[0], at[1] - step[1])
    has_ahead = ahead[0] < height and ahead[1] < width and _joined(target, inverse_depth, at, ahead, limits)
    has_behind = behind[0] >= 0 and behind[1] >= 0 and _joined(target, inverse_depth, at, behind, limits)
    to, fro = (ahead if has_ahead else at), (behind if has_behind else at)
    count = int(has_ahead) + int(has_behind)
    for k in range(2):
        out[k] = (target[to[0], to[1], k] - target[fro[0], fro[1], k]) / max(count, 1)
    out[2] = (inverse_depth[to] - inverse_depth[fro]) / max(count, 1)
    return count


@njit(cache=True, nogil=True)
def _draw_footprint(
    surface: tuple[F64, F32],
    at: tuple[int, int],
    limits: F64,
    rows: tuple[int, int],
    picture: tuple[F32, F32],
) -> None:
    """Draw what a pixel covers, half a pixel to each side, moved as its neighbours are."""
    target, inverse_depth = surface
    source, front = picture
    across, down = np.empty(3), np.empty(3)
    n_across = _slope(target, inverse_depth, at, (0, 1), limits, across)
    n_down = _slope(target, inverse_depth, at, (1, 0), limits, down)
    if n_across == 2 and n_down == 2:
        return
    # A pixel without neighbours keeps its shape, as far as it is known.
    if n_across == 0:
        across[0], across[1] = (down[1], -down[0]) if n_down else (1.0, 0.0)
    if n_down == 0:
        down[0], down[1] = -across[1], across[0]
    area = across[0] * down[1] - across[1] * down[0]
    if area < LEAST_AREA:
        return
    tx, ty, near = target[at[0], at[1], 0], target[at[0], at[1], 1], inverse_depth[at]
    reach_x = 0.5 * (abs(across[0]) + abs(down[0])) + SLACK
    reach_y = 0.5 * (abs(across[1]) + abs(down[1])) + SLACK
    first, last = max(int(np.ceil(ty - reach_y)), rows[0]), min(int(np.floor(ty + reach_y)) + 1, rows[1])
    left, right = max(int(np.ceil(tx - reach_x)), 0), min(int(np.floor(tx + reach_x)) + 1, front.shape[1])
    for y in range(first, last):
        for x in range(left, right):
            px, py = x - tx, y - ty
            u = (px * down[1] - py * down[0]) / area
            v = (across[0] * py - across[1] * px) / area
            if abs(u) > 0.5 + SLACK or abs(v) > 0.5 + SLACK:
                continue
            here = np.float32(near + u * across[2] + v * down[2])
            if front[y, x] >= here:
                continue
            front[y, x] = here
            source[y, x, 0] = min(max(at[1] + u, 0.0), inverse_depth.shape[1] - 1.0)
            source[y, x, 1] = min(max(at[0] + v, 0.0), inverse_depth.shape[0] - 1.0)


@njit(cache=True, nogil=True)
def _beside(target: F64, a: tuple[int, int], reach: float, rows: tuple[int, int]) -> bool:
    """Whether nothing that four pixels make can be seen in the rows: all lie farther from these on one side
    than a pixel and its neighbours of one surface reach."""
    least, most = np.inf, -np.inf
    for y in range(a[0], min(a[0] + 2, target.shape[0])):
        for x in range(a[1], min(a[1] + 2, target.shape[1])):
            # A comparison with NaN is false.
            least = target[y, x, 1] if target[y, x, 1] < least else least
            most = target[y, x, 1] if target[y, x, 1] > most else most
    return bool(most < rows[0] - reach - 1.0 or least > rows[1] + reach)


@njit(cache=True, nogil=True)
def draw_surface(
    target: F64, inverse_depth: F32, limits: F64, rows: tuple[int, int], source: F32, front: F32
) -> None:
    """Draw the surface of a photograph's pixels into rows [first, last) of another view, nearest in front.

    ``target`` (h, w, 2) px where each pixel comes to lie and ``inverse_depth`` (h, w), NaN = nowhere; ``limits``
    (2,) greatest differences of inverse depth and of place (px) between neighbours of one surface. ``source``
    (H, W, 2) px of the photograph seen at each pixel and ``front`` (H, W) its inverse depth, NaN where none.

    Four pixels around a point are two triangles, three of which hang together one; at cuts and borders every
    pixel covers half a pixel to each side. Of equally near ones the first stays.
    """
    height, width = inverse_depth.shape
    for y in range(height):
        for x in range(width):
            a = (y, x)
            # What is nowhere has a NaN among these.
            if np.isnan(inverse_depth[a] + target[y, x, 0] + target[y, x, 1]):
                continue
            if _beside(target, a, limits[1], rows):
                continue
            right = x + 1 < width and _joined(target, inverse_depth, a, (y, x + 1), limits)
            below = y + 1 < height and _joined(target, inverse_depth, a, (y + 1, x), limits)
            if x + 1 < width and y + 1 < height:
                across = _joined(target, inverse_depth, (y + 1, x), (y + 1, x + 1), limits)
                down = _joined(target, inverse_depth, (y, x + 1), (y + 1, x + 1), limits)
                corner_a, corner_d = right and below, across and down
                if corner_a:
                    _draw_triangle(target, inverse_depth, (y, x, y, x + 1, y + 1, x), rows, source, front)
                if corner_d:
                    _draw_triangle(
                        target, inverse_depth, (y + 1, x + 1, y + 1, x, y, x + 1), rows, source, front
                    )
                # These two reach over the diagonal that the others leave.
                if right and down and not (corner_a and corner_d):
                    _draw_triangle(target, inverse_depth, (y, x + 1, y + 1, x + 1, y, x), rows, source, front)
                if below and across and not (corner_a and corner_d):
                    _draw_triangle(target, inverse_depth, (y + 1, x, y, x, y + 1, x + 1), rows, source, front)
            inner = right and below and x > 0 and y > 0
            if not (
                inner
                and _joined(target, inverse_depth, a, (y, x - 1), limits)
                and _joined(target, inverse_depth, a, (y - 1, x), limits)
            ):
                _draw_footprint((target, inverse_depth), a, limits, rows, (source, front))


@njit(cache=True, nogil=True)
def sample_at(image: F32, source: F32, rows: tuple[int, int], out: F32) -> None:
    """Cubic samples of ``image`` (h, w, C) at ``source`` (H, W, 2) px into rows of ``out`` (H, W, C); beyond
    the border linear ones, NaN where the place or one of the pixels around it is NaN."""
    height, width, channels = image.shape
    wx, wy = np.empty(4, np.float32), np.empty(4, np.float32)
    for y in range(rows[0], rows[1]):
        for x in range(source.shape[1]):
            u, v = source[y, x, 0], source[y, x, 1]
            if not (u >= -0.5 and v >= -0.5 and u <= width - 0.5 and v <= height - 0.5):
                out[y, x] = np.nan
                continue
            x0 = min(max(int(np.floor(u)), 0), max(width - 2, 0))
            y0 = min(max(int(np.floor(v)), 0), max(height - 2, 0))
            inner = x0 >= 1 and y0 >= 1 and x0 + 2 < width and y0 + 2 < height
            value = np.float32(np.nan)
            if inner:
                cubic_weights(u - x0, wx)
                cubic_weights(v - y0, wy)
            for c in range(channels):
                if inner:
                    value = np.float32(0.0)
                    for k in range(4):
                        row = image[y0 - 1 + k]
                        value += wy[k] * (
                            wx[0] * row[x0 - 1, c]
                            + wx[1] * row[x0, c]
                            + wx[2] * row[x0 + 1, c]
                            + wx[3] * row[x0 + 2, c]
                        )
                if not inner or np.isnan(value):
                    value = _linear(image, u, v, x0, y0, c)
                out[y, x, c] = value


@njit(cache=True, nogil=True)
def _linear(image: F32, u: float, v: float, x0: int, y0: int, c: int) -> np.float32:
    """Bilinear, of the border pixel beyond it."""
    x1, y1 = min(x0 + 1, image.shape[1] - 1), min(y0 + 1, image.shape[0] - 1)
    s, t = min(max(u - x0, 0.0), 1.0), min(max(v - y0, 0.0), 1.0)
    top = image[y0, x0, c] + s * (image[y0, x1, c] - image[y0, x0, c])
    bottom = image[y1, x0, c] + s * (image[y1, x1, c] - image[y1, x0, c])
    return np.float32(top + t * (bottom - top))


@njit(cache=True, nogil=True)
def distances_to_known(inverse_depth: F32, steps: I32, distance: I16) -> None:
    """Into ``distance`` (K, H, W): how many of each of the ``steps`` (K, 2) (down, right) lead from a pixel
    to the next whose inverse depth (H, W) is not NaN; 0 there, -1 where none does."""
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


@njit(cache=True, nogil=True)
def fill_from_behind(
    rgb: F32, inverse_depth: F32, steps: I32, distance: I16, limits: tuple[float, float], out: F32
) -> None:
    """Give the holes of ``rgb`` (H, W, C) in ``out`` (H, W, C) the colours of what is behind them.

    Of the known pixels that the ``steps`` lead to within ``limits[1]`` px those count whose ``inverse_depth``
    (H, W) is at most ``limits[0]``, or ``BEHIND`` of its range, above the least: the mean of their colours
    weighted by 1 / distance^2. NaN where no step leads anywhere; what is no hole is left alone.
    """
    reach = np.empty(steps.shape[0])
    colors = np.empty(rgb.shape[2])
    for y in range(rgb.shape[0]):
        for x in range(rgb.shape[1]):
            if not np.isnan(inverse_depth[y, x]):
                continue
            least, most, total = np.inf, -np.inf, 0.0
            colors[:] = 0.0
            for k in range(steps.shape[0]):
                n = distance[k, y, x]
                reach[k] = n * np.hypot(steps[k, 0], steps[k, 1]) if n > 0 else np.nan
                if reach[k] <= limits[1]:
                    least = min(least, inverse_depth[y + n * steps[k, 0], x + n * steps[k, 1]])
                    most = max(most, inverse_depth[y + n * steps[k, 0], x + n * steps[k, 1]])
            behind = least + max(limits[0], BEHIND * (most - least))
            for k in range(steps.shape[0]):
                if not reach[k] <= limits[1]:
                    continue
                n = distance[k, y, x]
                v, u = y + n * steps[k, 0], x + n * steps[k, 1]
                if inverse_depth[v, u] > behind:
                    continue
                weight = 1.0 / (reach[k] * reach[k])
                total += weight
                for c in range(colors.size):
                    colors[c] += weight * rgb[v, u, c]
            for c in range(colors.size):
                out[y, x, c] = np.float32(colors[c] / total) if total > 0.0 else np.float32(np.nan)
