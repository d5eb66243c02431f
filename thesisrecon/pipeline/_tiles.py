"""Tiles of a surface model whose mesh is reduced: files of bounded size that hold all of its faces."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import I64
from thesisrecon.io._files import write_atomically, write_json
from thesisrecon.io._meshes import box_in_file, glb_bytes
from thesisrecon.records import TexturedMesh
from thesisrecon.runtime._run_folder import RunDirectory
from thesisrecon.surface._mesh import halve_surface
from thesisrecon.surface.texture_atlas import cut_tile

TILES = "tiles/tiles.json"
TILE_FILES = (TILES, "tiles/tile-[0-9]*.glb")
TILE_FACES, TILE_MB = 100_000, 10.0
"""Largest number of faces and largest size of a tile in megabytes (10^6 bytes)."""


def write_tiles(directory: RunDirectory, whole: TexturedMesh, coarse: TexturedMesh) -> int:
    """Write a mesh in tiles, and their list with ``coarse``, the mesh of model.glb; return their number.

    Boxes are halved across their longest side until each tile is small enough.
    """
    folder = directory.path / "tiles"
    entries = [{"file": "../model.glb", "level": 0, "faces": len(coarse.faces), "box": box_in_file(coarse)}]
    open_ = _halves(whole, np.arange(len(whole.faces)), TILE_FACES)
    while open_:
        faces = open_.pop()
        tile = cut_tile(whole, faces)
        content = glb_bytes(tile)
        if len(content) > 1e6 * TILE_MB and len(faces) > 1:
            open_ += _halves(tile, faces, -(-len(faces) // 2))
            continue
        path = folder / f"tile-{len(entries) - 1:04d}.glb"
        write_atomically(path, content)
        entries.append({"file": path.name, "level": 1, "faces": len(faces), "box": box_in_file(tile)})
    write_json(directory.path / TILES, {"tiles": entries})
    return len(entries) - 1


def _halves(mesh: TexturedMesh, faces: I64, largest: int) -> list[I64]:
    """Divide the numbers ``faces`` (M,) of faces into parts of at most ``largest``, in reverse order."""
    part = halve_surface(mesh, np.ones(len(faces), dtype=np.int64), largest)
    return [faces[part == k] for k in range(part.max(), -1, -1)]
