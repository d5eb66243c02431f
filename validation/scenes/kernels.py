"""The compiled core of the ray caster: see :mod:`validation.scenes.raycast` for what it computes.

A surface is a row of numbers (see ``build_world``), a ray six numbers (origin, unit direction), so that a
kernel allocates nothing.
"""

from __future__ import annotations

from math import atan2, log2, pi, sqrt
from typing import TypeAlias

import numpy as np

from thesisrecon.arrays import F32, F64, I64
from validation.scenes.procedural import compiled

PLANE, CYLINDER = 0, 1
LEVELS = 4
BLOCK = 16
FAR = 1e9
# heights, their offset, map width, map rows, block maxima, blocks per row, their offset
Pool: TypeAlias = tuple[F32, int, int, int, F32, int, int]
# the fields of World in their order
Packed: TypeAlias = tuple[I64, F64, F64, I64, F32, F32, F32, F64]


@compiled
def _height(heights: F32, start: int, width: int, rows: int, x: float, y: float) -> float:
    x = min(max(x, 0.0), width - 1.001)
    y = min(max(y, 0.0), rows - 1.001)
    c, r = int(x), int(y)
    fx, fy = x - c, y - r
    k = start + r * width + c
    top = heights[k] * (1.0 - fx) + heights[k + 1] * fx
    low = heights[k + width] * (1.0 - fx) + heights[k + width + 1] * fx
    return float(top * (1.0 - fy) + low * fy)


@compiled
def _chart(s: F64, kind: int, px: float, py: float, pz: float) -> tuple[float, float, float]:
    """(u, v, h) of a world point."""
    dx, dy, dz = px - s[0], py - s[1], pz - s[2]
    a = dx * s[3] + dy * s[4] + dz * s[5]
    v = dx * s[6] + dy * s[7] + dz * s[8]
    b = dx * s[9] + dy * s[10] + dz * s[11]
    if kind == 0:
        return a, v, b
    turn = atan2(b, a) / (2.0 * pi)
    if turn < 0.0:
        turn += 1.0
    return turn * s[12], v, sqrt(a * a + b * b) - s[14]


@compiled
def _gap(s: F64, kind: int, ray: F64, t: float, pool: Pool) -> float:
    u, v, h = _chart(s, kind, ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5])
    return h - _height(pool[0], pool[1], pool[2], pool[3], (u + s[20]) / s[19], (v + s[21]) / s[19])


@compiled
def _clipped(span: tuple[float, float], at: float, speed: float, size: float) -> tuple[float, float]:
    """Part of a span of t in which at + t speed lies between 0 and ``size``; empty = (1, 0)."""
    if abs(speed) < 1e-12:
        return (1.0, 0.0) if at < 0.0 or at > size else span
    one, two = -at / speed, (size - at) / speed
    return max(span[0], min(one, two)), min(span[1], max(one, two))


@compiled
def _plane_interval(s: F64, ray: F64, any_side: bool) -> tuple[float, float, float]:
    """Part of the ray inside slab and rectangle, and a bound of the closing speed; empty = (1, 0, 1)."""
    dh = ray[3] * s[9] + ray[4] * s[10] + ray[5] * s[11]
    h0 = (ray[0] - s[0]) * s[9] + (ray[1] - s[1]) * s[10] + (ray[2] - s[2]) * s[11]
    if dh > -1e-9 and (not any_side or s[26] > 0.0 or h0 < s[16] or h0 > s[17] or dh < 1e-9):
        return 1.0, 0.0, 1.0
    enter, leave = 0.0, FAR
    if dh < 0.0:
        enter, leave = max(0.0, (s[17] - h0) / dh), (s[16] - h0) / dh
    else:
        leave = (s[17] - h0) / dh
    lateral = 0.0
    for axis in range(2):
        k = 3 + 3 * axis
        speed = ray[3] * s[k] + ray[4] * s[k + 1] + ray[5] * s[k + 2]
        at = (ray[0] - s[0]) * s[k] + (ray[1] - s[1]) * s[k + 1] + (ray[2] - s[2]) * s[k + 2]
        lateral += speed * speed
        enter, leave = _clipped((enter, leave), at, speed, s[12 + axis])
    return enter, leave, sqrt(lateral)


@compiled
def _cylinder_interval(s: F64, ray: F64) -> tuple[float, float, float]:
    """Part of the ray inside the shell and between the ends; the far half of the shell is left out."""
    dv = ray[3] * s[6] + ray[4] * s[7] + ray[5] * s[8]
    ox, oy, oz = ray[0] - s[0], ray[1] - s[1], ray[2] - s[2]
    ov = ox * s[6] + oy * s[7] + oz * s[8]
    da, oa = ray[3] * s[3] + ray[4] * s[4] + ray[5] * s[5], ox * s[3] + oy * s[4] + oz * s[5]
    db, ob = ray[3] * s[9] + ray[4] * s[10] + ray[5] * s[11], ox * s[9] + oy * s[10] + oz * s[11]
    a, b = da * da + db * db, oa * da + ob * db
    if a < 1e-12:
        return 1.0, 0.0, 1.0
    outer, inner = s[14] + s[17], max(0.0, s[14] + s[16])
    d = b * b - a * (oa * oa + ob * ob - outer * outer)
    if d <= 0.0:
        return 1.0, 0.0, 1.0
    enter, leave = (-b - sqrt(d)) / a, (-b + sqrt(d)) / a
    d = b * b - a * (oa * oa + ob * ob - inner * inner)
    if d > 0.0:
        leave = (-b - sqrt(d)) / a
    enter, leave = _clipped((enter, leave), ov, dv, s[13])
    return max(0.0, enter), leave, 1.0


@compiled
def _cross(s: F64, kind: int, ray: F64, bracket: tuple[float, float, float, float], pool: Pool) -> float:
    """The crossing between (t, gap > 0) and (t, gap <= 0): regula falsi, the Illinois way."""
    low, high, above, below = bracket
    side = 0
    for _ in range(40):
        if high - low < 2e-6:
            break
        t = low + (high - low) * above / (above - below)
        gap = _gap(s, kind, ray, t, pool)
        if abs(gap) < 1e-7:
            return t
        if gap > 0.0:
            low, above = t, gap
            below = 0.5 * below if side == 1 else below
            side = 1
        else:
            high, below = t, gap
            above = 0.5 * above if side == -1 else above
            side = -1
    return 0.5 * (low + high)


@compiled
def _leap(s: F64, ray: F64, t: float, speeds: tuple[float, float, float], pool: Pool) -> float:
    """Return the step of a ray above the highest point of its block; 0 if it may meet the relief."""
    u, v, h = _chart(s, 0, ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5])
    x, y = (u + s[20]) / s[19], (v + s[21]) / s[19]
    c, r = int(max(x, 0.0)) // BLOCK, int(max(y, 0.0)) // BLOCK
    c, r = min(c, pool[5] - 1), min(r, (pool[3] - 1) // BLOCK)
    over = h - pool[4][pool[6] + r * pool[5] + c] - 1e-5
    if over <= 0.0:
        return 0.0
    reach = FAR if speeds[2] >= 0.0 else -over / speeds[2]
    for axis in range(2):
        at, cell, speed = (x, c, speeds[0]) if axis == 0 else (y, r, speeds[1])
        if speed > 1e-9:
            reach = min(reach, ((cell + 1) * BLOCK - at) * s[19] / speed)
        elif speed < -1e-9:
            reach = min(reach, (cell * BLOCK - at) * s[19] / speed)
    return max(reach, 0.0) + 1e-6


@compiled
def _march(s: F64, kind: int, ray: F64, span: tuple[float, float, float], pool: Pool) -> float:
    """First t in the span where the ray goes below the relief; FAR where it does not."""
    t, leave, lateral = span
    gap = _gap(s, kind, ray, t, pool)
    if gap <= 0.0:
        # Below at the entry: the side of a block cut by the border of its chart, or the start of a shadow
        # ray.
        return FAR
    bound = 1.0 + s[18] * max(lateral, 0.3)
    shortest = 0.5 * s[19] / max(lateral, 0.25)
    speeds = (0.0, 0.0, 0.0)
    if kind == 0:
        speeds = (
            ray[3] * s[3] + ray[4] * s[4] + ray[5] * s[5],
            ray[3] * s[6] + ray[4] * s[7] + ray[5] * s[8],
            ray[3] * s[9] + ray[4] * s[10] + ray[5] * s[11],
        )
    while t < leave:
        leap = _leap(s, ray, t, speeds, pool) if kind == 0 else 0.0
        ahead = min(leave, t + max(leap, max(gap / bound, shortest)))
        after = _gap(s, kind, ray, ahead, pool)
        if after <= 0.0:
            return _cross(s, kind, ray, (t, ahead, gap, after), pool)
        if ahead >= leave:
            break
        t, gap = ahead, after
    return FAR


@compiled
def _misses(sphere: F64, ray: F64, nearest: float) -> bool:
    mx, my, mz = sphere[0] - ray[0], sphere[1] - ray[1], sphere[2] - ray[2]
    along = mx * ray[3] + my * ray[4] + mz * ray[5]
    reach = sphere[3]
    off = mx * mx + my * my + mz * mz - along * along
    return bool(off > reach * reach or along < -reach or along - reach > nearest)


@compiled
def _hit(s: F64, kind: int, ray: F64, nearest: float, pool: Pool, shadow: bool) -> float:
    """t of the first crossing of one surface, FAR where there is none before ``nearest``."""
    span = _cylinder_interval(s, ray) if kind == 1 else _plane_interval(s, ray, shadow)
    if span[0] > span[1] or span[0] > nearest:
        return FAR
    t = span[0] if s[26] > 0.0 and kind == 0 else _march(s, kind, ray, span, pool)
    if s[15] > 0.0 and t < FAR:
        u, v, _ = _chart(s, kind, ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5])
        du, dv = u - 0.5 * s[12], v - 0.5 * s[13]
        if du * du + dv * dv > s[15] * s[15]:
            return FAR
    return t


@compiled
def _first(world: Packed, ray: F64, shadow: bool) -> tuple[float, int]:
    """Nearest hit (t, surface), or (FAR, -1); for a shadow any hit."""
    kind, numbers, groups, layout, _, heights, highest, _ = world
    nearest, index = FAR, -1
    for g in range(groups.shape[0]):
        if _misses(groups[g], ray, nearest):
            continue
        for k in range(int(groups[g, 4]), int(groups[g, 5])):
            s = numbers[k]
            if _misses(s[22:26], ray, nearest):
                continue
            m = kind[k, 1]
            pool = (heights, layout[m, 0], layout[m, 5], layout[m, 4], highest, layout[m, 2], layout[m, 1])
            t = _hit(s, kind[k, 0], ray, nearest, pool, shadow)
            if t < nearest:
                nearest, index = t, k
                if shadow:
                    return nearest, index
    return nearest, index


@compiled
def _texture(colours: F32, layout: I64, x: float, y: float, level: int, out: F64) -> None:
    """Bilinear sample of the five channels of one level at level-0 sample coordinates."""
    scale = 1.0 / (1 << level)
    start, rows, width = layout[3 + 3 * level], layout[4 + 3 * level], layout[5 + 3 * level]
    x = min(max((x + 0.5) * scale - 0.5, 0.0), width - 1.001)
    y = min(max((y + 0.5) * scale - 0.5, 0.0), rows - 1.001)
    c, r = int(x), int(y)
    fx, fy = x - c, y - r
    k = start + r * width + c
    for i in range(5):
        top = colours[k, i] * (1.0 - fx) + colours[k + 1, i] * fx
        low = colours[k + width, i] * (1.0 - fx) + colours[k + width + 1, i] * fx
        out[i] = top * (1.0 - fy) + low * fy


@compiled
def _normal(s: F64, kind: int, point: F64, slopes: tuple[float, float], out: F64) -> None:
    """Unit normal of the relief: base normal minus the slopes along the chart's axes."""
    for i in range(3):
        out[i] = s[9 + i]
    u0, u1, u2 = s[3], s[4], s[5]
    if kind == 1:
        dx, dy, dz = point[0] - s[0], point[1] - s[1], point[2] - s[2]
        v = dx * s[6] + dy * s[7] + dz * s[8]
        rx, ry, rz = dx - v * s[6], dy - v * s[7], dz - v * s[8]
        r = max(1e-9, sqrt(rx * rx + ry * ry + rz * rz))
        out[0], out[1], out[2] = rx / r, ry / r, rz / r
        u0, u1, u2 = (
            s[7] * out[2] - s[8] * out[1],
            s[8] * out[0] - s[6] * out[2],
            s[6] * out[1] - s[7] * out[0],
        )
    out[0] -= slopes[0] * u0 + slopes[1] * s[6]
    out[1] -= slopes[0] * u1 + slopes[1] * s[7]
    out[2] -= slopes[0] * u2 + slopes[1] * s[8]
    n = sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    for i in range(3):
        out[i] /= n


@compiled
def _sample(world: Packed, ray: F64, footprint: float, work: F64, jitter: tuple[float, float]) -> float:
    """Colour of a ray into work[:3]; returns t (FAR = sky). ``footprint``: sample's width at distance 1."""
    kinds, numbers, _, layout, colours, _, _, sun = world
    t, index = _first(world, ray, False)
    if index < 0:
        up = max(0.0, ray[5])
        work[0], work[1], work[2] = 0.62 - 0.30 * up, 0.70 - 0.22 * up, 0.80 - 0.08 * up
        return FAR
    s, m, kind = numbers[index], kinds[index, 1], kinds[index, 0]
    point = work[5:8]
    for i in range(3):
        point[i] = ray[i] + t * ray[3 + i]
    u, v, _ = _chart(s, kind, point[0], point[1], point[2])
    texture, normal = work[8:13], work[13:16]
    level = min(LEVELS - 1, max(0, int(log2(max(1.0, t * footprint / s[19])) + 0.5)))
    _texture(colours, layout[m], (u + s[20]) / s[19], (v + s[21]) / s[19], level, texture)
    bump = 0.4 if s[26] > 0.0 else 1.0
    _normal(s, kind, point, (bump * texture[3], bump * texture[4]), normal)
    beam = work[16:22]
    for i in range(3):
        beam[i] = point[i] + 2e-3 * normal[i] - 1e-3 * ray[3 + i]
    # The sun's disc, widened by haze: the samples of a pixel look at different places of it.
    beam[3], beam[4], beam[5] = (
        sun[0] + 0.007 * jitter[0],
        sun[1] - 0.005 * jitter[0],
        sun[2] + 0.007 * jitter[1],
    )
    facing = normal[0] * sun[0] + normal[1] * sun[1] + normal[2] * sun[2]
    light = 0.0
    if facing > 0.0:
        _, blocker = _first(world, beam, True)
        light = facing if blocker < 0 else 0.0
    sky = 0.55 + 0.45 * normal[2]
    fill = max(0.0, 0.35 * normal[0] - 0.75 * normal[1] + 0.55 * normal[2])
    for i in range(3):
        tone = 1.25 - 0.1 * i
        work[i] = texture[i] * (tone * light + (0.34 + 0.03 * i) * sky + 0.26 * fill)
    return t


@compiled
def trace_rows(
    world: Packed, camera: F64, samples: tuple[int, int], rays: F64, out: F32, depth: F64, shade: bool
) -> None:
    """Samples (row, col) at pixel ((col + 0.5) / n - 0.5, (row + 0.5) / n - 0.5), n = samples per pixel.

    ``rays`` are unit directions (H n, W n, 3) in the camera frame of a lens, NaN for none; empty: a pinhole.
    """
    per_pixel, first_row = samples
    f, cx, cy = camera[0], camera[1], camera[2]
    ray, work = np.zeros(6), np.zeros(22)
    ray[0], ray[1], ray[2] = camera[3], camera[4], camera[5]
    R = camera[6:15]
    footprint = 1.0 / (f * per_pixel)
    for row in range(out.shape[0]):
        for col in range(out.shape[1]):
            x = ((col + 0.5) / per_pixel - 0.5 - cx) / f
            y = ((row + first_row + 0.5) / per_pixel - 0.5 - cy) / f
            n, z = sqrt(x * x + y * y + 1.0), 1.0
            if rays.shape[0] > 0:
                x, y, z, n = rays[row, col, 0], rays[row, col, 1], rays[row, col, 2], 1.0
                if x != x:
                    continue
            for i in range(3):
                ray[3 + i] = (R[i] * x + R[3 + i] * y + R[6 + i] * z) / n
            if shade:
                a, b = 2.0 * (col % 2) - 1.0, 2.0 * (row % 2) - 1.0
                jitter = (0.75 * a + 0.25 * b, 0.75 * b - 0.25 * a)
                t = _sample(world, ray, footprint, work, jitter)
                out[row, col, 0], out[row, col, 1], out[row, col, 2] = work[0], work[1], work[2]
            else:
                t, _ = _first(world, ray, False)
            depth[row, col] = t * z / n if t < FAR else 0.0
