"""The accuracy of the default estimator of F on real photographs, held below fixed limits.

Each limit is about one and a half times what is reached with any seed, so that it catches damage and not
luck; sampling without refinement (OpenCV's FM_RANSAC) is beyond most of them. Hand-made correspondences are
themselves good to half a pixel or so, which is why their limits differ from pair to pair.
"""

from itertools import islice

import numpy as np
import pytest

from thesisrecon.epipolar.locally_optimised import estimate_fundamental
from validation.metrics.epipolar import precision_recall, rms_epipolar_distance
from validation.scenes.real import load_real_scene
from validation.scenes.real_pairs import adelaide_pairs, camera_pairs, kusvod2_pairs

SEEDS = (0, 1, 2)
ORDERS = (0, 1, 2, 3, 4)
HAND_MADE_PX = {"Leuven1": 0.65, "booksh": 1.5, "corr": 0.35, "head": 1.3, "plant": 1.05}
CAMERAS_PX = {"fountain-P11": 0.2, "Herz-Jesus-P8": 0.25}
LABELLED = {"biscuit": (0.93, 0.9), "book": (0.93, 0.82)}
"""Least precision and recall at a threshold of 1 px."""

pytestmark = pytest.mark.real


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("matches")


def pairs_or_skip(pairs):
    found = list(pairs)
    if not found:
        pytest.skip("the real photographs are not on this machine (THESISRECON_DATA)")
    return found


@pytest.mark.parametrize("name", HAND_MADE_PX)
def test_hand_made_correspondences_lie_on_their_lines(name, cache):
    (pair,) = pairs_or_skip(kusvod2_pairs(cache, (name,)))
    fits = (estimate_fundamental(pair.xy1, pair.xy2, seed=seed) for seed in ORDERS)
    errors = np.array([rms_epipolar_distance(fit.F, pair.truth) for fit in fits])
    # "head" has two geometries that explain nearly as much: every method ends in the other one now and then.
    assert np.count_nonzero(errors >= HAND_MADE_PX[name]) <= 1, errors


@pytest.mark.parametrize("name", CAMERAS_PX)
def test_correspondences_of_the_true_cameras_lie_on_their_lines(name, cache):
    for pair in pairs_or_skip(islice(camera_pairs(load_real_scene(name), cache), 2)):
        assert len(pair.truth) > 300
        assert rms_epipolar_distance(pair.F, pair.truth) < 1e-6
        for seed in SEEDS:
            fit = estimate_fundamental(pair.xy1, pair.xy2, seed=seed)
            assert rms_epipolar_distance(fit.F, pair.truth) < CAMERAS_PX[name]


@pytest.mark.parametrize("name", LABELLED)
def test_inliers_are_the_matches_labelled_right(name):
    (pair,) = [p for p in pairs_or_skip(adelaide_pairs()) if p.name == name]
    for seed in SEEDS:
        fit = estimate_fundamental(pair.xy1, pair.xy2, seed=seed)
        precision, recall = precision_recall(fit.inliers, pair.right)
        assert precision > LABELLED[name][0]
        assert recall > LABELLED[name][1]
