"""The examples of docs/recipes/plug-ins.md run as they stand there."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.config.test_plug_ins import images, strong, windows
from tests.synthetic import one_by_one
from thesisrecon import PipelineConfig, reconstruct
from thesisrecon.config import ImageOptions
from thesisrecon.epipolar.verification import PairVerification
from thesisrecon.matching.tracks import AlignedTracks

PAGE = Path(__file__).parents[2] / "docs" / "recipes" / "plug-ins.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
GIVEN = {"until": "matches", "max_size": 400}


@pytest.mark.references
def test_opencv_sift_is_a_matching_function(tmp_path):
    definition, call = BLOCKS[0].split("result = ")
    scope = {"__name__": "__main__"}
    exec(definition, scope)
    assert call.startswith('thesisrecon.reconstruct("images", "out", config=config, max_size=1000')
    result = reconstruct(images(3), tmp_path / "out", config=scope["config"], **(GIVEN | {"max_size": 600}))
    assert sum(pair.accepted for pair in result.pairs) >= 2
    assert max(pair.inliers for pair in result.pairs) > 100


@pytest.mark.references
def test_opencv_keypoints_are_features(tmp_path):
    definition, call = BLOCKS[1].split("result = ")
    scope = {"__name__": "__main__"}
    exec(definition, scope)
    assert call.startswith('thesisrecon.reconstruct("images", "out", **given)')
    given = scope["given"] | GIVEN
    result = reconstruct(images(3), tmp_path / "out", **given)
    assert sum(pair.accepted for pair in result.pairs) >= 2


class Extractor:
    """A stub of an extractor: an image (1, 3, H, W) in, keypoints (1, N, 2) and descriptors (1, N, D) out."""

    def __init__(self, max_num_keypoints):
        self.count = max_num_keypoints

    def extract(self, tensor):
        assert tensor.dtype == np.float32
        assert tensor.shape[:2] == (1, 3)
        rgb = np.moveaxis(tensor[0], 0, 2) * 255
        xy = strong(rgb, min(self.count, 300))
        return {"keypoints": xy[None], "descriptors": windows(rgb, xy)[None]}


class Matcher:
    """A stub of a matcher: matches (1, M, 2) and scores (1, M) of two images."""

    def __call__(self, data):
        similarity = data["image0"]["descriptors"][0] @ data["image1"]["descriptors"][0].T
        best = similarity.argmax(axis=1)
        one = np.flatnonzero(similarity.argmax(axis=0)[best] == np.arange(len(best)))
        return {"matches": [np.column_stack([one, best[one]])], "scores": [similarity.max(axis=1)[one]]}


def test_a_lightglue_style_matcher_fits_with_a_class(tmp_path):
    scope = {"__name__": "__main__", "extractor": Extractor, "matcher": Matcher}
    exec(BLOCKS[2], scope)
    few, images_ = PairVerification(min_inliers=20), ImageOptions(max_size_px=400)
    found = []
    for score in (0.9, 0.7):
        matching = scope["LightGlueMatching"](min_score=score)
        config = PipelineConfig(images=images_, features=strong, matching=matching, verification=few)
        result = reconstruct(images(3), tmp_path / "out", config=config, until="matches", overwrite=True)
        found.append(sum(pair.candidates for pair in result.pairs))
    assert found[1] > found[0] > 0
    assert result.pairs[0].accepted
    table = {"kind": "LightGlueMatching", "max_keypoints": 2048, "min_score": 0.7}
    assert result.settings["matching"] == table
    tracks = AlignedTracks().build([None] * 3, result.pairs, map_all=one_by_one, rng=np.random.default_rng(0))
    assert tracks.n_points >= result.pairs[0].inliers
