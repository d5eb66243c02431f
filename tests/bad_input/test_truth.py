"""Validation with damaged COLMAP models and cameras."""

import json

import numpy as np
import pytest

from tests.bad_input import files
from tests.io.test_colmap import NAMES, export, scene

pytestmark = pytest.mark.usefixtures("bounded")


def own_scene(tmp_path):
    """Photographs with a COLMAP model as their truth."""
    export(tmp_path / "in" / "sparse" / "0", scene())
    for name in NAMES:
        (tmp_path / "in" / name).write_bytes(files.encoded("PNG"))
    return tmp_path / "in"


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_binary_model_that_is_cut_anywhere_is_refused(name, tmp_path, validated):
    """At every hundredth byte."""
    folder = own_scene(tmp_path)
    path = folder / "sparse" / "0" / f"{name}.bin"
    whole = path.read_bytes()
    for size in range(0, len(whole), 100):
        path.write_bytes(whole[:size])
        said = validated(["report", "-o", str(tmp_path / "out"), "--images", str(folder)])
        assert f"{name}.bin is not a valid COLMAP file; it " in said
        assert "export the model again" in said
    assert not (tmp_path / "out").exists()


def test_a_model_of_other_images_is_refused(tmp_path, validated):
    folder = own_scene(tmp_path)
    for name in NAMES:
        (folder / name).rename(folder / f"x {name}")
    said = validated(["report", "-o", str(tmp_path / "out"), "--images", str(folder)])
    assert "must have a camera with K for every image; it lacks ['x a b.jpg'" in said


TRUTHS = ["[]", "{}", '{"cameras": 3}', '{"cameras": {"a.png": {}}}', files.deep_json(), "\0"]
TRUTHS += [json.dumps({"cameras": {"a.png": {"K": [[1]], "R": np.eye(3).tolist(), "C": [0, 0, 0]}}})]


@pytest.mark.parametrize("text", TRUTHS, ids=[str(k) for k in range(len(TRUTHS))])
def test_a_truth_of_wrong_types_is_refused(text, tmp_path, validated):
    files.folder_of(tmp_path, "images")
    (tmp_path / "cameras.json").write_text(text, encoding="utf-8")
    said = validated(["report", "-o", str(tmp_path / "out"), "--images", str(tmp_path)])
    assert "cameras.json does not hold cameras; it must " in said
