"""Initial image pair and its cameras (section 6.2).

The pair needs many points that continue into other views, and its matches must not be explained by a
homography (plane or pure rotation), which leaves F and the cameras undetermined.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.geometry.triangulation import triangulate
from thesisrecon.geometry.two_view import canonical_cameras, quasi_euclidean_planes
from thesisrecon.records import Tracks, TwoView

# Homography inlier ratio beyond which a pair shows no parallax: the rest may be undetected wrong matches.
NO_PARALLAX = 0.95
_NO_PARALLAX_REASONS = {
    "pure rotation": "the camera only rotated about its centre (pure rotation)",
    "plane": (
        "all matches lie on one plane (planar scene), the camera hardly moved, or it rotated about its "
        "centre while zooming (pure rotation)"
    ),
}


def rank_initial_pairs(tracks: Tracks, pairs: Sequence[TwoView]) -> list[TwoView]:
    """Rank the accepted pairs as initial pairs, best first.

    The score is the number of shared points (those seen in a third view count twice) times the share that no
    homography explains; pairs whose matches leave F undetermined count a tenth. If one initial pair fails,
    another one with the same view would probably fail too: each use of a view halves the score of its pairs.
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
    uses, ranked = np.zeros(tracks.n_views), []
    for _ in range(len(left)):
        discounted = np.where(scores >= 0.0, scores * 0.5 ** uses[views].sum(axis=1), -1.0)
        best = int(np.argmax(discounted))
        ranked.append(left[best])
        uses[views[best]] += 1
        scores[best] = -1.0
    return ranked


def require_pair_with_parallax(pairs: Sequence[TwoView]) -> None:
    """Raise ``StageFailure`` if every accepted pair is planar, a pure rotation or nearly a homography."""
    accepted = [pair for pair in pairs if pair.accepted]
    if not accepted:
        return
    shares = [pair.homography_inlier_ratio for pair in accepted]
    kinds = Counter(pair.configuration for pair in accepted)
    if min(shares) >= NO_PARALLAX or all(kind in _NO_PARALLAX_REASONS for kind in kinds):
        meaning = _NO_PARALLAX_REASONS.get(
            kinds.most_common(1)[0][0], "the camera only rotates, hardly moves, or sees one plane"
        )
        raise StageFailure(
            f"the images show no parallax: {meaning}",
            f"in the least planar of {counted(len(shares), 'pair')} a homography explains "
            f"{min(shares):.0%} of the matches",
            "walk around the scene between images, and include objects at different depths",
        )


def initial_cameras(pair: TwoView, sizes: I64) -> tuple[F64, F64]:
    """Compute initial cameras (3.42): P1 = [I | 0], P2 = [[e]x F + e pi' | e], in pixels (HZ 9.5).

    The plane pi is chosen in unit-free pixels so that the left part of P2 is nearest to a rotation: the frame
    is then nearly metric with a focal length of one long side. Of the two such planes the one with fewer
    points beyond it is taken, and the sign of P2 that places most points in front of both cameras.
    """
    T1, T2 = pixel_from_unit(sizes)
    F = T2.T @ pair.F @ T1
    best, most = None, -1.0
    for plane in quasi_euclidean_planes(F):
        P1, P2 = canonical_cameras(F, plane=plane)
        P = np.stack([T1 @ P1, T2 @ P2])
        X = triangulate(P, np.stack([pair.xy1, pair.xy2]), method="linear")
        first, second = np.sign(X @ P[0, 2]), np.sign(X @ P[1, 2])
        side = 1.0 if np.sum(first * second) >= 0 else -1.0
        here = abs(float(np.sum(first * np.sign(X[:, 3]))))
        if here > most:
            best, most = (P[0], side * P[1]), here
    assert best is not None
    return best
