"""What the user assumes of the cameras, as the stages take it."""

import numpy as np
import pytest

from thesisrecon.config import config_from_toml, preset, toml_from_config
from thesisrecon.errors import UsageError
from thesisrecon.intrinsics import (
    INTRINSICS,
    IntrinsicsOptions,
    camera_numbers,
    prior_from_options,
    prior_warnings,
)

SIZES = [(4000, 3000), (4000, 3000), (3000, 4000)]
SCALES = np.array([0.4, 0.4, 0.25])


def stages_view(wish, exif=(np.nan,) * 3):
    return prior_from_options(wish, SIZES, np.array(exif), SCALES)


def test_by_default_a_camera_is_a_size_with_square_pixels_and_an_unknown_focal():
    got = stages_view(IntrinsicsOptions())
    assert got.group.tolist() == [0, 0, 1]
    assert not got.focal_known.any()
    focal, aspect, skew, x, y, k1 = got.std.T
    assert np.isinf(focal).all()
    assert not aspect.any()
    assert not skew.any()
    # 0.01 of the long side at working size, around the middle of the picture.
    np.testing.assert_allclose(x, [16.0, 16.0, 10.0])
    np.testing.assert_allclose(y, x)
    np.testing.assert_allclose(got.mean[:, 3:5], [[799.5, 599.5], [799.5, 599.5], [374.5, 499.5]])
    np.testing.assert_allclose(k1, 0.05)
    np.testing.assert_allclose(got.mean[:, 1:3], [[1.0, 0.0]] * 3)


def test_values_in_original_pixels_come_to_working_size():
    wish = IntrinsicsOptions(
        focal_px=5000.0, focal_std_rel=0.1, skew="constant", skew_px=10.0, skew_std_px=2.0,
        principal_point_px=(1999.5, 0.0),
    )  # fmt: skip
    got = stages_view(wish)
    np.testing.assert_allclose(got.mean[:, 0], [2000.0, 2000.0, 1250.0])
    np.testing.assert_allclose(got.std[:, 0], 0.1)
    np.testing.assert_allclose(got.mean[:, 2], [4.0, 4.0, 2.5])
    np.testing.assert_allclose(got.std[:, 2], [0.8, 0.8, 0.5])
    np.testing.assert_allclose(got.mean[0, 3:5], [799.5, -0.3])


def test_a_zooming_camera_keeps_the_rest():
    got = stages_view(IntrinsicsOptions(focal="free"))
    shared = dict(zip(INTRINSICS, got.shared.T.tolist(), strict=True))
    assert shared["focal"] == [0, 1, 2]
    assert shared["principal_x"] == shared["principal_y"] == shared["k1"] == [0, 0, 1]
    assert got.kind.tolist() == [0, 0, 1]
    assert camera_numbers(SIZES, IntrinsicsOptions(focal="free")).tolist() == [0, 1, 2]
    assert camera_numbers(SIZES, IntrinsicsOptions()).tolist() == [0, 0, 1]
    strange = stages_view(IntrinsicsOptions(cameras="per-image", common_prior=False))
    assert strange.kind.tolist() == [0, 1, 2]
    assert strange.shared[:, 3].tolist() == [0, 1, 2]


def test_the_header_speaks_where_it_is_wanted():
    wish = IntrinsicsOptions(exif=True, focal_std_rel=0.2)
    got = stages_view(wish, exif=(3000.0, np.nan, 4000.0))
    assert got.focal_known.tolist() == [True, False, True]
    np.testing.assert_allclose(got.mean[[0, 2], 0], [1200.0, 1000.0])
    known = stages_view(IntrinsicsOptions(focal="known", focal_px=3000.0))
    assert not known.std[:, 0].any()
    assert known.focal_known.all()


def test_a_known_focal_that_no_header_names_is_constant_and_said():
    wish = IntrinsicsOptions(focal="known", exif=True)
    silent = np.full(3, np.nan)
    got = stages_view(wish)
    assert got.group.tolist() == [0, 0, 1]
    assert np.isinf(got.std[:, 0]).all()
    assert camera_numbers(SIZES, wish, silent).tolist() == [0, 0, 1]
    (sentence,) = prior_warnings(wish, silent)
    assert "none of the 3 photographs" in sentence
    assert "constant" in sentence
    each = IntrinsicsOptions(focal="known", exif=True, cameras="per-image")
    assert stages_view(each).group.tolist() == [0, 1, 2]


def test_headers_that_speak_for_some_leave_the_others_to_share_one_focal():
    wish = IntrinsicsOptions(focal="known", exif=True)
    sizes = [(4000, 3000)] * 5
    exif = np.array([3000.0, np.nan, 3000.0, np.nan, 3500.0])
    got = prior_from_options(wish, sizes, exif, np.ones(5))
    assert (got.std[:, 0] == 0.0).tolist() == [True, False, True, False, True]
    assert got.shared[1, 0] == got.shared[3, 0]
    assert got.shared[1, 0] not in got.shared[[0, 2, 4], 0]
    # Cameras are counted by what they have in common: known to be alike, tied, or neither.
    assert camera_numbers(sizes, wish, exif).tolist() == [0, 1, 0, 1, 2]
    assert "2 of the 5 images" in prior_warnings(wish, exif)[0]
    assert "constant" in prior_warnings(wish, exif)[0]


def test_a_principal_point_far_outside_of_the_picture_is_refused():
    stages_view(IntrinsicsOptions(principal_point_px=(-2900.0, 1500.0)))
    with pytest.raises(UsageError, match="outside an image of 4000 x 3000 px"):
        stages_view(IntrinsicsOptions(principal_point_px=(1e5, 1500.0)))


@pytest.mark.parametrize("name", ["default", "thesis"])
def test_presets_survive_their_own_text(name):
    """A deviation that a mode makes idle stands in the text, as the default it is."""
    assert config_from_toml(toml_from_config(preset(name)), preset(name)) == preset(name)
    known = IntrinsicsOptions(principal_point="known", k1="known")
    assert (known.principal_point_std_rel, known.k1_std) == (0.01, 0.05)


@pytest.mark.parametrize(
    ("wish", "words"),
    [
        ({"focal_px": 100.0}, "needs focal_std_rel"),
        ({"focal": "known"}, "needs its value"),
        ({"focal_px": -1.0, "focal_std_rel": 0.1}, "focal_px must be above 0"),
        ({"focal_px": np.inf, "focal_std_rel": 0.1}, "focal_px must be above 0"),
        ({"aspect_ratio": 0.0}, "aspect_ratio must be above 0"),
        ({"k1_std": 0.0}, "mode known"),
        ({"aspect_std": -0.1}, "aspect_std must be above 0"),
        ({"skew_px": np.inf}, "skew_px must be a number"),
        ({"k1_value": np.nan}, "k1_value must be a number"),
        ({"principal_point_px": (np.inf, 0.0)}, "principal_point_px must be two numbers"),
        ({"k1_std": np.inf}, "k1_std must be finite"),
        ({"focal_std_rel": 0.1}, "has no effect without a focal length"),
        ({"focal": "known", "focal_px": 9.0, "focal_std_rel": 0.1}, "has no effect with focal = known"),
        ({"aspect_std": 0.1}, "has no effect with aspect = known"),
        ({"skew_std_px": 0.1}, "has no effect with skew = known"),
        ({"principal_point": "known", "principal_point_std_rel": 0.1}, "with principal_point = known"),
        ({"k1": "known", "k1_std": 0.1}, "has no effect with k1 = known"),
    ],
)
def test_wishes_that_contradict_themselves_are_refused(wish, words):
    with pytest.raises(ValueError, match=words):
        IntrinsicsOptions(**wish)
