"""From the best disparities of both sides to a map that says what it does not know."""

from thesisrecon.dense.matching.finish.checks import Finish, texture_of

__all__ = ["Finish", "texture_of"]
