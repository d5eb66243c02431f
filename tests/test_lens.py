"""Lenses: exact against pycolmap, inverses, kernels of bundle adjustment, and the files that hold them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from thesisrecon import Camera, export
from thesisrecon.camera import camera_of_row
from thesisrecon.io._models import read_model
from thesisrecon.lens import PERSPECTIVE, WIDTH, image_of_directions, lens_row, named_lens
from thesisrecon.optimize.bundle import projection

K = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
KINDS = {
    "OPENCV": ("brown", 4), "FULL_OPENCV": ("rational", 8), "OPENCV_FISHEYE": ("fisheye", 4),
    "THIN_PRISM_FISHEYE": ("thin-prism-fisheye", 8), "DIVISION": ("division", 1), "RADIAL": ("radial", 2),
}  # fmt: skip
SCALES = np.array([0.1, 0.03, 0.004, 0.003, 0.02, 0.02, 0.004, 0.003])


def _camera(lens: Any, k: np.ndarray, focal: float = 510.0) -> Camera:
    calibration = K.copy()
    calibration[1, 1] = focal
    return Camera(calibration, np.eye(3), np.zeros(3), (640, 480), k, lens=lens)


@pytest.mark.parametrize("kind", KINDS)
def test_lenses_are_those_of_colmap_and_have_inverses(kind: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    lens, count = KINDS[kind]
    rng = np.random.default_rng(len(kind))
    for _ in range(20):
        k = rng.normal(0.0, SCALES[:count])
        # A division lens with k1 > 0 images directions near the axis only.
        k = -np.abs(k) if lens == "division" else k
        X = np.column_stack([rng.uniform(-0.8, 0.8, (100, 2)), rng.uniform(0.9, 3.0, 100)])
        equal = kind == "RADIAL"
        camera = _camera(lens, k, 500.0 if equal else 510.0)
        params = [500.0] if equal else [500.0, 510.0]
        theirs = pycolmap.Camera(model=kind, width=640, height=480, params=[*params, 320.5, 240.5, *k])
        xy = camera.project(X)
        np.testing.assert_allclose(xy, theirs.img_from_cam(X) - 0.5, rtol=0, atol=1e-9)
        rays = camera.unproject(xy)
        np.testing.assert_allclose(rays, X / np.linalg.norm(X, axis=1, keepdims=True), atol=1e-9)


def test_a_fisheye_lens_images_directions_behind_the_camera() -> None:
    camera = _camera("fisheye", np.array([-0.01, 0.002, 0.0, 0.0]))
    X = np.array([[1.0, 0.2, -0.4], [0.0, -2.0, 0.0], [0.0, 0.0, 1.0]])
    rays = camera.unproject(camera.project(X))
    np.testing.assert_allclose(rays, X / np.linalg.norm(X, axis=1, keepdims=True), atol=1e-12)


def test_pixels_that_no_direction_has_are_nan() -> None:
    # r_d = theta - 0.2 theta^3 is largest at theta = 1.29, where it is 0.86.
    camera = _camera("fisheye", np.array([-0.2]), 500.0)
    rays = camera.unproject(np.array([[320.0 + 500.0 * 0.8, 240.0], [320.0 + 500.0 * 0.9, 240.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


@pytest.mark.parametrize("lens", ["brown", "division", "fisheye", "thin-prism-fisheye"])
def test_derivatives_of_bundle_adjustment_are_those_of_the_projection(lens: Any) -> None:
    rng, n = np.random.default_rng(3), 30
    k = rng.normal(0.0, SCALES[: {"brown": 5, "division": 1, "fisheye": 4, "thin-prism-fisheye": 6}[lens]])
    k = -np.abs(k) if lens == "division" else k
    X = np.column_stack([rng.uniform(-1.5, 1.5, (n, 2)), rng.uniform(0.8, 3.0, n)])
    X[0, :2] = 1e-5  # near the axis the quotients of a fisheye lens are series
    q = np.concatenate([[500.0, 1.02, 3.0, 320.0, 240.0], lens_row(lens, k)[:7]])
    model = projection.MetricModel(np.eye(3)[None], np.zeros((1, 3)), q[None], np.zeros(1, int), X)
    seen = projection.Observations(np.zeros(n, int), np.arange(n), np.zeros((n, 2)))
    calibration = np.array([[500.0, 3.0, 320.0], [0.0, 510.0, 240.0]])
    expected = image_of_directions(X, lens_row(lens, k)) @ calibration[:, :2].T + calibration[:, 2]
    np.testing.assert_allclose(projection.project_metric(model, seen), expected, rtol=0, atol=1e-9)
    columns = np.arange(11)
    J = projection.Jacobians.empty(n, 6 + len(columns), 0)
    projection.linearize_metric(model, seen, projection.Weighting(1.0, np.inf), columns, np.zeros(0, int), J)

    def central(make: Any, step: float = 1e-6) -> np.ndarray:
        ends = [projection.project_metric(make(sign * step), seen) for sign in (1, -1)]
        return np.asarray((ends[0] - ends[1]) / (2.0 * step))

    def with_intrinsic(column: int, change: float) -> projection.MetricModel:
        row = q.copy()
        row[column] = row[column] * np.exp(change) if column == 0 else row[column] + change
        return model._replace(intrinsics=row[None])

    used = columns[:6] if lens == "division" else columns
    for column in used:
        numeric = central(lambda change, c=column: with_intrinsic(c, change))
        np.testing.assert_allclose(J.A[:, :, 6 + column], numeric, rtol=1e-5, atol=1e-4)
    for axis in range(3):
        numeric = central(lambda change, a=axis: model._replace(X=X + change * np.eye(3)[a]))
        np.testing.assert_allclose(J.B[:, :, axis], numeric, rtol=1e-5, atol=1e-4)


def test_rows_have_the_simplest_name() -> None:
    for lens, count in KINDS.values():
        row = lens_row(lens, SCALES[:count])
        name, k = named_lens(row)
        assert name == lens
        np.testing.assert_array_equal(k[:count], SCALES[:count])
    assert named_lens(lens_row("rational", np.array([0.1, 0.2, 0.0, 0.0, 0.0])))[0] == "radial"
    assert len(lens_row("brown", SCALES[:5])) == WIDTH
    assert lens_row("brown", SCALES[:5])[6] == PERSPECTIVE


def test_wrong_lenses_are_one_sentence() -> None:
    with pytest.raises(ValueError, match="a lens is one of radial, division"):
        _camera("fish", np.zeros(1))
    with pytest.raises(ValueError, match="a division lens has 1 coefficients; got 2"):
        _camera("division", np.array([-0.2, 0.1]))


@pytest.mark.parametrize("lens", sorted({lens for lens, _ in KINDS.values()}))
def test_files_of_cameras_keep_the_lens(lens: Any, tmp_path: Path) -> None:
    count = dict(KINDS.values())[lens]
    camera = _camera(lens, SCALES[:count])
    X = np.column_stack([np.random.default_rng(0).uniform(-0.8, 0.8, (20, 2)), np.ones(20)])
    export({"a.png": camera}, tmp_path, to="colmap")
    view = read_model(tmp_path / "sparse" / "0").views[0]
    back = camera_of_row((view.K, np.eye(3), np.zeros(3)), view.size, view.distortion)
    np.testing.assert_allclose(back.project(X), camera.project(X), atol=1e-6)
