"""Section 2.6 as it stands: the surfaces of the depth maps in triangles, put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.geometry.camera import project
from thesisrecon.model.depth_surface import surface_from_depth
from thesisrecon.model.fusion.volume import nothing_to_fuse
from thesisrecon.model.mesh import keep_large_parts, with_faces
from thesisrecon.types import B8, F64, DepthMap, TexturedMesh


@dataclass(frozen=True)
class DepthSheets:
    """Every depth map is a sheet of triangles; what an earlier sheet shows too is left out of a later one.

    The map with most depths comes first. Nothing is averaged: sheets overlap at their rims, a little apart.
    ``step``: every so many rows and columns. ``same``: relative difference of depths up to which a place is
    the same, beside three deviations. ``grazing_deg``: what is seen more flatly breaks. ``least_part``:
    connected parts below this share of the area are dropped.
    """

    step: int = 2
    same: float = 0.02
    grazing_deg: float = 10.0
    least_part: float = 0.0005

    def __post_init__(self) -> None:
        if self.step < 1 or not self.same >= 0.0 or not 0.0 < self.grazing_deg < 90.0:
            raise ValueError(
                "step >= 1, same >= 0 and 0 < grazing_deg < 90 are needed; got "
                f"{self.step}, {self.same} and {self.grazing_deg}"
            )

    def fuse(self, depth_maps: Sequence[DepthMap], *, threads: int = 1) -> TexturedMesh:  # noqa: ARG002
        """The sheets as one mesh, without colours; :class:`StageFailure` where the maps have no depth."""
        order = sorted(depth_maps, key=lambda m: (-int(np.isfinite(m.depth).sum()), m.view))
        sheets: list[TexturedMesh] = []
        for k, depth_map in enumerate(order):
            sheet = surface_from_depth(depth_map, step=self.step, grazing_deg=self.grazing_deg)
            shown = np.zeros(len(sheet.vertices), dtype=bool)
            for earlier in order[:k]:
                shown |= self._shows(earlier, sheet.vertices)
            sheets.append(with_faces(sheet, np.asarray(~shown[sheet.faces].all(axis=1))))
        if not sum(len(sheet.faces) for sheet in sheets):
            raise nothing_to_fuse()
        starts = np.cumsum([0, *(len(sheet.vertices) for sheet in sheets[:-1])])
        faces = [sheet.faces + start for sheet, start in zip(sheets, starts, strict=True)]
        vertices = np.concatenate([sheet.vertices for sheet in sheets])
        return keep_large_parts(TexturedMesh(vertices, np.concatenate(faces)), self.least_part)

    def _shows(self, depth_map: DepthMap, X: F64) -> B8:
        """(N,) whether points X (N, 3) lie where the map has its depths."""
        z = X @ depth_map.P[2, :3] + depth_map.P[2, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = np.rint(project(depth_map.P, X))
        inside = (z > 0.0) & np.all((at >= 0) & (at < depth_map.depth.shape[::-1]), axis=1)
        x, y = np.where(inside[:, None], at, 0).astype(np.int64).T
        limit = np.maximum(self.same * z, 3.0 * depth_map.std[y, x])
        with np.errstate(invalid="ignore"):
            return np.asarray(inside & (np.abs(depth_map.depth[y, x] - z) <= limit))
