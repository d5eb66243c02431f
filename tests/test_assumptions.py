"""What the user assumes of the cameras, as the stages take it."""

from __future__ import annotations

import numpy as np
import pytest

from thesisrecon.assumptions import IntrinsicsAssumption, assumptions_of_views, camera_numbers
from thesisrecon.types import INTRINSICS, Assumptions

SIZES = [(4000, 3000), (4000, 3000), (3000, 4000)]
SCALES = np.array([0.4, 0.4, 0.25])


def stages_view(wish: IntrinsicsAssumption, exif: tuple[float, ...] = (np.nan,) * 3) -> Assumptions:
    return assumptions_of_views(wish, SIZES, np.array(exif), SCALES)


def test_by_default_a_camera_is_a_size_with_square_pixels_and_an_unknown_focal() -> None:
    got = stages_view(IntrinsicsAssumption())
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


def test_values_in_original_pixels_come_to_working_size() -> None:
    wish = IntrinsicsAssumption(
        focal_px=5000.0, focal_std_rel=0.1, skew="constant", skew_px=10.0, skew_std_px=2.0,
        principal_point_px=(1999.5, 0.0),
    )  # fmt: skip
    got = stages_view(wish)
    np.testing.assert_allclose(got.mean[:, 0], [2000.0, 2000.0, 1250.0])
    np.testing.assert_allclose(got.std[:, 0], 0.1)
    np.testing.assert_allclose(got.mean[:, 2], [4.0, 4.0, 2.5])
    np.testing.assert_allclose(got.std[:, 2], [0.8, 0.8, 0.5])
    np.testing.assert_allclose(got.mean[0, 3:5], [799.5, -0.3])


def test_a_zooming_camera_keeps_the_rest() -> None:
    got = stages_view(IntrinsicsAssumption(focal="free"))
    shared = dict(zip(INTRINSICS, got.shared.T.tolist(), strict=True))
    assert shared["focal"] == [0, 1, 2]
    assert shared["principal_x"] == shared["principal_y"] == shared["k1"] == [0, 0, 1]
    assert got.alike.tolist() == [0, 0, 1]
    assert camera_numbers(SIZES, IntrinsicsAssumption(focal="free")).tolist() == [0, 1, 2]
    assert camera_numbers(SIZES, IntrinsicsAssumption()).tolist() == [0, 0, 1]
    strange = stages_view(IntrinsicsAssumption(cameras="per-image", alike=False))
    assert strange.alike.tolist() == [0, 1, 2]
    assert strange.shared[:, 3].tolist() == [0, 1, 2]


def test_the_header_speaks_where_it_is_wanted() -> None:
    wish = IntrinsicsAssumption(exif=True, focal_std_rel=0.2)
    got = stages_view(wish, exif=(3000.0, np.nan, 4000.0))
    assert got.focal_known.tolist() == [True, False, True]
    np.testing.assert_allclose(got.mean[[0, 2], 0], [1200.0, 1000.0])
    known = stages_view(IntrinsicsAssumption(focal="known", focal_px=3000.0))
    assert not known.std[:, 0].any()
    assert known.focal_known.all()


@pytest.mark.parametrize(
    ("wish", "words"),
    [
        ({"focal_px": 100.0}, "needs its weight"),
        ({"focal": "known"}, "needs its value"),
        ({"focal_px": -1.0, "focal_std_rel": 0.1}, "focal_px must be above 0"),
        ({"focal_px": np.inf, "focal_std_rel": 0.1}, "focal_px must be above 0"),
        ({"aspect_ratio": 0.0}, "aspect_ratio must be above 0"),
        ({"k1_std": 0.0}, "the mode known"),
        ({"aspect_std": -0.1}, "aspect_std must be above 0"),
    ],
)
def test_wishes_that_contradict_themselves_are_refused(wish: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        IntrinsicsAssumption(**wish)  # type: ignore[arg-type]
