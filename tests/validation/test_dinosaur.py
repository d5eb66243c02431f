"""The dinosaur: all 36 cameras of a real turntable from tracks alone, beside the published ones."""

import numpy as np
import pytest

from validation.scenes.dinosaur import load_dinosaur
from validation.studies.dinosaur import compare, to_metrics

pytestmark = pytest.mark.real


@pytest.fixture(scope="module")
def comparison():
    dinosaur = load_dinosaur()
    if dinosaur is None:
        pytest.skip("the dinosaur's tracks are not on this machine")
    return compare(dinosaur)


def test_all_cameras_are_found_and_explain_the_tracks_as_well_as_the_published_ones(comparison):
    missed = [row for row in to_metrics(comparison) if row.verdict == "missed"]
    assert not missed, missed


def test_hardly_an_observation_is_refused_and_the_noise_is_small(comparison):
    found = comparison.reconstruction
    assert found.inlier.mean() > 0.97
    assert found.valid.mean() > 0.98
    assert comparison.rms_px(comparison.ours) < 0.45
    assert np.nanmedian(comparison.ours.px) < 0.25
