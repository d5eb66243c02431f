import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon import average_rotations, average_translations


def _relative(n=60, wrong=0.2, noise=0.005):
    """Relative poses of which some are wrong: pairs, R_ij, t_ij, true R and C, wrong pairs."""
    rng = np.random.default_rng(0)
    R, C = Rotation.random(n, random_state=1).as_matrix(), rng.normal(size=(n, 3))
    i = np.repeat(np.arange(n), 8)
    j = (i + np.tile([1, 2, 3, 5, 8, 13, 21, 34], n)) % n
    off, t = rng.random(len(i)) < wrong, np.einsum("eij,ej->ei", R[j], C[i] - C[j])
    turned = Rotation.from_rotvec(noise * rng.normal(size=(len(i), 3))).as_matrix()
    turned[off] = Rotation.random(off.sum(), random_state=2).as_matrix()
    t = t / np.linalg.norm(t, axis=1, keepdims=True) + noise * rng.normal(size=t.shape)
    t[off] = rng.normal(size=(off.sum(), 3))
    return np.column_stack([i, j]), turned @ R[j] @ R[i].swapaxes(1, 2), t, R, C, off


def _similar(centres, C):
    centred = C - C.mean(axis=0)
    return np.linalg.norm(centres - centred / np.sqrt((centred**2).sum(axis=1).mean()), axis=1)


def test_averages_of_exact_relative_poses_are_exact():
    pairs, relative, t, R, C, _ = _relative(wrong=0.0, noise=0.0)
    found = average_rotations(pairs, relative)
    np.testing.assert_allclose(found.R, R @ R[0].T, atol=1e-9)
    centres = average_translations(pairs, t, R)
    assert _similar(centres.centres, C).max() < 1e-3
    assert max(found.residual_deg.max(), centres.residual_deg.max()) < 0.1


def test_wrong_relative_poses_have_no_influence():
    pairs, relative, t, R, C, off = _relative()
    found = average_rotations(pairs, relative)
    turned = Rotation.from_matrix(found.R @ R[0] @ R.swapaxes(1, 2)).magnitude()
    # The noise of a pair is .5 degrees; a camera has sixteen.
    assert np.degrees(turned).max() < 0.5
    assert found.weight[off & (found.residual_deg > 10.0)].max() < 0.1 < found.weight[~off].min()
    centres = average_translations(pairs, t, found.R @ R[0])
    assert np.median(_similar(centres.centres, C)) < 0.02
    assert np.median(centres.residual_deg[~off]) < 1.0 < np.median(centres.residual_deg[off])


def test_cameras_without_a_path_to_the_first_one_have_no_average():
    pairs, relative, t, *_ = _relative(n=40)
    inside = (pairs < 30).all(axis=1) | (pairs >= 30).all(axis=1)
    found = average_rotations(pairs[inside], relative[inside])
    assert np.isfinite(found.R[:30]).all()
    assert np.isnan(found.R[30:]).all()
    centres = average_translations(pairs[inside], t[inside], found.R)
    assert np.isnan(centres.centres[30:]).all()
    assert np.isfinite(centres.residual_deg).tolist() == (pairs[inside] < 30).all(axis=1).tolist()


@pytest.mark.parametrize("pairs", [[[0, 0]], [[0, -1]], [0, 1], [[0, 10**6]]])
def test_pairs_of_no_two_cameras_are_refused(pairs):
    refuses(ValueError, "average_rotations needs", average_rotations, pairs, np.eye(3)[None])
