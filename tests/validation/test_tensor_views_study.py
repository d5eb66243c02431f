"""Views by the trilinear tensor beside real photographs and rendered truth."""

import numpy as np

from thesisrecon.views.trilinear import CalibratedPair
from validation.studies.tensor_views import Place


def test_positions_are_stated_in_baselines():
    K = np.array([[900.0, 0.0, 511.5], [0.0, 900.0, 383.5], [0.0, 0.0, 1.0]])
    pair = CalibratedPair(K, K, np.eye(3), np.array([-1.0, 0.0, 0.0]))
    for place, centre in (
        (Place(1.5), (1.5, 0.0, 0.0)),
        (Place(-0.25), (-0.25, 0.0, 0.0)),
        (Place(0.5), (0.5, 0.0, 0.0)),
        (Place(0.5, 0.3, "up"), (0.5, -0.3, 0.0)),
        (Place(0.5, 0.3, "back"), (0.5, 0.0, -0.3)),
    ):
        camera = place.of(pair)
        # From the second camera, which is one baseline on.
        found = np.array([1.0, 0.0, 0.0]) - camera.rotation.T @ camera.translation
        np.testing.assert_allclose(found, centre, atol=1e-12)
