"""Meshes as files: GLB for browsers, OBJ with MTL and PNG for modelling programs, PLY with vertex colours."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, cast

import numpy as np
import PIL.Image
import trimesh
from trimesh.visual import material as materials
from trimesh.visual import texture as textures

from thesisrecon.io.run_directory import write_atomically
from thesisrecon.types import F64, I64, TexturedMesh

JPEG_QUALITY = 92
"""Of the texture inside a GLB: a quarter of the size of PNG, and no difference that one sees."""

FORMATS = ("glb", "obj", "ply")


def write_mesh(path: Path, mesh: TexturedMesh) -> None:
    """Write a mesh in the format that the ending of ``path`` names: .glb, .obj or .ply.

    GLB and OBJ hold the texture, or the colours of the vertices where there is no texture; OBJ writes
    ``NAME.mtl`` and ``NAME.png`` beside it. PLY holds colours of vertices only. Coordinates are float32.
    Those of a GLB are given half a turn about x, since the y axis of glTF points up and that of cameras
    down: so the scene stands upright in viewers. Raises ``ValueError`` for other endings.
    """
    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise ValueError(f"a mesh is written as .glb, .obj or .ply; got {path.name}")
    {"glb": _write_glb, "obj": _write_obj, "ply": _write_ply}[kind](path, mesh)


def unmerged(mesh: TexturedMesh) -> tuple[F64, I64, F64]:
    """Vertices (N, 3), faces (M, 3) and one texture coordinate each (N, 2) in texels: a vertex on a seam
    stands once for each of its places in the texture."""
    assert mesh.uv is not None
    corners = np.column_stack([mesh.faces.reshape(-1, 1), mesh.uv.reshape(-1, 2)])
    unique, number = np.unique(corners, axis=0, return_inverse=True)
    vertices = mesh.vertices[unique[:, 0].astype(np.int64)]
    return vertices, number.reshape(-1, 3).astype(np.int64), np.asarray(unique[:, 1:], dtype=np.float64)


def _normalized(uv: F64, texture: np.ndarray) -> F64:
    """Texels, y down, as shares of the picture, v up."""
    height, width = texture.shape[:2]
    return np.column_stack([(uv[:, 0] + 0.5) / width, 1.0 - (uv[:, 1] + 0.5) / height])


def _trimesh(mesh: TexturedMesh, *, turned: bool) -> Any:
    turn = np.array([1.0, -1.0, -1.0]) if turned else np.ones(3)
    if mesh.texture is None or mesh.uv is None:
        colors = None
        if mesh.colors is not None:
            colors = np.column_stack([mesh.colors, np.full(len(mesh.colors), 255, dtype=np.uint8)])
        return trimesh.Trimesh(mesh.vertices * turn, mesh.faces, vertex_colors=colors, process=False)
    vertices, faces, uv = unmerged(mesh)
    image = PIL.Image.fromarray(mesh.texture)
    if turned:
        packed = io.BytesIO()
        image.save(packed, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        image = cast(PIL.Image.Image, PIL.Image.open(packed))
    # trimesh gives these no types.
    new_material: Any = materials.PBRMaterial
    new_visual: Any = textures.TextureVisuals
    material = new_material(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)
    visual = new_visual(uv=_normalized(uv, mesh.texture), material=material)
    return trimesh.Trimesh(vertices * turn, faces, visual=visual, process=False)


def _write_glb(path: Path, mesh: TexturedMesh) -> None:
    write_atomically(path, _trimesh(mesh, turned=True).export(file_type="glb"))


def _write_ply(path: Path, mesh: TexturedMesh) -> None:
    bare = TexturedMesh(mesh.vertices, mesh.faces, colors=mesh.colors)
    write_atomically(path, _trimesh(bare, turned=False).export(file_type="ply"))


def _write_obj(path: Path, mesh: TexturedMesh) -> None:
    lines = [f"mtllib {path.stem}.mtl", "usemtl model"] if mesh.texture is not None else []
    if mesh.texture is not None and mesh.uv is not None:
        vertices, faces, uv = unmerged(mesh)
        lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices]
        lines += [f"vt {u:.7f} {v:.7f}" for u, v in _normalized(uv, mesh.texture)]
        lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in faces + 1]
        picture = io.BytesIO()
        PIL.Image.fromarray(mesh.texture).save(picture, "PNG")
        write_atomically(path.with_suffix(".png"), picture.getvalue())
        write_atomically(
            path.with_suffix(".mtl"),
            f"newmtl model\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {path.stem}.png\n".encode(),
        )
    else:
        rgb = np.zeros((len(mesh.vertices), 0)) if mesh.colors is None else mesh.colors / 255.0
        rows = np.column_stack([mesh.vertices, rgb])
        lines += ["v " + " ".join(f"{value:.7g}" for value in row) for row in rows]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    write_atomically(path, ("\n".join(lines) + "\n").encode())
