"""Small hostile and damaged files."""

import io
import json
import os
import socket
import struct
import unicodedata
import zlib
from pathlib import Path

import numpy as np
import PIL.Image

FEATURES = ["--until", "features", "--threads", "1", "--max-size", "1600"]
TOO_LONG = "x" * 5000


CAMERA = {
    "name": "a.png", "width": 160, "height": 120, "K": [[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]],
    "R": np.eye(3).tolist(), "t": [0.0, 0.0, 3.0],
}  # fmt: skip
SUMMARY = {
    "images": 2, "registered": 2, "points": 9, "stratum": "metric", "reprojection_rms_px": 0.1,
    "reprojection_median_px": 0.1, "cameras": [], "refused": [], "warnings": [], "failure": "",
    "pairs": {"matched": 1, "accepted": 1, "verified_matches": 9}, "resumed": [], "seconds": {"total": 1.0},
}  # fmt: skip
"""An entry of cameras.json, and a summary.json."""


def picture(seed=0, size=(96, 80)):
    """A colourful picture without two equal corners."""
    rng = np.random.default_rng(seed)
    coarse = PIL.Image.fromarray(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8))
    return coarse.resize(size, PIL.Image.Resampling.BICUBIC)


def encoded(kind, image=None, **options):
    """The bytes of a picture in that format."""
    stream = io.BytesIO()
    (image or picture()).save(stream, kind, **options)
    return stream.getvalue()


def png(width, height, *, pixels=b"", before=b""):
    """A PNG that claims this size, with any ``pixels``; ``before`` precedes them."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header) + before + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def bomb():
    """All 30,000 x 30,000 pixels of a black PNG, 2.7 GB, in 3 MB."""
    packer, size = zlib.compressobj(9, zlib.DEFLATED, -15), 30_000 * (3 * 30_000 + 1)
    block = packer.compress(bytes(size // 300)) + packer.flush(zlib.Z_FULL_FLUSH)
    data = b"\x78\xda" + 300 * block + packer.flush() + struct.pack(">I", size % 65_521 << 16 | 1)
    whole = png(30_000, 30_000)
    return whole[:33] + chunk(b"IDAT", data) + whole[-12:]


def large_palette():
    """10,000 x 8000 pixels of one transparent colour of a palette, in 80 kB."""
    header = struct.pack(">IIBBBBB", 10_000, 8000, 8, 3, 0, 0, 0)
    packer = zlib.compressobj(9)
    pixels = b"".join(packer.compress(bytes(10_001)) for _ in range(8000)) + packer.flush()
    parts = (b"IHDR", header), (b"PLTE", bytes(3)), (b"tRNS", b"\0"), (b"IDAT", pixels)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts) + chunk(b"IEND", b"")


def text_bomb():
    """A valid PNG with a compressed comment of 256 MiB."""
    note = b"Comment\0\0" + zlib.compress(bytes(2**28), 9)
    whole = encoded("PNG")
    return whole[:33] + chunk(b"zTXt", note) + whole[33:]


def writes(content):
    """The maker of a file of this content."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    return lambda path: path.write_bytes(data)


def links(target):
    """The maker of a symbolic link; ``{here}`` is the folder it stands in."""
    return lambda path: path.symlink_to(target.format(here=path.parent))


def pipe(path):
    os.mkfifo(path)


def listens(path):
    """A closed socket."""
    with socket.socket(socket.AF_UNIX) as ear:
        # Names of sockets are short.
        here = Path.cwd()
        os.chdir(path.parent)
        try:
            ear.bind(path.name)
        finally:
            os.chdir(here)


def sparse(size, begin=b""):
    """The maker of a file that claims this size and takes no room."""

    def make(path):
        path.write_bytes(begin)
        os.truncate(path, size)

    return make


def unreadable(path):
    """A file that opens and cannot be read, not even by root."""
    if os.geteuid() == 0:
        path.symlink_to("/proc/self/mem")
    else:
        path.write_bytes(encoded("PNG"))
        path.chmod(0)


def deep_json(depth=200_000):
    return "[" * depth + "]" * depth


def glb(header, data=b""):
    """A GLB of this header and these numbers."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    parts = struct.pack("<II", len(text), 0x4E4F534A) + text
    parts += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def triangle(**changes):
    """The header and the numbers of a GLB of one triangle."""
    data = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + np.arange(3, dtype="<u4").tobytes()
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 4}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "buffers": [{"byteLength": 48}],
    }
    return header | changes, data


def folder_of(place, name):
    """A folder with one image."""
    folder = place / name
    folder.mkdir()
    (folder / "a.png").write_bytes(encoded("PNG"))
    return folder


def require_sentence(said):
    """Require one printable line without traceback."""
    assert said.endswith("\n")
    assert not any(unicodedata.category(c) == "Cc" for c in said[:-1])
    assert "Traceback" not in said
    assert "DEBUG" not in said
    assert len(said) < 1500
