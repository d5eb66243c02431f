"""A variant of the user's own, as the documentation shows it, and all that can be wrong with one."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.validation.ablation.toy import Darts
from thesisrecon.errors import UsageError
from thesisrecon.records import FundamentalFit
from validation.ablation import Study, ablate, analyse
from validation.ablation.changes import load_own
from validation.ablation.plan import plan_study, read_study, study_from_table

DOCS = Path(__file__).resolve().parents[3] / "docs" / "development" / "ablations.md"


def write_examples(folder):
    """The files of the documentation; the study among them."""
    blocks = re.findall(r"<!-- example: (\S+) -->\n```\w+\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.S)
    for name, text in blocks:
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "study.toml"


def test_the_example_of_the_documentation_runs(tmp_path):
    rows = ablate(read_study(write_examples(tmp_path)), tmp_path / "out", executor="local", threads=1)
    assert not [r.failure for r in rows if r.failure]
    verdicts = {(c.variant, c.condition): c.verdict for c in analyse(rows).comparisons}
    assert [v.name for v in rows.plan.variants] == ["default", "EveryMatch", "EveryMatch, normalized = no"]
    assert verdicts["EveryMatch", "outliers = 0.3"] == "worse"
    assert verdicts["EveryMatch, normalized = no", "outliers = 0.3"] == "worse"


def test_the_first_lines_of_the_documentation_plan_a_study():
    code = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.S)[0]
    names = {}
    exec(compile(re.sub(r'"fountain.*?\]', "]", code.split("print(")[0]), DOCS.name, "exec"), names)
    plan = plan_study(names["study"])
    assert [v.name for v in plan.variants][1:] == ["threshold_px = 0.5", "threshold_px = 2"]
    assert len(plan.rows) > len(plan.variants)  # the whole scene and its windows


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
        ("import nothing_of_that_name", "mine.py:Mine", "does not run: ModuleNotFoundError"),
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


def test_a_task_of_a_file(tmp_path):
    text = "def weigh(config, scene, seed):\n    return {'grams': config.images.max_size_px + seed}\n"
    (tmp_path / "mine.py").write_text(text, encoding="utf-8")
    table = {
        "scenes": ["anything"],
        "seeds": 2,
        "task": "mine.py:weigh",
        "axes": {"images.max_size_px": [800]},
        "metrics": [{"name": "grams", "unit": "g", "better": "more"}],
    }
    rows = ablate(study_from_table(table, tmp_path), tmp_path / "out", executor="local", threads=1)
    assert [r.metrics["grams"] for r in rows] == [1600.0, 800.0, 1601.0, 801.0]
    with pytest.raises(UsageError, match="is a function and has no parameters; got size"):
        study_from_table({**table, "task": {"kind": "mine.py:weigh", "size": 1}}, tmp_path)
    assert load_own("mine.py:weigh", "task", tmp_path).__name__ == "weigh"
