"""The tutorial: each script of examples/ runs, makes its figures, and shows what its text says."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
pytestmark = pytest.mark.slow


@pytest.fixture
def run(capsys):
    """A function that runs the example of a number: its variables and what it printed."""
    matplotlib = pytest.importorskip("matplotlib", reason="the examples draw with matplotlib, extra docs")
    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    def run_example(number):
        (path,) = EXAMPLES.glob(f"{number:02d}_*.py")
        names = runpy.run_path(str(path), run_name="__main__")
        figures = [plt.figure(number) for number in plt.get_fignums()]
        assert figures
        for figure in figures:
            figure.canvas.draw()
            assert all(axis.has_data() for axis in figure.axes)
        return names, capsys.readouterr().out

    yield run_example
    plt.close("all")


def test_corners_are_matched(run):
    names, _ = run(1)
    assert len(names["inside"]) > 10
    assert names["pair"].inliers > 1200
    assert names["pair"].sigma_px < 0.1


def test_the_gold_standard_reaches_the_bound(run):
    names, _ = run(2)
    found = np.sqrt(np.mean(names["errors"][-2:] ** 2, axis=1))
    assert np.allclose(found, names["sigma"] * np.sqrt(14 / np.array(names["counts"][-2:])), rtol=0.15)
    assert names["fit"].determined


def test_each_stratum_restores_its_invariants(run):
    _, text = run(3)
    found = {
        line.split(":")[0]: [float(v) for v in re.findall(r"[\d.]+", line)] for line in text.splitlines()
    }
    assert list(found) == ["projective", "affine", "metric"]
    for residual, cross, _, _ in found.values():
        assert residual < 0.2
        assert cross == pytest.approx(4 / 3, abs=2e-3)
    assert abs(found["projective"][2] - 1.0) > 0.1
    assert found["affine"][2] == pytest.approx(1.0, abs=0.02)
    assert abs(found["affine"][3] - 90.0) > 5.0
    assert found["metric"][3] == pytest.approx(90.0, abs=1.0)


def test_every_method_calibrates(run):
    names, text = run(4)
    errors = {name: abs(K[0, 0] / 842.0 - 1.0) for name, (K, _) in names["found"].items()}
    assert len(errors) == 7
    assert 0.02 < errors.pop("linear-quadric") < 0.2
    assert "linear-quadric: " in text
    assert max(errors.values()) < 0.02
    K, std = names["found"]["metric stage"]
    assert abs(K[0, 0] - 842.0) < 3.0 * std


def test_critical_motions_are_named_and_leave_the_focal_length_open(run):
    names, text = run(5)
    lines = text.splitlines()
    assert [line.split(".")[0].split()[-1] for line in lines] == ["True", "True", "False", "False"]
    assert "turntable motion" in lines[1]
    assert "close to a pure translation" in lines[2]
    assert "rotated about its optical axis" in lines[3]
    assert np.ptp(names["rms"]) < 0.01  # of the last motion


def test_intervals_contain_the_truth(run):
    names, _ = run(6)
    assert (names["inside"].mean(axis=0) > 0.88).all()
    predicted = names["sigma"] * np.sqrt(1 - names["d"] / names["N"])
    assert np.sqrt(np.mean(names["residual"] ** 2)) == pytest.approx(predicted, rel=0.01)


def test_rows_correspond_and_disparities_are_those_of_the_scene(run):
    names, _ = run(7)
    assert np.sqrt(np.mean((names["rows"][0] - names["rows"][1]) ** 2)) < 0.2
    assert np.median(names["error"]) < 0.3


def test_depths_and_model_are_those_of_the_scene(run):
    names, _ = run(8)
    assert names["known"] > 0.7
    assert names["median"] < 0.5
    assert len(names["mesh"].faces) > 5000
    assert names["mesh"].texture is not None


def test_the_synthesised_view_resembles_the_image(run):
    names, _ = run(9)
    assert names["psnr"] > 21.0


def test_an_own_variant_is_compared(run):
    names, _ = run(10)
    found = {one.variant: one for one in names["report"].comparisons}
    assert found["EveryMatch"].verdict == found["thesis-ransac"].verdict == "worse"
    assert names["low"] > 20.0  # of the last variant, EveryMatch


def test_the_comparison_with_colmap_runs_with_and_without_it(run):
    names, text = run(11)
    assert names["found"]["thesisrecon"].centre_error.max() < 2e-3
    assert ("COLMAP" in names["found"]) == (names["pycolmap"] is not None) == ("not installed" not in text)


def test_a_lens_is_found_without_a_prior(run):
    names, printed = run(12)
    assert "lens: fisheye" in printed
    camera, truth = names["camera"], names["truth"]
    off = np.abs(np.subtract(camera.angles_of_view, truth.angles_of_view))
    assert (off < 3.0 * np.array([camera.std["angle_of_view_deg"], camera.std["corner_deg"]])).all()
    assert off[0] < 0.3
    assert np.ptp(names["scale"]) < 0.005 * names["scale"].mean()
