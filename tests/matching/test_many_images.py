"""Pairs of many images: first a share of the corners and seeds, all if these are too few, and in streets."""

from dataclasses import replace

import numpy as np
import PIL.Image
import pytest

from tests.conftest import same_pairs
from tests.synthetic import photograph, texture
from thesisrecon import PipelineConfig, load, reconstruct
from thesisrecon.errors import StageFailure
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.io._images import demo_images
from thesisrecon.matching._prepared import strongest_corners, strongest_share
from thesisrecon.matching.growth import SeedsAndGrowth
from thesisrecon.pipeline import matching
from thesisrecon.records import Features


def test_the_strongest_corners_of_each_scale_and_seeds_of_each_level_are_kept():
    features = MultiScaleCorners().detect(photograph(texture(200, 260)))
    fewer, rows = strongest_share(features, 0.5), strongest_corners(features, 0.5)
    assert np.array_equal(fewer.xy, features.xy[rows])
    assert (np.diff(rows) > 0).all()
    for scale in np.unique(features.scale):
        every, kept = (f.response[f.scale == scale] for f in (features, fewer))
        assert len(kept) == (len(every) + 1) // 2
        assert kept.min() >= np.sort(every)[-len(kept)]
    levels, kept = (
        np.unique(np.where(s.angle == 0.0, s.scale, -s.scale), return_counts=True)[1]
        for s in (features.seeds, fewer.seeds)
    )
    assert np.array_equal(kept, (levels + 1) // 2)
    assert len(fewer.seeds.patches) == len(fewer.seeds.xy) == kept.sum()


def test_pairs_of_many_images_have_fewer_matches_unless_all_are_needed(tmp_path, monkeypatch):
    def pairs(name, many_images):
        config = PipelineConfig(matching=SeedsAndGrowth(many_images=many_images))
        result = reconstruct(
            demo_images()[:3], tmp_path / name, config=config, max_size=480, until="matches", threads=2
        )
        assert same_pairs(load(tmp_path / name), result)
        return result

    every, fewer = pairs("all", 3), pairs("fewer", 2)
    for whole, part in zip(every.pairs, fewer.pairs, strict=True):
        assert part.accepted
        assert 240 <= part.inliers < 0.65 * whole.inliers
        # The numbers are those of all corners.
        assert np.array_equal(part.xy1, every.features[part.i].xy[part.index1])
        assert np.abs(part.xy2 - every.features[part.j].xy[part.index2]).max() < 10.0
    for name, value in (("MIN_VERIFIED", 10**6), ("has_narrow_cut", lambda _: True)):
        with monkeypatch.context() as patch:
            patch.setattr(matching, name, value)
            again = pairs(name, 2).pairs
        for whole, pair in zip(every.pairs, again, strict=True):
            assert np.array_equal(whole.index1, pair.index1)
            assert np.array_equal(whole.xy2, pair.xy2)


def test_an_image_without_corners_among_many_has_none_of_the_strongest():
    none = np.zeros(0, np.float32)
    empty = Features(np.zeros((0, 2)), none, none)
    assert len(strongest_corners(empty, 0.5)) == 0
    assert len(strongest_share(empty, 0.5).xy) == 0


def test_images_of_nothing_in_common_are_a_failure_for_any_number(tmp_path):
    """More images than `many_images`, one of them without corners, and no accepted pair."""
    rng = np.random.default_rng(0)
    images = [photograph(texture(96, 128, seed=k)) for k in range(3)]
    smooth = np.linspace(60.0, 190.0, 128)[None, :, None] + rng.normal(0.0, 0.0, (96, 1, 3))
    images.append(replace(images[0], name="smooth.png", rgb=smooth.astype(np.uint8)))
    paths = []
    for k, image in enumerate(images):
        paths.append(tmp_path / f"{k}.png")
        PIL.Image.fromarray(image.rgb).save(paths[-1])
    config = PipelineConfig(matching=SeedsAndGrowth(many_images=2))
    with pytest.raises(StageFailure, match="no two images could be matched"):
        reconstruct(paths, tmp_path / "out", config=config, until="metric", threads=2)
