"""Textured surface model of a scene from all depth maps (thesis, section 2.6)."""

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
    """Fit, fuse and texture the surfaces of depth maps.

    Parameters
    ----------
    surface : LinearSurface or BSplineSurface
        Surface fitted to each depth map.
    fusion : VolumetricFusion or DepthSheets
        Fusion of the fitted surfaces.
    atlas : TextureAtlas
        Texture of the fused surface.
    colors : {"texture", "vertices"}
        Texture, or one colour per vertex.
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
        """Build the textured surface.

        Parameters
        ----------
        depth_maps : sequence of DepthMap
        views : sequence of PinholeView
            Undistorted images with their cameras.
        threads : int
            Number of threads; the result does not depend on it.

        Returns
        -------
        TexturedMesh
            The model.

        Raises
        ------
        StageFailure
            If the maps contain no depths or no view sees the surface.
        """
        return self.color(self.surface_of(depth_maps, threads=threads), views, threads=threads)

    def surface_of(self, depth_maps: Sequence[DepthMap], *, threads: int = 1) -> TexturedMesh:
        """Build the surface without colours.

        Parameters
        ----------
        depth_maps : sequence of DepthMap
        threads : int
            Number of threads; the result does not depend on it.

        Returns
        -------
        TexturedMesh

        Raises
        ------
        StageFailure
            If the maps contain no depths.
        """
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
        """Texture a surface.

        Parameters
        ----------
        surface : TexturedMesh
        views : sequence of PinholeView
            Undistorted images with their cameras.
        without : int, optional
            Number of a view that is not used, for comparison of its image with a rendering of the model. Its
            depths remain part of the surface.
        threads : int
            Number of threads; the result does not depend on it.

        Returns
        -------
        TexturedMesh
            The textured surface.

        Raises
        ------
        StageFailure
            If no view sees the surface.
        """
        used = [view for view in views if view.view != without]
        if self.colors == "vertices":
            return color_vertices(surface, used, threads=threads)
        return self.atlas.texture(surface, used, threads=threads)
