"""The study of the plane of the initial cameras in small."""

import pytest

from validation.studies.projective import IDENTITY, KINDS, ROTATION, check_kind


@pytest.mark.parametrize("kind", KINDS)
def test_the_plane_nearest_to_a_rotation_serves_however_the_camera_is_held(kind):
    condition, beyond, _ = rows = check_kind(kind, trials=2)
    assert not [row for row in rows if row.verdict == "missed"]
    if kind in ("on its side", "upside down"):
        assert condition.values[IDENTITY] > 2.0 * condition.values[ROTATION]
        assert beyond.values[IDENTITY] >= beyond.values[ROTATION]
