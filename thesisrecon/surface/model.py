"""The model of a scene: one surface of all depth maps, with the graphics of the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Literal

from thesisrecon.records import DepthMap, PinholeView, TexturedMesh
from thesisrecon.surface.bspline import BSplineSurface
from thesisrecon.surface.fusion import DepthSheets, VolumetricFusion
from thesisrecon.surface.linear import LinearSurface, resample_surface
from thesisrecon.surface.texture_atlas import TextureAtlas
from thesisrecon.surface.texture_views import color_vertices


@dataclass(frozen=True)
class SurfaceModel:
    """Depth maps fused to a surface, with a texture or with colours of its vertices.

    ``surface`` is what stands in front of each map, ``fusion`` makes one of all, ``atlas`` its texture;
    ``colors`` "texture" or "vertices".
    """

    surface: LinearSurface | BSplineSurface = field(default_factory=LinearSurface)
    fusion: VolumetricFusion | DepthSheets = field(default_factory=VolumetricFusion)
    atlas: TextureAtlas = field(default_factory=TextureAtlas)
    colors: Literal["texture", "vertices"] = "texture"

    def __post_init__(self) -> None:
        if self.colors not in ("texture", "vertices"):
            raise ValueError(f'colors must be "texture" or "vertices"; got {self.colors!r}')

    def build(
        self, depth_maps: Sequence[DepthMap], views: Sequence[PinholeView], *, threads: int = 1
    ) -> TexturedMesh:
        """The textured surface; :class:`StageFailure` where the maps have no depths or no view sees any.

        The result does not depend on ``threads``.
        """
        return self.color(self.surface_of(depth_maps, threads=threads), views, threads=threads)

    def surface_of(self, depth_maps: Sequence[DepthMap], *, threads: int = 1) -> TexturedMesh:
        """The surface alone; :class:`StageFailure` where the maps have no depths."""
        with ThreadPoolExecutor(max(threads, 1)) as pool:
            fitted = list(pool.map(lambda m: resample_surface(self.surface.fit(m)), depth_maps))
        return self.fusion.fuse(fitted, threads=threads)

    def color(
        self,
        surface: TexturedMesh,
        views: Sequence[PinholeView],
        *,
        without: int | None = None,
        threads: int = 1,
    ) -> TexturedMesh:
        """A surface with new graphics, for a model that is made already too.

        ``without`` is the number of a view (:attr:`PinholeView.view`) that gives none: rendered from there,
        the model shows how like an unseen photograph it is. Its depths are in the surface all the same.
        Raises :class:`StageFailure` where no view sees any of it.
        """
        used = [view for view in views if view.view != without]
        if self.colors == "vertices":
            return color_vertices(surface, used, threads=threads)
        return self.atlas.texture(surface, used, threads=threads)
