"""The study of triangulation methods in small: what its tables claim holds."""

import pytest

pytest.importorskip("cv2")
pytest.importorskip("pycolmap")

from validation.studies.triangulation import (
    FRAMES,
    GEOMETRIES,
    OPENCV,
    OPENCV_POLYNOMIAL,
    OPTIMAL,
    POLYNOMIAL,
    SCENES,
    check_optimum,
    check_study,
    compare_methods,
)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("frame", FRAMES)
def test_no_method_reprojects_better_than_the_optimal_ones(scene, frame):
    rows = check_study(scene, frame, trials=3, points=30)
    assert len(rows) == 15
    assert not [row for row in rows if row.verdict == "missed"]


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_the_polynomial_method_is_at_the_optimum_wherever_the_epipoles_are(kind):
    assert check_optimum(kind, trials=4, points=50).verdict == "reached"


def test_optimal_methods_know_no_frame_and_the_midpoint_does():
    found = {
        frame: compare_methods("two views beside each other", 2.0, frame, trials=12, points=60)
        for frame in FRAMES
    }
    for method in (POLYNOMIAL, OPTIMAL, OPENCV_POLYNOMIAL):
        for frame in FRAMES:
            assert found[frame][method].image_px == pytest.approx(found["metric"][method].image_px, rel=1e-6)
    midpoint = {frame: found[frame]["mid-point"] for frame in FRAMES}
    assert midpoint["projective"].image_px > 1.05 * midpoint["metric"].image_px
    assert midpoint["projective"].space_pct > midpoint["metric"].space_pct
    # In a metric frame the plain linear method of two alike cameras is OpenCV's.
    assert found["metric"]["linear"].image_px == pytest.approx(found["metric"][OPENCV].image_px, rel=1e-3)
