"""Dense correspondence of two photographs of which only F and some matches are known."""

import numpy as np
import PIL.Image
import pytest

from thesisrecon.geometry.camera_matrix import camera_from_centre, project
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.stereo.correspondence import PairMatching, match_two_views
from validation.scenes.real import load_fixture_depth, load_fixture_scene

SIZE = (512, 384)


@pytest.fixture(scope="module")
def courtyard():
    """Two photographs at half size, and where the pixels of each are in the other by their true depth."""
    scene = load_fixture_scene()
    half = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])
    views = (6, 7)
    images, correspondences, P = (
        [],
        [],
        [camera_from_centre(half @ scene.K[k], scene.R[k], scene.C[k]) for k in views],
    )
    for k in views:
        with PIL.Image.open(scene.image_paths[k]) as image:
            images.append(np.asarray(image.resize(SIZE, PIL.Image.Resampling.BOX)))
    for side, k in enumerate(views):
        depth, stride = load_fixture_depth(k)
        y, x = np.indices(depth.shape)
        # The depth is that of every second pixel, a quarter of a small pixel beside its middle.
        rays = np.stack([x * stride, y * stride, np.ones_like(x)], axis=-1) @ np.linalg.inv(scene.K[k]).T
        X = (rays * depth[..., None]) @ scene.R[k] + scene.C[k]
        xy = project(P[side], X.reshape(-1, 3)), project(P[1 - side], X.reshape(-1, 3))
        correspondences.append(tuple(part.reshape(*depth.shape, 2) for part in xy))
    return images, P, correspondences


def test_both_photographs_know_where_their_pixels_are_in_the_other(courtyard):
    images, P, truth = courtyard
    F = fundamental_from_cameras(P[0], P[1])
    here, there = (part[::12, ::12].reshape(-1, 2) for part in truth[0])
    seen = np.all((there > 0) & (there < np.array(SIZE)), axis=1)
    pair = match_two_views(images[0], images[1], F, here[seen], there[seen], pairs=PairMatching())
    for side in (0, 1):
        found = pair.correspondences(side, SIZE)
        assert found.shape == (384, 512, 2)
        at, to = truth[side]
        slope = to - at
        off = np.linalg.norm(found - (np.indices((384, 512))[::-1].transpose(1, 2, 0) + slope), axis=2)
        inside = np.all((to > 2) & (to < np.array(SIZE) - 3), axis=2)
        assert np.isfinite(off[inside]).mean() > 0.97
        assert np.nanmedian(off[inside]) < 0.35
        assert np.nanmean(off[inside] < 1.5) > 0.8


def test_there_and_back_is_where_one_was(courtyard):
    images, P, truth = courtyard
    F = fundamental_from_cameras(P[0], P[1])
    here, there = (part[::12, ::12].reshape(-1, 2) for part in truth[0])
    seen = np.all((there > 0) & (there < np.array(SIZE)), axis=1)
    darker = (images[1] * 0.8).astype(np.uint8)
    pair = match_two_views(images[0], darker, F, here[seen], there[seen], pairs=PairMatching())
    np.testing.assert_allclose(pair.gain, 1.25 * np.ones(3), rtol=0.2)
    forth, back = pair.correspondences(0, SIZE), pair.correspondences(1, SIZE)
    at = np.rint(forth)
    inside = np.all((at >= 0) & (at <= np.array(SIZE) - 1), axis=2)
    x, y = at[inside].astype(int).T
    again = back[y, x] + forth[inside] - at[inside]
    off = np.linalg.norm(again - np.indices((384, 512))[::-1].transpose(1, 2, 0)[inside], axis=1)
    assert np.nanmedian(off) < 0.3
    with pytest.raises(ValueError, match="side"):
        pair.correspondences(2, SIZE)
