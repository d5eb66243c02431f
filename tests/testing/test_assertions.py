"""Accuracy gates: simulated errors of known size, power of gates, and a foreign repository that uses them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import thesisrecon.testing as gates
from thesisrecon import Camera, estimate_fundamental
from thesisrecon.epipolar.refinement import wrong_match_covariance
from thesisrecon.geometry.homogeneous import scene_frame
from thesisrecon.optimize.bundle.covariance import gauge_directions

ROOT = Path(__file__).resolve().parents[2]
SIZE = (640, 480)
F_STD, POINT_STD, TURN_STD, CENTRE_STD = 1.5, 1.0, np.radians(0.05), 0.01
SCALE = 3.0  # Of the world of the model that is judged


def cameras(n=12, seed=0):
    rng = np.random.default_rng(seed)
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    R = Rotation.from_rotvec(0.4 * rng.normal(size=(n, 3))).as_matrix()
    return {f"{i}.png": Camera(K, r, rng.normal(size=3), SIZE) for i, r in enumerate(R)}


def deviations(R, C):
    """Standard deviations (V, 6) of rotations and centres with independent noise, in the inner gauge."""
    origin, scale = scene_frame(C)
    N = gauge_directions(R, -np.einsum("vab,vb->va", R, scale * (C - origin)))
    noise = np.tile([TURN_STD] * 3 + [scale * SCALE * CENTRE_STD] * 3, len(R))
    projected = (np.eye(len(N)) - N @ N.T) * noise
    covariance = (projected @ projected.T).reshape(len(R), 6, len(R), 6)
    own = np.array([covariance[v, :, v] for v in range(len(R))])
    centre = np.einsum("vba,vbc,vcd->vad", R, own[:, 3:, 3:], R) / scale**2
    return np.sqrt(
        np.concatenate([np.diagonal(c, axis1=1, axis2=2) for c in (own[:, :3, :3], centre)], axis=1)
    )


def moved(truth, seed, *, sigmas=1.0):
    """The cameras in another world, with errors of the size that they state."""
    rng, found = np.random.default_rng(seed), {}
    Q, shift = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), np.array([4.0, -1.0, 2.0])
    R = np.array([c.R @ Q.T for c in truth.values()])
    C = np.array([SCALE * Q @ c.centre + shift for c in truth.values()])
    std = deviations(R, C)
    std[:, :3] = np.degrees(std[:, :3])
    R = Rotation.from_rotvec(TURN_STD * sigmas * rng.normal(size=(len(R), 3))).as_matrix() @ R
    C = C + sigmas * CENTRE_STD * SCALE * rng.normal(size=C.shape)
    f = sigmas * F_STD * rng.normal()
    for i, (name, camera) in enumerate(truth.items()):
        K = camera.K + np.diag([f, f, 0.0])
        K[:2, 2] += sigmas * POINT_STD * rng.normal(size=2)
        stated = {"focal_px": F_STD, "principal_x_px": POINT_STD, "principal_y_px": POINT_STD}
        stated |= {f"rotation_{axis}_deg": value for axis, value in zip("xyz", std[i, :3], strict=True)}
        stated |= {f"centre_{axis}": value for axis, value in zip("xyz", std[i, 3:], strict=True)}
        found[name] = Camera(K, R[i], -R[i] @ C[i], SIZE, std=stated)
    return found


def test_errors_in_stated_deviations_are_normal_in_any_world():
    truth = cameras()
    z = np.array([gates.camera_deviations(moved(truth, seed), truth).z for seed in range(60)])
    for columns in (slice(1), slice(1, 3), slice(3, 6), slice(6, 9)):
        assert np.sqrt(np.mean(z[:, :, columns] ** 2)) == pytest.approx(1.0, abs=0.15)
    exact = gates.camera_deviations(moved(truth, 0, sigmas=0.0), truth)
    assert np.abs(exact.z).max() < 1e-4
    assert max(exact.focal_pct.max(), exact.rotation_deg.max(), exact.centre.max()) < 1e-5


def test_right_cameras_pass_and_small_faults_do_not():
    truth = cameras()
    for seed in range(20):
        gates.assert_cameras(moved(truth, seed), truth, max_sigmas=4.5)
    one = moved(truth, 0)
    camera = one["3.png"]
    one["3.png"] = Camera(camera.K, camera.R, camera.t + 0.25 * SCALE * np.eye(3)[1], SIZE, std=camera.std)
    with pytest.raises(
        AssertionError, match=r"centre_. of 3.png is .* standard deviations off, the limit is 4"
    ):
        gates.assert_cameras(one, truth)
    missing = {name: c for name, c in one.items() if name != "5.png"}
    with pytest.raises(AssertionError, match=r"1 cameras of the truth are missing, such as 5.png"):
        gates.assert_cameras(missing, truth, max_sigmas=100.0)
    plain = {name: Camera(c.K, c.R, c.t, SIZE) for name, c in truth.items()}
    with pytest.raises(AssertionError, match="this gate sees nothing"):
        gates.assert_cameras(plain, truth)
    gates.assert_cameras(plain, truth, max_centre_error=1e-6, max_rotation_error_deg=1e-5)


def test_a_gate_sees_what_it_says_and_nothing_smaller():
    truth = cameras()
    sees = (4.0 + gates.POWER) * 100.0 * F_STD / 500.0
    gates.assert_cameras(moved(truth, 1), truth, sees={"focal_pct": 1.01 * sees})
    with pytest.raises(
        AssertionError, match=r"this gate sees 1.7 of focal_pct in 95 of 100 cases, and should 1.5"
    ):
        gates.assert_cameras(moved(truth, 1), truth, sees={"focal_pct": 1.5})
    caught = 0
    for seed in range(200):
        found = {
            name: Camera(c.K * [[1.0 + sees / 100.0], [1.0 + sees / 100.0], [1.0]], c.R, c.t, SIZE, std=c.std)
            for name, c in moved(truth, seed).items()
        }
        try:
            gates.assert_cameras(found, truth)
        except AssertionError as error:
            caught += "focal_px" in str(error) or "principal" in str(error)
    assert caught >= 190


def test_fundamental_matrices_within_their_covariance_and_a_distance():
    sizes = []
    for seed in range(12):
        pair = gates.two_views(120, noise_px=0.4, seed=seed)
        found = estimate_fundamental(pair.xy1, pair.xy2)
        sizes.append(gates.assert_fundamental(found, pair.F))
        gates.assert_fundamental(found, pair.true_matches, max_px=0.6)
    assert 0.7 < np.sqrt(np.mean(np.square(sizes))) < 1.4
    turned = pair.F + 0.02 * np.linalg.norm(pair.F) * np.eye(3)
    with pytest.raises(AssertionError, match="stated standard deviations off"):
        gates.assert_fundamental(found, turned)
    with pytest.raises(AssertionError, match=r"px from their lines, the limit is 0.6"):
        gates.assert_fundamental(turned, pair.true_matches, max_px=0.6)
    with pytest.raises(ValueError, match="needs an estimate with a covariance"):
        gates.assert_fundamental(pair.F, pair.F)


def test_clouds_by_accuracy_and_completeness():
    X = np.random.default_rng(0).normal(size=(400, 3))
    near = X[:200] + 1e-3 * np.eye(3)[2]
    accuracy, completeness = gates.assert_cloud(near, X, max_accuracy=2e-3)
    assert accuracy == pytest.approx(1e-3, rel=1e-6)
    with pytest.raises(AssertionError, match=r"completeness is .*, the limit is 0.01"):
        gates.assert_cloud(near, X, max_accuracy=2e-3, max_completeness=0.01, quantile=0.9)
    assert completeness > accuracy


FOREIGN = """
import pytest
from thesisrecon import estimate_fundamental
from thesisrecon.testing import assert_fundamental

def test_my_pair(thesisrecon_two_views):
    pair = thesisrecon_two_views(noise_px=0.3)
    assert_fundamental(estimate_fundamental(pair.xy1, pair.xy2), pair.F)
"""


def run_foreign(folder, text):
    (folder / "test_mine.py").write_text(text, encoding="utf-8")
    (folder / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "thesisrecon.testing.plugin",
        "-p",
        "no:cacheprovider",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environment, check=False)
    return done.returncode, done.stdout + done.stderr


def test_a_gate_in_a_foreign_repository_is_six_lines(tmp_path):
    code, said = run_foreign(tmp_path, FOREIGN)
    assert code == 0, said
    assert "F: sees 2 of deviations" in said or re.search(r"F: sees [\d.]+ of deviations", said)
    assert len([line for line in FOREIGN.splitlines() if line and not line.startswith("import pytest")]) <= 6


def test_a_gate_that_cannot_see_what_it_is_for_is_not_collected(tmp_path):
    blind = "@pytest.mark.accuracy_gate(sees=0.1, noise=0.02, limit=0.5)\ndef test_my"
    code, said = run_foreign(tmp_path, FOREIGN.replace("def test_my", blind))
    assert code == 4
    assert (
        "test_my_pair sees 0.533, which is more than 0.1: lower its limit (0.5) or its noise (0.02)" in said
    )
    code, said = run_foreign(tmp_path, FOREIGN.replace("def test_my", blind.replace("0.5", "0.05")))
    assert code == 0, said
    code, said = run_foreign(
        tmp_path, FOREIGN.replace("def test_my", "@pytest.mark.accuracy_gate(sees=1)\ndef test_my")
    )
    assert (code, "accuracy_gate takes numbers sees, noise and limit" in said) == (4, True)


def test_the_covariance_of_F_contains_accepted_wrong_matches():
    """200 matches, a fifth of them wrong: a third of the pairs accepts one, which turns F towards itself."""
    z = {False: [], True: []}
    for seed in range(100):
        pair = gates.two_views(200, noise_px=0.5, outliers=0.2, seed=1000 + seed)
        found = estimate_fundamental(pair.xy1, pair.xy2)
        accepted = bool((found.inliers & ~pair.inlier).any())
        z[accepted].append(gates.assert_fundamental(found, pair.F, false_alarm=1e-300))
        added = wrong_match_covariance(found, pair.xy1, pair.xy2)
        # A covariance, of matrices of rank 2 and unit norm.
        assert np.linalg.eigvalsh(added).min() >= -1e-9 * np.trace(added)
        assert np.abs(added @ found.F.ravel()).max() <= 1e-6 * np.trace(added)
    assert 25 < len(z[True]) < 60
    for squares, low, high in ((z[False], 0.9, 1.1), (z[True], 0.9, 1.3), (z[False] + z[True], 0.95, 1.15)):
        assert low < np.sqrt(np.mean(np.square(squares))) < high
    # Without the addition 70 of 100.
    assert sum(7.0 * v**2 < 14.07 for v in z[False] + z[True]) >= 90
    found.inliers[:] = True
    assert not wrong_match_covariance(found, pair.xy1, pair.xy2).any()
