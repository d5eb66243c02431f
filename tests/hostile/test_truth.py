"""Validation with damaged COLMAP models, cameras, reports and studies."""

import json

import numpy as np
import pytest

from tests.hostile import files
from tests.hostile.files import links, pipe, sparse, writes
from tests.io.test_colmap import _SMALL as SMALL_MODEL
from tests.io.test_colmap import _plain_names
from thesisrecon.io.colmap_model import write_colmap_model


def own_scene(tmp_path, *, binary):
    """Photographs with a COLMAP model as their truth."""
    model = _plain_names(SMALL_MODEL)
    write_colmap_model(tmp_path / "in" / "sparse" / "0", model, binary=binary)
    for image in model.images:
        (tmp_path / "in" / image.name).write_bytes(files.encoded("PNG"))
    return tmp_path / "in"


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_binary_model_that_is_cut_anywhere_is_refused(name, tmp_path, validated):
    """At every hundredth byte."""
    folder = own_scene(tmp_path, binary=True)
    path = folder / "sparse" / "0" / f"{name}.bin"
    whole = path.read_bytes()
    for size in range(0, len(whole), 100):
        path.write_bytes(whole[:size])
        said = validated(["report", "-o", str(tmp_path / "out"), "--images", str(folder)])
        assert f"{name}.bin is not a valid COLMAP file; it " in said
        assert "export the model again" in said
    assert not (tmp_path / "out").exists()


TEXTS = [
    ("cameras", " 600 ", " nan ", "a parameter that is not a finite number"),
    ("cameras", " 600 ", " -inf ", "a parameter that is not a finite number"),
    ("cameras", "SIMPLE_PINHOLE", "<script>", "has the unknown camera model '<script>'"),
    ("cameras", " 512 384", f" {'9' * 99} 384", "has the impossible size"),
    ("cameras", " 512 384", f" {'9' * 9999} 384", "is not a record of cameras"),
    ("images", "\n1 ", "\n1 nan ", "is not a record of images"),
    ("images", "a_b.jpg", "x y\x1b[31m.jpg", "missing or repeated: ['x y\\x1b[31m.jpg']"),
    ("points3D", "\n1 ", "\n1 nan ", "points3D.txt is not a valid COLMAP file"),
    ("points3D", "\n1 ", "\n-1 ", "holds a number out of range"),
]


@pytest.mark.parametrize(("name", "old", "new", "words"), TEXTS, ids=[str(k) for k in range(len(TEXTS))])
def test_a_text_model_of_wrong_numbers_is_refused(name, old, new, words, tmp_path, validated):
    folder = own_scene(tmp_path, binary=False)
    path = folder / "sparse" / "0" / f"{name}.txt"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    assert words in validated(["report", "-o", str(tmp_path / "out"), "--images", str(folder)])


TRUTHS = ["[]", "{}", '{"cameras": 3}', '{"cameras": {"a.png": {}}}', files.deep_json(), "\0"]
TRUTHS += [json.dumps({"cameras": {"a.png": {"K": [[1]], "R": np.eye(3).tolist(), "C": [0, 0, 0]}}})]


@pytest.mark.parametrize("text", TRUTHS, ids=[str(k) for k in range(len(TRUTHS))])
def test_a_truth_of_wrong_types_is_refused(text, tmp_path, validated):
    files.folder_of(tmp_path, "images")
    (tmp_path / "cameras.json").write_text(text, encoding="utf-8")
    said = validated(["report", "-o", str(tmp_path / "out"), "--images", str(tmp_path)])
    assert "cameras.json must " in said


@pytest.mark.parametrize("make", [pipe, links("/dev/zero"), sparse(10**13), writes(files.deep_json())])
def test_an_invalid_report_to_compare_with_is_rejected(make, tmp_path, validated):
    make(tmp_path / "results.json")
    command = ["report", "-o", str(tmp_path / "out"), "--against", str(tmp_path)]
    assert "holds no report to compare with" in validated(command)


STUDIES = [
    (pipe, "cannot be read: it is a pipe"),
    (links("/dev/zero"), "cannot be read: it is a pipe, a device"),
    (sparse(10**13), "cannot be read: it is larger"),
    (writes(f"a = {'[' * 50_000}"), "is not TOML"),
    (writes("title = 3"), "title takes text; got 3"),
    (writes("scenes = 3\naxes = 4"), "axes takes a table"),
    (writes("scenes = [3]\npreset = []\n[axes]"), "unknown preset []"),
    (writes("scenes = ['a']\nconfig = 3\n[axes]"), "config takes a table"),
    (writes("scenes = ['a']\nmetrics = [3]\n[axes]"), "a metric is a name"),
]


@pytest.mark.parametrize(("make", "words"), STUDIES, ids=[str(k) for k in range(len(STUDIES))])
def test_an_invalid_study_is_rejected(make, words, tmp_path, validated):
    make(tmp_path / "study.toml")
    command = ["ablate", str(tmp_path / "study.toml"), "-o", str(tmp_path / "out"), "--plan"]
    assert words in validated(command)
