from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from tests.textures import stereo_scene
from thesisrecon.config import PRESETS
from validation.checks.front_end_ablation import Bench, ladder, measure, one_changed


def changed_fields(one: Any, other: Any) -> list[str]:
    return [f.name for f in dataclasses.fields(one) if getattr(one, f.name) != getattr(other, f.name)]


def test_the_ladder_leads_from_the_thesis_to_the_default() -> None:
    rows = list(ladder().values())
    thesis, default = PRESETS["thesis"], PRESETS["default"]
    assert rows[0] == (thesis.features, thesis.matching)
    assert rows[-1] == (default.features, default.matching)
    assert len(rows) > 8


def test_each_row_of_the_second_table_changes_one_side_of_the_default_a_little() -> None:
    rows = one_changed()
    detector, matcher = rows.pop("default")
    for name, (corners, matching) in rows.items():
        assert (corners == detector) != (matching == matcher), name
        changed = changed_fields(detector, corners) + changed_fields(matcher, matching)
        # Corners of one size are as many as those of both.
        assert changed in (["full_corners", "half_corners"], [changed[0]]), name
    assert len({repr(row) for row in rows.values()}) == len(rows)


def test_a_row_tells_verified_matches_and_seconds_of_a_pair_that_is_related() -> None:
    y, x = (v.ravel().astype(float) for v in np.mgrid[20:280:20, 40:380:20])
    truth = np.stack([x, y, x - 14.0, y], axis=1)
    bench = Bench(stereo_scene(), {(0, 1): truth})
    row = measure(bench, ladder()["+ guided rematching: the default"])
    assert len(row.right) == 1
    assert row.verified > 300
    assert row.sigma_px < 0.1
    assert row.image_s > 0.0
    assert row.pair_s > 0.0
