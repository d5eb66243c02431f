"""The direction of F: x2' F x1 = 0 in every library."""

import numpy as np
import pytest

from tests.validation.references.conftest import skip_without
from validation.metrics.fundamental_precision import rms_epipolar_distance
from validation.references.fundamental import SOLVERS, estimate_with, opencv_eight_point

skip_without("cv2", "pycolmap", "poselib")


@pytest.mark.parametrize("method", SOLVERS)
def test_lines_in_the_second_image_are_f_times_points_of_the_first(method, looked):
    xy1, xy2 = looked.xy
    F = estimate_with(method, xy1, xy2, threshold_px=1.0, seed=0).F
    assert F is not None
    lines = np.column_stack([xy1, np.ones(len(xy1))]) @ F.T
    off = np.abs((lines * np.column_stack([xy2, np.ones(len(xy2))])).sum(axis=1))
    assert (off / np.linalg.norm(lines[:, :2], axis=1)).max() < 0.02
    assert rms_epipolar_distance(F.T, np.hstack([xy1, xy2])) > 5.0


def test_so_are_those_of_the_eight_point_method(looked):
    F = opencv_eight_point(*looked.xy)
    assert rms_epipolar_distance(F, np.hstack([*looked.xy])) < 1e-4
