"""The compiled loops of dense matching once more, plainly, with NumPy."""

import itertools

import numpy as np

from thesisrecon.stereo.scanline import FORBIDDEN, NOTHING


def census(grey):
    padded = np.pad(grey, 2, mode="edge")
    height, width = grey.shape
    bits = np.zeros(grey.shape, np.int64)
    for dy, dx in itertools.product(range(5), range(5)):
        if (dy, dx) != (2, 2):
            bits = bits << 1 | (padded[dy : dy + height, dx : dx + width] < grey)
    return bits.astype(np.int32)


def bounds(channels):
    padded = np.pad(channels.astype(np.int64), ((0, 0), (0, 0), (1, 1)), mode="edge")
    three = np.stack([channels, (padded[..., :-2] + channels) >> 1, (padded[..., 2:] + channels) >> 1])
    return three.min(axis=0), three.max(axis=0)


def ones(words):
    """How many bits are set in each of (N,) words."""
    octets = np.ascontiguousarray(words).view(np.uint8).reshape(len(words), -1)
    return np.unpackbits(octets, axis=1).sum(axis=1, dtype=np.int64)


def costs(left, right, first, n, weights, outside):
    """(H, D, W); each side is (census, channels, low, high, valid)."""
    height, width = left[0].shape
    out = np.full((height, n, width), outside, np.int64)
    for q, x in itertools.product(range(n), range(width)):
        j = x - first - q
        if not 0 <= j < width:
            continue
        differing = ones(left[0][:, x] ^ right[0][:, j])
        a, b = left[1][:, :, x].astype(np.int64), right[1][:, :, j].astype(np.int64)
        apart = np.abs(a - b)
        if weights[3]:
            one = np.maximum(a - right[3][:, :, j], right[2][:, :, j] - a)
            two = np.maximum(b - left[3][:, :, x], left[2][:, :, x] - b)
            apart = np.maximum(np.minimum(one, two), 0)
        colour = np.minimum(apart.sum(axis=0), weights[2])
        known = (left[4][:, x] > 0) & (right[4][:, j] > 0)
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
                    if costs[q, i - 1] == FORBIDDEN:
                        continue
                    cost += int(costs[q, i - 1])
                    breaks += across * sum(1 for d in (up, aside) if d not in (NOTHING, i - j))
                else:
                    cost += hidden
                    breaks += across * ((up if state == 1 else aside) != NOTHING)
                enter((i, j, state), (cost, breaks))
        if width in (i, j):
            for state in (0, 1, 2):
                if (i, j, state) in table:
                    cost, breaks = table[i, j, state]
                    end = (cost + (2 * width - i - j) * border, breaks)
                    best = end if best is None or end < best else best
    return best
