"""First matches without a search radius: mutual nearest patches that pass the ratio test."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy
from numba import njit

from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.records import Seeds

BLOCK = 256


@njit(cache=True, nogil=True)
def _scan_correlations(correlation: F32, xy2: F32, apart2: F32) -> tuple[I64, F32, F32]:
    """Best column (B,) of each row of correlations (B, N), its value (B,) and the second best (B,) elsewhere.

    ``xy2`` (N, 2) px are the column positions; a column within the squared distance ``apart2`` (N,) of the
    best is the same position. -1 without a second best.
    """
    rows, columns = correlation.shape
    index = np.zeros(rows, np.int64)
    value = np.full(rows, -1.0, np.float32)
    second_best = np.full(rows, -1.0, np.float32)
    for b in range(rows):
        row = correlation[b]
        best, top = 0, np.float32(-2.0)
        for n in range(columns):
            if row[n] > top:
                best, top = n, row[n]
        second = np.float32(-1.0)
        x, y, limit = xy2[best, 0], xy2[best, 1], apart2[best]
        for n in range(columns):
            if row[n] > second:
                dx, dy = xy2[n, 0] - x, xy2[n, 1] - y
                if dx * dx + dy * dy > limit:
                    second = row[n]
        index[b], value[b], second_best[b] = best, top, second
    return index, value, second_best


@njit(cache=True, nogil=True)
def _update_column_best(correlation: F32, first_row: int, value: F32, index: I64) -> None:
    """Update the best row ``index`` (N,) of each column and its ``value`` (N,)."""
    for b in range(correlation.shape[0]):
        row = correlation[b]
        for n in range(len(value)):
            if row[n] > value[n]:
                value[n] = row[n]
                index[n] = first_row + b


def mutual_best(blocks: Iterable[F32], xy2: F32, apart2: F32) -> tuple[I64, F32, F32]:
    """Find the pairs of rows and columns that are each other's best correlation.

    Parameters
    ----------
    blocks : iterable of ndarray (B, N)
        Blocks of rows of the correlation matrix.
    xy2 : ndarray (N, 2)
        Positions of the columns, px, float32.
    apart2 : ndarray (N,)
        Squared distance from the best column beyond which another column counts as elsewhere.

    Returns
    -------
    index : ndarray (M,) of int
        Column of each row, -1 if the best is not mutual. The first of equal values counts.
    value : ndarray (M,)
        Best correlation of each row.
    second_best : ndarray (M,)
        Best correlation elsewhere; -1 if there is none or the best is not mutual.
    """
    column_value, back = np.full(len(xy2), -2.0, np.float32), np.zeros(len(xy2), np.int64)
    parts, first = [], 0
    for correlation in blocks:
        parts.append(_scan_correlations(correlation, xy2, apart2))
        _update_column_best(correlation, first, column_value, back)
        first += len(correlation)
    index, value, second_best = (np.concatenate(column) for column in zip(*parts, strict=True))
    mutual = back[index] == np.arange(first)
    return np.where(mutual, index, -1), value, np.where(mutual, second_best, np.float32(-1.0))


@dataclass(frozen=True)
class SeedMatches:
    """Matches of seeds.

    Parameters
    ----------
    xy1, xy2 : ndarray (M, 2)
        Positions, px.
    affine : ndarray (M, 2, 2)
        Initial local affine maps from image 1 to image 2.
    score : ndarray (M,)
        Correlations.
    """

    xy1: F64
    xy2: F64
    affine: F64
    score: F32

    def __len__(self) -> int:
        """Number of matches."""
        return len(self.xy1)

    def at(self, chosen: B8 | I64) -> SeedMatches:
        """Return a subset of the matches.

        Parameters
        ----------
        chosen : ndarray of bool or int
            Mask or indices.

        Returns
        -------
        SeedMatches
            The subset.
        """
        return SeedMatches(self.xy1[chosen], self.xy2[chosen], self.affine[chosen], self.score[chosen])


def match_seeds(seeds1: Seeds, seeds2: Seeds, *, rotated: bool, ratio: float) -> SeedMatches:
    """Match seeds that are mutually nearest and pass the ratio test.

    The distance of unit patches is sqrt(2 - 2 correlation). Other seeds count as elsewhere beyond a quarter
    of the patch (8 pixels of its level).

    Parameters
    ----------
    seeds1, seeds2 : Seeds
        Seeds of both images.
    rotated : bool
        Use the patches rotated to their dominant gradient, else the upright ones.
    ratio : float
        Maximum ratio of the distances to the best and to the second best seed.

    Returns
    -------
    SeedMatches
        The matches.
    """
    use1, use2 = (np.flatnonzero((s.angle != 0.0) == rotated) for s in (seeds1, seeds2))
    if not (len(use1) and len(use2)):
        none = np.empty((0, 2))
        return SeedMatches(none, none, np.empty((0, 2, 2)), np.empty(0, np.float32))
    xy2, apart2 = seeds2.xy[use2].astype(np.float32), (8.0 * seeds2.scale[use2]) ** 2
    patches1, patches2 = seeds1.patches[use1], np.ascontiguousarray(seeds2.patches[use2].T)
    # A block of rows stays in the cache between the product and the scans.
    blocks = (patches1[first : first + BLOCK] @ patches2 for first in range(0, len(use1), BLOCK))
    index, value, second_best = mutual_best(blocks, xy2, apart2)
    distinct = (1.0 - value) < ratio**2 * (1.0 - second_best)
    rows = np.flatnonzero((index >= 0) & distinct & (value > 0.5))
    one, two = use1[rows], use2[index[rows]]
    turn = (seeds2.angle[two] - seeds1.angle[one]).astype(np.float64)
    grow = (seeds2.scale[two] / seeds1.scale[one]).astype(np.float64)
    return SeedMatches(seeds1.xy[one], seeds2.xy[two], similarity(grow, turn), value[rows])


def similarity(scale: F64, angle: F64) -> F64:
    """Compute scaled rotations.

    Parameters
    ----------
    scale : ndarray (M,)
        Scales.
    angle : ndarray (M,)
        Angles, rad.

    Returns
    -------
    ndarray (M, 2, 2)
        The matrices.
    """
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    maps: F64 = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    return maps


def _common_similarity(matches: SeedMatches) -> F64:
    """Scaled rotation (2, 2) of most matches: medians of log scale and of the angle around its mode."""
    a = matches.affine
    scale = np.exp(np.median(np.log(np.hypot(a[:, 0, 0], a[:, 1, 0]))))
    angle = np.arctan2(a[:, 1, 0], a[:, 0, 0])
    # The mode of the angles, by a histogram of 10 degrees, and the median around it.
    counts, edges = np.histogram(angle, bins=36, range=(-np.pi, np.pi))
    counts = counts + np.roll(counts, 1) + np.roll(counts, -1)
    mode = edges[np.argmax(counts)] + np.pi / 36
    around = np.angle(np.exp(1j * (angle - mode)))
    near = np.abs(around) < np.pi / 6
    common: F64 = similarity(np.array([scale]), np.array([mode + np.median(around[near])]))[0]
    return common


def neighbour_support(matches: SeedMatches, *, neighbours: int = 10, tolerance: float = 0.3) -> F64:
    """Compute the strength of each match: the number of neighbours that move alike ((4.1) with c = 1).

    Neighbour m of match k counts exp(-1/2 (|d_m - d_k| / (tolerance |u_m - u_k|))^2), with d the displacement
    after removing the common rotation and scale; both images serve as the first in turn.

    Parameters
    ----------
    matches : SeedMatches
        The matches.
    neighbours : int
        Number of neighbours.
    tolerance : float
        Relative difference of displacements.

    Returns
    -------
    ndarray (M,)
        Strengths, at most ``neighbours``.
    """
    if len(matches) < 2:
        return np.zeros(len(matches))
    a = _common_similarity(matches)
    u, v = matches.xy1 @ a.T, matches.xy2
    k = min(neighbours + 1, len(matches))
    support = np.zeros(len(matches))
    for here, there in ((u, v), (v, u)):
        near = scipy.spatial.cKDTree(here).query(here, k)[1][:, 1:]
        apart = np.linalg.norm(here[near] - here[:, None], axis=2)
        strain = np.linalg.norm((there[near] - there[:, None]) - (here[near] - here[:, None]), axis=2)
        support += np.exp(-0.5 * (strain / (tolerance * apart + 1.0)) ** 2).sum(axis=1)
    return 0.5 * support


def corners_of_seeds(
    xy1: F64, xy2: F64, known: SeedMatches, *, reach_px: float = 4.0
) -> tuple[I64, I64, SeedMatches]:
    """Find the pairs of corners at the positions of seed matches.

    The corner nearest to a seed in image 1 and the corner nearest to its prediction by the local affine map
    in image 2; one-to-one, best correlations first.

    Parameters
    ----------
    xy1, xy2 : ndarray (N, 2), ndarray (K, 2)
        Corners of both images, px.
    known : SeedMatches
        The seed matches.
    reach_px : float
        Maximum distance of a corner.

    Returns
    -------
    one, two : ndarray (M,) of int
        Indices of the corners.
    matches : SeedMatches
        Matches at the corners.
    """
    apart1, one = scipy.spatial.cKDTree(xy1).query(known.xy1)
    led = known.xy2 + np.einsum("mij,mj->mi", known.affine, xy1[one] - known.xy1)
    apart2, two = scipy.spatial.cKDTree(xy2).query(led)
    order = np.argsort(-known.score, kind="stable")
    order = order[(apart1[order] <= reach_px) & (apart2[order] <= reach_px)]
    for corner in (one, two):
        order = order[np.sort(np.unique(corner[order], return_index=True)[1])]
    order = order[np.argsort(one[order], kind="stable")]
    one, two = one[order].astype(np.int64), two[order].astype(np.int64)
    return one, two, SeedMatches(xy1[one], xy2[two], known.affine[order], known.score[order])
