"""Textured surface model of a scene from all depth maps (thesis, section 2.6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from thesisrecon._threads import ThreadPool
from thesisrecon.imaging.on_demand import OnDemand
from thesisrecon.records import DepthMap, PinholeView, TexturedMesh
from thesisrecon.surface.bspline import BSplineSurface
from thesisrecon.surface.fusion import DepthSheets, VolumetricFusion
from thesisrecon.surface.linear import LinearSurface
from thesisrecon.surface.texture_atlas import TextureAtlas


@dataclass(frozen=True)
class SurfaceModel:
    """Fit, fuse and texture the surfaces of depth maps.

    Parameters
    ----------
    surface, fusion
        Surface fitted to each depth map, and fusion of these surfaces.
    max_glb_mb : float
        Largest size of model.glb in megabytes, at least 5; the mesh of a larger one is reduced, and
        model-full.glb holds all of it, as do the tiles.
    """

    surface: LinearSurface | BSplineSurface = field(default_factory=LinearSurface)
    fusion: VolumetricFusion | DepthSheets = field(default_factory=VolumetricFusion)
    max_glb_mb: float = 50.0

    atlas = TextureAtlas()

    def __post_init__(self) -> None:
        if not self.max_glb_mb >= 5.0:
            raise ValueError(f"max_glb_mb must be at least 5; got {self.max_glb_mb}")

    def build(
        self, depth_maps: Sequence[DepthMap], views: Sequence[PinholeView], *, threads: int = 1
    ) -> TexturedMesh:
        """See `thesisrecon.config.ModelBuilder.build`."""
        return self.color(self.surface_of(depth_maps, threads=threads), views, threads=threads)

    def surface_of(self, depth_maps: Sequence[DepthMap], *, threads: int = 1) -> TexturedMesh:
        """Build the surface without colours.

        Parameters
        ----------
        depth_maps, threads
            As in :meth:`build`.

        Returns
        -------
        TexturedMesh
        """
        if isinstance(self.surface, BSplineSurface):
            with ThreadPool(threads) as pool:
                depth_maps = list(pool.map(self.surface.smooth, depth_maps))
        return self.fusion.fuse(depth_maps, threads=threads)

    def color(
        self,
        surface: TexturedMesh,
        views: Sequence[PinholeView],
        *,
        without: int | None = None,
        threads: int = 1,
    ) -> TexturedMesh:
        """See `thesisrecon.config.ModelBuilder.color`."""
        if without is not None:
            used = [n for n, view in enumerate(views) if view.view != without]
            given, views = views, OnDemand(len(used), lambda n: given[used[n]])
        return self.atlas.texture(surface, views, threads=threads)
