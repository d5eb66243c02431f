"""How unlike two pixels of a rectified pair are: a census of their surroundings and their colours, over a
support that ends at edges."""

from thesisrecon.dense.matching.costs.volume import CensusAndColour, CostedSide, costed_side

__all__ = ["CensusAndColour", "CostedSide", "costed_side"]
