"""Settings, presets and priors of intrinsics."""

import tomllib
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import refuses
from thesisrecon.api.reconstruct import _exif_warnings
from thesisrecon.config import KINDS, PRESETS, PipelineConfig, preset
from thesisrecon.config.intrinsics import IntrinsicsOptions, camera_numbers, prior_from_options
from thesisrecon.config.text import (
    as_config,
    build_config,
    config_from_tables,
    config_from_toml,
    tables_from_config,
    tables_from_settings,
    toml_from_config,
)
from thesisrecon.errors import UsageError
from thesisrecon.matching.pair_selection import AllPairs, ListedPairs, OverlapEstimate, SequenceWindow
from thesisrecon.records import INTRINSICS
from thesisrecon.selfcalibration.absolute_conic import FixedPlaneQuadric
from thesisrecon.selfcalibration.cheirality import ModulusConstraint
from thesisrecon.selfcalibration.stratified import Stratified


def apply_settings(*settings):
    return config_from_tables(tables_from_settings(settings))


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_survives_toml(name):
    config = preset(name)
    assert config_from_toml(toml_from_config(config), preset("default")) == config
    assert tomllib.loads(toml_from_config(config)) == tables_from_config(config)
    awkward = replace(config, pairs=ListedPairs((('quote " backslash \\ newline \n tab \t ünï', "b.png"),)))
    assert config_from_toml(toml_from_config(awkward)) == awkward


@pytest.mark.parametrize(("stage", "kind"), [(s, k) for s, kinds in KINDS.items() for k in kinds])
def test_every_kind_can_be_chosen_by_its_word(stage, kind):
    variant = getattr(apply_settings(f"{stage}.kind={kind}"), stage)
    assert type(variant) is KINDS[stage][kind]
    assert type(variant).__dataclass_params__.frozen


def test_settings_of_each_type_are_those_of_the_text_and_survive_toml():
    values = {
        "features.spread": False, "features.levels": 3, "features.measure.formula": "harris",
        "features.measure.integration_sigma_px": 2.0, "matching.ratio": 0.75, "matching.growth": False,
        "intrinsics.principal_point_px": (1.0, 2.5),
        "selfcalibration.search": None,
    }  # fmt: skip
    texts = {None: "none", (1.0, 2.5): "[1, 2.5]", 2.0: "2e0"}
    config = apply_settings(*(f"{place}={texts.get(v, str(v).lower())}" for place, v in values.items()))
    found = {place: attrgetter(place)(config) for place in values}
    assert found == values
    assert [type(v) for v in found.values()] == [type(v) for v in values.values()]
    assert config_from_toml(toml_from_config(config)) == config


def test_options_build_the_same_configuration_as_settings(tmp_path):
    file, pairs = tmp_path / "a.toml", tmp_path / "pairs.txt"
    file.write_text('preset = "thesis"\n[images]\nmax_size_px = 900\n', encoding="utf-8")
    pairs.write_text("a.png b.png\n", encoding="utf-8")
    assert build_config() == build_config("default") == build_config(preset="default") == preset("default")
    assert build_config("thesis") == build_config(preset="thesis") == as_config("thesis") == preset("thesis")
    assert build_config(file) == build_config(str(file)) == as_config(file)
    assert build_config(file).images.max_size_px == 900
    assert build_config(file, preset="default").features == preset("default").features
    given = {"max_size": 640, "cameras": "per-image", "pairs": "window:3"}
    places = ["images.max_size_px=640", "intrinsics.cameras=per-image"]
    places += ["pairs.kind=sequence-window", "pairs.window=3"]
    assert build_config(**given) == build_config(settings=places) == apply_settings(*places)
    numbers = {"matching.ratio": np.float64(0.5), "intrinsics.principal_point_px": np.ones(2)}
    config = build_config(settings=numbers)
    assert (config.matching.ratio, config.intrinsics.principal_point_px) == (0.5, (1.0, 1.0))
    for word, kind in (("all", AllPairs()), ("overlap", OverlapEstimate()), ("window:3", SequenceWindow(3))):
        assert build_config(pairs=word).pairs == kind
    listed = ListedPairs((("a.png", "b.png"),))
    for knowledge in (pairs, str(pairs), [("a.png", "b.png")], [["a.png", "b.png"]]):
        assert build_config(pairs=knowledge).pairs == listed
    assert build_config(PipelineConfig(pairs=listed), max_size=99).pairs == listed


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"config": "thesys"}, "did you mean thesis.*no TOML file"),
        ({"config": Path("no/x")}, "cannot be read"),
        ({"config": 3}, "name of a preset or a TOML file"),
        ({"config": "nowhere.toml"}, "no TOML file of this name"),
        ({"config": "thesis", "preset": "default"}, "contradict"),
        ({"config": PipelineConfig(), "preset": "thesis"}, "contradict"),
        ({"preset": "best"}, "unknown preset"),
        ({"max_size": 800, "settings": ["images.max_size_px=900"]}, "max_size.*800.*900 contradict"),
        ({"pairs": "all", "settings": {"pairs.kind": "overlap-estimate"}}, "contradict"),
        ({"cameras": "two"}, "unknown value of intrinsics.cameras"),
        ({"max_size": "big"}, "takes a whole number"),
        ({"pairs": "windw:3"}, "there is no file 'windw:3'"),
        ({"pairs": "window:x"}, "whole number of images"),
        ({"pairs": [("a", "b", "c")]}, "pairs of file names"), ({"pairs": 3}, "pairs of file names"),
        ({"settings": "matching.ratio=0.8"}, "a mapping or a list"), ({"settings": [3]}, "stage.field=value"),
        ({"settings": {"matching": 0.8}}, "stage.field=value"), ({"settings": {3: 0.8}}, "stage.field=value"),
    ],
)  # fmt: skip
def test_options_that_contradict_or_are_unknown_get_a_sentence(given, words):
    refuses(UsageError, words, build_config, **given)


def test_a_nested_field_of_several_kinds_takes_a_word_or_a_table():
    kind = "selfcalibration.kind=stratified"
    modulus = apply_settings(kind, "selfcalibration.plane=modulus-constraint")
    assert modulus.selfcalibration.plane == ModulusConstraint()
    config = apply_settings(
        kind, "selfcalibration.plane.kind=modulus-constraint", "selfcalibration.refine=false",
        "selfcalibration.calibration=fixed-plane-quadric",
    )  # fmt: skip
    assert config.selfcalibration == Stratified(ModulusConstraint(), FixedPlaneQuadric(), refine=False)
    assert config_from_toml(toml_from_config(config)) == config
    refuses(UsageError, "modulus-constraint", apply_settings, kind, "selfcalibration.plane=modulus")
    nothing = kind, "selfcalibration.plane.kind=cheirality-search", "selfcalibration.plane.starts=5"
    refuses(UsageError, "plane has no settings", apply_settings, *nothing)
    refuses(UsageError, "a table", apply_settings, kind, "selfcalibration.plane=3")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("featurs.kind=harris-corners", "did you mean features"),
        ("features.kind=haris-corners", "did you mean harris-corners"),
        ("images.max_size=900", "did you mean images.max_size_px"),
        ("metric.huber_px=1", "delete it if an earlier version wrote it"),
        ("images.max_size_px=large", "takes a whole number"),
        ("images.max_size_px=900.5", "takes a whole number"),
        ("images.max_size_px=true", "takes a whole number"), ("images.max_size_px=3", "at least 64"),
        ("intrinsics.cameras=each", "unknown value of intrinsics.cameras"),
        ("intrinsics.focal_px=1000", "needs focal_std_rel"),
        ("intrinsics.exif=true", "needs focal_std_rel"), ("intrinsics.principal_point_px=[1]", "list of 2"),
        ("selfcalibration.search=7", "takes a table"), ("images", "stage.field=value"),
        ("projective.core_views=-3", "at least 0; got -3"),
        ("=3", "stage.field=value"), ("images.=3", "stage.field=value"), ("images=3", "stage.field=value"),
    ],
)  # fmt: skip
def test_a_wrong_setting_gets_a_sentence(setting, words):
    refuses(UsageError, words.replace(".", r"\."), apply_settings, setting)


def test_settings_of_file_and_command_are_merged_before_they_are_checked():
    thesis, text = preset("thesis"), 'preset = "thesis"\n[images]\nmax_size_px = 900\n'
    assert config_from_toml(text) == replace(thesis, images=replace(thesis.images, max_size_px=900))
    assert config_from_toml(text, preset("default"), fixed_preset=True).features == preset("default").features
    config = apply_settings("intrinsics.focal_px=700", "intrinsics.focal_std_rel=0.05")
    assert (config.intrinsics.focal_px, config.intrinsics.focal_std_rel) == (700.0, 0.05)
    over = [tables_from_settings(["intrinsics.focal_std_rel=0.2"])]
    assert config_from_toml("[intrinsics]\nexif = true\n", changes=over).intrinsics.focal_std_rel == 0.2
    # Another kind on the command line drops the settings of the kind in the file.
    for kind, levels in (("harris-corners", None), ("multi-scale-corners", 4)):
        over = [tables_from_settings([f"features.kind={kind}"])]
        config = config_from_toml("[features]\nlevels = 4\n", changes=over)
        assert getattr(config.features, "levels", None) == levels


SIZES = [(4000, 3000), (4000, 3000), (3000, 4000)]
SCALES = np.array([0.4, 0.4, 0.25])


def stages_view(options, exif=(np.nan,) * 3):
    return prior_from_options(options, SIZES, np.array(exif), SCALES)


def test_by_default_a_camera_is_a_size_with_square_pixels_and_an_unknown_focal():
    got = stages_view(IntrinsicsOptions())
    assert got.group.tolist() == [0, 0, 1]
    assert not got.focal_known.any()
    # The principal point within 0.01 of the long side at working size, around the middle of the picture.
    stds = np.column_stack(
        [[np.inf] * 3, [0.0] * 3, [0.0] * 3, [16.0, 16.0, 10.0], [16.0, 16.0, 10.0], [0.05] * 3]
    )
    np.testing.assert_allclose(got.std, stds)
    np.testing.assert_allclose(got.mean[:, 3:5], [[799.5, 599.5], [799.5, 599.5], [374.5, 499.5]])
    np.testing.assert_allclose(got.mean[:, 1:3], [[1.0, 0.0]] * 3)


def test_values_in_original_pixels_come_to_working_size():
    options = IntrinsicsOptions(
        focal_px=5000.0, focal_std_rel=0.1, skew="constant", skew_px=10.0, skew_std_px=2.0,
        principal_point_px=(1999.5, 0.0),
    )  # fmt: skip
    got = stages_view(options)
    np.testing.assert_allclose(got.mean[:, 0], [2000.0, 2000.0, 1250.0])
    np.testing.assert_allclose(got.std[:, 0], 0.1)
    np.testing.assert_allclose(got.mean[:, 2], [4.0, 4.0, 2.5])
    np.testing.assert_allclose(got.std[:, 2], [0.8, 0.8, 0.5])
    np.testing.assert_allclose(got.mean[0, 3:5], [799.5, -0.3])


def test_a_zooming_camera_keeps_the_rest():
    got = stages_view(IntrinsicsOptions(focal="free"))
    shared = dict(zip(INTRINSICS, got.shared.T.tolist(), strict=True))
    assert shared["focal"] == [0, 1, 2]
    assert shared["principal_x"] == shared["principal_y"] == shared["k1"] == [0, 0, 1]
    assert got.kind.tolist() == [0, 0, 1]
    assert camera_numbers(SIZES, IntrinsicsOptions(focal="free")).tolist() == [0, 1, 2]
    assert camera_numbers(SIZES, IntrinsicsOptions()).tolist() == [0, 0, 1]
    strange = stages_view(IntrinsicsOptions(cameras="per-image", common_prior=False))
    assert strange.kind.tolist() == [0, 1, 2]
    assert strange.shared[:, 3].tolist() == [0, 1, 2]


def test_exif_is_used_on_request_and_images_without_it_share_one_focal():
    options = IntrinsicsOptions(exif=True, focal_std_rel=0.2)
    got = stages_view(options, exif=(3000.0, np.nan, 4000.0))
    assert got.focal_known.tolist() == [True, False, True]
    np.testing.assert_allclose(got.mean[[0, 2], 0], [1200.0, 1000.0])
    known = stages_view(IntrinsicsOptions(focal="known", focal_px=3000.0))
    assert not known.std[:, 0].any()
    assert known.focal_known.all()
    options = IntrinsicsOptions(focal="known", exif=True)
    sizes = [(4000, 3000)] * 5
    exif = np.array([3000.0, np.nan, 3000.0, np.nan, 3500.0])
    got = prior_from_options(options, sizes, exif, np.ones(5))
    assert (got.std[:, 0] == 0.0).tolist() == [True, False, True, False, True]
    assert got.shared[1, 0] == got.shared[3, 0]
    assert got.shared[1, 0] not in got.shared[[0, 2, 4], 0]
    # Cameras are counted by what they have in common: known to be alike, tied, or neither.
    assert camera_numbers(sizes, options, exif).tolist() == [0, 1, 0, 1, 2]
    assert "2 of the 5 images" in _exif_warnings(options, exif)[0]
    assert "constant" in _exif_warnings(options, exif)[0]
    none = stages_view(options)
    assert none.group.tolist() == camera_numbers(SIZES, options, np.full(3, np.nan)).tolist() == [0, 0, 1]
    assert np.isinf(none.std[:, 0]).all()
    assert "found in 3 images" in _exif_warnings(options, np.full(3, np.nan))[0]
    each = IntrinsicsOptions(focal="known", exif=True, cameras="per-image")
    assert stages_view(each).group.tolist() == [0, 1, 2]
    assert not _exif_warnings(options, np.full(2, 800.0))
    assert not _exif_warnings(IntrinsicsOptions(), np.full(2, np.nan))


def test_a_principal_point_far_outside_of_the_picture_is_refused():
    stages_view(IntrinsicsOptions(principal_point_px=(-2900.0, 1500.0)))
    far = IntrinsicsOptions(principal_point_px=(1e5, 1500.0))
    refuses(UsageError, "outside an image of 4000 x 3000 px", stages_view, far)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"focal_px": 100.0}, "needs focal_std_rel"), ({"focal": "known"}, "needs its value"),
        ({"focal_px": -1.0, "focal_std_rel": 0.1}, "focal_px must be above 0"),
        ({"focal_px": np.inf, "focal_std_rel": 0.1}, "focal_px must be above 0"),
        ({"aspect_ratio": 0.0}, "aspect_ratio must be above 0"), ({"k1_std": 0.0}, "mode known"),
        ({"aspect_std": -0.1}, "aspect_std must be above 0"),
        ({"skew_px": np.inf}, "skew_px must be finite"), ({"k1_value": np.nan}, "k1_value must be finite"),
        ({"principal_point_px": (np.inf, 0.0)}, "principal_point_px must be finite"),
        ({"k1_std": np.inf}, "k1_std must be finite"),
        ({"focal_std_rel": 0.1}, "has no effect without a focal length"),
        ({"focal": "known", "focal_px": 9.0, "focal_std_rel": 0.1}, "has no effect with focal = known"),
        ({"aspect_std": 0.1}, "has no effect with aspect = known"),
        ({"skew_std_px": 0.1}, "has no effect with skew = known"),
        ({"principal_point": "known", "principal_point_std_rel": 0.1}, "with principal_point = known"),
        ({"k1": "known", "k1_std": 0.1}, "has no effect with k1 = known"),
    ],
)  # fmt: skip
def test_contradictory_options_are_rejected(options, words):
    refuses(ValueError, words, IntrinsicsOptions, **options)
