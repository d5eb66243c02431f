"""What a study says of itself before anything runs, and variants of a user's own."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.validation.ablation.toy import Darts, area
from thesisrecon.config import PipelineConfig, preset
from thesisrecon.epipolar.ransac import ThesisRansac
from thesisrecon.errors import UsageError
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.records import FundamentalFit
from validation.ablation import Measure, Study, ablate, analyse, read_rows
from validation.ablation.plan import STUDIES, plan_study, read_study, study_from_table, versions
from validation.command import main


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
        {"preset": "thesis"},
    ]
    rows = plan_study(darts({"features": values})).rows
    found = {row.variant: row.setting.config.features for row in rows}
    assert [*found][1:3] == ["HarrisCorners, max_corners = 77", "harris-corners, max_corners = 88"]
    assert found["harris-corners, max_corners = 88"] == HarrisCorners(max_corners=88)
    assert found["thesis"] == preset("thesis").features


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


TABLE = {"scenes": ["courtyard"], "axes": {"epipolar.threshold_px": [2.0]}, "task": "reconstruction"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axes": {"epipolr.threshold_px": [1]}}, r"axis epipolr.* names no path .*did you mean epipolar\?"),
        ({"axes": {"epipolar.treshold_px": [1.0]}}, r"did you mean epipolar\.threshold_px\?"),
        ({"axes": {"epipolar.threshold_px": ["big"]}}, "takes a number; got 'big'"),
        ({"axes": {"epipolar.threshold_px": [-1.0]}}, "threshold_px = -1: .*must be positive"),
        ({"axes": {"epipolar.threshold_px": [2.0, 2.0]}}, "has the level 'threshold_px = 2' twice"),
        ({"axes": {"any": {"a": 3}}}, "takes a table of changes"),
        ({"axes": {"epipolar.threshold_px": 2.0}}, "takes a list of values or a table of levels"),
        ({"scenes": []}, "scenes are a list of at least one name"),
        ({"scenes": ["courtyrd"]}, "did you mean courtyard"),
        ({"seeds": 0}, "seeds are different whole numbers"),
        ({"metrics": ["focal_eror_pct"]}, "did you mean focal_error_pct"),
        ({"mode": "ladr"}, "unknown mode 'ladr'; did you mean ladder"),
        ({"baseline": "unchange"}, "unknown baseline 'unchange'; did you mean unchanged"),
        ({"task": "reconstuction"}, "did you mean reconstruction"),
        ({"config": {"images": {"max_size_px": 10}}}, "max_size_px must be at least 64"),
        ({"axis": {}}, "unknown key of a study 'axis'; did you mean axes"),
        ({"axes": {"features": ["mine.py:Corners"]}}, r"there is no file .*mine\.py to read Corners from"),
    ],
)  # fmt: skip
def test_inconsistent_plans_are_rejected_before_the_run(change, words):
    with pytest.raises(UsageError, match=words):
        plan_study(study_from_table({**TABLE, **change}))


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


DOCS = Path(__file__).resolve().parents[3] / "docs" / "development" / "ablations.md"


def write_examples(folder):
    """The files of the documentation; the study among them."""
    blocks = re.findall(r"<!-- example: (\S+) -->\n```\w+\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.S)
    for name, text in blocks:
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "study.toml"


def test_the_example_of_the_documentation_runs(tmp_path):
    """25 lines of one's own lead to a table in LaTeX and a figure as PDF."""
    study = write_examples(tmp_path)
    lines = [line for path in tmp_path.iterdir() for line in path.read_text("utf-8").splitlines() if line]
    assert len(lines) + len(["the command"]) <= 25
    assert main(["ablate", str(study), "-o", str(tmp_path / "out"), "--executor", "local"]) == 0
    assert r"\toprule" in (tmp_path / "out" / "tables.tex").read_text(encoding="utf-8")
    assert (tmp_path / "out" / "figures" / "distance-px-over-outliers.pdf").is_file()
    rows = read_rows(read_study(study), tmp_path / "out")
    assert not [r.failure for r in rows if r.failure]
    verdicts = {(c.variant, c.condition): c.verdict for c in analyse(rows).comparisons}
    assert [v.name for v in rows.plan.variants] == ["default", "EveryMatch", "EveryMatch, normalized = no"]
    assert verdicts["EveryMatch", "outliers = 0.3"] == "worse"


@dataclass(frozen=True)
class Blind:
    """An estimator that looks at nothing."""

    def estimate(self, xy1, *_):
        F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        return FundamentalFit(F / np.sqrt(2), np.ones(len(xy1), bool), 1.0, np.eye(9))


def test_an_object_of_a_script_enters_a_study_in_python(tmp_path):
    study = Study({"epipolar": [Blind()]}, ["a"], seeds=1, task=Darts())
    rows = ablate(study, tmp_path, executor="processes", threads=1)
    assert [r.variant for r in rows] == ["unchanged", "Blind"]
    assert not any(r.failure for r in rows)


@pytest.mark.parametrize(
    ("text", "word", "words"),
    [
        ("x = ", "mine.py:Mine", "mine.py does not run: SyntaxError"),
        ("class Mine: pass", "mine.py:Mine", "mine.py:Mine is not a frozen dataclass, as a variant must be"),
        ("class Mine: pass", "mine.py:Min", "unknown name in mine.py 'Min'; did you mean Mine"),
        (
            "from dataclasses import dataclass\n@dataclass(frozen=True)\nclass Mine:\n    size: int = 1\n",
            "mine.py:Mine",
            "a FundamentalEstimator must have the method estimate; Mine has none",
        ),
    ],
)
def test_invalid_variants_are_reported_before_the_run(tmp_path, text, word, words):
    (tmp_path / "mine.py").write_text(text, encoding="utf-8")
    table = {"scenes": ["cube"], "task": "fundamental", "axes": {"epipolar": [word]}}
    with pytest.raises(UsageError, match=words):
        plan_study(study_from_table(table, tmp_path))
