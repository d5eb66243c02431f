"""Image names of models and records: relative paths in the folder of images, in readers and exports."""

import json
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest

from tests.conftest import refuses
from thesisrecon import export
from thesisrecon.errors import UsageError
from thesisrecon.io._files import require_image_name
from thesisrecon.io._images import images_folder, read_images
from thesisrecon.io._models import read_model
from thesisrecon.pipeline.inputs import views_of
from thesisrecon.records import Image
from thesisrecon.results import SparseModel, SparseView

OUTSIDE = [
    "/a/x.png", "../x.png", "a/../../x.png", "a/..", "..", "", ".", "a/", "C:\\x.png", "C:x.png", "\\x.png",
    "..\\x.png", "a\\..\\x.png", "\\\\host\\share\\x.png", "x\0.png", "//host/x.png",
]  # fmt: skip
INSIDE = [
    "\\x0ab.png", "x.png", "a/x.png", "./x.png", "a b/..x.png", "...png", "a\\x.png", "\udcff.png", "böld",
]  # fmt: skip
RULE = "an image name must be a relative path inside the folder of images, without '..'"


def view(name):
    K = np.array([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]])
    return SparseView(name, np.eye(3), np.zeros(3), K, (128, 96), np.zeros(3))


def as_json(path, name):
    camera = {"name": name, "width": 128, "height": 96, "K": view("").K.tolist(), "R": np.eye(3).tolist()}
    (path / "cameras.json").write_text(json.dumps({"cameras": [camera | {"t": [0, 0, 0]}]}))


def as_colmap(path, name):
    (path / "cameras.txt").write_text("1 PINHOLE 128 96 100 100 64 48\n")
    (path / "points3D.txt").write_text("")
    encoded = name.encode("utf-8", "surrogateescape")
    (path / "images.txt").write_bytes(b"1 1 0 0 0 0 0 0 1 " + encoded + b"\n\n")


@pytest.mark.parametrize("name", OUTSIDE)
def test_names_outside_the_folder_of_images_are_refused_everywhere(tmp_path, name):
    refuses(UsageError, RULE, require_image_name, name, "m")
    as_json(tmp_path, name)
    refuses(UsageError, f"{tmp_path} names an image .*{RULE}", read_model, tmp_path)
    model, out = SparseModel([view(name)]), tmp_path / "out"
    refuses(UsageError, RULE, export, model, out, to="opencv")
    refuses(UsageError, RULE, export, model, out, to="nerfstudio", images=tmp_path)
    refuses(UsageError, RULE, views_of, [(128, 96)], [name], None)
    image = Image(name, np.zeros((96, 128, 3), np.uint8), (128, 96))
    refuses(UsageError, RULE, read_images, [image], max_size_px=200)
    assert [file.name for file in tmp_path.iterdir()] == ["cameras.json"]
    if name.strip():
        (tmp_path / "model").mkdir()
        as_colmap(tmp_path / "model", name)
        refuses(UsageError, RULE, read_model, tmp_path / "model")


@pytest.mark.parametrize("name", INSIDE)
def test_names_inside_the_folder_are_read(tmp_path, name):
    as_colmap(tmp_path, name)
    assert read_model(tmp_path).names == [name]


@pytest.mark.parametrize("names", [("a/x.png", "A/X.png"), ("ö.png", "o\u0308.png"), ("a//x.png", "a/x.png")])
def test_names_that_would_be_one_file_elsewhere_are_not_exported(tmp_path, names):
    model = SparseModel([view(name) for name in names])
    for to in ("nerfstudio", "openmvs", "colmap-undistorted"):
        given = {"to": to, "images": tmp_path}
        refuses(UsageError, "two images of the model would", export, model, tmp_path / to, **given)
    assert not any(tmp_path.glob("*"))


def test_files_of_one_name_are_named_below_their_common_folder(tmp_path):
    files = []
    for k, place in enumerate(("left/1", "right")):
        files.append(tmp_path / place / "x.png")
        files[-1].parent.mkdir(parents=True)
        rgb = np.random.default_rng(k).integers(0, 255, (96, 128, 3), np.uint8)
        PIL.Image.fromarray(rgb).save(files[-1])
    names = [image.name for image in read_images(files, max_size_px=200).images]
    assert names == ["left/1/x.png", "right/x.png"]
    assert images_folder(files) == tmp_path
    views = [replace(view(name), t=np.array([k, 0.0, 0])) for k, name in enumerate(names)]
    written = export(SparseModel(views), tmp_path / "out", to="nerfstudio", images=tmp_path)
    there = {file.relative_to(written.file.parent).as_posix() for file in (tmp_path / "out").rglob("*.png")}
    assert there == {"images/left/1/x.png", "images/right/x.png"}


def test_a_file_whose_name_no_model_may_have_is_left_out_by_name(tmp_path):
    for k, name in enumerate(("C:a.png", "b.png", "\nc.png")):
        rgb = np.random.default_rng(k).integers(0, 255, (96, 128, 3), np.uint8)
        PIL.Image.fromarray(rgb).save(tmp_path / name)
    found = read_images(tmp_path, max_size_px=200)
    assert [image.name for image in found.images] == ["\\x0ac.png", "b.png"]
    assert found.refused == {"C:a.png": f"has to be renamed: {RULE}"}
