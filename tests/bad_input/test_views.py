"""Invalid models and cameras, also as truth for validation."""

import json

import numpy as np
import pytest

from tests.bad_input import files
from tests.bad_input.files import links, pipe, sparse, writes
from tests.conftest import refuses
from tests.io.test_colmap import NAMES, export, scene
from thesisrecon import read_cameras, read_mesh
from thesisrecon.errors import UsageError

pytestmark = pytest.mark.usefixtures("bounded")


def camera(**changes):
    return writes(json.dumps({"cameras": [files.CAMERA | changes]}))


NO_CAMERAS = [
    ("pipe", pipe), ("device", links("/dev/zero")), ("deep", writes(files.deep_json())),
    ("none", writes('{"cameras": []}')), ("K singular", camera(K=np.zeros((3, 3)).tolist())),
    ("K beyond numbers", camera(K=[[10**400, 0, 0], [0, 1, 0], [0, 0, 1]])),
]  # fmt: skip
"""Other values of another type are tried at random."""


@pytest.mark.parametrize("make", [make for _, make in NO_CAMERAS], ids=[name for name, _ in NO_CAMERAS])
def test_invalid_cameras_are_refused(make, tmp_path):
    make(tmp_path / "cameras.json")
    refuses(UsageError, "cameras.json", read_cameras, tmp_path / "cameras.json")


def numbered(values):
    """A triangle whose corners or faces are these numbers."""
    header, data = files.triangle()
    new = values.tobytes()
    return files.glb(header, new + data[36:] if values.dtype == "<f4" else data[:36] + new)


def textured(blob):
    header, data = files.triangle(images=[{"bufferView": 2, "mimeType": "image/png"}])
    (primitive,) = header["meshes"][0]["primitives"]
    primitive["attributes"]["TEXCOORD_0"], primitive["material"] = 0, 0
    header["textures"] = [{"source": 0}]
    header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    header["bufferViews"] += [{"buffer": 0, "byteOffset": 48, "byteLength": len(blob)}]
    header["buffers"] = [{"byteLength": 48 + len(blob)}]
    return files.glb(header, data + blob)


def changed(**changes):
    return files.glb(*files.triangle(**changes))


DEEP = b"glTF" + np.array([2, 9, 400_000, 0x4E4F534A], "<u4").tobytes() + b"[" * 400_000
ACCESSOR = {"componentType": 5126, "type": "VEC3"}
NO_MODELS = [
    ("device", links("/dev/zero"), ""),
    ("10 TiB", sparse(10**13, b"glTF"), "is larger than"),
    ("text", writes("dear reader, dear reader"), "incorrect header on GLB"),
    ("short", writes(b"glTF"), "cannot be read"),
    ("deep", writes(DEEP), "RecursionError"),
    ("list", writes(files.glb([1, 2])), "cannot be read: AttributeError"),
    ("nothing", writes(files.glb({})), "it holds no surface"),
    (
        "count",
        writes(changed(accessors=[ACCESSOR | {"count": 10**12, "bufferView": 0}] * 2)),
        "cannot reshape",
    ),
    ("faces beyond", writes(numbered(np.array([0, 1, 9], "<u4"))), "faces refer to missing vertices"),
    ("corners of NaN", writes(numbered(np.full((3, 3), np.nan, "<f4"))), "it holds no surface"),
    ("program", writes(textured(b"%!PS-Adobe-3.0 EPSF-3.0\n")), "its texture is missing or damaged"),
    ("bomb", writes(textured(files.png(30_000, 30_000))), "its texture is missing or damaged"),
]


@pytest.mark.parametrize(("make", "words"), [m[1:] for m in NO_MODELS], ids=[m[0] for m in NO_MODELS])
def test_invalid_models_are_refused(make, words, tmp_path):
    make(tmp_path / "model.glb")
    refuses(UsageError, f"model.*{words}", read_mesh, tmp_path / "model.glb")


TRUTHS = ["[]", "{}", '{"cameras": 3}', '{"cameras": {"a.png": {}}}', files.deep_json(), "\0"]
TRUTHS += [json.dumps({"cameras": {"a.png": {"K": [[1]], "R": np.eye(3).tolist(), "C": [0, 0, 0]}}})]


@pytest.mark.parametrize("text", TRUTHS, ids=[str(k) for k in range(len(TRUTHS))])
def test_a_truth_of_wrong_types_is_refused(text, tmp_path, validated):
    files.folder_of(tmp_path, "images")
    (tmp_path / "cameras.json").write_text(text, encoding="utf-8")
    said = validated(["report", "-o", str(tmp_path / "out"), "--images", str(tmp_path)])
    assert "cameras.json does not hold cameras; it must " in said


def test_a_truth_that_is_cut_or_of_other_images_is_refused(tmp_path, validated):
    folder = tmp_path / "in"
    export(folder / "sparse" / "0", scene())
    for name in NAMES:
        (folder / f"x {name}").write_bytes(files.encoded("PNG"))
    command = ["report", "-o", str(tmp_path / "out"), "--images", str(folder)]
    assert "has a camera of no image of in: " in validated(command)
    path = folder / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:500])
    said = validated(command)
    assert "images.bin is not a valid COLMAP file; it " in said
    assert "export the model again" in said
    assert not (tmp_path / "out").exists()
