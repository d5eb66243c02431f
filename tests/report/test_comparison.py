"""The page of a comparison in a browser."""

from dataclasses import replace

import numpy as np
import pytest

from tests.io.test_colmap import export, scene
from tests.report import synthetic
from thesisrecon import compare_models
from thesisrecon.io._models import read_model
from thesisrecon.records import Similarity
from thesisrecon.report._page import comparison_page

pytestmark = pytest.mark.browser


def test_all_points_are_in_view_although_the_reference_has_none(browser, tmp_path):
    export(tmp_path, scene())
    a = read_model(tmp_path)
    path = tmp_path / "page.html"
    b = replace(a, X=a.X[:0], view_index=a.view_index[:0], point_index=a.point_index[:0], xy=a.xy[:0])
    a = replace(a, X=a.X - np.array([0.0, 4.0, 0.0]))
    path.write_text(comparison_page(compare_models(a, b), "a", "b"), encoding="utf-8")
    seen = synthetic.Witness(browser, path, 900, drawn=("scene-figure",))
    points = np.abs(seen.pixels("#scene-figure").astype(int) - (255, 199, 138)).max(axis=2) < 30
    assert points.sum() > 20
    assert not points[:3].any()
    assert not points[-3:].any()


def test_a_browser_draws_both_models(browser, tmp_path):
    export(tmp_path, scene())
    b = read_model(tmp_path)
    a = replace(b, X=b.X + 0.2).transformed(Similarity(3.0, np.eye(3), np.ones(3)))
    path = tmp_path / "page.html"
    path.write_text(comparison_page(compare_models(a, b), "a", "b"), encoding="utf-8")
    seen = synthetic.Witness(browser, path, 900, drawn=("scene-figure",))
    colors = seen.pixels("#scene-figure").reshape(-1, 3).astype(int)
    for points in ((255, 199, 138), (159, 216, 247)):
        assert (np.abs(colors - points).max(axis=1) < 30).sum() > 20
    assert seen.errors == []
