"""Settings as text: what is refused, and that everything written is read back."""

import dataclasses
import tomllib

import pytest

from thesisrecon.config import (
    KINDS,
    PRESETS,
    config_from_tables,
    config_from_toml,
    preset,
    tables_from_config,
    tables_from_settings,
    toml_from_config,
)
from thesisrecon.errors import UsageError
from thesisrecon.selfcalibration.hartley import FixedPlaneQuadric
from thesisrecon.selfcalibration.modulus import ModulusConstraint
from thesisrecon.selfcalibration.stratified import Stratified
from thesisrecon.settings import parse_word, toml_from_tables
from thesisrecon.surface.bspline import BSplineSurface
from thesisrecon.surface.fusion import DepthSheets


def apply_settings(*settings):
    return config_from_tables(tables_from_settings(settings))


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_survives_toml(name):
    config = preset(name)
    assert config_from_toml(toml_from_config(config), preset("default")) == config
    assert tomllib.loads(toml_from_config(config)) == tables_from_config(config)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("features.spread=false", False),
        ("features.levels=3", 3),
        ("features.measure.formula=harris", "harris"),
        ("features.measure.derivative_taps=[-1, 0, 1]", (-1.0, 0.0, 1.0)),
        ("features.measure.colour=true", True),
        ("matching.growth=false", False),
        ("matching.coarse_first=false", False),
        ("matching.rematch=false", False),
        ("matching.align=false", False),
        ("matching.support=never", "never"),
        ("matching.orientation=upright", "upright"),
    ],
)
def test_the_steps_of_the_front_end_are_switched_by_settings(setting, value):
    config = apply_settings(setting)
    found = config
    for name in setting.partition("=")[0].split("."):
        found = getattr(found, name)
    assert found == value
    assert config_from_toml(toml_from_config(config)) == config


@pytest.mark.parametrize(("stage", "kind"), [(s, k) for s, kinds in KINDS.items() for k in kinds])
def test_every_kind_can_be_chosen_by_its_word(stage, kind):
    config = apply_settings(f"{stage}.kind={kind}")
    variant = getattr(config, stage)
    assert type(variant) is KINDS[stage][kind]
    assert dataclasses.is_dataclass(variant)
    assert type(variant).__dataclass_params__.frozen


def test_the_file_names_its_preset_unless_the_command_did():
    text = 'preset = "thesis"\n[images]\nmax_size_px = 900\n'
    assert config_from_toml(text) == dataclasses.replace(
        preset("thesis"), images=dataclasses.replace(preset("thesis").images, max_size_px=900)
    )
    assert config_from_toml(text, preset("default"), fixed_preset=True).features == preset("default").features


def test_a_setting_keeps_the_others_of_its_stage():
    config = apply_settings(
        "features.max_corners=7", "features.kind=harris-corners", "features.threshold_rel=0.5"
    )
    assert config.features.max_corners == 7
    assert config.features.threshold_rel == 0.5


def test_a_nested_setting_and_none():
    config = apply_settings("selfcalibration.search.steps=5")
    assert config.selfcalibration.search.steps == 5
    config = apply_settings("selfcalibration.search.steps=5", "selfcalibration.search=none")
    assert config.selfcalibration.search is None
    assert config_from_toml(toml_from_config(config)) == config


def test_a_nested_field_of_several_kinds_takes_a_word_or_a_table():
    kind = "selfcalibration.kind=stratified"
    assert apply_settings(kind, "selfcalibration.plane=modulus-constraint").selfcalibration.plane == (
        ModulusConstraint()
    )
    config = apply_settings(
        kind, "selfcalibration.plane.kind=modulus-constraint", "selfcalibration.plane.starts=50",
        "selfcalibration.calibration=fixed-plane-quadric",
    )  # fmt: skip
    assert config.selfcalibration == Stratified(ModulusConstraint(starts=50), FixedPlaneQuadric())
    assert config_from_toml(toml_from_config(config)) == config
    with pytest.raises(UsageError, match="modulus-constraint"):
        apply_settings(kind, "selfcalibration.plane=modulus")
    with pytest.raises(UsageError, match="starts"):
        apply_settings(kind, "selfcalibration.plane.kind=cheirality-search", "selfcalibration.plane.starts=5")
    with pytest.raises(UsageError, match="a table"):
        apply_settings(kind, "selfcalibration.plane=3")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("featurs.kind=harris-corners", "did you mean features"),
        ("features.kind=haris-corners", "did you mean harris-corners"),
        ("images.max_size=900", "did you mean images.max_size_px"),
        ("images.max_size_px=large", "takes a whole number"),
        ("images.max_size_px=900.5", "takes a whole number"),
        ("images.max_size_px=true", "takes a whole number"),
        ("images.max_size_px=3", "at least 64"),
        ("intrinsics.cameras=each", "unknown value of intrinsics.cameras"),
        ("intrinsics.focal_px=1000", "needs focal_std_rel"),
        ("intrinsics.exif=true", "needs focal_std_rel"),
        ("selfcalibration.focal_range=[1]", "list of 2"),
        ("selfcalibration.search=7", "takes a table"),
        ("images", "stage.field=value"),
        ("=3", "stage.field=value"),
        ("images.=3", "stage.field=value"),
        ("images=3", "stage.field=value"),
    ],
)
def test_a_wrong_setting_gets_a_sentence(setting, words):
    with pytest.raises(UsageError, match=words.replace(".", r"\.")):
        apply_settings(setting)


def test_settings_that_need_each_other_may_come_one_by_one_and_from_file_and_command():
    config = apply_settings("intrinsics.focal_px=700", "intrinsics.focal_std_rel=0.05")
    assert (config.intrinsics.focal_px, config.intrinsics.focal_std_rel) == (700.0, 0.05)
    over = [tables_from_settings(["intrinsics.focal_std_rel=0.2"])]
    assert config_from_toml("[intrinsics]\nexif = true\n", changes=over).intrinsics.focal_std_rel == 0.2


def test_another_kind_on_the_command_line_drops_the_settings_of_the_kind_in_the_file():
    over = [tables_from_settings(["features.kind=harris-corners"])]
    config = config_from_toml("[features]\nlevels = 4\n", changes=over)
    assert config == apply_settings("features.kind=harris-corners")
    same = [tables_from_settings(["features.kind=multi-scale-corners"])]
    kept = config_from_toml("[features]\nlevels = 4\n", changes=same)
    assert kept.features.levels == 4


def test_text_that_is_no_toml_and_stages_that_are_no_tables_are_refused():
    with pytest.raises(UsageError, match="not TOML"):
        config_from_toml("features: harris")
    with pytest.raises(UsageError, match="takes a table"):
        config_from_toml("features = 3")
    with pytest.raises(UsageError, match="unknown preset"):
        config_from_toml('preset = "best"')


@pytest.mark.parametrize(
    ("text", "value"),
    [("true", True), ("3", 3), ("-2.5e3", -2500.0), ("[1, 2.5]", [1, 2.5]), ("word", "word"), ("'3'", "3")],
)
def test_words_of_the_command_line(text, value):
    parsed = parse_word(text)
    assert parsed == value
    assert type(parsed) is type(value)


def test_toml_keeps_awkward_text():
    tables = {
        "a": {
            "text": 'quote " backslash \\ newline \n tab \t ünï',
            "list": [1, 2.5, True],
            "b": {"c": 1e-300},
        }
    }
    assert tomllib.loads(toml_from_tables(tables)) == tables


def test_surface_and_fusion_are_chosen_by_their_words():
    assert apply_settings("model.surface=b-spline-surface").model.surface == BSplineSurface()
    config = apply_settings("model.surface.kind=b-spline-surface", "model.surface.knot_px=6")
    assert config.model.surface == BSplineSurface(knot_px=6)
    assert apply_settings("model.fusion=depth-sheets").model.fusion == DepthSheets()
    with pytest.raises(UsageError, match="linear-surface"):
        apply_settings("model.surface=linear")
