"""Two places with one weak link between them: images that one model leaves over become a further model."""

import numpy as np
import pytest

from tests.pipeline.given_scene import SIZE, given_scene
from thesisrecon import load, reconstruct_from_matches, reconstruct_from_tracks

SCENE = given_scene()
LINK = 80
"""Points that only the last view of the first place and the first view of the second see."""


def two_places():
    """Pixels (10, N, 2), NaN where a point is not seen."""
    rng = np.random.default_rng(1)
    views, points = len(SCENE.keypoints), len(SCENE.X)
    xy = np.full((2 * views, 2 * points + LINK, 2), np.nan)
    for place in (0, 1):
        rows, columns = (slice(place * n, (place + 1) * n) for n in (views, points))
        seen = np.stack(SCENE.keypoints)
        xy[rows, columns] = seen + place * rng.normal(0, SCENE.noise_px, seen.shape)
    X = rng.uniform(-1, 1, (LINK, 3))
    for view in (views - 1, views):
        pixels = SCENE.cameras[view % views].project(X)
        xy[view, -LINK:] = pixels + rng.normal(0, SCENE.noise_px, pixels.shape)
    return xy


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
    # Its interval is that of all images.
    assert second.std["focal_px"] < 0.9 * first.std["focal_px"]
