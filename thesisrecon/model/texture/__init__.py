"""Section 2.6: the graphics of the photographs mapped onto the surface."""

from thesisrecon.model.texture.atlas import TextureAtlas
from thesisrecon.model.texture.blending import BlendedViews
from thesisrecon.model.texture.leveling import SingleView
from thesisrecon.model.texture.visibility import color_vertices

__all__ = ["BlendedViews", "SingleView", "TextureAtlas", "color_vertices"]
