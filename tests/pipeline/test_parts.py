"""Many images in overlapping parts: the cut of the view graph, the parts, and their common frame."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy

from tests.matching.test_pair_selection import pair
from tests.matching.test_pair_selection import street as street_pairs
from tests.metric.metric_stage import centre_error
from tests.pipeline.test_core_and_windows import street, with_repeated_windows
from tests.synthetic import make_scene, true_pairs
from thesisrecon.config import ImageOptions, PipelineConfig
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_from_options
from thesisrecon.matching.pair_selection import reject_repeated_structure
from thesisrecon.pipeline import large_sets
from thesisrecon.pipeline.large_sets import (
    align_parts,
    cameras_from_parts,
    divide_views,
    has_narrow_cut,
    input_of_part,
    neighbour_graph,
    overlapping_parts,
    reconstruct_part,
)
from thesisrecon.pipeline.run import _StageLog, start_run
from thesisrecon.pipeline.stages import cameras_on_tracks, pairs_of_missing
from thesisrecon.records import MetricResult

VIEWS, PART = 72, 45
OBSERVED = ("view_index", "point_index", "xy")


@pytest.fixture(scope="module")
def scene():
    return street(VIEWS)


def parts_of(scene, part_views):
    graph = neighbour_graph(scene.tracks)
    own = divide_views(graph, part_views)
    return own, overlapping_parts(graph, own)


def models_of(scene, parts):
    config = PipelineConfig()
    pairs = [pair for pair in true_pairs(scene) if pair.inliers >= 16]
    n = len(scene.sizes)
    sizes = [(int(width), int(height)) for width, height in scene.sizes]
    prior = prior_from_options(IntrinsicsOptions(), sizes, np.full(n, np.nan), np.ones(n))
    found = []
    for number, views in enumerate(parts):
        given = input_of_part(scene.tracks, pairs, scene.sizes, prior, views)
        found += reconstruct_part(config, given, number, 0, 1)
    return found


@pytest.fixture(scope="module")
def models(scene):
    return models_of(scene, parts_of(scene, PART)[1])


def aligned_error(found, scene):
    return centre_error(MetricResult(found, (), None, True, (), ()), scene)


def test_a_street_is_cut_into_stretches_that_overlap(scene):
    own, parts = parts_of(scene, PART)
    np.testing.assert_array_equal(np.sort(np.concatenate(own)), np.arange(VIEWS))
    assert max(len(views) for views in own) <= PART
    assert all((np.diff(views) == 1).all() for views in own)
    for k, (views, grown) in enumerate(zip(own, parts, strict=True)):
        ends = (k > 0) + (k < len(own) - 1)
        assert set(views) < set(grown)
        assert len(grown) - len(views) <= ends * large_sets.OVERLAP
        assert (np.diff(grown) == 1).all()


def test_a_street_has_a_narrow_cut_and_one_place_has_none(scene):
    assert has_narrow_cut(scene.tracks)
    place = make_scene(views=24, points=300, sigma_px=0.4, seed=5)
    assert [len(views) for views in divide_views(neighbour_graph(place.tracks), 8)] == [24]
    nothing = replace(scene.tracks, **{name: getattr(scene.tracks, name)[:0] for name in OBSERVED})
    assert not has_narrow_cut(place.tracks)
    assert not has_narrow_cut(nothing)


def test_repeated_windows_make_no_neighbours(scene):
    same = with_repeated_windows(scene, 10, 60, count=25)
    graph = neighbour_graph(same.tracks)
    far = graph[10:12][:, 59:62]
    assert graph[10, 11] > 0
    assert far.nnz == 0


def test_parts_are_put_into_one_frame(scene, models):
    own, parts = parts_of(scene, PART)
    assert all(model.registered.all() for model in models)
    assert not models_of(scene, [np.arange(2)])[0].registered.any()
    found = align_parts(scene.tracks, scene.sizes, own, parts, models)
    assert found.registered.all()
    assert aligned_error(found, scene) < 0.02
    points = cameras_on_tracks(found, scene.tracks)
    assert points.valid.mean() > 0.95


def test_the_tasks_of_a_run_give_the_parts_that_are_aligned(scene, models, monkeypatch, tmp_path):
    monkeypatch.setattr(large_sets, "reconstruct_part", lambda _, __, number, ___, ____: [models[number]])
    config = PipelineConfig(images=ImageOptions(part_views=PART))
    _, run, _ = start_run(tmp_path, config, 0, None, {"threads": 1})
    run.logs["tracks"] = run.logs["matches"] = _StageLog()
    prior = prior_from_options(IntrinsicsOptions(), [(1, 1)] * VIEWS, np.full(VIEWS, np.nan), np.ones(VIEWS))
    job = SimpleNamespace(run=run, config=config, sizes=scene.sizes, prior=prior)
    (found, keys), (own, parts) = cameras_from_parts(job, scene.tracks, (), 1), parts_of(scene, PART)
    assert keys == list(run.logs["metric"].keys.values())
    expected = align_parts(scene.tracks, scene.sizes, own, parts, models)
    assert expected.registered.all()
    for name in ("P", "X", "inlier", "valid", "registered"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_part_without_cameras_leaves_the_others_whole(scene, models):
    own, parts = parts_of(scene, PART)
    last = replace(models[-1], registered=np.zeros_like(models[-1].registered))
    found = align_parts(scene.tracks, scene.sizes, own, parts, [*models[:-1], last])
    np.testing.assert_array_equal(
        np.flatnonzero(~found.registered), np.setdiff1d(parts[-1], np.concatenate(parts[:-1]))
    )
    nothing = [replace(model, registered=np.zeros_like(model.registered)) for model in models]
    assert align_parts(scene.tracks, scene.sizes, own, parts, nothing) is None


def test_a_part_that_contradicts_the_others_is_not_aligned(scene, models):
    own, parts = parts_of(scene, PART)
    rng = np.random.default_rng(0)
    wrong = replace(models[-1], P=models[-1].P[rng.permutation(len(models[-1].P))])
    found = align_parts(scene.tracks, scene.sizes, own, parts, [*models[:-1], wrong])
    assert not found.registered[np.setdiff1d(parts[-1], np.concatenate(parts[:-1]))].any()


@pytest.mark.parametrize("order", [1, -1])
def test_a_cut_does_not_depend_on_the_direction_of_the_numbers(order):
    ties = np.where(np.arange(23) == 22, 9.0, 1.0)[::order]
    graph = scipy.sparse.diags_array([ties, ties], offsets=[1, -1], shape=(24, 24)).tocsr()
    sizes = [len(views) for views in divide_views(graph, 23)]
    assert sizes == [16, 8][::order]


def test_pairs_of_repeated_structure_do_not_come_back_for_missing_images():
    pairs, missing = reject_repeated_structure([*street_pairs(60), pair(5, 50, 80)], 60), np.arange(60) == 50
    pairs = [replace(p, configuration="general") for p in pairs]
    few = replace(pair(49, 50, 40, accepted=False), configuration="general")
    found = pairs_of_missing([*pairs, few], missing)
    assert (5, 50) not in {(p.i, p.j) for p in found}
    assert len(found) == len(pairs)
