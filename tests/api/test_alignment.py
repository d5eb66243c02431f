import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from thesisrecon import (
    Camera,
    UsageError,
    align_to_positions,
    reconstruction_from_cameras,
    scaled,
    scaled_by_points,
)
from thesisrecon.results import SparseModel, SparseView

R0, T0, S0 = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix(), np.array([40.0, -7.0, 3.0]), 2.5


def make_model(count, seed=0):
    rng = np.random.default_rng(seed)
    K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    views = []
    for i in range(count):
        R = Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_matrix()
        t = -R @ np.array([*rng.uniform(-3, 3, 2), -6 + rng.uniform(-1, 1)])
        views.append(SparseView(f"{i}.jpg", R, t, K, (640, 480), np.zeros(3)))
    X = rng.uniform(-1, 1, (20, 3))
    xy = np.concatenate([Camera(v.K, v.R, v.t, v.size).project(X) for v in views])
    return SparseModel(views, X, None, np.repeat(np.arange(count), 20), np.tile(np.arange(20), count), xy)


def true_positions(model):
    return {view.name: S0 * R0 @ view.centre + T0 for view in model.views}


def observed(model):
    views = [model.views[i] for i in model.view_index]
    pairs = zip(views, model.X[model.point_index], strict=True)
    return np.array([Camera(v.K, v.R, v.t, v.size).project(X[None])[0] for v, X in pairs])


@pytest.mark.parametrize("count", [3, 4, 25])
def test_exact_positions_give_the_similarity_and_keep_every_projection(count):
    model = make_model(count)
    aligned, report = align_to_positions(model, true_positions(model))
    assert report.similarity.scale == pytest.approx(S0, rel=1e-9)
    assert report.inlier.all()
    np.testing.assert_allclose(aligned.X, S0 * model.X @ R0.T + T0, atol=1e-8)
    np.testing.assert_allclose(observed(aligned), model.xy, atol=1e-6)
    for view, position in zip(aligned.views, true_positions(model).values(), strict=True):
        np.testing.assert_allclose(view.centre, position, atol=1e-8)
    if count == 25:
        moved = true_positions(model) | {"2.jpg": true_positions(model)["2.jpg"] + [0.0, 3.0, 4.0]}
        _, report = align_to_positions(model, moved)
        assert "2.jpg: 5  (outlier, not used)" in str(report)
        assert report.distance[2] == pytest.approx(5.0)


@pytest.mark.parametrize(("count", "wrong"), [(6, 1), (12, 4), (40, 15)])
@pytest.mark.parametrize("seed", range(5))
def test_wrong_positions_are_found_and_the_noise_is_measured(count, wrong, seed):
    model, rng = make_model(count, seed), np.random.default_rng(seed)
    positions = {name: X + rng.normal(0, 0.02, 3) for name, X in true_positions(model).items()}
    bad = rng.choice(count, wrong, replace=False)
    for i in bad:
        positions[f"{i}.jpg"] += rng.choice([-1, 1], 3) * rng.uniform(2, 30, 3)
    aligned, report = align_to_positions(model, positions | {"lost.jpg": np.zeros(3)}, seed=seed)
    assert not report.inlier[bad].any()
    # 1 % of the good positions are beyond the limit, more if there are few of them.
    assert report.inlier.sum() >= 0.8 * (count - wrong)
    assert 0.005 < report.sigma < 0.04
    errors = [view.centre - X for view, X in zip(aligned.views, true_positions(model).values(), strict=True)]
    assert np.sqrt(np.mean(np.square(errors))) < 0.03
    assert report.unknown == ("lost.jpg",)
    text = str(report)
    assert text.count("outlier") == count - report.inlier.sum()
    assert f"{report.inlier.sum()} of {count} positions used" in text


def test_a_missing_position_costs_one_image_and_too_few_or_collinear_ones_are_refused():
    model = make_model(6)
    positions = true_positions(model)
    few = {name: positions[name] for name in ("0.jpg", "1.jpg")}
    words = "at least 3 images; got 2; 'x.jpg' is not an image of the model"
    refuses(UsageError, words, align_to_positions, model, few | {"x.jpg": np.zeros(3)})
    for wrong in ([0.0, 1.0], 3.0, "0 1 2", [0.0, np.inf, 1.0]):
        bad = positions | {"0.jpg": wrong}
        refuses(
            UsageError, "three coordinates of each position; that of 0.jpg", align_to_positions, model, bad
        )
    refuses(UsageError, "positions by image name", align_to_positions, model, [np.zeros(3)] * 6)
    line = [SparseView(f"{i}.jpg", np.eye(3), np.array([float(i), 0, 0])) for i in range(6)]
    words = "camera centres of the 6 images lie on one line"
    refuses(UsageError, words, align_to_positions, SparseModel(line), positions)
    on_line = {f"{i}.jpg": [1.0 * i, 2.0 * i, 0.0] for i in range(6)}
    refuses(UsageError, "the positions of the 6 images lie on one line", align_to_positions, model, on_line)
    # A street: beside its line there is only noise.
    rng = np.random.default_rng(1)
    street = [SparseView(v.name, v.R, v.t + rng.normal(0, 0.02, 3)) for v in line]
    noisy = {view.name: view.centre + rng.normal(0, 0.05, 3) for view in line}
    refuses(UsageError, "rotation about it undetermined", align_to_positions, SparseModel(street), noisy)
    model = make_model(10)
    for missing in ([0.0, np.nan, 1.0], None, [None] * 3, np.ma.masked_all(3)):
        moved, report = align_to_positions(model, true_positions(model) | {"4.jpg": missing})
        assert report.missing == ("4.jpg",)
        assert "1 image without a position, such as 4.jpg" in str(report)
        np.testing.assert_allclose(moved.views[4].centre, true_positions(model)["4.jpg"], atol=1e-9)


def test_a_known_distance_gives_the_scale_of_cameras_in_any_form():
    views = make_model(4).views
    cameras = {view.name: Camera(view.K, view.R, view.t, view.size, view.distortion) for view in views}
    K, R, t = (np.array([getattr(view, name) for view in views]) for name in ("K", "R", "t"))
    for model in (cameras, list(cameras.values()), reconstruction_from_cameras(K, R, t, sizes=(640, 480))):
        first, last = (f"{k}.jpg" if isinstance(model, dict) else f"image-{k}" for k in (0, 3))
        found = scaled(model, first, last, 7.0)
        assert np.linalg.norm(found.views[0].centre - found.views[3].centre) == pytest.approx(7.0)
        assert {view.camera for view in found.views} == {0}
    refuses(UsageError, "0.jpg is a ndarray", scaled, {"0.jpg": np.eye(3, 4)}, "0.jpg", "1.jpg", 1.0)
    refuses(UsageError, "a model must be", scaled, 3, "0.jpg", "1.jpg", 1.0)
    model = make_model(4)
    metres = scaled(model, "1.jpg", "3.jpg", 7.5)
    assert np.linalg.norm(metres.views[1].centre - metres.views[3].centre) == pytest.approx(7.5)
    np.testing.assert_allclose(observed(metres), model.xy, atol=1e-6)
    for names, distance, words in [
        (("1.jpg", "4.jpg"), 1.0, "unknown image '4.jpg'"),
        (("1.jpg", "1.jpg"), 1.0, "positive distance of two different cameras"),
        (("1.jpg", "2.jpg"), 0.0, "got 0"),
        (("1.jpg", "2.jpg"), np.nan, "got nan"),
    ]:
        refuses(UsageError, words, scaled, model, *names, distance)


def test_two_points_seen_in_images_set_the_scale_also_with_a_lens_and_from_a_file(tmp_path):
    rng = np.random.default_rng(4)
    K = np.array([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]])
    ends = np.array([[0.2, -0.3, 0.1], [0.6, 0.4, -0.2]])
    R = Rotation.from_euler("yx", rng.uniform(-0.3, 0.3, (3, 2))).as_matrix()
    t = np.column_stack([rng.uniform(-1, 1, (3, 2)), np.full(3, 5.0)])
    size, lens = (1280, 960), np.array([-0.15, 0.02])
    model = {f"{i}.jpg": Camera(K, R[i], t[i], size, lens) for i in range(3)}
    pixels = {name: camera.project(ends) + rng.normal(0, 0.02, (2, 2)) for name, camera in model.items()}
    found = scaled_by_points(model, pixels, 1.25)
    true = 1.25 / np.linalg.norm(ends[1] - ends[0])
    for view, camera in zip(found.views, model.values(), strict=True):
        assert view.centre == pytest.approx(true * camera.centre, rel=2e-3)
    lines = [f"{name},{','.join(map(str, xy.ravel()))}" for name, xy in pixels.items()]
    (tmp_path / "ruler.csv").write_text("name,x1,y1,x2,y2\n" + "\n".join(lines))
    again = scaled_by_points(model, tmp_path / "ruler.csv", 1.25)
    assert again.views[2].centre == pytest.approx(found.views[2].centre)
    (tmp_path / "ruler.csv").write_text("0.jpg,1,2,3\n")
    words = "line 1 of .* must hold name,x1,y1,x2,y2"
    refuses(UsageError, words, scaled_by_points, model, tmp_path / "ruler.csv", 1.0)
    refuses(UsageError, "two images", scaled_by_points, model, {"0.jpg": pixels["0.jpg"]}, 1.0)
    refuses(UsageError, "not an image", scaled_by_points, model, {"x": pixels["0.jpg"]}, 1.0)
    swapped = {**pixels, "1.jpg": pixels["1.jpg"][::-1]}
    refuses(UsageError, "not show the same two points", scaled_by_points, model, swapped, 1.0)
    refuses(UsageError, "positive distance", scaled_by_points, model, pixels, 0.0)
