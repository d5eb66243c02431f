"""The exercises: solutions pass, the fault of wrong ones is named, and the command grades files."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from thesisrecon.cli.commands import run_command

HOME = Path(__file__).parents[2] / "exercises"
NAMES = sorted(path.stem for path in HOME.glob("*.py") if path.stem not in ("grader", "causes", "variants"))
PAGE = HOME.parent / "docs" / "recipes" / "exercises.md"

# Name -> a line of the solution, the wrong line, and words of the reason.
WRONG = {
    "intersection": [
        ("x[:, :2] / x[:, 2:]", "x[:, :2]", "not divided"),
        ("np.cross(a, b), np.cross(c, d)", "np.cross(a, c), np.cross(b, d)", "ac and bd"),
        ("return x[:, :2]", "return -x[:, :2]", "sign"),
        ("x[:, :2] / x[:, 2:]", "x[:, 1::-1] / x[:, 2:]", "x and y are swapped"),
    ],
    "homography": [
        ("np.linalg.inv(T2) @ H @ T1", "np.linalg.inv(np.linalg.inv(T2) @ H @ T1)", "inverted"),
        ("np.linalg.inv(T2) @ H @ T1", "H", "not undone"),
        (
            "T = np.array([[s, 0, -s * mean[0]], [0, s, -s * mean[1]], [0, 0, 1]])",
            "T = np.eye(3)",
            "not normalised",
        ),
        (".reshape(3, 3)", ".reshape(3, 3).T", "transposed"),
    ],
    "camera_from_points": [
        ("return K / K[2, 2], R, t", "return K / K[2, 2], R.T, t", "R is transposed"),
        ("return K / K[2, 2], R, t", "return K, R, t", "divide K by it"),
        ("t = np.linalg.inv(K) @ P[:, 3]", "t = -np.linalg.inv(P[:, :3]) @ P[:, 3]", "camera centre"),
        (
            "P = P * np.sign(np.linalg.det(P[:, :3]))",
            "P = -P * np.sign(np.linalg.det(P[:, :3]))",
            "det R = -1",
        ),
    ],
    "eight_point": [
        ("(x2[:, :, None] * x1[:, None, :])", "(x1[:, :, None] * x2[:, None, :])", "transposed"),
        ("return T2.T @ F @ T1", "return F", "not undone"),
        ("s[2] = 0", "pass", "rank"),
        ("return T2.T @ F @ T1", "return np.linalg.inv(T2) @ F @ T1", "homography"),
    ],
    "triangulation": [
        ("X[:3] / X[3]", "X[:3]", "not divided"),
        ("[2][-1]", "[2][:, -1]", "column"),
        ("x1 * P1[2] - P1[0], y1 * P1[2] - P1[1]", "y1 * P1[2] - P1[0], x1 * P1[2] - P1[1]", "in image 1"),
        ("x2 * P2[2] - P2[0], y2 * P2[2] - P2[1]", "x2 * P1[2] - P1[0], y2 * P1[2] - P1[1]", "with P1"),
    ],
    "relative_pose": [
        ("front > best", "best < 0", "cheirality"),
        ("* np.sign(np.linalg.det(A))", "", "det R = -1"),
        ("best, pose = front, (R, t)", "best, pose = front, (R.T, -R.T @ t)", "inverse pose"),
        ("best, pose = front, (R, t)", "best, pose = front, (R, -t)", "t has the wrong sign"),
    ],
    "seven_point": [
        (
            "T2.T @ (k * F1 + (1 - k) * F2) @ T1 for",
            "(T2.T @ (k * F1 + (1 - k) * F2) @ T1).T for",
            "transposed",
        ),
        ("np.polyfit(a, values, 3)", "np.polyfit(a, values, 3)[::-1]", "reverse order"),
        ("T2.T @ (k * F1 + (1 - k) * F2)", "T2.T @ (k * F2 + (1 - k) * F1)", "swapped"),
        ("np.abs(roots.imag) < 1e-6", "roots.real == roots.real", "complex"),
    ],
    "pose_from_points": [
        ("return U @ Vt,", "return P[:, :3] / s.mean(),", "not a rotation"),
        ("P[:, 3] / s.mean()", "P[:, 3]", "not divided"),
        ("np.linalg.inv(K) @ dlt", "dlt", "K is not used"),
        ("return U @ Vt,", "return (U @ Vt).T,", "transposed"),
    ],
    "height": [
        (
            "np.linalg.norm(np.cross(v, t), axis=1)",
            "np.linalg.norm(np.cross(v, b), axis=1)",
            "crossed with b",
        ),
        ("np.abs(b @ l)", "np.abs(t @ l)", "multiplied with t"),
        ("ratio(v, l, base, top) / known", "known / ratio(v, l, base, top)", "inverted"),
        ("return known_height * ratio", "return ratio", "known height is not used"),
    ],
    "factorisation": [
        ("(xy - t[:, None])", "xy", "not subtracted"),
        ("s[:3]", "np.sqrt(s[:3])", "square root"),
        ("* s[:3]", "", "not used"),
        ("xy.mean(axis=1)", "np.tile(xy.mean(axis=(0, 1)), (len(xy), 1))", "each image has its own"),
    ],
    "horizon": [
        (
            "return np.array([[1, 0, 0], [0, 1, 0], l / l[2]])",
            "return np.linalg.inv([[1, 0, 0], [0, 1, 0], l / l[2]])",
            "inverted",
        ),
        ("l = np.cross(v1, v2) / [1000, 1000, 1]", "l = np.cross(v1, v2)", "not undone"),
        ("[0, 1, 0], l / l[2]])", "[0, 1, 0], l / l[2]]).T", "transposed"),
        ("np.cross(ends[:, 0], ends[:, 1])", "np.cross(ends[:2, 0], ends[:2, 1])", "first two segments"),
    ],
    "dual_quadric": [
        ("np.sqrt(w[:, 0, 0] / w[:, 2, 2])", "w[:, 0, 0] / w[:, 2, 2]", "root is missing"),
        ("w[:, 0, 0] / w[:, 2, 2]", "w[:, 2, 2] / w[:, 0, 0]", "inverted"),
        ("return np", "return -np", "sign"),
        ("return np", "return 1000 * np", "pixels"),
    ],
    "ransac": [
        ("return best", "return ~best", "inverted"),
        (" < threshold", " < np.inf", "all matches"),
        (
            "inliers = sampson(eight_point(xy1[some], xy2[some])",
            "inliers = sampson(eight_point(xy1, xy2)",
            "without samples",
        ),
        ("eight_point(xy1[some], xy2[some])", "eight_point(xy2[some], xy1[some])", "transposed"),
    ],
    "bundle": [
        ("return r_best, t_best, X_best", "return r_best, t_best, X", "adjusted points are not returned"),
        ("return r_best, t_best, X_best", "return r, t, X_best", "adjusted cameras are not returned"),
        ("return r_best, t_best, X_best", "return r, t_best, X_best", "rotations are not returned"),
        ('x_scale="jac"', 'x_scale="jac", max_nfev=1', "initial values"),
    ],
    "disparity": [
        ("jump = penalty * np.abs", "jump = 0 * np.abs", "no penalty"),
        (
            "d[:, x - 1] = came[np.arange(len(d)), x, d[:, x]]",
            "d[:, x - 1] = S[:, x - 1].argmin(axis=1)",
            "backward pass",
        ),
        ("costs(left, right, count), left", "costs(right, left, count), left", "left and right are swapped"),
        ("    return d", "    return d + 1", "larger by 1"),
    ],
}


@pytest.fixture(scope="module", autouse=True)
def grader():
    """The grader with the modules beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(HOME))
        yield importlib.import_module("grader")
    for name in [
        name
        for name in sys.modules
        if name.split(".")[0] in ("grader", "causes", "variants", "checks", "solutions")
    ]:
        del sys.modules[name]


def source(name):
    return (HOME / "solutions" / f"{name}.py").read_text("utf-8")


@pytest.mark.parametrize("name", NAMES)
def test_solutions_pass_in_twelve_lines_and_skeletons_are_not_written(name, grader):
    passed, lines = grader.grade(name, grader.solution(name))
    assert passed, lines
    function = next(n for n in ast.parse(source(name)).body if getattr(n, "name", "") == name)
    assert function.end_lineno - function.body[0].end_lineno <= 12
    passed, lines = grader.grade(name, grader.read(HOME / f"{name}.py", name))
    assert not passed
    assert "is not written yet" in lines[0]


def test_wrong_solutions_are_told_why(grader, tmp_path):
    """Each is a solution with one line changed."""
    missed = []
    for name, changes in WRONG.items():
        for k, (line, wrong, words) in enumerate(changes):
            path = tmp_path / f"{name}{k}.py"
            assert line in source(name)
            path.write_text(source(name).replace(line, wrong), "utf-8")
            passed, lines = grader.grade(name, grader.read(path, name), path)
            if passed or not lines[-1].startswith("reason: ") or words not in lines[-1]:
                missed.append((name, wrong, lines))
    assert {len(changes) for changes in WRONG.values()} == {4}
    assert WRONG.keys() == {*NAMES}
    assert len(missed) <= 4 * len(NAMES) // 10, missed


# Mistakes that no table lists: a changed expression, what makes the results right, what was called.
UNLISTED = [
    ("homography", "np.linalg.inv(T2) @ H", "T2.T @ H", "transposed, not inverted"),
    ("homography", "np.linalg.inv(T2) @ H @ T1", "T2 @ H @ np.linalg.inv(T1)", "outer factors"),
    ("triangulation", "x1 * P1[2] - P1[0]", "x1 * P1[2] + P1[0]", "a sign"),
    (
        "triangulation",
        "array(points)",
        "array(points)[:, [0, 2, 1]]",
        "the columns of the result are not in order",
    ),
    ("triangulation", "array(points)", "array(points) + 1", "the result is right up to a constant, of 1"),
    ("factorisation", "Vt[:3]", "Vt[1:4]", "shifted"),
    ("dual_quadric", "w[..., 1, 1]]", "w[..., 2, 2]]", "other indices"),
    ("dual_quadric", "return np", "return 3 * np", "the result is right up to a factor, of 3"),
    ("ransac", "< threshold", "** 2 < threshold", "the square of the distance"),
    ("ransac", "range(500)", "range(9)", "9 samples are few"),
    ("ransac", "inliers.sum() > best.sum()", "True", "the last sample is kept"),
    ("bundle", "R.transpose(0, 2, 1)", "R", "the residuals are those of R' X + t"),
    ("intersection", "in (a, b, c, d)", "in (a, a + 1, c, d)", "b is not used"),
]


@pytest.mark.parametrize(("name", "line", "wrong", "words"), UNLISTED)
def test_a_mistake_that_is_not_listed_is_named(name, line, wrong, words, grader, tmp_path):
    path = tmp_path / "my.py"
    assert line in source(name)
    path.write_text(source(name).replace(line, wrong), "utf-8")
    passed, lines = grader.grade(name, grader.read(path, name), path)
    assert not passed
    assert lines[-1].startswith(f"reason: {words}")


HEAD = "import numpy as np\n\n\ndef triangulation(P1, P2, xy1, xy2):\n    "


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return 1 / 0", "raised ZeroDivisionError in line 5: division by zero"),
        ("pass", "returns None"),
        ("return np.zeros((3, len(xy1)))", "has the shape (3, 40), not (N, 3)"),
        ("return np.full((len(xy1), 3), np.nan)", "contains NaN"),
        ("return np.ones((len(xy1), 3)) * 1j", "is complex"),
        ("return", "returns None"),
        ("raise SystemExit", "raised SystemExit in line 5"),
        ("return np.array([P1", "line 5 is not Python"),
        ("return 0\n\n\ndel triangulation", "defines no function triangulation(P1, P2, xy1, xy2)"),
        (
            "return np.cos(P1[0, 0] * P2.sum() * xy1[:, :1] * xy2[:, 1:] + [0, 1, 2])",
            "no usual mistake explains the error; it must be at most 0.0",
        ),
    ],
)
def test_what_cannot_be_graded_is_one_sentence(body, words, grader, tmp_path, capsys):
    path = tmp_path / "my.py"
    path.write_text(HEAD + body + "\n", "utf-8")
    assert grader.main("triangulation", path) == 4
    verdict, *lines = capsys.readouterr().out.splitlines()
    assert verdict == "triangulation: not solved"
    assert words in lines[-1]
    assert len(lines) <= 2


def test_the_command_lists_shows_and_checks(tmp_path, capfd):
    # In a process of its own: the modules beside the grader are not on the path of the command.
    command = [sys.executable, "-m", "thesisrecon", "exercises"]
    listed = subprocess.run(command, cwd=HOME.parent, capture_output=True, text=True, check=True).stdout
    assert all(re.search(rf"^{name} ", listed, re.M) for name in NAMES)
    assert run_command(["exercises", "show", "eight_point"]) == 0
    assert capfd.readouterr().out == (HOME / "eight_point.py").read_text("utf-8")
    right = HOME / "solutions" / "eight_point.py"
    assert run_command(["exercises", "check", "eight_point", str(right)]) == 0
    assert "eight_point: passed\nerror " in capfd.readouterr().out
    endless = tmp_path / "my.py"
    endless.write_text("def eight_point(xy1, xy2):\n    while True:\n        pass\n")
    assert run_command(["exercises", "check", "eight_point", str(endless), "--seconds", "5"]) == 4
    assert "did not end within 5 s" in capfd.readouterr().out
    assert run_command(["exercises", "check", "nine_point", str(right)]) == 2
    assert "eight_point" in capfd.readouterr().err
    assert run_command(["exercises", "check", "eight_point", str(tmp_path / "none.py")]) == 2
    assert "none.py" in capfd.readouterr().err
    assert run_command(["exercises", "check"]) == 2


def test_the_page_for_teachers_has_a_row_for_each(grader):
    page = PAGE.read_text("utf-8")
    assert [name for name in grader.titles() if f"| `{name}` |" not in page] == []
