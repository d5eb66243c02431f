"""Section 2.6 as it stands: the surfaces of the depth maps in triangles, put together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.geometry.camera import project
from thesisrecon.model.depth_surface import split_squares, steepest_slope, surface_from_depth
from thesisrecon.model.fusion.volume import nothing_to_fuse
from thesisrecon.model.mesh import keep_large_parts, with_faces
from thesisrecon.types import B8, F64, DepthMap, TexturedMesh


@dataclass(frozen=True)
class DepthSheets:
    """Every depth map is a sheet of triangles; what an earlier sheet shows too is left out of a later one.

    The map with most depths comes first. Nothing is averaged: sheets overlap at their rims, a little apart.
    ``step``: every so many rows and columns. ``same``: relative difference of depths up to which a place is
    the same, beside three deviations. ``grazing_deg``: what is seen more flatly breaks. ``least_part``:
    connected parts of a map below this share of its area are dropped.
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
        shows: list[Callable[[F64], B8]] = []
        for depth_map in order:
            sheet = keep_large_parts(
                surface_from_depth(depth_map, step=self.step, grazing_deg=self.grazing_deg), self.least_part
            )
            shown = np.zeros(len(sheet.vertices), dtype=bool)
            for earlier in shows:
                shown |= earlier(sheet.vertices)
            shows.append(self._shown_by(depth_map))
            sheets.append(with_faces(sheet, np.asarray(~shown[sheet.faces].all(axis=1))))
        if not sum(len(sheet.faces) for sheet in sheets):
            raise nothing_to_fuse()
        starts = np.cumsum([0, *(len(sheet.vertices) for sheet in sheets[:-1])])
        faces = [sheet.faces + start for sheet, start in zip(sheets, starts, strict=True)]
        vertices = np.concatenate([sheet.vertices for sheet in sheets])
        return TexturedMesh(vertices, np.concatenate(faces))

    def _shown_by(self, depth_map: DepthMap) -> Callable[[F64], B8]:
        """Which of points (N, 3) lie on the sheet of a map: in a whole square of it, at its depth."""
        depth = depth_map.depth[:: self.step, :: self.step].astype(np.float64)
        std = depth_map.std[:: self.step, :: self.step].astype(np.float64)
        slope = self.step * steepest_slope(depth_map.P, self.grazing_deg)
        whole: B8 = np.asarray(split_squares(depth, std, slope).whole.all(axis=-1))

        def shown(X: F64) -> B8:
            z = X @ depth_map.P[2, :3] + depth_map.P[2, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                at = project(depth_map.P, X) / self.step
            inside: B8 = np.asarray((z > 0.0) & np.all((at >= 0.0) & (at < whole.shape[::-1]), axis=1))
            place = np.where(inside[:, None], at, 0.0)
            x, y = place.astype(np.int64).T
            inside = inside & whole[y, x]
            n = np.flatnonzero(inside)
            (x, y), (u, v) = np.stack([x, y])[:, n], place[n].T % 1.0
            a, b, c, d = (1.0 / depth[y + k, x + m] for k in (0, 1) for m in (0, 1))
            there = 1.0 / ((1.0 - v) * ((1.0 - u) * a + u * b) + v * ((1.0 - u) * c + u * d))
            inside[n] = np.abs(there - z[n]) <= np.maximum(self.same * z[n], 3.0 * std[y, x])
            return np.asarray(inside)

        return shown
