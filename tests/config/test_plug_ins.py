"""Functions and objects from outside as stages: calls, refusals, stored results, examples of the page."""

# ruff: noqa: ARG001, ARG002, ARG005 (functions and methods take what their stage passes)

import functools
import importlib
import logging
import re
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.conftest import refuses
from tests.pipeline.fake_stages import photographs
from tests.synthetic import one_by_one
from thesisrecon import match_pair, reconstruct
from thesisrecon.config import ImageOptions, PipelineConfig
from thesisrecon.config.plug_ins import FunctionFundamental, FunctionMatcher
from thesisrecon.config.text import build_config, config_from_toml, tables_from_config, toml_from_config
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.verification import PairVerification
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.matching.pair_selection import OverlapEstimate
from thesisrecon.matching.strength import StrengthOfMatch
from thesisrecon.matching.tracks import AlignedTracks, PlainTracks
from thesisrecon.records import Features

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "images"
SMALL = ImageOptions(max_size_px=400)
FEW = PairVerification(min_inliers=20)


def images(count):
    return sorted(COURTYARD.iterdir())[:count]


def positions(image, step=5):
    y, x = np.mgrid[8 : image.shape[0] - 8 : step, 8 : image.shape[1] - 8 : step]
    return np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)


def strong(image, count=300):
    """Positions of large gradients."""
    gray = image.astype(np.float64).sum(axis=2)
    xy = positions(image, 2)
    dy, dx = np.gradient(gray)
    rows = np.argsort(-np.minimum(np.abs(dx), np.abs(dy))[xy[:, 1].astype(int), xy[:, 0].astype(int)])
    return xy[rows[:count]]


def windows(image, xy):
    gray = image.astype(np.float64).sum(axis=2)
    at = xy.astype(int)
    found = np.stack([gray[y - 7 : y + 8, x - 7 : x + 8].ravel() for x, y in at])
    found -= found.mean(axis=1, keepdims=True)
    return found / (np.linalg.norm(found, axis=1, keepdims=True) + 1e-9)


def mutual(image1, image2, ratio=0.9):
    """A matcher in a few lines: mutual best windows at strong gradients, of any position."""
    xy1, xy2 = strong(image1), strong(image2)
    similarity = windows(image1, xy1) @ windows(image2, xy2).T
    best, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
    second, first = np.sort(similarity, axis=1)[:, -2:].T
    good = (back[best] == np.arange(len(xy1))) & (1.0 - first < ratio * (1.0 - second))
    return xy1[good], xy2[best[good]], first[good]


@pytest.fixture(scope="module")
def by_function(tmp_path_factory):
    config = PipelineConfig(images=SMALL, features=strong, matching=mutual, verification=FEW)
    return reconstruct(images(3), tmp_path_factory.mktemp("function") / "out", config=config, until="matches")


def test_functions_detect_and_match_and_their_matches_are_joined_to_tracks(by_function, caplog):
    assert [len(f.xy) for f in by_function.features] == [300] * 3
    assert all(pair.candidates >= pair.inliers for pair in by_function.pairs)
    assert by_function.pairs[0].accepted
    assert (by_function.pairs[0].index1 == -1).all()
    pair = match_pair(*images(2), config=PipelineConfig(images=SMALL, matching=mutual, verification=FEW))
    assert pair.inliers == by_function.pairs[0].inliers
    given = {"map_all": one_by_one, "rng": np.random.default_rng(0)}
    tracks = PlainTracks().build([None] * 3, by_function.pairs, **given)
    assert (np.bincount(tracks.point_index) == 3).sum() > 5
    with caplog.at_level(logging.INFO):
        assert PipelineConfig(matching=mutual).tracks == PlainTracks()
    assert "not aligned" in caplog.text
    assert PipelineConfig(matching=mutual, tracks=PlainTracks(merge_px=3.0)).tracks.merge_px == 3.0
    with caplog.at_level(logging.WARNING):
        aligned = AlignedTracks().build([None] * 3, by_function.pairs, **given)
    np.testing.assert_array_equal(aligned.xy, tracks.xy)


def test_a_function_estimates_f_and_the_library_adds_noise_and_covariance(by_function):
    pair = by_function.pairs[0]
    reference = LocallyOptimisedRansac().estimate(pair.xy1, pair.xy2, np.random.default_rng(0))
    inliers = reference.inliers[:, None].astype(np.uint8)
    method = FunctionFundamental(lambda xy1, xy2: (3.0 * reference.F, inliers))
    fit = method.estimate(pair.xy1, pair.xy2, np.random.default_rng(0))
    np.testing.assert_allclose(fit.F, reference.F * np.sign((fit.F * reference.F).sum()), atol=1e-10)
    assert fit.sigma_px == pytest.approx(reference.sigma_px, rel=0.5)
    ratio = np.trace(fit.covariance) / np.trace(reference.covariance)
    assert 0.1 < ratio < 10.0
    nothing = FunctionFundamental(lambda xy1, xy2: (None, None))
    refuses(StageFailure, "returned no F", nothing.estimate, pair.xy1, pair.xy2, None)


def called(stage, function):
    """Call a stage of two images with this function."""
    config = PipelineConfig(**{stage: function})
    one, two = photographs(2)
    if stage == "features":
        return config.features.detect(one)
    if stage == "epipolar":
        xy = np.random.default_rng(0).uniform(0.0, 99.0, (2, 30, 2))
        return config.epipolar.estimate(*xy, None)
    views = [config.matching.prepare(image, None) for image in (one, two)]
    return config.matching.match(*views, pair=(0, 1), estimate_fundamental=None, rng=None)


POINT = np.full((1, 2), 5.0)
F = np.diag([1.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("stage", "returned", "words"),
    [
        ("features", np.ones((4, 3)), r"xy \(N, 2\); got \(4, 3\)"),
        ("features", np.full((4, 2), np.nan), "finite numbers"),
        ("features", np.full((4, 2), 97.0), "outside the image of 96 x 80 px"),
        ("features", (POINT, [1.0, 2.0]), r"xy \(N, 2\), scale \(N\); got \(1, 2\), \(2,\)"),
        ("features", (POINT, [0.0]), "not positive"),
        ("features", (1, 2, 3, 4), "4 values"),
        ("features", "corners", "array of real numbers as xy"),
        ("matching", None, "NoneType"),
        ("matching", (POINT, np.ones((2, 2))), r"xy1 \(N, 2\), xy2 \(N, 2\); got \(1, 2\), \(2, 2\)"),
        ("matching", (POINT, POINT, [np.inf]), "finite numbers"),
        ("matching", (POINT, -POINT), r"xy2 with \(-5, -5\) outside the image"),
        ("epipolar", F, "ndarray"),
        ("epipolar", (F, np.ones(29)), r"inliers of shape \(29,\) for 30 matches"),
        ("epipolar", (np.ones((9, 3)), np.ones(30)), r"F \(3, 3\); got \(9, 3\)"),
        ("epipolar", (np.zeros((3, 3)), np.ones(30)), "rank below 2"),
    ],
)  # fmt: skip
def test_a_wrong_result_gets_one_sentence(stage, returned, words):
    refuses(UsageError, f"the function chosen returned.*{words}", called, stage, give(returned, stage))


def give(returned, stage):
    chosen = (lambda one, two: returned) if stage in ("matching", "epipolar") else (lambda one: returned)
    chosen.__name__ = "chosen"
    return chosen


class Own:
    """A matcher that is no dataclass and returns what it is given."""

    def __init__(self, returned):
        self.returned = returned

    def prepare(self, image, features):
        return FunctionMatcher(mutual).prepare(image, features)

    def match(self, view1, view2, **_):
        return self.returned


class Incomplete:
    prepare = detect = lambda self: None


@pytest.mark.parametrize(
    ("stage", "value", "words"),
    [
        ("matching", Incomplete(), "prepare and match, or a function of image1, image2; .*no match"),
        ("features", Incomplete(), r"method detect of features=Incomplete .*\(image\); it takes \(\)"),
        ("matching", Own, r"got the class Own: write Own\(\)"),
        ("matching", lambda image: image, r"2 arguments \(image1, image2\); it takes \(image\)"),
        ("features", mutual, "1 arguments"),
        ("tracks", mutual, "got a function, which has no build"),
        ("metric", "metric-refinement", "got 'metric-refinement', which has no refine"),
        ("images", {"max_size_px": 3}, r"images takes ImageOptions\(...\)"),
    ],
)  # fmt: skip
def test_a_method_is_checked_when_the_configuration_is_built(stage, value, words):
    refuses(UsageError, words, PipelineConfig, **{stage: value})


def test_an_object_is_checked_like_a_function(tmp_path):
    config = PipelineConfig(images=SMALL, matching=Own((np.ones((3, 2)), np.ones((2, 2)))))
    words = r"method match of Own returned, needs xy1 \(N, 2\), xy2 \(N, 2\); got \(3, 2\), \(2, 2\)"
    refuses(UsageError, words, match_pair, *images(2), config=config)
    views = [FunctionMatcher(mutual).prepare(image, None) for image in photographs(2)]
    matches = FunctionMatcher(mutual).match(*views, pair=(0, 1), estimate_fundamental=None, rng=None)
    matches.index1[:1] = 7**7
    config = PipelineConfig(images=SMALL, features=strong, matching=Own(matches))
    refuses(UsageError, "indices that are not corners", match_pair, *images(2), config=config)


def test_features_without_seeds_get_a_sentence_where_seeds_are_needed(tmp_path):
    features = [Features(POINT, np.ones(1, np.float32), np.ones(1, np.float32))] * 31
    given = {"map_all": one_by_one, "rng": np.random.default_rng(0)}
    names = [str(n) for n in range(31)]
    refuses(UsageError, "pairs.kind=all-pairs", OverlapEstimate().select, names, features, **given)
    config = PipelineConfig(images=SMALL, features=strong)
    refuses(UsageError, "needs features with seeds", match_pair, *images(2), config=config)


FILE = """
from dataclasses import dataclass
from tests.config.test_plug_ins import mutual
from beside import RATIO

def loose(image1, image2):
    return mutual(image1, image2, RATIO)

@dataclass(frozen=True)
class Mutual:
    ratio: float = 0.9
    def prepare(self, image, features):
        return image.rgb
    def match(self, view1, view2, **_):
        return mutual(view1, view2, self.ratio)

strict = Mutual(0.5)
"""


@pytest.fixture
def file(tmp_path, monkeypatch):
    (tmp_path / "beside.py").write_text("RATIO = 0.95\n", encoding="utf-8")
    (tmp_path / "plugged.py").write_text(FILE, encoding="utf-8")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    yield tmp_path / "plugged.py"
    for name in ("beside", "plugged"):
        sys.modules.pop(name, None)


def test_code_in_a_file_is_chosen_by_text_and_replayed(file, tmp_path):
    for name, fields in (("loose", {}), ("Mutual", {"ratio": 0.9}), ("strict", {"ratio": 0.5})):
        config = build_config(settings=[f"matching.kind=plugged.py:{name}"])
        kind = f"{file}:{'Mutual' if fields else name}"
        assert tables_from_config(config)["matching"] == {"kind": kind, **fields}
        assert config_from_toml(toml_from_config(config)) == config
        assert config_from_toml(f'[matching]\nkind = "plugged.py:{name}"\n') == config
    config = build_config(settings={"matching.kind": "plugged.py:Mutual", "matching.ratio": 0.7})
    assert config.matching.ratio == 0.7
    settings = ["matching.kind=plugged.py:loose", "verification.min_inliers=20"]
    given = {"max_size": 400, "until": "matches", "seed": 2}
    result = reconstruct(images(2), tmp_path / "out", set=settings, **given)
    again = reconstruct(images(2), tmp_path / "out", config=tmp_path / "out" / "config.toml", **given)
    assert again.summary["resumed"] == ["features", "pairs", "matches"]
    other = reconstruct(images(2), tmp_path / "b", set=settings, executor="processes", **given)
    assert other.pairs[0].candidates == result.pairs[0].candidates > 20


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("matching.kind=nowhere.py:f", "there is no file nowhere.py"),
        ("matching.kind=plugged.py:mutal", "unknown name in plugged.py 'mutal'; did you mean"),
        ("matching.kind=broken.py:f", "broken.py cannot be imported: ZeroDivisionError"),
        ("matching.kind=plugged.py:RATIO", "matching takes an object"),
        ("matching.kind=plugged", "path/to/file.py:name"),
        ("features.kind=plugged.py:loose", "1 arguments"),
    ],
)
def test_a_wrong_name_of_code_gets_a_sentence(file, setting, words):
    (file.parent / "broken.py").write_text("1 / 0\n", encoding="utf-8")
    refuses(UsageError, words, build_config, settings=[setting])
    wrong = ["matching.kind=plugged.py:loose", "matching.ratio=0.5"]
    refuses(UsageError, "has no settings", build_config, settings=wrong)
    wrong = ["matching.kind=plugged.py:Mutual", "matching.rato=0.5"]
    refuses(UsageError, "did you mean matching.ratio", build_config, settings=wrong)


def test_a_function_of_a_prompt_cannot_be_replayed(tmp_path):
    toml = toml_from_config(PipelineConfig(matching=defined("def f(a, b): pass")))
    assert "f (defined in a running program, not in a file)" in toml
    refuses(UsageError, "the function f was .*matching.kind=path/to/file.py:f", config_from_toml, toml)
    out = tmp_path / "out"
    lines = [lambda a, b: mutual(a, b), functools.partial(mutual, ratio=0.8)]
    for line in lines:
        config = PipelineConfig(images=SMALL, features=strong, matching=line)
        assert reconstruct(images(2), out, config=config, until="matches", overwrite=True).pairs
    given = {"until": "matches", "overwrite": True, "executor": "processes", "threads": 1}
    given["config"] = PipelineConfig(images=SMALL, features=lambda image: strong(image))
    refuses(UsageError, "cannot be sent to another process", reconstruct, images(2), out, **given)


def defined(text):
    """The function f that a prompt or a notebook cell defines."""
    scope = {"__name__": "__main__", "mutual": mutual}
    exec(text, scope)
    return scope["f"]


def test_strength_of_match_takes_the_features_of_a_function():
    config = PipelineConfig(images=SMALL, features=strong, matching=StrengthOfMatch(), verification=FEW)
    assert match_pair(*images(2), config=config).inliers >= 20


def test_an_edited_variant_takes_no_stored_results(tmp_path, monkeypatch):
    """Here a helper of its code is edited; other edits are tested with the digest."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # two edits within a second

    def matched(ratio, out="out"):
        helper = f"def limit(): return {ratio}  # {ratio}"
        (tmp_path / "edited_helper.py").write_text(helper, encoding="utf-8")
        sys.modules.pop("edited_helper", None)
        importlib.invalidate_caches()
        own = "import edited_helper\ndef f(a, b):\n    return mutual(a, b, edited_helper.limit())"
        config = PipelineConfig(images=SMALL, features=HarrisCorners(), matching=defined(own))
        result = reconstruct(images(2), tmp_path / out, config=config, until="matches", overwrite=True)
        return result.pairs[0].candidates, result.summary["resumed"]

    loose, _ = matched(0.8)
    strict, resumed = matched(0.5)
    assert loose > strict == matched(0.5, "fresh")[0]
    assert "matches" not in resumed
    # The same code finds its results again.
    assert "matches" in matched(0.5)[1]


PAGE = Path(__file__).parents[2] / "docs" / "recipes" / "plug-ins.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
GIVEN = {"until": "matches", "max_size": 400}


@pytest.mark.references
@pytest.mark.parametrize(
    ("number", "said", "max_size"), [(0, "config=config, max_size=1000", 600), (1, "**given)", 400)]
)
def test_opencv_sift_matches_and_its_keypoints_are_features(number, said, max_size, tmp_path):
    definition, call = BLOCKS[number].split("result = ")
    scope = {"__name__": "__main__"}
    exec(definition, scope)
    assert call.startswith(f'thesisrecon.reconstruct("images", "out", {said}')
    given = scope.get("given", {"config": scope.get("config")}) | GIVEN | {"max_size": max_size}
    result = reconstruct(images(3), tmp_path / "out", **given)
    assert sum(pair.accepted for pair in result.pairs) >= 2
    assert max(pair.inliers for pair in result.pairs) > (100 if number == 0 else 0)


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


class Tensor:
    """What the blocks of the page use of a tensor."""

    def __init__(self, array):
        self.array = np.asarray(array)

    def __getitem__(self, key):
        return Tensor(self.array[key])

    def cpu(self):
        return self

    def numpy(self):
        return self.array


class Network:
    """Stub of the networks: an evaluated module that finds a grid shifted by 5 pixels."""

    def __init__(self, **options):
        assert options in ({"max_num_keypoints": 2048}, {"features": "superpoint"}, {"pretrained": "outdoor"})

    def eval(self):
        return self

    def extract(self, tensor):
        assert tensor.array.shape[0] == 3
        return {"keypoints": Tensor([[[10.0, 10], [20, 30], [40, 50]]])}

    def __call__(self, data):
        if isinstance(data["image0"], dict):
            return {"matches": Tensor([[[0, 0], [2, 1]]]), "scores": Tensor([[0.9, 0.8]])}
        assert data["image1"].array.shape == (1, 1, 60, 80)
        assert data["image1"].array.max() <= 1.0
        found = {"keypoints0": [[1.0, 2]], "keypoints1": [[6.0, 2]], "confidence": [0.7]}
        return {name: Tensor(value) for name, value in found.items()}


def test_lightglue_and_loftr_fit_by_their_documented_calls(monkeypatch):
    rgb = np.full((60, 80, 3), 200, np.uint8)

    def unbatched(data):
        return {name: value[0] for name, value in data.items()}

    utils = SimpleNamespace(
        numpy_image_to_torch=lambda i: Tensor(np.moveaxis(i, 2, 0) / 255.0), rbd=unbatched
    )
    feature = SimpleNamespace(LoFTR=Network)
    stubs = {
        "torch": SimpleNamespace(inference_mode=nullcontext, from_numpy=Tensor),
        "lightglue": SimpleNamespace(LightGlue=Network, SuperPoint=Network), "lightglue.utils": utils,
        "kornia": SimpleNamespace(feature=feature), "kornia.feature": feature,
    }  # fmt: skip
    for name, module in stubs.items():
        monkeypatch.setitem(sys.modules, name, module)
    expected = {"lightglue": ([[10, 10], [40, 50]], [[10, 10], [20, 30]], [0.9, 0.8]),
                "loftr": ([[1, 2]], [[6, 2]], [0.7])}  # fmt: skip
    for block, (name, values) in zip(BLOCKS[3:5], expected.items(), strict=True):
        scope = {"__name__": "__main__"}
        exec(block, scope)
        for found, value in zip(scope[name](rgb, rgb), values, strict=True):
            np.testing.assert_array_equal(found, value)
