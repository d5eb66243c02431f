"""Photographs that were zoomed and cropped digitally, whose true intrinsics are hence known exactly.

All other promises stand in ``validation/gates.toml``.
"""

import numpy as np
import pytest

import thesisrecon
from thesisrecon.config import PipelineConfig
from thesisrecon.intrinsics import IntrinsicsOptions
from validation.metrics.intervals import focal_errors_pct, interval_scores
from validation.scenes.real import load_real_scene
from validation.scenes.zoomed import rezoom_scene

ZOOM_MEDIAN_PCT, ZOOM_WORST_PCT = 0.5, 3.0


@pytest.mark.real
def test_zoomed_and_cropped_photographs_are_calibrated_each_for_itself(tmp_path):
    whole = load_real_scene("Herz-Jesus-P8")
    if whole is None:
        pytest.skip("the photographs of Herz-Jesus-P8 are not on this machine (THESISRECON_DATA)")
    scene = rezoom_scene(whole, tmp_path / "images", seed=0)
    config = PipelineConfig(intrinsics=IntrinsicsOptions(cameras="per-image"))
    result = thesisrecon.reconstruct(
        list(scene.image_paths), tmp_path / "out", config=config, seed=0, until="metric"
    )
    assert result.metric is not None
    assert result.metric.trusted, result.metric.failed_checks
    found = result.metric.reconstruction
    assert found.registered.all()
    assert found.K is not None
    assert scene.K is not None
    errors = focal_errors_pct(found.K, scene.K)
    assert np.median(errors) <= ZOOM_MEDIAN_PCT
    assert errors.max() <= ZOOM_WORST_PCT
    assert interval_scores(result.metric, scene.K).holding() >= 0.92
