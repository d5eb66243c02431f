"""Whether the cameras of a model agree with the epipolar geometry that was found without it.

A camera that a crowd of wrong matches placed fits those matches, and may well be determined by them. What it
does not fit are the matches of its pairs, verified pair by pair before there was a model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.multiview import fundamental_from_cameras, sampson_residuals
from thesisrecon.types import B8, TwoView

F64 = NDArray[np.float64]


def epipolar_agreement(P: F64, registered: B8, pairs: Sequence[TwoView], *, gate_px: float) -> F64:
    """Share of the verified matches of each pair within ``gate_px`` (Sampson) of the cameras' F; -> (M,).

    P (V, 3, 4). NaN for pairs that are not accepted, of which a view is not registered, or whose cameras
    have one centre.
    """
    shares = np.full(len(pairs), np.nan)
    for n, pair in enumerate(pairs):
        if not (pair.accepted and registered[pair.i] and registered[pair.j]):
            continue
        try:
            F = fundamental_from_cameras(P[pair.i], P[pair.j])
        except ValueError:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.abs(sampson_residuals(F, pair.xy1, pair.xy2))
        shares[n] = float(np.mean(distance < gate_px))
    return shares


def contradicted_view(
    P: F64, registered: B8, pairs: Sequence[TwoView], *, gate_px: float, least: float
) -> tuple[int, float] | None:
    """The registered view that agrees least with its pairs, and its share; None where all reach ``least``.

    A view's share is that of all its verified matches with other registered views. One view at a time: the
    partners of a wrong camera look worse than they are as long as it is there.
    """
    shares = epipolar_agreement(P, registered, pairs, gate_px=gate_px)
    total, agreed = np.zeros(len(P)), np.zeros(len(P))
    for pair, share in zip(pairs, shares, strict=True):
        if np.isfinite(share):
            total[[pair.i, pair.j]] += pair.inliers
            agreed[[pair.i, pair.j]] += share * pair.inliers
    share_of_view = np.where(total > 0, agreed / np.maximum(total, 1.0), 1.0)
    worst = int(np.argmin(share_of_view))
    return (worst, float(share_of_view[worst])) if share_of_view[worst] < least else None
