"""Several models of one set of images: of groups that do not overlap, and of what one model leaves over.

The first tests use fake stages, the last ones two places with one weak link between them.
"""

import re
from dataclasses import dataclass, replace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from tests.conftest import refuses
from tests.pipeline import fake_stages as fakes
from tests.pipeline.fake_stages import CALLS, fake_config, interrupt_at, kept_bytes, photographs, read
from tests.pipeline.given_scene import SIZE, given_scene, write_database
from thesisrecon import (
    Camera,
    load,
    reconstruct_from_colmap,
    reconstruct_from_matches,
    reconstruct_from_tracks,
)
from thesisrecon.api import reconstruct as api
from thesisrecon.cli.commands import summary_text
from thesisrecon.config import ImageOptions
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline import matching, stages

GROUPS = [range(3), range(3, 7), range(7, 9)]


@dataclass(frozen=True)
class GroupVerifier(fakes.FakeVerifier):
    def verify(self, matches, fit, rng):
        together = any(matches.i in group and matches.j in group for group in GROUPS)
        return replace(super().verify(matches, fit, rng), accepted=together)


@dataclass(frozen=True)
class ProjectiveOfSize(fakes.FakeProjective):
    """Registers the views of its pairs; fails for so many of them."""

    impossible: int = 0

    def reconstruct(self, tracks, pairs, sizes, *, rng, attempt=0):
        found = super().reconstruct(tracks, pairs, sizes, rng=rng, attempt=attempt)
        seen = [
            any(view in (pair.i, pair.j) for pair in pairs if pair.accepted) for view in range(len(sizes))
        ]
        if sum(seen) == self.impossible:
            raise StageFailure("no initial pair")
        reasons = tuple("" if there else "sees 0 points" for there in seen)
        return replace(found, registered=found.registered & seen, reasons=reasons)


@pytest.fixture(autouse=True)
def _forget_calls():
    CALLS.clear()


def run(out, impossible=0, **given):
    config = fake_config(verification=GroupVerifier(), projective=ProjectiveOfSize(impossible=impossible))
    config = replace(config, images=ImageOptions(groups=given.pop("groups", True)))
    return api.reconstruct(photographs(9), out, config=config, until="metric", **given)


def files_of(out):
    return kept_bytes(out), kept_bytes(out / "group-2")


def test_each_group_has_a_model_and_the_largest_is_first(tmp_path):
    result = run(tmp_path, threads=1)
    assert list(result.cameras) == ["03.png", "04.png", "05.png", "06.png"]
    assert "is reconstructed in group-2" in result.refused["00.png"]
    assert result.refused["08.png"] == "sees 0 points"
    summary = read(tmp_path / "summary.json")
    entry = {"folder": "group-2", "images": 3, "registered": 3, "trusted": True, "failure": None}
    assert summary["groups"] == [entry | {"names": ["00.png", "01.png", "02.png"], "missing": []}]
    models = "The images form 2 models without a common scale"
    sentence = f"{models}: 4 images in this model, 3 in group-2, 2 in none"
    assert sentence in summary["warnings"]
    said = summary_text(summary, tmp_path)
    assert "warning: To join 3 images to the model, photograph between 02.png and 03.png, about" in said
    assert f"group-2: 3 of 3 images registered; report: {tmp_path}" in said
    assert "not registered: 00.png" not in said
    assert '<a href="group-2/report.html">group-2</a>' in (tmp_path / "report.html").read_text("utf-8")
    assert not (tmp_path / "group-3").exists()
    other = load(tmp_path / "group-2")
    assert list(other.cameras) == ["00.png", "01.png", "02.png"]
    assert [(pair.i, pair.j) for pair in other.pairs] == [(0, 1), (0, 2), (1, 2)]
    assert (tmp_path / "group-2" / "report.html").is_file()
    calls = [call for call in CALLS if call.startswith(("detect", "match"))]
    assert len(calls) == len(set(calls)) == 9 + 36


def test_groups_are_resumed_to_the_same_bytes(tmp_path):
    run(tmp_path / "whole", threads=1)
    stopped = []

    def interrupt(stage, done, _total):
        stopped.append((stage, done))
        if stopped.count(("projective", 0)) == 2:
            raise KeyboardInterrupt

    refuses(KeyboardInterrupt, None, run, tmp_path / "cut", threads=1, progress=interrupt)
    CALLS.clear()
    run(tmp_path / "cut", threads=3)
    assert files_of(tmp_path / "cut") == files_of(tmp_path / "whole")
    assert not [call for call in CALLS if call.startswith(("detect", "match"))]
    CALLS.clear()
    run(tmp_path / "cut")
    assert CALLS == []


def test_groups_can_be_turned_off(tmp_path):
    run(tmp_path)
    result = run(tmp_path, groups=False, overwrite=True)
    assert len(result.cameras) == 9
    assert "groups" not in result.summary
    assert not (tmp_path / "group-2" / "summary.json").exists()


def test_a_replaced_run_leaves_no_result_of_its_groups(tmp_path):
    run(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, seed=1, overwrite=True, threads=1, progress=interrupt_at("features", 9))
    assert not list(tmp_path.rglob("summary.json"))
    assert (tmp_path / "group-2" / "06-metric").is_dir()


def test_a_group_that_fails_leaves_the_others_whole(tmp_path):
    result = run(tmp_path / "second", impossible=3)
    assert len(result.cameras) == 4
    assert result.summary["groups"][0]["failure"] == "no initial pair."
    assert "group-2: no initial pair; report" in summary_text(result.summary, tmp_path)
    assert read(tmp_path / "second" / "group-2" / "summary.json")["failure"] == "no initial pair."
    refuses(StageFailure, "no initial pair", run, tmp_path / "first", impossible=4)
    assert read(tmp_path / "first" / "summary.json")["groups"][0]["registered"] == 3
    assert len(load(tmp_path / "first" / "group-2").cameras) == 3


def test_a_group_takes_the_pairs_of_the_whole_set_and_not_older_ones(tmp_path, monkeypatch):
    """A pair may be rejected, or matched again, because of images that were added."""
    run(tmp_path)
    reject = matching.reject_repeated_structure

    def reject_first(pairs, views):
        return [replace(p, accepted=p.accepted and (p.i, p.j) != (0, 1)) for p in reject(pairs, views)]

    monkeypatch.setattr(matching, "reject_repeated_structure", reject_first)
    run(tmp_path, overwrite=True)
    assert [pair.accepted for pair in load(tmp_path / "group-2").pairs] == [False, True, True]


@dataclass(frozen=True)
class ProjectiveOfAFew(ProjectiveOfSize):
    """Registers the first three of the views of its pairs."""

    def reconstruct(self, tracks, pairs, sizes, *, rng, attempt=0):
        found = super().reconstruct(tracks, pairs, sizes, rng=rng, attempt=attempt)
        few = found.registered & (found.registered.cumsum() <= 3)
        reasons = tuple("" if there else "sees 5 points" for there in few)
        return replace(found, registered=few, reasons=reasons)


def test_images_left_over_become_models_until_too_few_are_left(tmp_path):
    config = fake_config(projective=ProjectiveOfAFew())
    result = api.reconstruct(photographs(8), tmp_path, config=config, until="metric")
    assert [group["registered"] for group in result.summary["groups"]] == [3]
    models = "The images form 2 models without a common scale"
    sentence = f"{models}: 3 images in this model, 3 in group-2, 2 in none"
    assert sentence in result.summary["warnings"]
    said = summary_text(result.summary, tmp_path)
    assert re.findall("not registered: (.*):", said) == ["06.png", "07.png"]
    assert "is reconstructed in group-2" in result.refused["03.png"]
    assert result.refused["07.png"] == "sees 5 points"
    # A projective run may end at the core of a large set, whose other images the metric stage registers.
    result = api.reconstruct(photographs(8), tmp_path / "short", config=config, until="projective")
    assert "groups" not in result.summary
    assert not list(tmp_path.glob("short/group-*"))


SCENE = given_scene()
APART = np.array([3.2, 0.0, 0.0])
"""The second place, whose cameras do not see the first one."""
LINK = 80
"""Points that only the last view of the first place and one view of the second see."""


def two_places(common=0, apart=APART):
    """Pixels (10, N, 2), NaN where a point is not seen; two views of either place see ``common`` more points.

    Each view of the second place sees at most half of these.
    """
    rng = np.random.default_rng(1)
    views, points = len(SCENE.keypoints), len(SCENE.X)
    between = rng.uniform(-0.2, 0.2, (2 * LINK + common, 3)) + apart / 2
    X = np.concatenate([SCENE.X, SCENE.X + apart, between])
    seen = np.zeros((2 * views, len(X)), dtype=bool)
    for place in (0, 1):
        seen[place * views : (place + 1) * views, place * points : (place + 1) * points] = True
    link, more, shared = np.split(np.arange(2 * points, len(X)), [LINK, 2 * LINK])
    seen[np.ix_([views - 1, views], link)] = True
    if common:
        seen[np.ix_([views - 1, views + 2], more)] = True
        seen[views - 2 : views, shared] = True
        seen[views : views + 2, shared[::2]] = seen[views + 2 : views + 4, shared[1::2]] = True
    moved = [Camera(camera.K, camera.R, camera.t - camera.R @ apart, SIZE) for camera in SCENE.cameras]
    pixels = np.array([camera.project(X) for camera in SCENE.cameras + moved])
    return np.where(seen[:, :, None], pixels + rng.normal(0, SCENE.noise_px, pixels.shape), np.nan)


def from_tracks(xy, out):
    return reconstruct_from_tracks(xy, [SIZE] * len(xy), out)


def given_matches(xy):
    """Keypoints of each view, and rows of them that show the same points."""
    seen = np.isfinite(xy).all(axis=2)
    rows = np.cumsum(seen, axis=1) - 1
    matches = {}
    for i in range(len(xy)):
        for j in range(i + 1, len(xy)):
            both = seen[i] & seen[j]
            if both.any():
                matches[i, j] = np.column_stack([rows[i, both], rows[j, both]])
    return [xy[i, there] for i, there in enumerate(seen)], matches


def from_matches(xy, out):
    return reconstruct_from_matches(*given_matches(xy), [SIZE] * len(xy), out)


def from_database(xy, out):
    return reconstruct_from_colmap(
        write_database(out.parent / "colmap.db", *given_matches(xy), verified=True), out=out
    )


@pytest.mark.parametrize("reconstruct", [from_tracks, from_matches, from_database])
def test_images_beyond_a_weak_link_become_a_model_with_the_same_camera(reconstruct, tmp_path):
    result = reconstruct(two_places(), tmp_path / "out")
    (group,) = result.summary["groups"]
    other = load(tmp_path / "out" / "group-2")
    assert len(result.cameras) == len(other.cameras) == 5
    assert not set(result.cameras) & set(other.cameras)
    assert group["registered"] == 5
    assert group["trusted"]
    assert any("5 images in this model, 5 in group-2" in text for text in result.summary["warnings"])
    assert all("is reconstructed in group-2" in reason for reason in result.refused.values())
    for found in (result, other):
        assert found.summary["self_check"]["sigmas_to_minimum"] < 0.1
    focal = SCENE.cameras[0].K[0, 0]
    first, second = (next(iter(found.cameras.values())) for found in (result, other))
    assert abs(second.K[0, 0] - focal) < 3 * second.std["focal_px"]
    for (model,) in (result.further_models, load(tmp_path / "out").further_models):
        assert list(model.cameras) == list(other.cameras)
    # Its interval is that of all images.
    assert second.std["focal_px"] < 0.95 * first.std["focal_px"]


@pytest.mark.parametrize("reconstruct", [from_tracks, from_matches, from_database])
def test_a_further_model_that_shares_points_is_joined(reconstruct, tmp_path):
    result = reconstruct(two_places(common=8), tmp_path / "out")
    assert len(result.cameras) == len(load(tmp_path / "out").cameras) == 10
    assert result.summary["trusted"]
    assert result.summary["self_check"]["sigmas_to_minimum"] < 0.1
    assert "groups" not in result.summary
    assert result.further_models == ()
    # Both places have the same cameras in the same world, as far apart as they are.
    truth = np.array([camera.centre for camera in SCENE.cameras])
    truth = np.concatenate([truth, truth + APART])
    by_number = sorted(result.cameras.items(), key=lambda item: int(re.findall(r"\d+", item[0])[0]))
    centres = np.array([camera.centre for _, camera in by_number])
    # Images of the database are named in the opposite order.
    ratio = pdist(centres) / pdist(truth[::-1] if reconstruct is from_database else truth)
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=0.02)


def test_a_place_that_looks_alike_is_not_joined_and_reconstructed_once(tmp_path, monkeypatch):
    """What the places have in common agrees, but the images of one see nothing else of the other."""
    xy, calibrated = two_places(common=8, apart=0.0 * APART), Mock(wraps=stages.calibrate_with_core)
    monkeypatch.setattr(stages, "calibrate_with_core", calibrated)
    result = from_tracks(xy, tmp_path / "out")
    (other,) = result.further_models
    assert len(result.cameras) == len(other.cameras) == 5
    assert calibrated.call_count == 2
    kept = files_of(tmp_path / "out")
    from_tracks(xy, tmp_path / "out")
    assert calibrated.call_count == 2
    assert files_of(tmp_path / "out") == kept


def test_further_models_are_part_of_a_result_without_a_folder():
    result = from_tracks(two_places(), None)
    (other,) = result.further_models
    assert len(result.cameras) == len(other.cameras) == 5
    assert other.out is None
    assert len(other.points) > 100


def test_images_in_no_model_that_matches_connect_with_one_are_named(tmp_path):
    # Two images of the second place are too few for a model.
    result = from_tracks(two_places()[:7], tmp_path)
    assert len(result.cameras) == 5
    (text,) = (text for text in result.warnings if getattr(text, "code", "") == "linked-images")
    assert text == "1 image in no model, although verified matches connect them with one: image-5"
