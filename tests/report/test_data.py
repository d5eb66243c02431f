import dataclasses

import numpy as np
import pytest

from tests.report.synthetic import made_up_run, projective_run
from thesisrecon.records import HeldOut, TexturedMesh


def test_the_metric_reconstruction_goes_before_the_projective_one():
    data, early = made_up_run(points=100), projective_run()
    assert data.metric is not None
    assert data.best_reconstruction is data.metric.reconstruction
    assert early.best_reconstruction is early.reconstruction
    assert dataclasses.replace(early, reconstruction=None).best_reconstruction is None


def test_records_that_disagree_are_refused():
    data = made_up_run(points=100)
    with pytest.raises(ValueError, match="one camera per photograph"):
        dataclasses.replace(data, photographs=data.photographs[:-1])
    with pytest.raises(ValueError, match=r"colours must be \(100, 3\)"):
        dataclasses.replace(data, colours=np.zeros((99, 3), dtype=np.uint8))
    wrong = dataclasses.replace(data.pairs[0], j=99)
    with pytest.raises(ValueError, match="pairs must name views"):
        dataclasses.replace(data, pairs=[wrong])


def test_intrinsics_are_told_in_pixels_of_the_file():
    data = made_up_run(points=100)  # worked at a quarter of the size
    assert data.metric is not None
    working, original = data.metric.intrinsics[0], data.original_intrinsics[0]
    assert original["focal_px"].value == pytest.approx(4 * working["focal_px"].value)
    assert original["focal_px"].std == pytest.approx(4 * working["focal_px"].std)
    # The middle of the file stays the middle: (x + 0.5) / s - 0.5.
    assert original["principal_x_px"].value == pytest.approx(
        4 * (working["principal_x_px"].value + 0.5) - 0.5
    )
    assert original["k1"] == working["k1"]
    assert data.original_intrinsics[-1] == {}
    assert dataclasses.replace(data, metric=None, colours=None).original_intrinsics == ({},) * 9


def test_a_model_and_its_pictures_must_belong_to_the_run():
    data = made_up_run(points=100)
    mesh = TexturedMesh(np.eye(3), np.array([[0, 1, 2]]))
    assert dataclasses.replace(data, model=mesh).model is mesh
    with pytest.raises(ValueError, match="model needs the metric reconstruction"):
        dataclasses.replace(projective_run(), model=mesh)
    with pytest.raises(ValueError, match="depth_pictures must name views below 9"):
        dataclasses.replace(data, depth_pictures={9: np.ones((3, 4), dtype=np.float32)})
    pixels = np.zeros((4, 6, 3), dtype=np.uint8)
    compared = np.zeros((4, 6), dtype=bool)
    compared[:2] = True
    assert HeldOut(0, pixels, pixels, compared, 30.0, 0.9).share == 0.5
    with pytest.raises(ValueError, match="of one size"):
        HeldOut(0, pixels, pixels[:3], compared, 30.0, 0.9)
