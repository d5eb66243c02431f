"""The accuracy that is promised of the main job, from photographs to metric cameras, held against the truth.

Limits that the README states for the photographs; those of the courtyard are set at about three times what is
reached, so that they catch damage and not luck.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

import thesisrecon
from thesisrecon.config import PipelineConfig
from thesisrecon.types import RunResult
from validation.metrics.cameras import TrueCameras, measure_cameras, measure_reprojection
from validation.scenes.real import Scene, load_fixture_scene, load_real_scene


@dataclass(frozen=True)
class Promise:
    """Largest focal error (%), principal point error (px), mean centre error (mm), median residual (px)."""

    focal_pct: float
    principal_point_px: float
    centre_mm: float
    median_px: float


PROMISES = {
    "courtyard": Promise(0.1, 1.0, 1.0, 0.15),
    "fountain-P11": Promise(0.5, 5.0, 8.0, 0.35),
    "Herz-Jesus-P8": Promise(0.5, 5.0, 8.0, 0.35),
}


def scene_or_skip(name: str) -> Scene:
    if name == "courtyard":
        return load_fixture_scene(name)
    scene = load_real_scene(name)
    if scene is None:
        pytest.skip(f"the photographs of {name} are not on this machine (THESISRECON_DATA)")
    return scene


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Scene], RunResult]:
    """The main job on a scene, done once for all tests."""

    @cache
    def once(name: str) -> RunResult:
        out = tmp_path_factory.mktemp(name) / "out"
        paths = list(scene_or_skip(name).image_paths)
        return thesisrecon.reconstruct(paths, out, config=PipelineConfig(), seed=0)

    return lambda scene: once(scene.name)


@pytest.mark.parametrize(
    "name",
    [
        "courtyard",
        pytest.param("fountain-P11", marks=pytest.mark.real),
        pytest.param("Herz-Jesus-P8", marks=pytest.mark.real),
    ],
)
def test_cameras_are_as_near_to_the_truth_as_promised(name: str, run: Callable[[Scene], RunResult]) -> None:
    scene, promise = scene_or_skip(name), PROMISES[name]
    result = run(scene)
    assert result.metric is not None
    assert result.metric.trusted, result.metric.doubts
    model = result.metric.reconstruction
    assert model.registered.all()
    assert scene.K is not None
    assert scene.R is not None
    assert scene.C is not None
    errors = measure_cameras(model, TrueCameras(scene.K, scene.R, scene.C))
    assert errors.centre_error is not None
    assert errors.focal_error_pct <= promise.focal_pct
    assert errors.principal_point_error_px <= promise.principal_point_px
    assert 1000.0 * errors.centre_error <= promise.centre_mm
    assert measure_reprojection(model).median_px <= promise.median_px


@pytest.mark.real
def test_hand_held_photographs_are_registered_or_refused_with_a_reason(
    run: Callable[[Scene], RunResult],
) -> None:
    scene = scene_or_skip("kermit")
    result = run(scene)
    assert result.metric is not None
    registered = result.metric.reconstruction.registered
    assert registered.sum() >= 9
    reasons = result.metric.reconstruction.reasons
    assert all(bool(reason) != bool(ok) for reason, ok in zip(reasons, registered, strict=True))


def test_intervals_of_the_courtyard_hold_its_camera(run: Callable[[Scene], RunResult]) -> None:
    scene = load_fixture_scene("courtyard")
    result = run(scene)
    assert result.metric is not None
    assert scene.K is not None
    truth = {"focal_px": (0, 0), "principal_x_px": (0, 2), "principal_y_px": (1, 2)}
    for view, intervals in enumerate(result.metric.intrinsics):
        for name, place in truth.items():
            deviation = intervals[name].value - scene.K[view][place]
            assert np.abs(deviation) <= 3.0 * intervals[name].std
