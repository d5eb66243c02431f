"""The checks of growing cost, of workers and of rounding: what they compute of what they measure."""

from dataclasses import replace

import numpy as np
import pytest

from tests.fake_stages import CALLS, FakeDetector, fake_config, photographs
from thesisrecon.pipeline.reconstruction import reconstruct
from validation.scenes.many_views import walk
from validation.studies import growth_of_cost, parallel, perturbation
from validation.studies.growth_of_cost import Cost, Meter


def test_a_longer_walk_begins_with_the_shorter_and_looks_at_the_yard():
    few, many = walk(5, (480, 360)), walk(40, (480, 360))
    for a, b in zip(few, many, strict=False):
        np.testing.assert_array_equal(a.R, b.R)
        np.testing.assert_array_equal(a.C, b.C)
    centres = np.array([pose.C for pose in many])
    angle = np.sort(np.degrees(np.arctan2(centres[:, 0], -1.4 - centres[:, 1])))
    assert np.diff(angle).max() < 8.0, "the arc has no gap"
    middle = np.array([pose.R @ (np.array([0.0, -1.1, 1.7]) - pose.C) for pose in many])
    assert (middle[:, 2] > 4.0).all()


def test_costs_go_to_the_stage_that_ran_and_powers_are_those_of_the_numbers(tmp_path):
    CALLS.clear()
    meter = Meter()
    reconstruct(photographs(4), tmp_path, config=fake_config(), until="metric", progress=meter.hear)
    meter.enter("end")
    assert set(growth_of_cost.STAGES) <= set(meter.cpu_s)
    assert all(peak > 20.0 for peak in meter.peak_mb.values())
    costs = [
        Cost(
            n, dict.fromkeys(growth_of_cost.STAGES, n**1.5), {"images": 3.0 * n}, {"points": n**2}, 1.0, 0.01
        )
        for n in (10, 100)
    ]
    rows = growth_of_cost.table(costs).splitlines()
    assert next(row for row in rows if row.startswith("| matches, processor s")).endswith("| 1.50 |")
    assert next(row for row in rows if row.startswith("| whole run, peak MB")).endswith("| 1.00 |")
    assert next(row for row in rows if row.startswith("| points")).endswith("| 2.00 |")


def test_the_efficiency_is_that_of_two_workers():
    found = {"one thread": [(10.0, 10.0)], "two processes": [(6.25, 12.5)]}
    rows = {row.name: row for row in parallel.rows("a set", found)}
    assert rows["efficiency by the clock"].values == {"two processes": 0.8}
    assert rows["efficiency by work"].values == {"two processes": 0.8}
    assert rows["efficiency by work"].verdict == "missed"


def test_shaken_numbers_are_moved_by_their_rounding():
    rng = np.random.default_rng(0)
    for kind, rel in ((np.float64, 1e-12), (np.float32, 1.3e-7)):
        values = np.linspace(1.0, 500.0, 1000).astype(kind)
        apart = np.abs(perturbation.shaken(values, rng).astype(np.float64) / values - 1.0)
        assert 0.0 < apart.max() <= rel
    assert perturbation.shaken(values, rng).dtype == np.float32


@pytest.mark.parametrize("stage", perturbation.STAGES)
def test_a_shaken_run_lies_beside_the_still_one(stage, tmp_path):
    """Fakes that know the truth: what is shaken is the stage that was asked for, and nothing comes of it."""
    config = fake_config()
    still = reconstruct(photographs(4), tmp_path, config=config, until="metric").metric
    CALLS.clear()
    shaken = perturbation.disturbed(config, stage, 1)
    other = reconstruct(photographs(4), tmp_path, config=shaken, until="metric", overwrite=True).metric
    assert still is not None
    assert other is not None
    assert any(call.startswith("detect") for call in CALLS) == (stage == "corners")
    assert "tracks" in CALLS
    moved = perturbation.compare(still, other)
    assert moved.intrinsics_std == 0.0
    assert moved.registered == 0


def test_what_moved_is_told_in_standard_deviations():
    still = _result()
    further = replace(still.intrinsics[0]["focal_px"], value=100.5)
    other = replace(still, intrinsics=({**still.intrinsics[0], "focal_px": further}, *still.intrinsics[1:]))
    moved = perturbation.compare(still, other)
    assert moved.intrinsics_std == pytest.approx(0.5)
    assert moved.centres_rel == pytest.approx(0.0, abs=1e-9)
    worst = {"corners": [moved], "matches": [replace(moved, intrinsics_std=1.5)], "tracks": [moved]}
    row = perturbation.rows("a set", worst)[0]
    assert (row.verdict, row.judged) == ("missed", "matches")
    assert perturbation.rows("a set", {"corners": [moved]})[0].verdict == "reached"


def _result():
    from tests.fake_stages import FakeCalibrator, FakeMetric, FakeProjective, FakeTracks

    features = [FakeDetector().detect(image) for image in photographs(4)]
    rng = np.random.default_rng(0)
    tracks = FakeTracks().build(features, (), rng)
    projective = FakeProjective().reconstruct(tracks, (), np.full((4, 2), 90), rng=rng)

    class Assumed:
        mean, focal_known = np.zeros(4), np.zeros(4, dtype=bool)

    calibration = FakeCalibrator().calibrate(projective, prior=Assumed(), rng=rng)
    return FakeMetric().refine(projective, calibration, prior=Assumed(), rng=rng)
