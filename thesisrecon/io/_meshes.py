"""Surface models as GLB files, and from PLY and OBJ.

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

from thesisrecon.arrays import F64, I64, U8, are_finite, distinct_corners
from thesisrecon.errors import UsageError
from thesisrecon.io._files import read_bytes
from thesisrecon.records import TexturedMesh, as_mesh

_MAX_TEXELS = 2**26  # Many times the size of a run's texture, and within the limit of Pillow
_HALF_TURN = np.array([1.0, -1.0, -1.0])
"""Rotation by 180 degrees about x, between the camera axes and those of glTF; its own inverse."""

_HEAD = struct.Struct("<4sIIII")
_NUMBERS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def _mesh_of_glb(content: bytes) -> TexturedMesh:
    """The mesh of a GLB as a run writes it: one primitive, all data in the file; others raise any error."""
    magic, version, _, size, kind = _HEAD.unpack_from(content)
    if magic != b"glTF" or version != 2 or kind != 0x4E4F534A:
        raise ValueError("it is not a GLB of version 2")
    header, data = json.loads(content[_HEAD.size : _HEAD.size + size]), content[_HEAD.size + size + 8 :]
    accessors, views = header["accessors"], header["bufferViews"]

    def numbers(accessor: int) -> Any:
        found = accessors[accessor]
        start = found.get("byteOffset", 0) + views[found["bufferView"]].get("byteOffset", 0)
        columns = _COLUMNS[found["type"]]
        values = np.frombuffer(data, _NUMBERS[found["componentType"]], found["count"] * columns, start)
        return values.reshape(found["count"], columns)

    ((primitive,),) = (mesh["primitives"] for mesh in header["meshes"])
    parts = {name: numbers(accessor) for name, accessor in primitive["attributes"].items()}
    vertices = parts["POSITION"].astype(np.float64) * _HALF_TURN
    faces = numbers(primitive["indices"]).astype(np.int64).reshape(-1, 3)
    if "TEXCOORD_0" not in parts:
        return _checked(vertices, faces, parts["COLOR_0"][:, :3] if "COLOR_0" in parts else None)
    view = views[header["images"][0]["bufferView"]]
    start = view.get("byteOffset", 0)
    blob = io.BytesIO(data[start : start + view["byteLength"]])
    with PIL.Image.open(blob, formats=("JPEG", "PNG")) as picture:
        if math.prod(picture.size) > _MAX_TEXELS:
            raise ValueError(f"its texture has more than {_MAX_TEXELS >> 20} megapixels")
        return _checked(vertices, faces, None, parts["TEXCOORD_0"], np.asarray(picture.convert("RGB")))


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
    try:
        if kind == "glb":
            return _mesh_of_glb(read_bytes(path, largest=2**31))
        import trimesh

        return _mesh_of(trimesh.load(path, process=False, force="mesh"))
    except OSError as error:
        raise UsageError(f"the mesh {path} cannot be read: {error.strerror or error}") from None
    except Exception as error:
        # Damaged files raise errors of any kind.
        what = f"{error}" if type(error) is ValueError else f"{type(error).__name__} {error}"
        raise UsageError(f"the mesh {path} cannot be read: {what}") from None


def _mesh_of(loaded: Any) -> TexturedMesh:
    """Convert a mesh of trimesh."""
    visual, colors = loaded.visual, None
    uv, material = getattr(visual, "uv", None), getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if uv is not None and image is not None:
        # From v up to v down.
        uv = np.asarray(uv, dtype=np.float64) * [1.0, -1.0] + [0.0, 1.0]
        return _checked(loaded.vertices, loaded.faces, None, uv, np.asarray(image.convert("RGB")))
    if visual.kind == "vertex":
        colors = visual.vertex_colors[:, :3]
    return _checked(loaded.vertices, loaded.faces, colors)


def _checked(
    vertices: Any, faces: Any, colors: Any, uv: Any = None, texture: U8 | None = None
) -> TexturedMesh:
    """A mesh with texture coordinates of vertices from 0 to 1, v down; ``ValueError`` if it is invalid."""
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    if len(faces) == 0 or not are_finite(vertices):
        raise ValueError("it holds no surface")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("its faces refer to missing vertices")
    if texture is None:
        return TexturedMesh(vertices, faces, None if colors is None else np.array(colors, dtype=np.uint8))
    corners = (np.asarray(uv, dtype=np.float64) * texture.shape[1::-1] - 0.5)[faces]
    if not are_finite(corners):
        raise ValueError("its texture coordinates are not finite")
    vertices, faces = _merged(vertices, faces)
    return TexturedMesh(vertices, faces, uv=corners, texture=texture)


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
