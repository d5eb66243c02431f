"""The default front end on real photographs, held beside SIFT by fixed limits.

Each limit leaves a tenth to a fifth of what is reached, so that it catches damage and not luck; all of them
are stricter than what is promised (1.05, 1.4 and 1.7 times SIFT's verified matches for neighbours, (i, i+2)
and (i, i+3); 0.6, 0.7 and 0.75 of its sigma).
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic import reconstruction_of
from thesisrecon.geometry.camera_matrix import calibration_matrix, compose_camera, project_camera
from thesisrecon.records import TwoView
from validation.studies.front_end import CONTRADICTS_PX, disagreement, judge
from validation.studies.front_end_pairs import OURS, SIFT, check_pairs, measure_pairs

# (scene, gap): pairs measured, least ratio of verified matches and largest of sigma, and error of F in px.
LIMITS = {
    ("fountain-P11", 1): (2, 1.55, 0.55, 0.15),
    ("fountain-P11", 3): (2, 2.0, 0.62, 0.15),
    ("Herz-Jesus-P8", 3): (2, 2.4, 0.45, 0.2),
}


@pytest.mark.real
@pytest.mark.parametrize(("scene", "gap"), LIMITS)
def test_pairs_have_more_and_finer_verified_matches_than_sift(scene, gap, tmp_path):
    most, verified, sigma, error_px = LIMITS[scene, gap]
    pairs = list(measure_pairs(scene, (gap,), tmp_path, names=(OURS, SIFT), most=most))
    if not pairs:
        pytest.skip("the real photographs are not on this machine (THESISRECON_DATA)")
    rows = {row.name: row.values[OURS] for row in check_pairs(scene, gap, pairs)}
    assert len(pairs) == most
    assert all(pair.by[OURS].view.accepted for pair in pairs)
    assert rows["verified, mean of the pairs' ratios to SIFT"] > verified
    assert rows["sigma, mean of the pairs' ratios to SIFT"] < sigma
    assert rows["largest error of F"] < error_px


def _model_and_pair(k1, moved):
    """Two cameras with distortion that saw 50 points; the model has the second one ``moved`` up."""
    rng = np.random.default_rng(0)
    X = rng.uniform([-1.0, -1.0, 3.0], [1.0, 1.0, 5.0], (50, 3))
    K, R, t = (
        calibration_matrix(700.0, 700.0, 319.5, 239.5),
        np.eye(3),
        np.array([[0.0] * 3, [-0.8, 0.0, 0.1]]),
    )
    xy1, xy2 = (project_camera(K, R, t[i], X, distortion=k1) for i in range(2))
    P = np.stack([compose_camera(K, R, t[0]), compose_camera(K, R, t[1] + [0.0, moved, 0.0])])
    lenses = {"K": np.stack([K, K]), "distortion": np.tile([k1, 0.0, 0.0], (2, 1))}
    model = reconstruction_of(P, (640, 480), **lenses)
    index = np.arange(50)
    affine = np.broadcast_to(np.eye(2), (50, 2, 2))
    pair = TwoView(0, 1, np.eye(3), 0.1, index, index, xy1, xy2, affine, 50, 0.0, True)
    return model, pair


def test_a_pair_agrees_with_the_cameras_that_saw_it_and_contradicts_others():
    model, pair = _model_and_pair(k1=-0.12, moved=0.0)
    assert disagreement(pair, model) < 1e-6
    assert not judge(pair, {"a model": model}).contradicts("a model")
    model, pair = _model_and_pair(k1=-0.12, moved=0.1)
    assert disagreement(pair, model) > CONTRADICTS_PX
    assert judge(pair, {"a model": model}).contradicts("a model")


def test_a_pair_whose_view_is_not_in_the_model_cannot_contradict_it():
    model, pair = _model_and_pair(k1=0.0, moved=0.1)
    partial = replace(model, registered=np.array([True, False]))
    assert np.isnan(disagreement(pair, partial))
    assert not judge(pair, {"a model": partial}).contradicts("a model")
