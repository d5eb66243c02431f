"""Section 6.2: which two views to begin with, and their cameras.

The pair must be tied by many points that go on into other views and must not look like a plane or a pure
rotation, since a homography then explains it and F, hence the cameras, is not determined.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.types import I64, Tracks, TwoView

F64 = NDArray[np.float64]


def rank_initial_pairs(tracks: Tracks, pairs: Sequence[TwoView]) -> list[TwoView]:
    """Accepted pairs, best beginning first.

    The score is the number of points the pair shares, those seen in a third view counting twice, times the
    share that no single homography explains.
    """
    table = np.zeros((tracks.n_views, tracks.n_points), dtype=bool)
    table[tracks.view_index, tracks.point_index] = True
    long = table.sum(axis=0) >= 3

    def score(pair: TwoView) -> float:
        both = table[pair.i] & table[pair.j]
        return float((both.sum() + (both & long).sum()) * (1.0 - pair.homography_share))

    usable = [pair for pair in pairs if pair.accepted]
    return sorted(usable, key=lambda pair: (-score(pair), pair.i, pair.j))


def require_parallax(pairs: Sequence[TwoView], *, most: float = 0.95) -> None:
    """``StageFailure`` where one homography explains at least the share ``most`` of every accepted pair.

    Then the cameras turned about one point, hardly moved, or see a single plane: no F is determined, and
    whatever is reconstructed from one is arbitrary, however small its residuals.
    """
    shares = [pair.homography_share for pair in pairs if pair.accepted]
    if shares and min(shares) >= most:
        raise StageFailure(
            "the photographs show no parallax: the camera only turns, hardly moves, or sees one plane",
            f"a homography explains at least {min(shares):.0%} of the matches in each of {len(shares)} pairs",
            "walk around the scene between photographs, and have things at different depths in the picture",
        )


def cameras_from_fundamental(F: F64, sizes: I64) -> tuple[F64, F64]:
    """Initial cameras (3.42), P1 = [I | 0] and P2 = [[e]x F + e pi' | e], in pixels.

    ``sizes`` (2, 2) width and height of the two images. The plane pi (and the scale of F) is the one that
    brings the left part of P2 closest to the identity in unit-free pixels: a pair of similar photographs
    then starts near a metric frame, and the left part is not singular although [e]x F alone is.
    """
    T1, T2 = (_pixel_from_unit(size) for size in sizes)
    Fu = T2.T @ F @ T1
    Fu = Fu / np.linalg.norm(Fu)
    e = np.linalg.svd(Fu)[0][:, 2]
    H = cross_matrix(e) @ Fu
    design = np.column_stack([H.ravel(), np.kron(e[:, None], np.eye(3))])
    solution = np.linalg.lstsq(design, np.eye(3).ravel(), rcond=None)[0]
    scale = solution[0] if abs(solution[0]) > 1e-3 else 1e-3
    M = scale * H + np.outer(e, solution[1:])
    P1 = T1 @ np.eye(3, 4)
    return P1, T2 @ np.column_stack([M, e])


def _pixel_from_unit(size: I64) -> F64:
    s = float(max(size))
    return np.array([[s, 0.0, (size[0] - 1) / 2], [0.0, s, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
