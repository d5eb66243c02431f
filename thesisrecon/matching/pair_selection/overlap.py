"""How much two photographs overlap, told from a few hundred small patches of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.matching.pair_selection.kernels import most_agreeing, mutual_best
from thesisrecon.types import F32, F64, I64, Seeds

LEAST_CORRELATION = 0.5
"""Of two patches that may show the same: half of the variance in common."""
LEAST_LOG10 = -300.0
"""Below it the tail of the binomial underflows."""


@dataclass(frozen=True)
class Sketch:
    """Some seeds of one photograph, of every scale; ``size`` (width, height) px is the extent of all.

    ``xy`` (S, 2) px; ``scale``, ``angle`` (S,); ``patches`` (S, D) float32 of zero mean and unit norm.
    """

    xy: F64
    scale: F64
    angle: F64
    patches: F32
    size: F64


def sketch_seeds(seeds: Seeds, *, turned: bool, per_scale: int) -> Sketch:
    """The strongest ``per_scale`` seeds of each scale: the turned patches, or the upright ones."""
    use = np.flatnonzero((seeds.angle != 0.0) == turned)
    parts = [use[seeds.scale[use] == scale][:per_scale] for scale in np.unique(seeds.scale[use])]
    kept = np.concatenate([np.empty(0, np.int64), *parts])
    extent = np.ptp(seeds.xy, axis=0) + 1.0 if len(seeds.xy) else np.ones(2)
    return Sketch(
        np.ascontiguousarray(seeds.xy[kept]),
        seeds.scale[kept].astype(np.float64),
        seeds.angle[kept].astype(np.float64),
        np.ascontiguousarray(seeds.patches[kept]),
        extent,
    )


@dataclass(frozen=True)
class OverlapTest:
    """Patches that are each other's best name a similarity; how many agree with one is judged against chance.

    Parameters
    ----------
    ratio : distance of a patch to its match as a share of that to the best rival elsewhere, at most.
    radius_rel : how far a match may lie from where the similarity of another foretells it, share of the long
        side: wide, for parallax and perspective are no similarity.
    log_scale : how far logarithms of their scales may differ; ``angle_rad`` their angles.
    most_matches : matches, the best by correlation, that are asked.
    """

    ratio: float = 0.8
    radius_rel: float = 0.1
    log_scale: float = 0.8
    angle_rad: float = 0.8
    most_matches: int = 150

    def score(self, a: Sketch, b: Sketch) -> float:
        """-log10 of how many similarities with as many matches chance would give this pair (at 0: one).

        With M matches, each of which is a trial, k that agree with the best, and p the area around a
        foretold place as a share of the photograph: M B(M - 1, k, p), B the tail of the binomial (the number
        of false alarms of Desolneux, Moisan and Morel, Meaningful alignments, IJCV 2000).
        """
        one, two = self._matches(a, b)
        if len(one) < 2:
            return -float(np.log10(max(len(one), 1)))
        radius = self.radius_rel * float(b.size.max())
        turn = b.angle[two] - a.angle[one]
        k = most_agreeing(
            a.xy[one],
            b.xy[two],
            b.scale[two] / a.scale[one],
            turn,
            np.array([radius, self.log_scale, self.angle_rad]),
        )
        return -_log10_false_alarms(k, len(one), min(1.0, np.pi * radius**2 / float(np.prod(b.size))))

    def _matches(self, a: Sketch, b: Sketch) -> tuple[I64, I64]:
        if not (len(a.xy) and len(b.xy)):
            return np.empty(0, np.int64), np.empty(0, np.int64)
        correlation = a.patches @ b.patches.T
        apart2 = ((8.0 * b.scale) ** 2).astype(np.float32)
        index, rival = mutual_best(correlation, b.xy.astype(np.float32), apart2)
        one = np.flatnonzero(index >= 0)
        value = correlation[one, index[one]]
        distinct = (value > LEAST_CORRELATION) & ((1.0 - value) < self.ratio**2 * (1.0 - rival[one]))
        one, value = one[distinct], value[distinct]
        one = one[np.argsort(-value, kind="stable")[: self.most_matches]]
        return one, index[one]


def _log10_false_alarms(k: int, matches: int, chance: float) -> float:
    """log10 of M times the probability that of M - 1 others at least k agree by chance."""
    tail = float(scipy.special.bdtrc(k - 1, matches - 1, chance)) if k > 0 else 1.0
    return float(np.log10(matches)) + max(float(np.log10(max(tail, 1e-320))), LEAST_LOG10)
