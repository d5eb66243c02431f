"""Sections 1.2, 1.3 and 2.6: new views of a model or between photographs."""

from thesisrecon.views.paths import interpolate, orbit, surface_points, upward
from thesisrecon.views.render import render
from thesisrecon.views.shading import Light, Shading

__all__ = ["Light", "Shading", "interpolate", "orbit", "render", "surface_points", "upward"]
