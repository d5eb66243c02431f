"""NumPy twins of the kernels of stereo matching and depth estimation."""

import itertools

import numpy as np

from thesisrecon.stereo._plane_kernels import (
    MAX_EXCESS_COST,
    MIN_WINDOW_COVERAGE,
    TEXTURE,
    UNKNOWN,
)
from thesisrecon.stereo.scanline import NO_MATCH, OCCLUDED


def squares(gray):
    """Levels (H, W, 4) of a pixel, its right, lower and lower right neighbours; 0 where one is unknown."""
    level = np.floor(np.clip(gray + np.float32(0.5), 1.0, 255.0))
    padded = np.pad(level, ((0, 1), (0, 1)), constant_values=np.nan)
    four = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]], axis=-1)
    return np.where(np.isfinite(four).all(axis=-1, keepdims=True), four, 0.0)


class Setting:
    """A reference and its neighbours; places (x, y, 1) of inverse depth rho are at H (x, y, 1) + rho e."""

    def __init__(self, gray, others, H, e, offsets, likeness):
        self.gray, self.H, self.e, self.offsets, self.likeness = gray, H, e, offsets, likeness
        self.others = [squares(other) for other in others]

    def window(self, u, v):
        """Weights and levels of the samples of a window."""
        x, y = u + self.offsets[0].astype(int), v + self.offsets[1].astype(int)
        inside = (x >= 0) & (y >= 0) & (x < self.gray.shape[1]) & (y < self.gray.shape[0])
        level = self.gray[np.where(inside, y, v), np.where(inside, x, u)].astype(float)
        inside &= np.isfinite(level)
        level = np.where(inside, level, 0.0)
        apart = np.abs(level - self.gray[v, u]).clip(0, 255).astype(int)
        return np.where(inside, self.likeness[apart], 0.0).astype(float), level

    def costs(self, u, v, plane):
        """1 - weighted NCC with each neighbour, NaN where that does not hold the window."""
        weight, level = self.window(u, v)
        rho = plane[0] + self.offsets.T.astype(float) @ plane[1:]
        x = np.stack([u + self.offsets[0], v + self.offsets[1], np.ones_like(rho)], axis=1).astype(float)
        found = np.full(len(self.others), np.nan)
        for k, four in enumerate(self.others):
            q = x @ self.H[k].T + rho[:, None] * self.e[k]
            centre = self.H[k] @ (u, v, 1.0) + plane[0] * self.e[k]
            if not (q[:, 2] > 0.0).all() or not centre[2] > 0.0:
                continue
            place = q[:, :2] / q[:, 2:]
            at = np.clip(np.floor(place).astype(int), 0, np.array(four.shape[1::-1]) - 1)
            a, b, c, d = four[at[:, 1], at[:, 0]].T
            fx, fy = (place - at).T
            other = (a + fx * (b - a)) * (1.0 - fy) + (c + fx * (d - c)) * fy
            inside = (place >= 0.0).all(axis=1) & (place < np.array(four.shape[1::-1]) - 1).all(axis=1)
            held = np.where(inside & (a > 0.0), weight, 0.0)
            if held.sum() >= MIN_WINDOW_COVERAGE * weight.sum():
                share = held / held.sum()
                one, two = level - share @ level, other - share @ other
                spread = (share @ one**2 + TEXTURE) * (share @ two**2 + TEXTURE)
                found[k] = max(1.0 - share @ (one * two) / np.sqrt(spread), 0.0)
        return found

    def cost(self, u, v, plane):
        """That of the two best neighbours, the second at most ``HIDDEN`` above the first."""
        found = np.sort(self.costs(u, v, plane)) if plane[0] > 0.0 else np.full(1, np.nan)
        found = np.append(found[np.isfinite(found)], [UNKNOWN, UNKNOWN])
        return found[0] + 0.5 * min(found[1] - found[0], MAX_EXCESS_COST) if found[0] < UNKNOWN else UNKNOWN

    def motions(self, u, v, rho):
        """Pixels (K,) that places move per unit of inverse depth."""
        q = self.H @ (u, v, 1.0) + rho * self.e
        return np.linalg.norm((self.e[:, :2] - q[:, :2] / q[:, 2:] * self.e[:, 2:]) / q[:, 2:], axis=1)

    def begin(self, planes):
        """Cost (H, W) of planes (H, W, 3)."""
        cost = np.full(self.gray.shape, UNKNOWN)
        for v, u in np.argwhere(np.isfinite(self.gray) & (planes[..., 0] > 0.0)):
            cost[v, u] = self.cost(u, v, planes[v, u].astype(float))
        return cost

    def rate(self, planes, accepted):
        """Least cost, support and slope (H, W)."""
        least, support, slope = np.full(self.gray.shape, UNKNOWN), np.zeros(self.gray.shape, int), None
        slope = np.zeros(self.gray.shape)
        for v, u in np.argwhere(np.isfinite(self.gray) & (planes[..., 0] > 0.0)):
            found = self.costs(u, v, planes[v, u].astype(float))
            good = np.nan_to_num(found, nan=UNKNOWN) <= accepted
            least[v, u] = np.nanmin(np.append(found, UNKNOWN))
            support[v, u] = good.sum()
            slope[v, u] = np.linalg.norm(self.motions(u, v, planes[v, u, 0])[good])
        return least, support, slope


def census(grey):
    padded = np.pad(grey, 2, mode="edge")
    height, width = grey.shape
    bits = np.zeros(grey.shape, np.int64)
    for dy, dx in itertools.product(range(5), range(5)):
        if (dy, dx) != (2, 2):
            bits = bits << 1 | (padded[dy : dy + height, dx : dx + width] < grey)
    return bits.astype(np.int32)


def ones(words):
    """How many bits are set in each of (N,) words."""
    octets = np.ascontiguousarray(words).view(np.uint8).reshape(len(words), -1)
    return np.unpackbits(octets, axis=1).sum(axis=1, dtype=np.int64)


def costs(left, right, first, n, weights, outside):
    """(H, D, W); each side is (census, channels, valid)."""
    height, width = left[0].shape
    out = np.full((height, n, width), outside, np.int64)
    for q, x in itertools.product(range(n), range(width)):
        j = x - first - q
        if not 0 <= j < width:
            continue
        differing = ones(left[0][:, x] ^ right[0][:, j])
        a, b = left[1][:, :, x].astype(np.int64), right[1][:, :, j].astype(np.int64)
        apart = np.abs(a - b)
        colour = np.minimum(apart.sum(axis=0), weights[2])
        known = (left[2][:, x] > 0) & (right[2][:, j] > 0)
        joined = (differing * weights[0] + colour * weights[1]) >> 8
        out[:, q, x] = np.where(known, joined, outside)
    return out


def arm_lengths(channels, valid, tolerance):
    """(4, H, W): left, right, above, below."""
    _, height, width = channels.shape
    out = np.zeros((4, height, width), int)
    for arm, (dy, dx) in enumerate(((0, -1), (0, 1), (-1, 0), (1, 0))):
        for y, x, s in itertools.product(range(height), range(width), (1, 2)):
            v, u = y + s * dy, x + s * dx
            if out[arm, y, x] == s - 1 and 0 <= v < height and 0 <= u < width and valid[v, u]:
                apart = np.abs(channels[:, v, u].astype(int) - channels[:, y, x])
                out[arm, y, x] += bool((apart <= tolerance).all())
    return out


def mean_over_support(volume, arms):
    height, _, width = volume.shape
    out = np.zeros(volume.shape)
    for y, x in itertools.product(range(height), range(width)):
        rows = range(y - arms[2, y, x], y + arms[3, y, x] + 1)
        pieces = [volume[v, :, x - arms[0, v, x] : x + arms[1, v, x] + 1] for v in rows]
        out[y, :, x] = np.concatenate(pieces, axis=1).mean(axis=1)
    return np.floor(out + 0.5)


def path_sum(costs, penalty, step, direction):
    """Least costs (H, D, W) of paths that arrive by ``direction`` (dy, dx); ``penalty(y, x, v, u)``."""
    height, _, width = costs.shape
    out = np.zeros(costs.shape, np.int64)
    dy, dx = direction
    rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
    columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
    for y in rows:
        for x in columns:
            v, u = y - dy, x - dx
            if not (0 <= v < height and 0 <= u < width):
                out[y, :, x] = costs[y, :, x]
                continue
            before = out[v, :, u]
            padded = np.pad(before, 1, constant_values=10**6)
            far = before.min() + penalty(y, x, v, u)
            best = np.minimum(np.minimum(padded[:-2], padded[2:]) + step, np.minimum(before, far))
            out[y, :, x] = costs[y, :, x] + best - before.min()
    return out


def most_likely_row(costs, first, prices, above):
    """(cost, discontinuities) of the best correspondence of a row, by recursion over whole solutions."""
    n, width = costs.shape
    hidden, border, along, across = prices
    start = {}
    for q in range(n):
        d = first + q
        i, j = max(d, 0), max(-d, 0)
        if i <= width and j <= width:
            start[i, j] = ((i + j) * border, 0)
    table = {}

    def enter(key, value):
        if key not in table or value < table[key]:
            table[key] = value

    best = None
    for i, j in itertools.product(range(width + 1), range(width + 1)):
        q = i - j - first
        if not 0 <= q < n:
            continue
        if (i, j) in start:
            enter((i, j, 0), start[i, j])
        for state in (0, 1, 2):
            moves = {0: (1, 1), 1: (1, 0), 2: (0, 1)}
            a, b = i - moves[state][0], j - moves[state][1]
            if a < 0 or b < 0 or i == 0 or j == 0:
                continue
            for before in (0, 1, 2):
                if (a, b, before) not in table:
                    continue
                cost, breaks = table[a, b, before]
                breaks += along * (before != state)
                up, aside = above[0][i - 1], above[1][j - 1]
                if state == 0:
                    if costs[q, i - 1] == NO_MATCH:
                        continue
                    cost += int(costs[q, i - 1])
                    breaks += across * sum(1 for d in (up, aside) if d not in (OCCLUDED, i - j))
                else:
                    cost += hidden
                    breaks += across * ((up if state == 1 else aside) != OCCLUDED)
                enter((i, j, state), (cost, breaks))
        if width in (i, j):
            for state in (0, 1, 2):
                if (i, j, state) in table:
                    cost, breaks = table[i, j, state]
                    end = (cost + (2 * width - i - j) * border, breaks)
                    best = end if best is None or end < best else best
    return best
