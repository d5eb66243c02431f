"""Two places with one weak link between them: images that one model leaves over become a further model."""

import numpy as np
import pytest

from tests.pipeline.given_scene import SIZE, given_scene
from thesisrecon import load, reconstruct_from_matches, reconstruct_from_tracks

SCENE = given_scene()
LINK = 80
"""Points that only the last view of the first place and one view of the second see."""


def two_places(common=0):
    """Pixels (10, N, 2), NaN where a point is not seen; two views of either place see ``common`` more points.

    Each view of the second place sees at most half of these.
    """
    rng = np.random.default_rng(1)
    views, points = len(SCENE.keypoints), len(SCENE.X)
    X = np.concatenate([SCENE.X, SCENE.X, rng.uniform(-1, 1, (2 * LINK + common, 3))])
    seen = np.zeros((2 * views, len(X)), dtype=bool)
    for place in (0, 1):
        seen[place * views : (place + 1) * views, place * points : (place + 1) * points] = True
    link, more, shared = np.split(np.arange(2 * points, len(X)), [LINK, 2 * LINK])
    seen[np.ix_([views - 1, views], link)] = True
    if common:
        seen[np.ix_([views - 1, views + 2], more)] = True
        seen[views - 2 : views, shared] = True
        seen[views : views + 2, shared[::2]] = seen[views + 2 : views + 4, shared[1::2]] = True
    pixels = np.array([camera.project(X) for camera in SCENE.cameras * 2])
    return np.where(seen[:, :, None], pixels + rng.normal(0, SCENE.noise_px, pixels.shape), np.nan)


def from_tracks(xy, out):
    return reconstruct_from_tracks(xy, [SIZE] * len(xy), out)


def from_matches(xy, out):
    seen = np.isfinite(xy).all(axis=2)
    rows = np.cumsum(seen, axis=1) - 1
    matches = {}
    for i in range(len(xy)):
        for j in range(i + 1, len(xy)):
            both = seen[i] & seen[j]
            if both.any():
                matches[i, j] = np.column_stack([rows[i, both], rows[j, both]])
    return reconstruct_from_matches(
        [xy[i, there] for i, there in enumerate(seen)], matches, [SIZE] * len(xy), out
    )


@pytest.mark.parametrize("reconstruct", [from_tracks, from_matches])
def test_images_beyond_a_weak_link_become_a_model_with_the_same_camera(reconstruct, tmp_path):
    result = reconstruct(two_places(), tmp_path)
    (group,) = result.summary["groups"]
    other = load(tmp_path / "group-2")
    assert len(result.cameras) == len(other.cameras) == 5
    assert not set(result.cameras) & set(other.cameras)
    assert group["registered"] == 5
    assert group["trusted"]
    assert any("5 images in this model, 5 in group-2" in text for text in result.summary["warnings"])
    assert all("is reconstructed in group-2" in reason for reason in result.refused.values())
    focal = SCENE.cameras[0].K[0, 0]
    first, second = (next(iter(found.cameras.values())) for found in (result, other))
    assert abs(second.K[0, 0] - focal) < 3 * second.std["focal_px"]
    for (model,) in (result.further_models, load(tmp_path).further_models):
        assert list(model.cameras) == list(other.cameras)
    # Its interval is that of all images.
    assert second.std["focal_px"] < 0.9 * first.std["focal_px"]


@pytest.mark.parametrize("reconstruct", [from_tracks, from_matches])
def test_a_further_model_that_shares_points_is_joined(reconstruct, tmp_path):
    result = reconstruct(two_places(common=8), tmp_path)
    assert len(result.cameras) == len(load(tmp_path).cameras) == 10
    assert result.summary["trusted"]
    assert "groups" not in result.summary
    assert result.further_models == ()
    # Both places have the same cameras in the same world.
    centres = np.array([camera.centre for camera in result.cameras.values()])
    size = np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()
    assert np.linalg.norm(centres[:5] - centres[5:], axis=1).max() < 0.02 * size


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
