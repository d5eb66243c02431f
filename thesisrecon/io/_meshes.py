"""Surface models as GLB files, whose structure is checked before they are parsed, and from PLY and OBJ.

trimesh is imported on demand: it takes longer to import than the rest of the package.
"""

import io
import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from thesisrecon.arrays import F64, I64, distinct_corners
from thesisrecon.errors import UsageError
from thesisrecon.io._files import read_bytes
from thesisrecon.records import TexturedMesh, as_mesh

_MAX_TEXELS = 2**26  # Many times the size of a run's texture, and within the limit of Pillow
_HALF_TURN = np.array([1.0, -1.0, -1.0])
"""Rotation by 180 degrees about x, between the camera axes and those of glTF; its own inverse."""

_HEAD = struct.Struct("<4sIIII")


def _require_plain_glb(content: bytes) -> None:
    """Require a GLB as a run writes it: one mesh, no external files, no false counts, no cyclic nodes."""
    header, start = _header(content)
    for part in (*_list(header, "buffers"), *_list(header, "images")):
        if "uri" in part:
            raise ValueError("it refers to another file")
    for accessor in _list(header, "accessors"):
        count = accessor.get("count")
        if not isinstance(count, int) or not 0 <= count <= len(content) or "bufferView" not in accessor:
            raise ValueError(f"it claims {count} elements in {len(content)} bytes")
    for image in _list(header, "images"):
        _require_texture(header, image, content[start:])
    nodes, meshes = _list(header, "nodes"), _list(header, "meshes")
    if len(meshes) != 1 or len(_list(meshes[0], "primitives")) != 1:
        raise ValueError("it must hold one mesh with one primitive")
    if sum("mesh" in node for node in nodes) > 1:
        raise ValueError("it instantiates its mesh several times")
    _require_tree(nodes)


def _header(content: bytes) -> tuple[dict[str, Any], int]:
    """Return the JSON header of a GLB, and the offset of its data."""
    if len(content) < _HEAD.size:
        raise ValueError(f"it ends after {len(content)} bytes")
    magic, version, _, size, kind = _HEAD.unpack_from(content)
    if magic != b"glTF" or version != 2 or kind != 0x4E4F534A:
        raise ValueError("it is not a GLB of version 2")
    try:
        header = json.loads(content[_HEAD.size : _HEAD.size + size].decode("utf-8"))
    except (ValueError, RecursionError):
        raise ValueError("its header is not JSON") from None
    if not isinstance(header, dict):
        raise ValueError("its header is not a JSON object")
    return header, _HEAD.size + size + 8


def _require_texture(header: dict[str, Any], image: dict[str, Any], data: bytes) -> None:
    """Require an image in the file, of a size that can be decoded."""
    views, number = _list(header, "bufferViews"), image.get("bufferView")
    if not isinstance(number, int) or not 0 <= number < len(views):
        raise ValueError("its texture is missing")
    start, size = views[number].get("byteOffset", 0), views[number].get("byteLength", 0)
    if not isinstance(start, int) or not isinstance(size, int) or not 0 <= start <= start + size <= len(data):
        raise ValueError("its texture is missing")
    try:
        blob = io.BytesIO(data[start : start + size])
        with PIL.Image.open(blob, formats=("JPEG", "PNG")) as picture:
            texels = math.prod(picture.size)
    except (PIL.UnidentifiedImageError, PIL.Image.DecompressionBombError):
        texels = _MAX_TEXELS + 1
    if texels > _MAX_TEXELS:
        raise ValueError(f"its texture is not a JPEG or PNG of at most {_MAX_TEXELS >> 20} megapixels")


def _list(header: dict[str, Any], name: str) -> list[dict[str, Any]]:
    found = header.get(name, [])
    if not isinstance(found, list) or not all(isinstance(part, dict) for part in found):
        raise ValueError(f"its {name} are not a list of JSON objects")
    return found


def _require_tree(nodes: list[dict[str, Any]]) -> None:
    """Require at most one parent per node, before its children."""
    held: list[int] = []
    for number, node in enumerate(nodes):
        children = node.get("children", [])
        if not isinstance(children, list) or not all(isinstance(c, int) and c < len(nodes) for c in children):
            raise ValueError("its nodes are not a tree")
        if any(child <= number for child in children):
            raise ValueError("its nodes are cyclic or out of order")
        held += children
    if len(set(held)) < len(held):
        raise ValueError("its nodes are not a tree")


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

    try:
        if kind != "glb":
            return _mesh_of(trimesh.load(path, process=False, force="mesh"), np.ones(3))
        content = read_bytes(path, largest=2**31)
        _require_plain_glb(content)
        return _mesh_of(
            trimesh.load(io.BytesIO(content), file_type="glb", process=False, force="mesh"), _HALF_TURN
        )
    except OSError as error:
        raise UsageError(f"the mesh {path} cannot be read: {error.strerror or error}") from None
    except Exception as error:
        # The parser raises errors of any kind on damaged files.
        raise UsageError(f"the mesh {path} cannot be read: {error}") from None


def _mesh_of(loaded: Any, axes: F64) -> TexturedMesh:
    """Convert a mesh of trimesh, its axes by factors; ``ValueError`` if it is invalid."""
    vertices = np.asarray(loaded.vertices, dtype=np.float64) * axes
    faces = np.asarray(loaded.faces, dtype=np.int64)
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise ValueError("it holds no surface")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("its faces refer to missing vertices")
    uv = getattr(loaded.visual, "uv", None)
    material = getattr(loaded.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if uv is not None and image is not None:
        texture = np.asarray(image.convert("RGB"))
        height, width = texture.shape[:2]
        x, y = np.asarray(uv, dtype=np.float64).T
        corners = np.column_stack([x * width - 0.5, (1.0 - y) * height - 0.5])[faces]
        if not np.isfinite(corners).all():
            raise ValueError("its texture coordinates are not finite")
        vertices, faces = _merged(vertices, faces)
        return TexturedMesh(vertices, faces, uv=corners, texture=texture)
    colors = None
    if loaded.visual.kind == "vertex":
        colors = np.array(loaded.visual.vertex_colors[:, :3], dtype=np.uint8)
    return TexturedMesh(vertices, faces, colors=colors)


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
