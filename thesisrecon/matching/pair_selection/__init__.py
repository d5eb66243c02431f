"""Which pairs of photographs are matched: all, a sequence, a list, or those that seem to overlap."""

from __future__ import annotations

from thesisrecon.matching.pair_selection.choices import AllPairs, ListedPairs, SequenceWindow
from thesisrecon.matching.pair_selection.estimate import OverlapEstimate
from thesisrecon.matching.pair_selection.overlap import OverlapTest
from thesisrecon.matching.pair_selection.records import MapAll

__all__ = ["AllPairs", "ListedPairs", "MapAll", "OverlapEstimate", "OverlapTest", "SequenceWindow"]
