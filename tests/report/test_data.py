from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.report.synthetic import made_up_run, projective_run


def test_the_metric_reconstruction_goes_before_the_projective_one() -> None:
    data, early = made_up_run(points=100), projective_run()
    assert data.metric is not None
    assert data.best_reconstruction is data.metric.reconstruction
    assert early.best_reconstruction is early.reconstruction
    assert dataclasses.replace(early, reconstruction=None).best_reconstruction is None


def test_records_that_disagree_are_refused() -> None:
    data = made_up_run(points=100)
    with pytest.raises(ValueError, match="one camera per photograph"):
        dataclasses.replace(data, photographs=data.photographs[:-1])
    with pytest.raises(ValueError, match=r"colours must be \(100, 3\)"):
        dataclasses.replace(data, colours=np.zeros((99, 3), dtype=np.uint8))
    wrong = dataclasses.replace(data.pairs[0], j=99)
    with pytest.raises(ValueError, match="pairs must name views"):
        dataclasses.replace(data, pairs=[wrong])
