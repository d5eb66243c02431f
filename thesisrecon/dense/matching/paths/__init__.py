"""Least costs along paths through the image: the scanlines, and what ties them together."""

from thesisrecon.dense.matching.paths.penalties import PathPenalties

__all__ = ["PathPenalties"]
