"""Chapter 6: projective reconstruction."""

from thesisrecon.projective.factorization import Factorization
from thesisrecon.projective.incremental import GatedIncremental
from thesisrecon.projective.sequential import SequentialProjective

__all__ = ["Factorization", "GatedIncremental", "SequentialProjective"]
