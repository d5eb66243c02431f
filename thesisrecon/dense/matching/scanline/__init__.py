"""The maximum-likelihood scanline algorithm that the thesis refers to."""

from thesisrecon.dense.matching.scanline.maximum_likelihood import MaximumLikelihoodScanline

__all__ = ["MaximumLikelihoodScanline"]
