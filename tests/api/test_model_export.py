"""Exports are read back by the programs themselves or by a reader of the format, and project known points."""

import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.pipeline import fake_stages as fakes
from thesisrecon import Camera, UsageError, export, reconstruct
from thesisrecon.api import export as export_module
from thesisrecon.cli.commands import run_command
from thesisrecon.io import _images
from thesisrecon.io._models import read_model
from thesisrecon.io._pixels import MemoryBudget
from thesisrecon.lens import lens_row
from thesisrecon.results import SparseModel, SparseView

SIZE = (160, 120)
NAMES = ["a b.png", "sub/c.png", "d.tif", "é.png"]
WRITTEN = {"a b.png": "a b.png", "sub/c.png": "sub/c.png", "d.tif": "d.tif.png", "é.png": "é.png"}
SLOPE = np.array([1.37, 1.83])
"""Grey levels per pixel of the test images; no whole numbers, so that rounding is not the same everywhere."""
BARREL, PINCUSHION = np.array([-0.15, 0.03, 0.01]), np.array([0.1, 0.0, 0.0])


def make_model(*distortions, skew=0.0):
    """Four views of forty points, with exact observations, by two cameras in turn."""
    rng = np.random.default_rng(3)
    X, views = rng.uniform(-1, 1, (40, 3)), []
    for i, name in enumerate(NAMES):
        fx, fy = (150.0, 152.0) if i % 2 else (140.0, 140.0)
        K = np.array([[fx, skew, 76.2 + i % 2], [0.0, fy, 61.7], [0.0, 0.0, 1.0]])
        R = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
        views.append(
            SparseView(name, R, np.array([*rng.normal(0, 0.2, 2), 4.5]), K, SIZE, distortions[i % 2])
        )
    view, point = (grid.ravel() for grid in np.meshgrid(np.arange(4), np.arange(40)))
    xy = np.array([camera(views[i]).project(X[j : j + 1])[0] for i, j in zip(view, point, strict=True)])
    colors = rng.integers(0, 256, (40, 3), dtype=np.uint8)
    return SparseModel(views, X, colors, view.astype(np.int64), point.astype(np.int64), xy)


def camera(view):
    return Camera(view.K, view.R, view.t, view.size, view.distortion)


@pytest.fixture
def images(tmp_path):
    """Images whose red and green are proportional to their pixel coordinates."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rgb = np.rint(np.stack([x * SLOPE[0], y * SLOPE[1], 0 * x], axis=-1)).astype(np.uint8)
    for name in NAMES:
        path = tmp_path / "originals" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        PIL.Image.fromarray(rgb).save(path)
    return tmp_path / "originals"


def pixels_of(path):
    with PIL.Image.open(path) as image:
        return np.asarray(image).astype(float)


# Readers: image name -> (projection of points in our pixels, size or None).


def read_colmap(folder):
    import pycolmap

    model = pycolmap.Reconstruction(folder / "sparse" / "0")

    def reader(image):
        return lambda X: np.array([image.project_point(x) for x in X]) - 0.5

    return {i.name: (reader(i), (i.camera.width, i.camera.height)) for i in model.images.values()}


def read_nerfstudio(folder):
    """As the loader of a splatting trainer: poses with OpenGL axes, intrinsics of frame or file."""
    table = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    found = {}
    for frame in table["frames"]:
        given = {**table, **frame}
        world_to_camera = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        assert not any(given[name] for name in ("k1", "k2", "p1", "p2"))

        def project(X, given=given, T=world_to_camera):
            x, y, z = (X @ T[:3, :3].T + T[:3, 3]).T
            pixel = [given["fl_x"] * x / z + given["cx"], given["fl_y"] * y / z + given["cy"]]
            return np.array(pixel).T - 0.5

        assert (folder / frame["file_path"]).is_file()
        found[frame["file_path"].removeprefix("images/")] = project, (given["w"], given["h"])
    return found


@pytest.mark.parametrize(
    ("to", "read", "skew"),
    [
        pytest.param("colmap-undistorted", read_colmap, 0.0, marks=pytest.mark.references),
        pytest.param("colmap-undistorted", read_colmap, 3.0, marks=pytest.mark.references),
        ("nerfstudio", read_nerfstudio, 0.0),
    ],
)
def test_undistorted_exports_project_known_points(tmp_path, images, to, read, skew):
    model = make_model(BARREL, PINCUSHION, skew=skew)
    export(model, tmp_path / "out", to=to, images=images)
    found = read(tmp_path / "out")
    for view in model.views:
        name = WRITTEN[view.name]
        project, (width, height) = found[name]
        xy = project(model.X)
        pinhole = Camera(view.K * [[1, skew == 0, 1], [1, 1, 1], [1, 1, 1]], view.R, view.t, view.size)
        offset = pinhole.project(model.X) - xy
        np.testing.assert_allclose(offset, np.tile(np.rint(offset[0]), (40, 1)), atol=1e-6, rtol=0)
        # The image content is where the distorted camera sees it, and no pixel is outside of the original.
        pixels = pixels_of(tmp_path / "out" / "images" / name)
        assert pixels.shape == (height, width, 3)
        assert (pixels[1:-1, 1:-1, :2].sum(axis=2) > 0).all()
        inside = np.flatnonzero(((xy > 1) & (xy < [width - 2, height - 2])).all(axis=1))
        x0, y0 = np.floor(xy[inside]).astype(int).T
        fx, fy = (xy[inside] - np.column_stack([x0, y0])).T[:, :, None]
        rows = [(1 - fx) * pixels[y, x0] + fx * pixels[y, x0 + 1] for y in (y0, y0 + 1)]
        seen = ((1 - fy) * rows[0] + fy * rows[1])[:, :2] / SLOPE
        error = seen - camera(view).project(model.X[inside])
        assert len(inside) > 30
        assert np.abs(error).max() < 1.0
        assert np.abs(error.mean(axis=0)).max() < 0.2


FISHEYE_K = np.array([[58.0, 0, 79.0], [0, 58.0, 60.0], [0, 0, 1]])


def test_fisheye_images_keep_their_lens_in_nerfstudio(tmp_path, images):
    k = np.array([-0.02, 0.003, 0.001, -0.0005])
    model = make_model(BARREL, BARREL)
    row = lens_row("fisheye", k)
    model = replace(model, views=[replace(v, K=FISHEYE_K, distortion=row) for v in model.views])
    export(model, tmp_path / "out", to="nerfstudio", images=images)
    head = json.loads((tmp_path / "out" / "transforms.json").read_text(encoding="utf-8"))
    assert head["camera_model"] == "OPENCV_FISHEYE"
    assert [head[name] for name in ("k1", "k2", "k3", "k4", "p1", "p2")] == [*k, 0.0, 0.0]
    read = {view.name: view for view in read_model(tmp_path / "out" / "transforms.json").views}
    for view in model.views:
        found = read[Path(WRITTEN[view.name]).as_posix()]
        for name in ("R", "t", "K", "distortion"):
            np.testing.assert_allclose(getattr(found, name), getattr(view, name), atol=1e-12)
        given = pixels_of(images / view.name)
        off = np.abs(pixels_of(tmp_path / "out" / "images" / found.name).astype(int) - given)
        assert off.max() <= (0 if WRITTEN[view.name].endswith("png") else 8)


@pytest.mark.parametrize(("to", "lens"), [
    ("colmap-undistorted", "fisheye"), ("nerfstudio", "thin-prism-fisheye"),
])  # fmt: skip
def test_wide_images_are_divided_into_pinhole_images(tmp_path, images, to, lens):
    pytest.importorskip("pycolmap")
    read = {"colmap-undistorted": read_colmap, "nerfstudio": read_nerfstudio}[to]
    model, rng = make_model(BARREL, BARREL), np.random.default_rng(5)
    # Nerfstudio has no decentred fisheye lens.
    k = np.array([-0.02, 0.0, 1e-5 if lens != "fisheye" else 0.0, 0.0])
    K, row = FISHEYE_K, lens_row(lens, k)
    X = rng.normal(size=(300, 3))
    X *= 6.0 / np.linalg.norm(X, axis=1, keepdims=True)
    views = [replace(v, K=K, distortion=row, t=0.1 * v.t, R=v.R) for v in model.views]
    true = [Camera(K, v.R, v.t, SIZE, k, lens=lens) for v in views]
    xy = np.stack([one.project(X) for one in true])
    angle = [np.arccos((X @ one.R.T + one.t)[:, 2] / np.linalg.norm(X - one.centre, axis=1)) for one in true]
    seen = (xy > 2.0).all(axis=2) & (xy < np.array(SIZE) - 3.0).all(axis=2) & (np.array(angle) < 1.9)
    view, point = np.nonzero(seen)
    model = SparseModel(views, X, np.zeros((300, 3), np.uint8), view, point, xy[view, point])
    report = export(model, tmp_path / "out", to=to, images=images)
    assert "are divided into images of 90 degrees" in report.notes[-1]
    found, reached = read(tmp_path / "out"), 0
    for i, one in enumerate(true):
        stem = Path(WRITTEN[NAMES[i]])
        for face in ("front", "left", "right", "up", "down"):
            name = stem.with_stem(f"{stem.stem}_{face}").as_posix()
            if name not in found:
                continue
            project, size = found[name]
            pixels = pixels_of(tmp_path / "out" / "images" / name)
            masks = [p for p in (tmp_path / "out" / "masks").rglob("*") if Path(name).stem in p.name]
            mask = pixels_of(masks[0]) > 0
            turned = export_module.FACES[face] @ one.R
            ahead = (X @ turned.T + export_module.FACES[face] @ one.t)[:, 2] > 0.1
            index = np.flatnonzero(ahead & seen[i])
            used = project(X[index])
            inside = ((used > 1.0) & (used < np.array(size) - 2.0)).all(axis=1)
            columns, rows = np.rint(used[inside]).astype(int).T
            good = mask[rows, columns]
            assert good.mean() > 0.9
            assert not pixels[~mask].any()
            off = pixels[rows, columns, :2][good] / SLOPE - xy[i, index[inside]][good]
            assert np.abs(off).max() < 1.5
            assert np.abs(off.mean(axis=0)).max() < 0.3
            reached += int(good.sum())
    # All but points near the edges of the image are in one of its pinhole images.
    assert reached > 0.9 * seen.sum()
    assert len(found) > 2 * len(true)


MASKED = np.s_[30:70, 40:90]
"""Rows and columns that the mask of one image leaves out."""


@pytest.mark.parametrize("to", ["colmap-undistorted", "nerfstudio"])
def test_masks_are_where_the_pixels_of_the_undistorted_image_come_from(tmp_path, images, to):
    """One image of four has a mask, or transparent pixels; programs want a mask for every image."""
    mask_names = {name: f"masks/{name}.png" for name in WRITTEN.values()}
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[MASKED] = 0
    (tmp_path / "given").mkdir()
    PIL.Image.fromarray(mask).save(tmp_path / "given" / "c.png.png")
    model, given = make_model(BARREL, PINCUSHION), {"to": to, "images": images, "masks": tmp_path / "given"}
    export(model, tmp_path / "out", **given)
    for name, file in mask_names.items():
        written = pixels_of(tmp_path / "out" / file)
        rgb = pixels_of(tmp_path / "out" / "images" / name)
        assert written.shape == rgb.shape[:2]
        assert set(np.unique(written)) <= {0.0, 255.0}
        if name != "sub/c.png":
            assert (written == 255).all()
            continue
        # The colours of a pixel tell its place in the original.
        x, y = rgb[..., 0] / SLOPE[0], rgb[..., 1] / SLOPE[1]
        inside = (x > 41) & (x < 88) & (y > 31) & (y < 68)
        outside = (x < 38) | (x > 91) | (y < 28) | (y > 71)
        assert inside.sum() > 1000
        assert (written[inside] == 0).all()
        assert (written[outside] == 255).all()
    if to == "nerfstudio":
        table = json.loads((tmp_path / "out" / "transforms.json").read_text(encoding="utf-8"))
        found = {frame["file_path"].removeprefix("images/"): frame["mask_path"] for frame in table["frames"]}
        assert found == mask_names
    rgb = pixels_of(images / "sub" / "c.png").astype(np.uint8)
    for alpha, there in ((np.full_like(mask, 255), False), (mask, True)):
        PIL.Image.fromarray(np.dstack([rgb, alpha])).save(images / "sub" / "c.png")
        export(model, tmp_path / f"alpha {there}", to=to, images=images)
        assert (tmp_path / f"alpha {there}" / "masks").exists() == there
    for file in mask_names.values():
        np.testing.assert_array_equal(
            pixels_of(tmp_path / "alpha True" / file), pixels_of(tmp_path / "out" / file)
        )


def test_the_masks_of_a_run_are_exported_with_it(tmp_path, capsys):
    names = [image.name for image in fakes.photographs(4)]
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
    for image in fakes.photographs(4):
        PIL.Image.fromarray(image.rgb).save(tmp_path / "images" / image.name)
        mask = np.full(image.rgb.shape[:2], 255, np.uint8)
        mask[:, :9] = 0
        PIL.Image.fromarray(mask).save(tmp_path / "masks" / f"{image.name}.png")
    out, config = tmp_path / "out", fakes.fake_config()
    reconstruct(tmp_path / "images", out, config=config, until="metric", masks=tmp_path / "masks")
    report = export(out, tmp_path / "a", to="colmap-undistorted")
    assert report.notes == ()
    assert all((pixels_of(tmp_path / "a" / "masks" / f"{name}.png")[:, 0] == 0).all() for name in names)
    command = ["export", str(out), "--to", "nerfstudio", "-o"]
    assert run_command([*command, str(tmp_path / "e")]) == 0
    assert "note" not in capsys.readouterr().out
    assert len(list((tmp_path / "e" / "masks").iterdir())) == len(names)
    (tmp_path / "masks").rename(tmp_path / "moved")
    assert run_command([*command, str(tmp_path / "c")]) == 0
    assert "is gone; give --masks" in capsys.readouterr().out
    assert not (tmp_path / "c" / "masks").exists()
    export(out, tmp_path / "d", to="colmap-undistorted", masks=tmp_path / "moved")
    assert len(list((tmp_path / "d" / "masks").iterdir())) == len(names)


@pytest.mark.references
def test_exports_with_distortion_project_known_points(tmp_path):
    model = make_model(BARREL, PINCUSHION)
    export(model, tmp_path, to="colmap")
    found = read_colmap(tmp_path)
    for view in model.views:
        project, size = found[view.name]
        assert size == SIZE
        np.testing.assert_allclose(project(model.X), camera(view).project(model.X), atol=1e-6, rtol=0)


def test_a_colmap_model_is_an_input_and_equal_cameras_are_shared(tmp_path, images):
    """Intrinsics of one camera stand at the top of transforms.json; a pinhole image is not resampled."""
    model = make_model(np.zeros(3), np.zeros(3))
    views = [replace(view, K=model.views[0].K) for view in model.views]
    export(replace(model, views=views), tmp_path / "colmap", to="colmap")
    report = export(tmp_path / "colmap", tmp_path / "out", to="nerfstudio", images=images)
    table = json.loads(report.file.read_text(encoding="utf-8"))
    assert (table["w"], table["h"], table["cx"]) == (*SIZE, pytest.approx(76.7))
    assert [sorted(frame) for frame in table["frames"]] == [["file_path", "transform_matrix"]] * 4
    original, written = images / "a b.png", tmp_path / "out" / "images" / "a b.png"
    np.testing.assert_array_equal(pixels_of(original), pixels_of(written))
    ply = (tmp_path / "out" / table["ply_file_path"]).read_bytes()
    body = np.frombuffer(ply.split(b"end_header\n")[1], [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    np.testing.assert_allclose(body["xyz"], model.X, rtol=1e-6)
    np.testing.assert_array_equal(body["rgb"], model.colors)


@pytest.mark.parametrize("orientation", [3, 6])
def test_images_of_a_colmap_model_are_used_as_stored(tmp_path, images, orientation):
    """COLMAP ignores the EXIF rotation of images and masks."""
    mask, exif = np.full(SIZE[::-1], 255, np.uint8), PIL.Image.Exif()
    mask[MASKED], exif[0x0112] = 0, orientation
    for folder, options in (("plain", {}), ("rotated", {"exif": exif})):
        for name in NAMES:
            path = tmp_path / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            PIL.Image.fromarray(pixels_of(images / name).astype(np.uint8)).save(path, **options)
        (tmp_path / f"{folder}-masks").mkdir()
        PIL.Image.fromarray(mask).save(tmp_path / f"{folder}-masks" / "c.png.png", **options)
    model = make_model(BARREL, PINCUSHION)
    export(model, tmp_path / "colmap", to="colmap")
    for source, folder in ((model, "plain"), (tmp_path / "colmap", "rotated")):
        given = {"images": tmp_path / folder, "masks": tmp_path / f"{folder}-masks"}
        export(source, tmp_path / f"{folder}-out", to="nerfstudio", **given)
    for path in (tmp_path / "plain-out").rglob("*.png"):
        found = pixels_of(tmp_path / "rotated-out" / path.relative_to(tmp_path / "plain-out"))
        np.testing.assert_array_equal(found, pixels_of(path))
    if orientation == 6:
        turned, words = {"to": "nerfstudio", "images": tmp_path / "rotated"}, "pixels after EXIF"
        refuses(UsageError, rf"has \(120, 160\) {words}", export, model, tmp_path / "other", **turned)


@pytest.mark.references
@pytest.mark.parametrize("kept", [True, False])
def test_a_result_is_exported_with_or_without_its_folder(tmp_path, kept):
    run = reconstruct(fakes.photographs(4), tmp_path / "run", config=fakes.fake_config(), until="metric")
    result = run if kept else replace(run, out=None)
    export(result, tmp_path / "out", to="colmap")
    found = read_colmap(tmp_path / "out")
    assert sorted(found) == list(result.cameras)
    for name, (project, size) in found.items():
        assert size == result.cameras[name].size
        expected = result.cameras[name].project(result.points)
        np.testing.assert_allclose(project(result.points), expected, atol=1e-6, rtol=0)
    refuses(UsageError, "give it with --images", export, result, tmp_path / "out", to="nerfstudio")


def test_models_and_folders_that_cannot_be_exported_are_named(tmp_path, images):
    model = make_model(BARREL, PINCUSHION)
    other = replace(model, views=[replace(model.views[0], distortion=None), *model.views[1:]])
    twice = replace(model, views=[replace(view, name="a b.png") for view in model.views])
    small = replace(model, views=[replace(view, size=(150, 120)) for view in model.views])
    lost = replace(model, views=[replace(view, K=None) for view in model.views])
    wild = replace(model, views=[replace(view, distortion=np.array([-400.0, 0, 0])) for view in model.views])
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    cases = [
        (model, "nerfstdio", images, "did you mean nerfstudio"),
        (model, "nerfstudio", None, "give it with --images"),
        (model, "nerfstudio", tmp_path / "run", "4 of the 4 images of the model are not in"),
        (other, "colmap", None, "lens model of image a b.png is unknown"),
        (lost, "colmap", None, "no intrinsics"),
        (twice, "nerfstudio", images, "two images of the model would be written as a b.png"),
        (small, "nerfstudio", images, r"has \(160, 120\) pixels after EXIF rotation, but \(150, 120\)"),
        (wild, "nerfstudio", images, "the camera is not plausible"),
        (replace(model, views=[]), "colmap", None, "no camera"),
        (make_model(PINCUSHION, BARREL, skew=3.0), "colmap", None, "colmap has no camera model with skew"),
    ]
    for bad, to, source, words in cases:
        refuses(UsageError, words, export, bad, tmp_path / "out", to=to, images=source)
    refuses(UsageError, "holds a run", export, model, tmp_path / "run", to="colmap")
    far = export(replace(model, X=model.X + 5e6), tmp_path / "far", to="nerfstudio", images=images)
    assert "rounded to 0.5" in far.notes[0]


def test_an_export_does_not_replace_its_input(tmp_path, images):
    model = make_model(BARREL, PINCUSHION)
    export(model, tmp_path, to="colmap")
    (tmp_path / "masks").mkdir()
    PIL.Image.fromarray(np.full(SIZE[::-1], 255, np.uint8)).save(tmp_path / "masks" / "c.png.png")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def refused(source, to, **given):
        refuses(UsageError, "would replace the originals", export, source, tmp_path, to=to, **given)

    refused(model, "nerfstudio", images=images, masks=tmp_path / "masks")
    for source in ("", "sparse", "sparse/0"):
        refused(tmp_path / source, "colmap")
        refused(tmp_path / source, "colmap-undistorted", images=images)
    command = ["export", str(tmp_path / "sparse" / "0"), "-o", str(tmp_path), "--to", "colmap"]
    assert run_command([*command, "--scale", *NAMES[:2], "2"]) == 2
    (tmp_path / "images").symlink_to(images)
    refused(model, "nerfstudio", images=images)
    (tmp_path / "images").unlink()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    # Next to the model is no problem for formats without a sparse folder.
    export(tmp_path / "sparse" / "0", tmp_path, to="nerfstudio", images=images)


@pytest.mark.parametrize(("total", "together"), [(1e6, 1), (1e9, 4)])
def test_images_are_undistorted_within_the_memory_budget(tmp_path, images, monkeypatch, total, together):
    """An image of 160 x 120 px takes 0.6 MB."""
    working, most, gate = [], [], threading.Barrier(together)
    read, write = _images.read_image, export_module.write_image

    def counted(*given, **options):
        working.append(1)
        most.append(len(working))
        gate.wait(60)
        return read(*given, **options)

    def ended(*given):
        write(*given)
        working.pop()

    monkeypatch.setattr(export_module, "_budget", MemoryBudget(int(total)))
    monkeypatch.setattr(_images, "read_image", counted)
    monkeypatch.setattr(export_module, "write_image", ended)
    export(make_model(BARREL, PINCUSHION), tmp_path / "out", to="nerfstudio", images=images, threads=4)
    assert (len(most), max(most)) == (4, together)


def test_an_image_ends_where_the_lens_model_folds_back(tmp_path, images):
    """r (1 - 9 r^2) grows up to r = 0.19; beyond it two points of the scene would fall on one pixel."""
    model = make_model(np.array([-9.0, 0.0, 0.0]), PINCUSHION)
    export(model, tmp_path / "out", to="nerfstudio", images=images)
    project, (width, height) = read_nerfstudio(tmp_path / "out")["a b.png"]
    view = model.views[0]
    X = Camera(view.K, view.R, view.t, SIZE).unproject(view.K[None, :2, 2], np.ones(1))
    centre = project(X)[0]
    reach = np.hypot(*np.maximum(centre, [width - 1, height - 1] - centre)) / 140.0
    assert 0.17 < reach < 1 / np.sqrt(27)
