"""From the best disparities of both sides to a map that says what it does not know."""

from thesisrecon.dense.matching.finish.checks import Finish

__all__ = ["Finish"]
