"""Reports of existing models: scores against brute force and closed form, formats, refusals."""

import csv
import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from validation.command import main
from validation.metrics.cameras import area_under_recall, mean_accuracy, recall, relative_pose_errors

K = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]


def poses(n, seed=0):
    rng = np.random.default_rng(seed)
    return Rotation.from_rotvec(0.3 * rng.normal(size=(n, 3))).as_matrix(), rng.normal(size=(n, 3))


def test_relative_errors_are_those_of_pairs_one_by_one():
    R, C = poses(5)
    noisy = Rotation.from_rotvec(0.02 * np.random.default_rng(1).normal(size=(5, 3))).as_matrix() @ R
    moved = C + 0.05 * np.random.default_rng(2).normal(size=C.shape)
    found, expected = relative_pose_errors(noisy, moved, R, C), []
    for i in range(5):
        for j in range(i + 1, 5):
            turn = Rotation.from_matrix((noisy[j] @ noisy[i].T).T @ R[j] @ R[i].T).magnitude()
            a, b = noisy[i] @ (moved[j] - moved[i]), R[i] @ (C[j] - C[i])
            cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
            expected.append(np.degrees(max(turn, np.arccos(cosine))))
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    # A similarity of the world and its scale change nothing.
    Q = Rotation.from_rotvec([0.1, 2.0, -0.4]).as_matrix()
    np.testing.assert_allclose(
        relative_pose_errors(noisy @ Q.T, 3.0 * moved @ Q.T + 7.0, R, C), expected, rtol=1e-6
    )


def test_missing_cameras_fail_and_unknown_truth_is_left_out():
    R, C = poses(4)
    missing, unknown = C.copy(), C.copy()
    missing[0], unknown[3] = np.nan, np.nan
    found = relative_pose_errors(R, missing, R, C)
    assert np.isinf(found).sum() == 3
    assert np.nan_to_num(found, posinf=0.0).max() < 1e-5
    assert len(relative_pose_errors(R, C, R, unknown)) == 3
    same = C.copy()
    same[1] = same[0]
    assert relative_pose_errors(R, C, R, same)[0] < 1e-5, "one centre: the rotation alone is judged"


def test_the_area_is_the_integral_of_the_recall():
    errors = np.random.default_rng(0).exponential(2.0, 300)
    at = np.linspace(0.0, 5.0, 200_001)
    assert area_under_recall(errors, 5.0) == pytest.approx(
        np.trapezoid(recall(errors, at), at) / 5.0, abs=1e-4
    )
    assert area_under_recall(np.array([np.inf, 0.0]), 5.0) == 0.5
    assert mean_accuracy(np.array([0.5, 9.5, 20.0])) == pytest.approx((10 + 1) / 30)


def write_model(path, R, C, *, f=500.0, scale=1.0, names=None, std=None):
    K_own = np.diag([f / 500.0, f / 500.0, 1.0]) @ K
    cameras = []
    for i, (turn, centre) in enumerate(zip(R, C, strict=True)):
        entry = {"name": f"{i}.png" if names is None else names[i], "width": 640, "height": 480}
        entry |= {"K": K_own.tolist(), "R": turn.tolist(), "t": (-turn @ (scale * centre)).tolist()}
        stated = {**{f"centre_{a}": std for a in "xyz"}, "focal_px": 2.0}
        cameras.append(entry if std is None else {**entry, "std": stated})
    path.write_text(json.dumps({"cameras": cameras}))
    return path


def test_a_report_of_two_models_is_one_command(tmp_path, capsys):
    R, C = poses(8)
    truth = write_model(tmp_path / "truth.json", R, C)
    good = write_model(tmp_path / "good.json", R, C + 1e-3, f=501.0, scale=4.0, std=0.01)
    turned = Rotation.from_rotvec([0, 0, 0.05]).as_matrix()
    R_bad = np.concatenate([R[:3], turned @ R[3:6]])
    bad = write_model(tmp_path / "bad.json", R_bad, C[:6])
    command = ["report", "--model", f"good={good}", "--model", f"bad={bad}", "--reference", str(truth)]
    assert main([*command, "-o", str(tmp_path / "out")]) == 0
    assert "2 models compared" in capsys.readouterr().out
    with (tmp_path / "out" / "numbers.csv").open(encoding="utf-8") as file:
        numbers = {line["name"]: line for line in csv.DictReader(file)}
    assert float(numbers["cameras found"]["good"]) == 100.0
    assert float(numbers["cameras found"]["bad"]) == 75.0
    assert float(numbers["AUC@1°"]["good"]) > 99.0
    # Three of the 28 pairs are of cameras that were not turned.
    assert 100.0 * 3 / 28 <= float(numbers["AUC@1°"]["bad"]) + 1e-3 < 100.0 * 7 / 28
    assert float(numbers["focal error, median"]["good"]) == pytest.approx(0.2)
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "good, bad against truth.json" in page
    assert page.count("stated 95 % intervals") == 2, "of centres and focal lengths, not of rotations"
    bars = {round(float(v), 4) for part in re.findall(r'"array": ?\[(.*?)\]', page) for v in part.split(",")}
    # Centres in units of the reference, whose scale is a quarter; focal lengths in per cent of 501 px.
    assert bars == {round(1.96 * 0.01 / 4.0, 4), round(100.0 * 1.96 * 2.0 / 501.0, 4)}


def test_models_that_cannot_be_compared_are_named(tmp_path, capsys):
    R, C = poses(4)
    truth = write_model(tmp_path / "truth.json", R, C)
    other = write_model(tmp_path / "other.json", R, C, names=["a", "b", "c", "d"])
    out = ["-o", str(tmp_path / "out")]
    for words, options in {
        "mine: the models have no common camera": ["--model", f"mine={other}", "--reference", str(truth)],
        "there is no": ["--model", "mine=none.json", "--reference", str(truth)],
        "needs --model NAME=PATH, once or more, and --reference PATH": ["--model", f"mine={other}"],
        "two models are called 'a'": [
            "--model",
            f"a={truth}",
            "--model",
            f"a={other}",
            "--reference",
            str(truth),
        ],
    }.items():
        assert main(["report", *options, *out]) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
