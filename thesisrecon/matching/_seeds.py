"""First matches without a search radius: mutual nearest patches that pass the ratio test."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, replace
from itertools import product

import numpy as np
import scipy

from thesisrecon._numba import empty, full, kernel, zeros
from thesisrecon.arrays import F32, F64, I64
from thesisrecon.matching._prepared import empty_matches, join_matches, select_found
from thesisrecon.matching.track_alignment import strongest_distinct
from thesisrecon.records import Features, Matches, Seeds

BLOCK, LANES = 64, 64
"""Rows multiplied at a time, which stay in the cache for the scans, and columns compared at once."""
TOLERANCE = 0.3
# Maximum distance of a corner from its seed or prediction.
REACH_PX = 4.0
SeedSet = tuple[Matches, Callable[[Matches], F64]]
"""Matched seeds, and the function that computes their strength of match."""


@kernel(fastmath={"nnan", "nsz"})
def _scan_correlations(correlation: F32, xy2: F32, apart2: F32) -> tuple[I64, F32, F32]:
    """Best column (B,) of each row of correlations (B, N), its value, and the second best elsewhere, or -1.

    A column, at ``xy2`` (N, 2) px, within the squared distance ``apart2`` (N,) of the best is the same
    position.
    """
    rows, columns = correlation.shape
    index = zeros(rows, np.int64)
    value = full(rows, -1.0, np.float32)
    second_best = full(rows, -1.0, np.float32)
    largest, whole = empty(LANES, np.float32), columns // (4 * LANES) * (4 * LANES)
    for b in range(rows):
        row = correlation[b]
        # The largest of the values whose number is l modulo ``LANES``, four at once.
        largest[:] = np.float32(-2.0)
        for first in range(0, whole, 4 * LANES):
            one, two = row[first : first + LANES], row[first + LANES : first + 2 * LANES]
            three, four = (
                row[first + 2 * LANES : first + 3 * LANES],
                row[first + 3 * LANES : first + 4 * LANES],
            )
            for lane in range(LANES):
                p = one[lane] if one[lane] > two[lane] else two[lane]
                q = three[lane] if three[lane] > four[lane] else four[lane]
                p = p if p > q else q
                largest[lane] = p if p > largest[lane] else largest[lane]
        for n in range(whole, columns):
            largest[n % LANES] = max(largest[n % LANES], row[n])
        top = largest.max()
        best = columns
        for lane in range(LANES):
            if largest[lane] == top:
                n = lane
                while row[n] != top:
                    n += LANES
                best = min(best, n)
        second = np.float32(-1.0)
        x, y, limit = xy2[best, 0], xy2[best, 1], apart2[best]
        for lane in range(LANES):
            if not largest[lane] > second:
                continue
            for n in range(lane, columns, LANES):
                if row[n] > second:
                    dx, dy = xy2[n, 0] - x, xy2[n, 1] - y
                    if dx * dx + dy * dy > limit:
                        second = row[n]
        index[b], value[b], second_best[b] = best, top, second
    return index, value, second_best


def mutual_best(blocks: Iterable[F32], xy2: F32, apart2: F32) -> tuple[I64, F32, F32]:
    """Pairs of rows and columns, at ``xy2`` (N, 2), of the matrix in ``blocks`` that are each other's best.

    The column of each row (-1: not mutual; of equals the first counts), its correlation, and the second best
    beyond the squared distance ``apart2`` (N,), or -1.
    """
    largest, parts = np.full(len(xy2), -2.0, np.float32), []
    for correlation in blocks:
        parts.append(_scan_correlations(correlation, xy2, apart2))
        np.maximum(largest, correlation.max(axis=0), out=largest)
    index, value, second_best = (np.concatenate(column) for column in zip(*parts, strict=True))
    rows = np.flatnonzero(value == largest[index])
    # Written from the last to the first, so that the first of equal rows stays.
    back = np.full(len(xy2), -1)
    back[index[rows[::-1]]] = rows[::-1]
    mutual = back[index] == np.arange(len(index))
    return np.where(mutual, index, -1), value, np.where(mutual, second_best, np.float32(-1.0))


def nearest_seeds(seeds1: Seeds, seeds2: Seeds, ratio: float) -> tuple[I64, I64, F32]:
    """Numbers (M,) of seeds of both images that are mutually nearest and distinct, and their correlation."""
    if not (len(seeds1.xy) and len(seeds2.xy)):
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32)
    patches2 = np.ascontiguousarray(seeds2.patches.T)
    # A block of rows stays in the cache between the product and the scans.
    blocks = (seeds1.patches[k : k + BLOCK] @ patches2 for k in range(0, len(seeds1.xy), BLOCK))
    index, value, second_best = mutual_best(blocks, seeds2.xy.astype(np.float32), (8.0 * seeds2.scale) ** 2)
    distinct = (1.0 - value) < ratio**2 * (1.0 - second_best)
    rows = np.flatnonzero((index >= 0) & distinct & (value > 0.5))
    return rows, index[rows], value[rows]


def match_seeds(
    seeds1: Seeds, seeds2: Seeds, pair: tuple[int, int], *, rotated: bool, ratio: float
) -> Matches:
    """Match seeds that are mutually nearest and pass the ratio test of sqrt(2 - 2 correlation), with maps."""
    use1, use2 = (np.flatnonzero((s.angle != 0.0) == rotated) for s in (seeds1, seeds2))
    rows, columns, score = nearest_seeds(select_found(seeds1, use1), select_found(seeds2, use2), ratio)
    if not len(rows):
        return empty_matches(pair)
    one, two = use1[rows], use2[columns]
    if seeds1.frame is None and seeds2.frame is None:
        turn = (seeds2.angle[two] - seeds1.angle[one]).astype(np.float64)
        affine = _similarity((seeds2.scale[two] / seeds1.scale[one]).astype(np.float64), turn)
    else:
        affine = _frame(seeds2)[two] @ np.linalg.inv(_frame(seeds1)[one])
    return Matches(*pair, one, two, seeds1.xy[one], seeds2.xy[two], score, affine)


def _frame(seeds: Seeds) -> F64:
    """Maps (S, 2, 2) of patches to image pixels."""
    if seeds.frame is not None:
        return seeds.frame
    return _similarity(seeds.scale.astype(np.float64), seeds.angle.astype(np.float64))


def seed_matches(
    features1: Features, features2: Features, pair: tuple[int, int], *, ratio: float
) -> Iterator[SeedSet]:
    """Sets of matched seeds: one of each orientation, or one of all with oblique views of either image."""
    seeds1, seeds2 = features1.seeds, features2.seeds
    assert seeds1 is not None
    assert seeds2 is not None
    if features1.oblique is None or features2.oblique is None:
        for rotated in (False, True):
            yield match_seeds(seeds1, seeds2, pair, rotated=rotated, ratio=ratio), neighbour_support
        return
    ways = (_joined(seeds1, features1.oblique), seeds2), (seeds1, _joined(seeds2, features2.oblique))
    each = product((False, True), ways)
    matches = join_matches([match_seeds(*way, pair, rotated=kind, ratio=ratio) for kind, way in each])
    yield select_found(matches, strongest_distinct(matches, REACH_PX)), map_support


def _joined(seeds: Seeds, oblique: Seeds) -> Seeds:
    both = replace(seeds, frame=_frame(seeds)), oblique
    return Seeds(*(np.concatenate([getattr(part, f.name) for part in both]) for f in fields(Seeds)))


def _similarity(scale: F64, angle: F64) -> F64:
    """Scaled rotations (M, 2, 2)."""
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    maps: F64 = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    return maps


def neighbour_support(matches: Matches) -> F64:
    """Strength (M,) of each match: neighbours with similar displacements ((4.1) with c = 1), in both images.

    Neighbour m of match k counts exp(-1/2 (|d_m - d_k| / (TOLERANCE |u_m - u_k|))^2), without common rotation
    and scale.
    """
    if len(matches.xy1) < 2:
        return np.zeros(len(matches.xy1))
    # The common similarity: medians of the log scale and of the angle around its mode, of 10 degrees.
    a = matches.affine
    scale = np.exp(np.median(np.log(np.hypot(a[:, 0, 0], a[:, 1, 0]))))
    angle = np.arctan2(a[:, 1, 0], a[:, 0, 0])
    counts, edges = np.histogram(angle, bins=36, range=(-np.pi, np.pi))
    counts = counts + np.roll(counts, 1) + np.roll(counts, -1)
    mode = edges[np.argmax(counts)] + np.pi / 36
    around = np.angle(np.exp(1j * (angle - mode)))
    turn = mode + np.median(around[np.abs(around) < np.pi / 6])
    u, v = matches.xy1 @ _similarity(np.array([scale]), np.array([turn]))[0].T, matches.xy2
    same = np.eye(2)[None]
    return 0.5 * (_agreement(u, v, same, 10) + _agreement(v, u, same, 10))


def map_support(matches: Matches) -> F64:
    """Like :func:`neighbour_support`, but of the own affine map of each match: holds for oblique surfaces."""
    if len(matches.xy1) < 2:
        return np.zeros(len(matches.xy1))
    xy1, xy2, back = matches.xy1, matches.xy2, np.asarray(np.linalg.inv(matches.affine), np.float64)
    return 0.5 * (_agreement(xy1, xy2, matches.affine, 20) + _agreement(xy2, xy1, back, 20))


def _agreement(here: F64, there: F64, maps: F64, neighbours: int) -> F64:
    """Weighted number (M,) of nearest neighbours that are where the ``maps`` (M or 1, 2, 2) predict them."""
    near = nearest_neighbours(here, here, min(neighbours + 1, len(here)))
    offset = (here[near] - here[:, None]) @ maps.swapaxes(1, 2)
    off = there[near] - there[:, None] - offset
    apart = TOLERANCE * np.linalg.norm(offset, axis=2) + 1.0
    weight = np.exp(-0.5 * np.sum(off**2, axis=2) / apart**2)
    return np.asarray(np.where(near == np.arange(len(here))[:, None], 0.0, weight).sum(axis=1))


def corners_of_seeds(xy1: F64, xy2: F64, known: Matches) -> Matches:
    """Matches (one-to-one, best first) of the corners nearest to the seeds and to their predictions."""
    apart1, one = scipy.spatial.cKDTree(xy1).query(known.xy1)
    led = known.xy2 + np.einsum("mij,mj->mi", known.affine, xy1[one] - known.xy1)
    apart2, two = scipy.spatial.cKDTree(xy2).query(led)
    order = np.argsort(-known.score, kind="stable")
    order = order[(apart1[order] <= REACH_PX) & (apart2[order] <= REACH_PX)]
    for corner in (one, two):
        order = order[np.sort(np.unique(corner[order], return_index=True)[1])]
    order = order[np.argsort(one[order], kind="stable")]
    one, two = one[order].astype(np.int64), two[order].astype(np.int64)
    return Matches(known.i, known.j, one, two, xy1[one], xy2[two], known.score[order], known.affine[order])


def nearest_neighbours(xy: F64, of: F64, count: int) -> I64:
    """Numbers (N, count) of the points ``xy`` (M, 2) nearest to each position ``of`` (N, 2), in order."""
    return np.asarray(scipy.spatial.cKDTree(xy).query(of, range(1, count + 1))[1], np.int64)
