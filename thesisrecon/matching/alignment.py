"""Least-squares matching of corners: at the scale they were found on, then at the finest there is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from thesisrecon.matching.kernels import align_windows
from thesisrecon.matching.prepared import PreparedView
from thesisrecon.matching.records import matches_at
from thesisrecon.types import F32, F64, I64, Matches

ITERATIONS = 12
# A window of half the width sees less: it must fit better, and not wander from what the wider one found.
FINE_CORRELATION = 0.85
FINE_SHIFT = 1.0
# Smooth shading correlates with anything and holds no place: what its own gradients cannot place to this many
# pixels of its scale is dropped. It removes the false matches that a correlation threshold lets through.
LARGEST_STD = 0.12


def align_corners(
    view1: PreparedView,
    view2: PreparedView,
    matches: tuple[F64, F32, F64, F64],
    *,
    affine_std: float,
    largest_shift: float,
) -> tuple[F64, F64, F32]:
    """Sub-pixel places in image 2 of corners of image 1, with the local maps and the correlations reached.

    Criterion: the squared difference of two 15 x 15 windows, gain and bias free, over the place and the
    affine map, the map held to its start by ``affine_std``. Corners found at a coarser scale are aligned
    there first (a wide basin) and then at the finest scale of the photographs (the noise of the place shrinks
    with the pixel), where the finer answer is kept if it fits.

    Parameters
    ----------
    matches : xy1 (M, 2) px, scale1 (M,), start of xy2 (M, 2) px, start of the affine maps (M, 2, 2).
    affine_std : prior standard deviation of the affine coefficients (pure numbers); 0 leaves them fixed.
    largest_shift : from the start, in pixels of the corner's scale.

    Returns
    -------
    xy2 (M, 2), affine (M, 2, 2), correlation (M,), 0 where the alignment failed or its expected error
    exceeds ``LARGEST_STD`` px of the scale, and the start was kept.
    """
    xy1, scale1, start, maps = matches
    xy2, affine, score = align_windows(
        view1.pyramid,
        view2.pyramid,
        (xy1, scale1, start, maps),
        (ITERATIONS, affine_std, largest_shift, LARGEST_STD),
    )
    coarse = np.flatnonzero((scale1 > 1.5 * view1.base) & (score > 0.0))
    if not len(coarse):
        return xy2, affine, score
    finest = np.full(len(coarse), view1.base, np.float32)
    fine_xy2, _, fine_score = align_windows(
        view1.pyramid,
        view2.pyramid,
        (xy1[coarse], finest, xy2[coarse], affine[coarse]),
        (ITERATIONS, affine_std, FINE_SHIFT, LARGEST_STD),
    )
    fits = fine_score >= FINE_CORRELATION
    xy2[coarse[fits]] = fine_xy2[fits]
    return xy2, affine, score


def aligned_matches(
    view1: PreparedView,
    view2: PreparedView,
    matches: Matches,
    *,
    affine_std: float,
    least_correlation: float,
    largest_shift: float = 3.0,
) -> Matches:
    """The matches of corners with the places in image 2 moved to sub-pixel by :func:`align_corners`.

    Those that do not reach ``least_correlation`` are dropped, and those that the alignment led to the place
    of a better one.
    """
    xy2, affine, score = align_corners(
        view1,
        view2,
        (matches.xy1, view1.features.scale[matches.index1], matches.xy2, matches.affine),
        affine_std=affine_std,
        largest_shift=largest_shift,
    )
    moved = replace(matches, xy2=xy2, affine=affine, score=score)
    good = matches_at(moved, np.flatnonzero(score >= least_correlation))
    return matches_at(good, strongest_distinct(good))


def strongest_distinct(matches: Matches, *, apart_px: float = 1.0) -> I64:
    """Rows, in order, of the matches that repeat no stronger one within ``apart_px`` in both images."""
    rows = np.argsort(-matches.score, kind="stable")
    keep = np.ones(len(rows), np.bool_)
    if len(rows) >= 2:
        places = np.hstack([matches.xy1, matches.xy2])[rows]
        for a, b in sorted(scipy.spatial.cKDTree(places).query_pairs(apart_px)):
            if keep[a]:
                keep[b] = False
    kept: I64 = np.sort(rows[keep])
    return kept
