"""Section 6.2: which two views to begin with, and their cameras.

The pair must be tied by many points that go on into other views and must not look like a plane or a pure
rotation, since a homography then explains it and F, hence the cameras, is not determined.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.geometry.triangulation import triangulate_linear
from thesisrecon.geometry.two_view import canonical_cameras, quasi_euclidean_planes
from thesisrecon.records import Tracks, TwoView

# Share of a pair's matches that one homography explains beyond which the pair shows no parallax: what is left
# is of the size of the wrong matches that verification lets through.
NO_PARALLAX = 0.95

NO_PARALLAX_BECAUSE = {
    "pure rotation": "the camera only turned about one point (a pure rotation)",
    "plane": (
        "all that is matched lies in one plane (a planar scene), or the camera hardly moved, "
        "or it turned about one point while it zoomed (a pure rotation)"
    ),
}
"""What the configurations that are found in pairs of views mean."""


def rank_initial_pairs(tracks: Tracks, pairs: Sequence[TwoView]) -> list[TwoView]:
    """Accepted pairs, best beginning first, and each next one unlike those before it.

    The score is the number of points the pair shares, those seen in a third view counting twice, times the
    share that no single homography explains; a pair whose matches leave F undetermined counts a tenth. Where
    a beginning fails, one from the same view would likely fail with it: a pair counts half as much for every
    time that one of its views has begun.
    """
    table = np.zeros((tracks.n_views, tracks.n_points), dtype=bool)
    table[tracks.view_index, tracks.point_index] = True
    long = table.sum(axis=0) >= 3

    def score(pair: TwoView) -> float:
        both = table[pair.i] & table[pair.j]
        shared = float(both.sum() + (both & long).sum())
        return shared * (1.0 - pair.homography_inlier_ratio) * (0.1 if pair.undetermined else 1.0)

    left = sorted((pair for pair in pairs if pair.accepted), key=lambda pair: (pair.i, pair.j))
    scores = np.array([score(pair) for pair in left])
    views = np.array([(pair.i, pair.j) for pair in left]).reshape(-1, 2)
    begun, ranked = np.zeros(tracks.n_views), []
    for _ in range(len(left)):
        worth = np.where(scores >= 0.0, scores * 0.5 ** begun[views].sum(axis=1), -1.0)
        best = int(np.argmax(worth))
        ranked.append(left[best])
        begun[views[best]] += 1
        scores[best] = -1.0
    return ranked


def require_pair_with_parallax(pairs: Sequence[TwoView], *, most: float = NO_PARALLAX) -> None:
    """``StageFailure`` where every accepted pair was found to show a plane or a camera that only turned, or
    where one homography explains at least the share ``most`` of every one.

    Then the cameras turned about one point, hardly moved, or see a single plane: no F is determined, and
    whatever is reconstructed from one is arbitrary, however small its residuals.
    """
    accepted = [pair for pair in pairs if pair.accepted]
    if not accepted:
        return
    shares = [pair.homography_inlier_ratio for pair in accepted]
    kinds = Counter(pair.configuration for pair in accepted)
    if min(shares) >= most or all(kind in NO_PARALLAX_BECAUSE for kind in kinds):
        meaning = NO_PARALLAX_BECAUSE.get(
            kinds.most_common(1)[0][0], "the camera only turns, hardly moves, or sees one plane"
        )
        raise StageFailure(
            f"the photographs show no parallax: {meaning}",
            f"in the least planar of {counted(len(shares), 'pair')} a homography explains "
            f"{min(shares):.0%} of all",
            "walk around the scene between photographs, and have things at different depths in the picture",
        )


def initial_cameras(pair: TwoView, sizes: I64) -> tuple[F64, F64]:
    """Initial cameras (3.42), P1 = [I | 0] and P2 = [[e]x F + e pi' | e], in pixels.

    ``sizes`` (2, 2) width and height of the two images. The plane pi is chosen in unit-free pixels, such that
    the left part of P2 comes near a rotation: the frame is then near a metric one, whose focal length is the
    long side. Of the two such planes the one is taken that fewer of the pair's points lie beyond, and the
    sign of P2 that puts most of them in front of both cameras.
    """
    T1, T2 = pixel_from_unit(sizes)
    F = T2.T @ pair.F @ T1
    best, most = None, -1.0
    for plane in quasi_euclidean_planes(F):
        P1, P2 = canonical_cameras(F, plane=plane)
        P = np.stack([T1 @ P1, T2 @ P2])
        X = triangulate_linear(P, np.stack([pair.xy1, pair.xy2]))
        first, second = np.sign(X @ P[0, 2]), np.sign(X @ P[1, 2])
        side = 1.0 if np.sum(first * second) >= 0 else -1.0
        here = abs(float(np.sum(first * np.sign(X[:, 3]))))
        if here > most:
            best, most = (P[0], side * P[1]), here
    assert best is not None
    return best
