"""What a GLB of strangers may hold before a parser is let loose on it."""

from __future__ import annotations

import io
import json
import math
import struct
from typing import Any

import PIL.Image

TEXTURES = ("JPEG", "PNG")
LARGEST_TEXTURE = 2**26
"""Texels: many times what a run writes, and no more than Pillow decodes without a warning."""

_HEAD = struct.Struct("<4sIIII")
_JSON = 0x4E4F534A


def require_plain_glb(content: bytes) -> None:
    """Refuse a file that names other files, claims more numbers than it has bytes, shows one mesh many times
    or has parts that hold each other: whoever follows these reads what he should not, or never ends.

    One mesh of one piece is left, as a run writes it. Raises ``ValueError``.
    """
    header, start = _header(content)
    for part in (*_list(header, "buffers"), *_list(header, "images")):
        if "uri" in part:
            raise ValueError("it names another file")
    for accessor in _list(header, "accessors"):
        count = accessor.get("count")
        if not isinstance(count, int) or not 0 <= count <= len(content) or "bufferView" not in accessor:
            raise ValueError(f"it claims {count} numbers in {len(content)} bytes")
    for image in _list(header, "images"):
        _require_texture(_viewed(header, image, content[start:]))
    nodes, meshes = _list(header, "nodes"), _list(header, "meshes")
    if len(meshes) != 1 or len(_list(meshes[0], "primitives")) != 1:
        raise ValueError("it is not one mesh of one piece")
    if sum("mesh" in node for node in nodes) > 1:
        raise ValueError("it shows one mesh many times")
    _require_tree([_children(node) for node in nodes])


def _header(content: bytes) -> tuple[dict[str, Any], int]:
    """The JSON that a GLB begins with, and where its numbers start."""
    if len(content) < _HEAD.size:
        raise ValueError(f"it ends after {len(content)} bytes")
    magic, version, _, size, kind = _HEAD.unpack_from(content)
    if magic != b"glTF" or version != 2 or kind != _JSON:
        raise ValueError("it is no GLB of version 2")
    try:
        header = json.loads(content[_HEAD.size : _HEAD.size + size].decode("utf-8"))
    except (ValueError, RecursionError):
        raise ValueError("its header is not JSON") from None
    if not isinstance(header, dict):
        raise ValueError("its header is no table")
    return header, _HEAD.size + size + 8


def _viewed(header: dict[str, Any], image: dict[str, Any], data: bytes) -> bytes:
    """The bytes of an image in the file."""
    views, number = _list(header, "bufferViews"), image.get("bufferView")
    if not isinstance(number, int) or not 0 <= number < len(views):
        raise ValueError("its texture is not there")
    start, size = views[number].get("byteOffset", 0), views[number].get("byteLength", 0)
    if not isinstance(start, int) or not isinstance(size, int) or not 0 <= start <= start + size <= len(data):
        raise ValueError("its texture is not there")
    return data[start : start + size]


def _require_texture(blob: bytes) -> None:
    try:
        with PIL.Image.open(io.BytesIO(blob), formats=TEXTURES) as picture:
            texels = math.prod(picture.size)
    except (PIL.UnidentifiedImageError, PIL.Image.DecompressionBombError):
        texels = LARGEST_TEXTURE + 1
    if texels > LARGEST_TEXTURE:
        raise ValueError(f"its texture is no JPEG or PNG of at most {LARGEST_TEXTURE >> 20} megapixels")


def _list(header: dict[str, Any], name: str) -> list[dict[str, Any]]:
    found = header.get(name, [])
    if not isinstance(found, list) or not all(isinstance(part, dict) for part in found):
        raise ValueError(f"its {name} are no list of tables")
    return found


def _children(node: dict[str, Any]) -> list[int]:
    children = node.get("children", [])
    if not isinstance(children, list) or not all(isinstance(child, int) for child in children):
        raise ValueError("its nodes are no tree")
    return children


def _require_tree(children: list[list[int]]) -> None:
    """Every node is held by one other at most, and none holds itself."""
    held = [child for own in children for child in own]
    if len(set(held)) < len(held) or not all(0 <= child < len(children) for child in held):
        raise ValueError("its nodes are no tree")
    waiting, reached = sorted(set(range(len(children))) - set(held)), 0
    while waiting:
        waiting += children[waiting.pop()]
        reached += 1
    if reached < len(children):
        raise ValueError("its nodes hold each other")
