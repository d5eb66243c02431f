"""What a study says of itself before anything runs."""

from dataclasses import replace

import pytest

from tests.validation.ablation.toy import Darts, Steps, area
from thesisrecon.config import PRESETS, PipelineConfig, preset
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.ransac import ThesisRansac
from thesisrecon.errors import UsageError
from thesisrecon.features.harris import HarrisCorners
from validation.ablation import Measure, Study
from validation.ablation.command import STUDIES, plan_summary
from validation.ablation.plan import plan_study, read_study, study_from_table, versions
from validation.ablation.run import parts_of


def darts(axes, **more):
    return Study(axes, **{"scenes": ["a", "b"], "seeds": 2, "task": Darts(), **more})


def names(study):
    return [v.name for v in plan_study(study).variants]


def test_one_thing_changes_at_a_time():
    plan = plan_study(darts({"task.aim": [1.0, 2.0], "epipolar": ["thesis-ransac"]}, start="as it is"))
    assert [v.name for v in plan.variants] == ["as it is", "aim = 1", "aim = 2", "thesis-ransac"]
    settings = {r.variant: r.setting for r in plan.rows}
    assert settings["aim = 2"].task.aim == 2.0
    assert settings["aim = 2"].config == PipelineConfig()
    assert isinstance(settings["thesis-ransac"].config.epipolar, ThesisRansac)
    assert settings["thesis-ransac"].task == Darts()
    assert plan.baseline == "as it is"


def test_a_grid_takes_every_combination_and_no_start():
    study = darts(
        {"task.aim": [0.0, 1.0], "task.spread": [1.0, 2.0]}, mode="grid", baseline="aim = 1, spread = 2"
    )
    assert names(study) == [f"aim = {a}, spread = {s}" for a in (0, 1) for s in (1, 2)]
    assert plan_study(study).variants[3].levels == {"task.aim": "aim = 1", "task.spread": "spread = 2"}


def test_a_ladder_keeps_its_steps_and_a_whole_stage_replaces_what_was_set_in_it():
    steps = {
        "wide": {"epipolar.threshold_px": 3.0},
        "high": {"task.aim": 2.0},
        "new": {"epipolar": "thesis-ransac"},
    }
    plan = plan_study(darts({"steps": steps}, mode="ladder", start="bottom"))
    assert [v.name for v in plan.variants] == ["bottom", "wide", "high", "new"]
    found = {r.variant: r.setting for r in plan.rows}
    assert found["high"].config.epipolar.threshold_px == 3.0
    assert found["new"].config.epipolar == ThesisRansac()
    assert found["new"].task.aim == 2.0


def test_values_may_be_objects_tables_words_or_preset_values():
    values = [
        HarrisCorners(max_corners=77),
        {"kind": "harris-corners", "max_corners": 88},
        "harris-corners",
        {"preset": "thesis"},
    ]
    assert names(darts({"features": values[:3]})) == [
        "unchanged",
        "HarrisCorners, max_corners = 77",
        "harris-corners, max_corners = 88",
        "harris-corners",
    ]
    rows = plan_study(darts({"features": values[1:2]})).rows
    assert rows[1].setting.config.features == HarrisCorners(max_corners=88)
    rows = plan_study(darts({"features": values[3:]})).rows
    assert rows[1].setting.config.features == preset("thesis").features


def test_rows_are_named_by_setting_scene_seed_and_versions(monkeypatch):
    study = darts({"task.aim": [1.0]})
    keys = {(r.variant, r.scene, r.seed): r.key for r in plan_study(study).rows}
    again = plan_study(replace(study, seeds=[1, 5], scenes=["b"], axes={"task.aim": [1.0, 3.0]}))
    same = [r.key for r in again.rows if keys.get((r.variant, r.scene, r.seed)) == r.key]
    assert len(same) == 2, "a study that grows keeps its rows"
    monkeypatch.setattr("validation.ablation.plan.versions", lambda: {**versions(), "numpy": "0"})
    assert not {r.key for r in plan_study(study).rows} & set(keys.values())


def test_a_function_that_declares_its_metrics_is_a_task():
    study = Study(
        {"images.max_size_px": [800]}, ["a"], seeds=1, task=area, metrics=["size", Measure("scene_length")]
    )
    assert [m.name for m in plan_study(study).measures] == ["size", "scene_length"]
    with pytest.raises(UsageError, match="needs metrics"):
        plan_study(replace(study, metrics=()))
    with pytest.raises(UsageError, match="has no parameters"):
        plan_study(replace(study, axes={"task.aim": [1]}))


def test_only_steps_after_which_rows_part_are_parts_of_their_own():
    axes = {"epipolar.threshold_px": [2.0], "dense.max_side": [512], "images.max_size_px": [800]}
    plan = plan_study(Study(axes, ["a"], seeds=2, task=Steps()))
    parts = parts_of(plan.rows)
    steps = [p for p in parts if p.step]
    # Corners of the usual size serve three variants and two seeds; those of 800 px serve two seeds.
    assert [p.step for p in steps].count("first") == 2
    # With dense.max_side the second step is as without it.
    assert [p.step for p in steps].count("second") == 2
    for part in parts:
        assert all(any(s.key == key for s in steps) for key in part.after)
    assert "computed once for several rows: first (2), second (2)" in plan_summary(plan)


TABLE = {"scenes": ["a"], "axes": {"epipolar.threshold_px": [2.0]}, "task": "reconstruction"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axes": {"epipolr.threshold_px": [1]}}, r"axis epipolr.* names no path .*did you mean epipolar\?"),
        ({"axes": {"epipolar.treshold_px": [1.0]}}, r"did you mean epipolar\.threshold_px\?"),
        ({"axes": {"epipolar.threshold_px": ["big"]}}, "takes a number; got 'big'"),
        ({"axes": {"epipolar.threshold_px": [-1.0]}}, "threshold_px = -1: .*must be positive"),
        ({"axes": {"epipolar.threshold_px": []}}, "has no values"),
        ({"axes": {"epipolar.threshold_px": [2.0, 2.0]}}, "has the level 'threshold_px = 2' twice"),
        ({"axes": {"features": ["haris-corners"]}}, "did you mean harris-corners"),
        ({"axes": {"any": {"a": 3}}}, "takes a table of changes"),
        ({"axes": {"epipolar.threshold_px": 2.0}}, "takes a list of values or a table of levels"),
        ({"axes": 3}, "axes takes a table"),
        ({"scenes": []}, "scenes are a list of at least one name"),
        ({"scenes": ["courtyrd"]}, "did you mean courtyard"),
        ({"seeds": 0}, "seeds are different whole numbers"),
        ({"seeds": [1, 1]}, "seeds are different whole numbers"),
        ({"seeds": 2.5}, "seeds are different whole numbers"),
        ({"metrics": ["focal_eror_pct"]}, "did you mean focal_error_pct"),
        ({"metrics": "focal_error_pct"}, "metrics take a list"),
        ({"mode": "ladr"}, "unknown mode 'ladr'; did you mean ladder"),
        ({"baseline": "unchange"}, "unknown baseline 'unchange'; did you mean unchanged"),
        ({"task": "reconstuction"}, "did you mean reconstruction"),
        ({"task": {"kind": "reconstruction", "until": "soon"}}, "unknown stage 'soon'"),
        ({"task": {"kind": "stereo", "unti": 1}}, r"unknown setting 'task\.unti'"),
        ({"preset": "defalt"}, "unknown preset 'defalt'; did you mean default"),
        ({"config": {"images": {"max_size_px": 10}}}, "max_size_px must be at least 64"),
        ({"axis": {}}, "unknown key of a study 'axis'; did you mean axes"),
        ({"title": 5}, "title takes text"),
        ({"axes": {"features": ["mine.py:Corners"]}}, r"there is no file .*mine\.py to read Corners from"),
    ],
)  # fmt: skip
def test_inconsistent_plans_are_rejected_before_the_run(change, words):
    scenes = {"scenes": ["courtyard"]} if change.get("task", "") != {"kind": "stereo", "unti": 1} else {}
    with pytest.raises(UsageError, match=words):
        plan_study(study_from_table({**TABLE, **scenes, **change}))


def test_a_file_that_is_not_a_study_is_rejected(tmp_path):
    with pytest.raises(UsageError, match=r"gone\.toml cannot be read"):
        read_study(tmp_path / "gone.toml")
    (tmp_path / "broken.toml").write_text("scenes = [", encoding="utf-8")
    with pytest.raises(UsageError, match=r"broken\.toml is not TOML"):
        read_study(tmp_path / "broken.toml")
    (tmp_path / "short.toml").write_text("scenes = ['a']", encoding="utf-8")
    with pytest.raises(UsageError, match=r"short\.toml: a study needs axes"):
        read_study(tmp_path / "short.toml")


SHIPPED = sorted(STUDIES.glob("*.toml"))


@pytest.mark.parametrize("path", SHIPPED, ids=[p.stem for p in SHIPPED])
def test_every_study_that_is_shipped_can_be_planned(path):
    try:
        plan = plan_study(read_study(path))
    except UsageError as error:
        if "not on this machine" not in str(error):
            raise
        pytest.skip(str(error))
    assert len(plan.variants) >= 2
    assert plan.study.title
    assert plan.study.words


def test_the_ladder_leads_from_the_thesis_to_the_default():
    study = replace(read_study(STUDIES / "thesis-to-default.toml"), scenes=["courtyard"], seeds=1)
    rows = plan_study(study).rows
    configs = [replace(r.setting.config, images=PipelineConfig().images) for r in rows]
    # What comes after the cameras does not change them.
    ends = [
        replace(PRESETS[name], dense=configs[0].dense, model=configs[0].model)
        for name in ("thesis", "default")
    ]
    assert configs[0] == ends[0]
    assert configs[-1] == ends[1]
    assert isinstance(configs[-1].epipolar, LocallyOptimisedRansac)
