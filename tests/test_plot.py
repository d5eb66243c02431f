"""Pictures: every function draws into a given axis or a new figure, and records show themselves."""

import numpy as np
import pytest

import thesisrecon as tr

plot = pytest.importorskip("thesisrecon.plot")
figure = pytest.importorskip("matplotlib.figure", reason="the extra plot")

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
CAMERAS = [tr.Camera(K, np.eye(3), np.array([-x, 0.0, 5]), (640, 480), [-0.1]) for x in (0.0, 1.0, 2.0)]
X = np.random.default_rng(0).uniform(-1, 1, (40, 3))
GREY = np.full((480, 640), 128, np.uint8)
XY = [camera.project(X) for camera in CAMERAS]
NOISY = [xy + np.random.default_rng(k).normal(0, 0.5, (40, 2)) for k, xy in enumerate(XY[:2])]
FIT = tr.estimate_fundamental(*NOISY, method="gold-standard")
ONES = np.ones((9, 9), np.float32)
DEPTH = tr.DepthMap(0, CAMERAS[0].P, np.where(np.eye(9), np.nan, ONES), ONES, ONES.astype(np.uint8))
MESH = tr.TexturedMesh(X[:4] + np.array([0, 0, 3.0]), np.array([[0, 1, 2], [1, 3, 2]]))
P = np.array([camera.P for camera in CAMERAS])
R = tr.reconstruction_from_cameras(P, sizes=(640, 480), xy=np.stack(XY), X=X)

PICTURES = {
    "matches": lambda ax: plot.matches(GREY, GREY, *XY[:2], inliers=np.arange(40) > 9, ax=ax),
    "epipolar_lines": lambda ax: plot.epipolar_lines(GREY, FIT, XY[0], XY[1], ax=ax),
    "corners": lambda ax: plot.corners(GREY, XY[0], ax=ax),
    "residuals": lambda ax: plot.residuals(XY[0], XY[1] - XY[0], size=(640, 480), ax=ax),
    "depth": lambda ax: plot.depth(DEPTH, ax=ax),
    "lens": lambda ax: plot.lens(CAMERAS[0], ax=ax),
    "focal": lambda ax: plot.focal([499.0, 502.0], [1.0, 1.5], truth=500.0, ax=ax),
    "cameras": lambda ax: plot.cameras(CAMERAS, X, covariance=np.tile(1e-3 * np.eye(3), (40, 1, 1)), ax=ax),
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_drawn_into_a_given_axis_or_a_new_figure(name):
    mine = figure.Figure()
    ax = mine.add_subplot(projection="3d" if name == "cameras" else None)
    for found in (PICTURES[name](ax), PICTURES[name](None)):
        assert found.axes[0].has_data()
        found.canvas.draw()
    assert PICTURES[name](ax) is mine


def test_the_band_of_an_epipolar_line_is_its_interval():
    """The distance of a point from a line F x1 is normal with the variance x' A S A' x over |l|^2."""
    xy1 = np.array([[300.0, 200.0]])
    covariance = 1e-4 * FIT.covariance  # small, as the first order assumes
    (band,) = plot.epipolar_lines(GREY, FIT.F, xy1, covariance=covariance).axes[0].patches
    line = tr.epipolar_lines(FIT.F, xy1)[0]
    corners = band.get_xy()
    half = np.abs(corners @ line[:2] + line[2])[:60]
    rng, samples = np.random.default_rng(0), []
    ends = corners[:60] - (corners[:60] @ line[:2] + line[2])[:, None] * line[:2]
    for f in rng.multivariate_normal(FIT.F.ravel(), covariance, 4000):
        l = tr.epipolar_lines(f.reshape(3, 3), xy1)[0]
        samples.append(np.abs(ends @ l[:2] + l[2]))
    np.testing.assert_allclose((np.array(samples) <= half).mean(axis=0), 0.95, atol=0.015)


@pytest.mark.parametrize("record", [CAMERAS[0], R, FIT, DEPTH, MESH], ids=lambda one: type(one).__name__)
def test_a_record_shows_a_picture_and_its_numbers(record):
    page = record._repr_html_()
    assert "data:image/png;base64," in page
    assert f"<caption>{type(record).__name__}</caption>" in page


def test_a_comparison_of_a_model_shows_itself_and_other_records_do_not():
    path = tr.sample() / "cameras.json"
    assert "centre_error, median" in tr.compare_models(path, path)._repr_html_()
    assert tr.DisparityMap(np.zeros((2, 2)), np.zeros((2, 2)), 1.0)._repr_html_() is None


def test_strata_are_side_by_side():
    found = plot.strata({"projective": np.column_stack([X, 1 + 0.2 * X[:, 0]]), "metric": R})
    assert [ax.get_title() for ax in found.axes] == ["projective", "metric"]
