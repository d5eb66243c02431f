"""Chapter 5 on real matches: turntable tracks with known cameras, hand-labelled wrong matches."""

import os
from pathlib import Path

import numpy as np
import pytest

from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac, estimate_fundamental
from thesisrecon.epipolar.ransac import ThesisRansac
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals

pytestmark = pytest.mark.real
DATA = Path(os.environ.get("THESISRECON_DATA", Path(__file__).resolve().parents[2] / "../shared/data"))


def load(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"the real data are not on this machine ({name})")
    return np.loadtxt(path)


@pytest.mark.parametrize("estimator", [LocallyOptimisedRansac(), ThesisRansac()])
@pytest.mark.parametrize("view", [0, 9, 20])
def test_turntable_tracks(estimator, view):
    tracks = load("dinosaur/tracks.txt")
    P = load("dinosaur/projections.txt").reshape(-1, 3, 4)
    seen = tracks.reshape(len(tracks), -1, 2)[:, view : view + 2]
    seen = seen[(seen != -1).all(axis=(1, 2))]
    xy1, xy2 = seen[:, 0].copy(), seen[:, 1].copy()
    good = np.abs(sampson_residuals(fundamental_from_cameras(P[view], P[view + 1]), xy1, xy2)) < 1.0
    rng = np.random.default_rng(view)
    wrong = rng.random(len(xy1)) < 0.2
    xy2[wrong] = rng.uniform(xy2.min(axis=0), xy2.max(axis=0), (int(wrong.sum()), 2))
    fit = estimator.estimate(xy1, xy2, rng)
    assert fit.sigma_px < 0.5
    assert fit.inliers[good & ~wrong].mean() > 0.8
    assert fit.inliers[wrong].mean() < 0.1


@pytest.mark.parametrize("name", ["biscuit", "book"])
def test_hand_labelled_matches(name):
    rows = load(f"adelaide/{name}/matches.txt")
    right = rows[:, 4] > 0
    fit = estimate_fundamental(rows[:, :2], rows[:, 2:4], threshold_px=2.0)
    assert fit.inliers[right].mean() > 0.7
    assert fit.inliers[~right].mean() < 0.15
