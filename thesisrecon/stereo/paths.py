"""Compiled semi-global passes: least costs along paths, each row of pixels by vector instructions.

What a change of disparity costs, and the sums of the least path costs under it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from thesisrecon.arrays import I16, U8, U64
from thesisrecon.stereo.cost import Side
from thesisrecon.stereo.cost_kernels import LEVELS

Word8 = tuple[np.uint64, np.uint64, np.uint64, np.uint64, np.uint64, np.uint64, np.uint64, np.uint64]

TOP = 127
"""The dearest match and the largest penalty together, at most: then two paths that meet in a pixel cost no
more than a byte holds."""
BLOCK = 192
"""Rows that go through the horizontal passes together, at most: a multiple of 8."""
TILE = 64
"""Columns that are transposed together: a multiple of 8."""
ODD = np.uint64(0x00FF00FF00FF00FF)
ODD_PAIRS = np.uint64(0x0000FFFF0000FFFF)
ODD_FOURS = np.uint64(0x00000000FFFFFFFF)


@njit(cache=True, nogil=True)
def _jumps_between(
    a: I16, b: I16, largest: np.float32, least: np.float32, scale: np.float32, out: U8
) -> None:
    for x in range(len(out)):
        apart = np.float32(a[x]) - np.float32(b[x])
        apart = -apart if apart < 0 else apart
        jump = largest * scale / (scale + apart)
        out[x] = np.uint8(least if jump < least else jump)


@njit(cache=True, nogil=True, error_model="numpy")
def jump_penalties(grey: I16, largest: np.float32, least: np.float32, scale: np.float32, out: U8) -> None:
    """The penalty of a large change of disparity between neighbours, ``out`` (4, H, W): of (y, x) and its
    neighbour at the left, above, above left and above right.

    It falls with the step of grey between them, ``largest`` / (1 + step / scale), but not below ``least``
    (Hirschmüller 2008, section 2.2).
    """
    height, width = grey.shape
    out[:] = np.uint8(largest)
    for y in range(height):
        _jumps_between(grey[y, 1:], grey[y, : width - 1], largest, least, scale, out[0, y, 1:])
        if y > 0:
            above = grey[y - 1]
            _jumps_between(grey[y], above, largest, least, scale, out[1, y])
            _jumps_between(grey[y, 1:], above[: width - 1], largest, least, scale, out[2, y, 1:])
            _jumps_between(grey[y, : width - 1], above[1:], largest, least, scale, out[3, y, : width - 1])


@njit(cache=True, nogil=True)
def _extend(
    cost: U8,
    before: tuple[U8, U8, U8],
    base: U8,
    jump: U8,
    step: np.uint8,
    path: U8,
    least: U8,
) -> None:
    """One disparity of a row of pixels: L = C + min(L'(d), L'(d +- 1) + P1, min L' + P2) - min L'.

    ``before`` are the rows L'(d - 1), L'(d), L'(d + 1) of the pixels before on the path, ``base`` their
    minimum over d; ``least`` takes that of this row.
    """
    below, same, above = before
    for x in range(len(cost)):
        # Read before the choices: a read inside of one would be a branch, and no vector instruction.
        beside, other, value, floor = below[x], above[x], same[x], base[x]
        beside = other if other < beside else beside
        beside = np.uint8(beside + step)
        value = beside if beside < value else value
        far = np.uint8(floor + jump[x])
        value = far if far < value else value
        value = np.uint8(np.uint8(value - floor) + cost[x])
        path[x] = value
        so_far = least[x]
        least[x] = value if value < so_far else so_far


@njit(cache=True, nogil=True)
def _extend_row(
    cost: U8, before: U8, base: U8, jump: U8, steps: tuple[np.uint8, int, U8], path: U8, least: U8
) -> None:
    """Paths (D, W) of a row of pixels from those of the row before, a column aside where shifted.

    ``jump`` (W,) belongs to the pixel where the path comes from. ``steps``: the penalty of a step, the shift,
    and a row of costs that no path reaches.
    """
    step, shift, unreachable = steps
    n, width = cost.shape
    a, b = max(0, -shift), width - max(0, shift)
    c, d = a + shift, b + shift
    least[:] = 255
    for q in range(n):
        if b > a:
            below = before[q - 1, c:d] if q > 0 else unreachable[c:d]
            above = before[q + 1, c:d] if q < n - 1 else unreachable[c:d]
            _extend(
                cost[q, a:b],
                (below, before[q, c:d], above),
                base[c:d],
                jump[c:d],
                step,
                path[q, a:b],
                least[a:b],
            )
        for x in range(a):
            path[q, x] = cost[q, x]
            least[x] = min(least[x], cost[q, x])
        for x in range(b, width):
            path[q, x] = cost[q, x]
            least[x] = min(least[x], cost[q, x])


@njit(cache=True, nogil=True)
def _start_row(cost: U8, path: U8, least: U8) -> None:
    least[:] = 255
    for q in range(len(cost)):
        for x in range(len(least)):
            value = cost[q, x]
            path[q, x] = value
            least[x] = min(least[x], value)


@njit(cache=True, nogil=True)
def _add(values: U8, total: U8) -> None:
    for x in range(len(total)):
        total[x] = np.uint8(total[x] + values[x])


@njit(cache=True, nogil=True)
def _copy(source: U8, out: U8) -> None:
    for x in range(len(out)):
        out[x] = source[x]


@njit(cache=True, nogil=True)
def _shifted(jump: U8, shift: int, out: U8) -> None:
    """Penalties of pixels that lie ``shift`` columns from where they are wanted."""
    width = len(jump)
    a, b = min(max(0, shift), width), max(width + min(0, shift), 0)
    out[:a], out[b:] = 0, 0
    if b > a:
        _copy(jump[a - shift : b - shift], out[a:b])


@njit(cache=True, nogil=True)
def sum_opposite(costs: U8, jumps: U8, step: np.uint8, shift: int, total: U8) -> None:
    """Paths through the rows of ``costs`` (N, D, W) from above and ``shift`` columns aside, and the opposite
    ones from below; their sum to ``total`` (N, D, W). ``jumps`` (N, W) of a pixel and the one above it."""
    rows, n, width = costs.shape
    unreachable = np.full(width, np.uint8(255 - step), np.uint8)
    least, jump = np.empty((2, width), np.uint8), np.empty(width, np.uint8)
    _start_row(costs[0], total[0], least[0])
    for y in range(1, rows):
        # The sum is still the path from above alone, so it is where the next one starts.
        _shifted(jumps[y], shift, jump)
        steps = (step, shift, unreachable)
        old, new = least[(y - 1) & 1], least[y & 1]
        _extend_row(costs[y], total[y - 1], old, jump, steps, total[y], new)
    paths = np.empty((2, n, width), np.uint8)
    _start_row(costs[rows - 1], paths[(rows - 1) & 1], least[(rows - 1) & 1])
    for y in range(rows - 1, -1, -1):
        path = paths[y & 1]
        if y < rows - 1:
            steps = (step, -shift, unreachable)
            old = least[(y + 1) & 1]
            _extend_row(costs[y], paths[(y + 1) & 1], old, jumps[y + 1], steps, path, least[y & 1])
        for q in range(n):
            _add(path[q], total[y, q])


@njit(cache=True, nogil=True)
def _swap(a: np.uint64, b: np.uint64, shift: np.uint64, mask: np.uint64) -> tuple[np.uint64, np.uint64]:
    apart = ((a >> shift) ^ b) & mask
    return a ^ (apart << shift), b ^ apart


@njit(cache=True, nogil=True)
def _transposed(rows: Word8) -> Word8:
    """8 x 8 bytes, a row a word, transposed: bytes are swapped, then pairs, then fours."""
    one, two, four = np.uint64(8), np.uint64(16), np.uint64(32)
    a, b, c, d, e, f, g, h = rows
    a, b = _swap(a, b, one, ODD)
    c, d = _swap(c, d, one, ODD)
    e, f = _swap(e, f, one, ODD)
    g, h = _swap(g, h, one, ODD)
    a, c = _swap(a, c, two, ODD_PAIRS)
    b, d = _swap(b, d, two, ODD_PAIRS)
    e, g = _swap(e, g, two, ODD_PAIRS)
    f, h = _swap(f, h, two, ODD_PAIRS)
    a, e = _swap(a, e, four, ODD_FOURS)
    b, f = _swap(b, f, four, ODD_FOURS)
    c, g = _swap(c, g, four, ODD_FOURS)
    d, h = _swap(d, h, four, ODD_FOURS)
    return a, b, c, d, e, f, g, h


@njit(cache=True, nogil=True)
def _load(words: U64, first: int, column: int) -> Word8:
    """Words of eight rows from ``first`` on."""
    part = words[first : first + 8, column]
    return part[0], part[1], part[2], part[3], part[4], part[5], part[6], part[7]


@njit(cache=True, nogil=True)
def _store(square: Word8, words: U64, first: int, column: int) -> None:
    part = words[first : first + 8, column]
    part[0], part[1], part[2], part[3] = square[0], square[1], square[2], square[3]
    part[4], part[5], part[6], part[7] = square[4], square[5], square[6], square[7]


@njit(cache=True, nogil=True)
def turn_rows(source: U8, out: U8) -> None:
    """(N, D, W) to (W', D, N'), N <= BLOCK, W' and N' the next multiples of 8; what is added is left as it is
    or arbitrary.

    Tile by tile: read column by column from where it lies, a row length that is a multiple of a large power
    of two would use a few places of the cache only.
    """
    rows, n, width = source.shape
    words = out.view(np.uint64)
    tile = np.zeros((BLOCK, TILE // 8 + 1), np.uint64)
    bytes_of = tile.view(np.uint8)
    for q in range(n):
        plane = words[:, q]
        for start in range(0, width, TILE):
            size = min(TILE, width - start)
            for y in range(rows):
                _copy(source[y, q, start : start + size], bytes_of[y, :size])
            for x in range(0, size, 8):
                for y in range(0, rows, 8):
                    _store(_transposed(_load(tile, y, x >> 3)), plane, start + x, y >> 3)


@njit(cache=True, nogil=True)
def turn_back(source: U8, out: U8) -> None:
    """(W', D, N') to (N, D, W): the inverse of :func:`turn_rows`."""
    rows, n, width = out.shape
    words = source.view(np.uint64)
    tile = np.zeros((BLOCK, TILE // 8 + 1), np.uint64)
    bytes_of = tile.view(np.uint8)
    for q in range(n):
        plane = words[:, q]
        for start in range(0, width, TILE):
            size = min(TILE, width - start)
            for x in range(0, size, 8):
                for y in range(0, rows, 8):
                    _store(_transposed(_load(plane, start + x, y >> 3)), tile, y, x >> 3)
            for y in range(rows):
                _copy(bytes_of[y, :size], out[y, q, start : start + size])


def scratch_size(height: int, disparities: int, width: int) -> int:
    """Bytes of a block of transposed costs."""
    return (width + 7) // 8 * 8 * disparities * ((min(height, BLOCK) + 7) // 8 * 8)


@njit(cache=True, nogil=True)
def sum_paths(costs: U8, jumps: U8, step: np.uint8, total: U8, scratch: U8) -> None:
    """Sums of the least costs of opposite paths that end in a pixel (Hirschmüller 2008), ``total``
    (P, H, D, W), from ``costs`` (H, D, W): P = 2 along its row and column, P = 4 also along the diagonals.

    ``jumps`` (4, H, W) from :func:`jump_penalties`, ``step`` the penalty of a change by one; ``scratch``
    (2, :func:`scratch_size`).
    """
    height, n, width = costs.shape
    # Along a row every pixel waits for the one before: many rows together, transposed, fill the vectors.
    for start in range(0, height, BLOCK):
        rows = min(BLOCK, height - start)
        wide, high = (width + 7) // 8 * 8, (rows + 7) // 8 * 8
        turned = scratch[0, : wide * n * high].reshape((wide, n, high))
        summed = scratch[1, : wide * n * high].reshape((wide, n, high))
        turn_rows(costs[start : start + rows], turned)
        jump = np.zeros((width, high), np.uint8)
        jump[:, :rows] = jumps[0, start : start + rows].T
        sum_opposite(turned[:width], jump, step, 0, summed[:width])
        turn_back(summed, total[0, start : start + rows])
    sum_opposite(costs, jumps[1], step, 0, total[1])
    if len(total) == 4:
        sum_opposite(costs, jumps[2], step, -1, total[2])
        sum_opposite(costs, jumps[3], step, 1, total[3])


LARGEST = 15.0
"""Of a penalty, in dearest costs: they share a byte, and a cost needs a few steps of its own."""


@dataclass(frozen=True)
class PathPenalties:
    """Penalties of a change of disparity from one pixel of a path to the next, in dearest costs of a match.

    ``step`` for a change by one. For more ``jump`` / (1 + g / ``edge``), g the step of grey between the
    pixels in units of the noise, but no less than ``least_jump``: surfaces end where the colour changes
    (Hirschmüller 2008, P1 and P2).
    """

    step: float = 0.43
    jump: float = 1.6
    least_jump: float = 0.65
    edge: float = 14.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.step <= self.least_jump <= self.jump <= LARGEST:
            raise ValueError(
                f"penalties must obey 0 <= step <= least_jump <= jump <= {LARGEST:g}; "
                f"got {self.step}, {self.least_jump}, {self.jump}"
            )
        if not self.edge > 0.0:
            raise ValueError(f"edge must be above 0; got {self.edge}")

    @property
    def dearest(self) -> int:
        """The dearest cost of a match as a whole number: as large as the penalties leave room for."""
        return int(TOP / (1.0 + self.jump))

    def jumps(self, side: Side, noise: float) -> U8:
        """(4, H, W) penalties of a jump from the pixel at the left, above, above left and above right."""
        out = np.empty((4, *side.valid.shape), np.uint8)
        scale = np.float32(self.edge * noise * LEVELS * len(side.channels))
        largest, least = np.float32(self.jump * self.dearest), np.float32(self.least_jump * self.dearest)
        jump_penalties(side.grey, largest, least, scale, out)
        return out

    def sum_into(self, out: U8, costs: U8, jumps: U8, scratch: U8) -> None:
        """Sums of the least costs of the paths that end in a pixel, two by two, ``out`` (P, H, D, W).

        P = 2 along its row and column, P = 4 also along the diagonals; from ``costs`` (H, D, W) and
        ``jumps`` (4, H, W) of the same rows; ``scratch`` (2, ``scratch_size(H, D, W)``).
        """
        step = np.uint8(round(self.step * self.dearest))
        sum_paths(costs, np.ascontiguousarray(jumps), step, out, scratch)
