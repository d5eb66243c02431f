"""Views by the trilinear tensor beside real photographs and rendered truth."""

import numpy as np
import pytest

from thesisrecon.views.trilinear import CalibratedPair
from validation.studies.tensor_views import Measured, Place, draw, linear_range


def test_positions_have_the_stated_distance_from_the_baseline():
    K = np.array([[900.0, 0.0, 511.5], [0.0, 900.0, 383.5], [0.0, 0.0, 1.0]])
    pair = CalibratedPair(K, K, np.eye(3), np.array([-1.0, 0.0, 0.0]))
    for place, centre, distance in (
        (Place(1.5), (1.5, 0.0, 0.0), 0.5),
        (Place(-0.25), (-0.25, 0.0, 0.0), 0.25),
        (Place(0.5), (0.5, 0.0, 0.0), 0.0),
        (Place(0.5, 0.3, "up"), (0.5, -0.3, 0.0), 0.3),
        (Place(0.5, 0.3, "back"), (0.5, 0.0, -0.3), 0.3),
    ):
        camera = place.of(pair)
        # From the second camera, which is one baseline on.
        found = np.array([1.0, 0.0, 0.0]) - camera.rotation.T @ camera.translation
        np.testing.assert_allclose(found, centre, atol=1e-12)
        assert place.distance == pytest.approx(distance)


def test_the_linear_range_ends_where_proportion_does():
    offs = {1.25: 1.0, 1.5: 2.05, 2.0: 6.0}
    rows = [Measured(Place(s), "guessed K", 25.0, 0.8, (off, 2 * off)) for s, off in offs.items()]
    assert linear_range(rows, "guessed K") == (0.5, 4.0)
    assert len(draw(rows).data) == 4
