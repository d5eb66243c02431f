"""Depth maps of whole scenes against truth, and what hopeless ones give."""

from __future__ import annotations

import numpy as np
import pytest

from tests.dense.multiview.scenes import RADIAL, make_walled, on_arc
from thesisrecon.dense.multiview import MultiViewStereo, SequenceLinking

STEREO = MultiViewStereo()


@pytest.fixture(scope="module")
def walled():
    return make_walled(on_arc((-14.0, -5.0, 4.0, 13.0)), radial=RADIAL)


def errors(walled, maps):
    """Relative errors of known pixels, and the share of all that is known."""
    apart = [maps[i].depth / walled.depth[i] - 1.0 for i in maps]
    known = np.concatenate([a[np.isfinite(a)] for a in apart])
    return np.abs(known), len(known) / sum(a.size for a in apart)


@pytest.mark.parametrize("linker", [STEREO.linker, SequenceLinking()], ids=lambda v: type(v).__name__)
def test_depth_is_that_of_the_scene_and_its_deviation_tells_the_error(walled, linker):
    stereo = MultiViewStereo(linker=linker)
    maps = stereo.map_all(walled.images, walled.reconstruction)
    error, known = errors(walled, maps)
    assert np.median(error) < 0.002
    assert np.mean(error < 0.01) > 0.95
    assert known > 0.75
    for i, found in maps.items():
        z = (found.depth - walled.depth[i]) / found.std
        assert 0.05 < np.nanmedian(np.abs(z)) < 2.0
        assert (found.views[np.isfinite(found.depth)] >= 1).all()
        assert (found.views[np.isnan(found.depth)] == 0).all()
        assert np.array_equal(np.isnan(found.depth), np.isnan(found.std))


def test_the_same_bytes_whatever_the_number_of_threads_and_one_by_one(walled):
    together = STEREO.map_all(walled.images, walled.reconstruction, threads=2)
    scene = STEREO.prepare(walled.images, walled.reconstruction)
    raw = {i: STEREO.depth_map(scene, i) for i in reversed(sorted(scene.views))}
    for i in scene.views:
        one = STEREO.confirm(scene, raw, i)
        for field in ("depth", "std", "views", "P"):
            assert getattr(one, field).tobytes() == getattr(together[i], field).tobytes()
