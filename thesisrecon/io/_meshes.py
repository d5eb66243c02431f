"""Surface models as GLB files, and from PLY and OBJ.

trimesh is imported on demand: it takes longer to import than the rest of the package.
"""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from thesisrecon.arrays import F64, I64, are_finite, distinct_corners
from thesisrecon.errors import UsageError
from thesisrecon.io._files import read_bytes
from thesisrecon.records import TexturedMesh, as_mesh

_MAX_TEXELS = 2**26  # Many times the size of a run's texture, and within the limit of Pillow
_HALF_TURN = np.array([1.0, -1.0, -1.0])
"""Rotation by 180 degrees about x, between the camera axes and those of glTF; its own inverse."""


def glb_bytes(mesh: TexturedMesh) -> bytes:
    """The GLB that :func:`write_mesh` writes."""
    mesh = as_mesh("write_mesh", mesh)
    import trimesh
    from trimesh.visual import material as materials
    from trimesh.visual import texture as textures

    if mesh.texture is None or mesh.uv is None:
        colors, (used, number) = None, np.unique(mesh.faces, return_inverse=True)
        if mesh.colors is not None:
            colors = np.column_stack([mesh.colors[used], np.full(len(used), 255, dtype=np.uint8)])
        vertices, faces = mesh.vertices[used] * _HALF_TURN, number.reshape(-1, 3)
        made: Any = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    else:
        first, number = distinct_corners(mesh.faces.ravel(), mesh.uv.reshape(-1, 2))
        vertices, uv = mesh.vertices[mesh.faces.ravel()[first]], mesh.uv.reshape(-1, 2)[first]
        packed = io.BytesIO()
        # A quarter of the size of PNG without visible differences.
        PIL.Image.fromarray(mesh.texture).save(packed, "JPEG", quality=92, subsampling=0)
        # trimesh gives these no types.
        new_material: Any = materials.PBRMaterial
        new_visual: Any = textures.TextureVisuals
        material = new_material(
            baseColorTexture=PIL.Image.open(packed), metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
        )
        height, width = mesh.texture.shape[:2]
        # From texels, y down, to [0, 1], v up.
        normalized = np.column_stack([(uv[:, 0] + 0.5) / width, 1.0 - (uv[:, 1] + 0.5) / height])
        visual = new_visual(uv=normalized, material=material)
        made = trimesh.Trimesh(vertices * _HALF_TURN, number.reshape(-1, 3), visual=visual, process=False)
    return bytes(made.export(file_type="glb"))


def read_mesh(path: Path) -> TexturedMesh:
    """Read a GLB of :func:`write_mesh`, a PLY or an OBJ, whose axes stay.

    Vertices that were split at texture seams are merged again.
    """
    if not path.is_file():
        raise UsageError(f"there is no mesh {path}")
    kind = path.suffix.lower()[1:]
    if kind not in ("glb", "ply", "obj"):
        raise UsageError(f"a mesh is read from GLB, PLY or OBJ; got {path.name}")
    import trimesh
    from PIL import EpsImagePlugin

    # A texture must not start Ghostscript.
    program, EpsImagePlugin.gs_binary = EpsImagePlugin.gs_binary, False
    try:
        content = io.BytesIO(read_bytes(path, largest=2**31)) if kind == "glb" else path
        loaded: Any = trimesh.load(content, file_type=kind, process=False, force="mesh")
        turn = _HALF_TURN if kind == "glb" else np.ones(3)
        found = _mesh_of(np.asarray(loaded.vertices, dtype=np.float64) * turn, loaded.faces, loaded.visual)
        if kind == "glb" and found.texture is None and getattr(loaded.visual, "uv", None) is not None:
            raise ValueError("its texture is missing or damaged")
        return found
    except OSError as error:
        raise UsageError(f"the mesh {path} cannot be read: {error.strerror or error}") from None
    except Exception as error:
        # Damaged files raise errors of any kind.
        what = f"{error}" if type(error) is ValueError else f"{type(error).__name__} {error}"
        raise UsageError(f"the mesh {path} cannot be read: {what}") from None
    finally:
        EpsImagePlugin.gs_binary = program


def _mesh_of(vertices: F64, faces: Any, visual: Any) -> TexturedMesh:
    """A mesh with the appearance of one of trimesh; ``ValueError`` if it is invalid."""
    faces = np.asarray(faces, dtype=np.int64)
    if len(faces) == 0 or not are_finite(vertices):
        raise ValueError("it holds no surface")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("its faces refer to missing vertices")
    uv, material = getattr(visual, "uv", None), getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if uv is None or image is None:
        colors = np.array(visual.vertex_colors[:, :3], dtype=np.uint8) if visual.kind == "vertex" else None
        return TexturedMesh(vertices, faces, colors)
    if math.prod(image.size) > _MAX_TEXELS:
        raise ValueError(f"its texture has more than {_MAX_TEXELS >> 20} megapixels")
    texture = np.asarray(image.convert("RGB"))
    # From v up to v down.
    uv = np.asarray(uv, dtype=np.float64) * [1.0, -1.0] + [0.0, 1.0]
    corners = (uv * texture.shape[1::-1] - 0.5)[faces]
    if not are_finite(corners):
        raise ValueError("its texture coordinates are not finite")
    return TexturedMesh(*_merged(vertices, faces), uv=corners, texture=texture)


def _merged(vertices: F64, faces: I64) -> tuple[F64, I64]:
    """Merge equal vertices (N, 3), in the order of first use, and renumber the faces."""
    used = np.unique(faces)
    _, first, number = np.unique(vertices[used], axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    of_vertex = np.full(len(vertices), -1, dtype=np.int64)
    of_vertex[used] = rank[number.ravel()]
    return vertices[used[first[order]]], of_vertex[faces]
