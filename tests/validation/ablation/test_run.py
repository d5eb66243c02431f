"""Rows: kept as they end, computed once, whatever fails or is killed."""

import json
import os
import signal
import sys
from dataclasses import dataclass

import pytest

from tests.validation.ablation.toy import Darts, Steps, marks
from thesisrecon.errors import OutputError, UsageError
from validation.ablation import Study, ablate, analyse, read_rows
from validation.ablation.own_files import PREFIX, helpers_of
from validation.ablation.plan import study_from_table
from validation.ablation.run import read_earlier_rows


def study(log, **more):
    reported = {"scenes": ["a", "bb"], "seeds": 2, "task": Darts(log=str(log))}
    return Study({"task.aim": [1.0, 2.0]}, **{**reported, **more})


def test_every_row_is_computed_once_and_reported_in_order(tmp_path):
    log, out = tmp_path / "log", tmp_path / "out"
    rows = ablate(study(log), out, executor="local")
    assert len(rows) == 3 * 2 * 2 == len(marks(log))
    assert [(r.seed, r.scene, r.variant) for r in rows[:4]] == [
        (0, "a", "unchanged"),
        (0, "a", "aim = 1"),
        (0, "a", "aim = 2"),
        (0, "bb", "unchanged"),
    ]
    by = {(r.variant, r.scene, r.seed): r.metrics["miss"] for r in rows}
    assert by["aim = 2", "bb", 0] - by["unchanged", "bb", 0] == pytest.approx(2.0)
    again = ablate(study(log), out, executor="local")
    assert len(marks(log)) == 12
    assert [vars(r) for r in again] == [vars(r) for r in rows]
    grown = ablate(study(log, seeds=3), out, executor="local")
    assert len(grown) == 18
    assert len(marks(log)) == 18


def test_failures_are_stored_with_their_reason_and_not_retried(tmp_path):
    log = tmp_path / "log"
    failing = study(log, scenes=["a", "refuses", "breaks", "empty"], seeds=1)
    rows = ablate(failing, tmp_path / "out", executor="local")
    reported = {r.scene: r.failure for r in rows}
    assert reported["a"] == ""
    assert reported["refuses"] == "no board; nothing hangs there; hang one up."
    assert reported["breaks"].startswith("KeyError: 'board' (toy.py, line")
    assert reported["empty"] == "miss is nan"
    assert list(next(r for r in rows if r.scene == "empty").metrics) == ["score"]
    count = len(marks(log))
    ablate(failing, tmp_path / "out", executor="local")
    assert len(marks(log)) == count
    warnings = analyse(rows).warnings
    assert any("every row of refuses failed: no board" in w for w in warnings)


def test_common_first_stages_of_rows_are_computed_once(tmp_path):
    log = tmp_path / "log"
    axes = {"epipolar.threshold_px": [2.0], "dense.max_side": [512], "images.max_size_px": [800]}
    shared = Study(axes, ["a", "b"], seeds=2, task=Steps(log=str(log)))
    rows = ablate(shared, tmp_path / "out", executor="local")
    assert len(rows) == 4 * 2 * 2
    assert not any(r.failure for r in rows)
    # Corners of two sizes on two scenes; second steps of three kinds, two scenes, two seeds.
    assert marks(log).count("first") == 2 * 2
    assert marks(log).count("second") == 3 * 2 * 2
    own = {r.key: json.loads((tmp_path / "out" / "rows" / f"{r.key}.json").read_text()) for r in rows}
    for row in rows:
        assert row.cost_s >= own[row.key]["cpu_s"]
    assert sum(bool(reported["steps"]) for reported in own.values()) == len(rows)


def test_a_wrong_executor_or_folder_is_reported(tmp_path):
    planned = study(tmp_path / "log", seeds=1)
    with pytest.raises(UsageError, match="unknown executor 'prozesses'; did you mean processes"):
        ablate(planned, tmp_path / "out", executor="prozesses")
    with pytest.raises(UsageError, match="threads must be at least 1"):
        ablate(planned, tmp_path / "out", threads=0)
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(UsageError, match="cannot be written"):
        ablate(planned, tmp_path / "file" / "out", executor="local")


@dataclass(frozen=True)
class Deadly(Darts):
    """Kills its process where the aim is 2."""

    def run(self, *given):
        if self.aim == 2.0:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().run(*given)


def test_a_row_that_kills_its_process_is_lost_alone_and_tried_again_next_time(tmp_path):
    planned = study(tmp_path / "log", scenes=["a"], seeds=1, task=Deadly(log=str(tmp_path / "log")))
    rows = ablate(planned, tmp_path / "out", executor="processes", threads=2)
    assert [bool(r.failure) for r in rows] == [False, False, True]
    assert "was killed or ran out of memory" in rows[2].failure
    assert len(read_rows(planned, tmp_path / "out")) == 2


@pytest.mark.parametrize("executor", ["local", "processes"])
def test_a_row_on_a_full_disk_has_not_failed(executor, tmp_path):
    log, out = tmp_path / "log", tmp_path / "out"
    crowded = study(log, scenes=["full"], seeds=1)
    with pytest.raises(OutputError, match=r"throws\.txt cannot be written: .* free space there"):
        ablate(crowded, out, executor=executor, threads=1)
    assert len(read_rows(crowded, out)) == 0
    (tmp_path / "log.room").touch()
    rows = ablate(crowded, out, executor="local")
    assert [r.failure for r in rows] == [""] * 3


OWN = '''"""A task that works with two helpers of its folder, one in a package."""

import numpy as np

import aim_factors
from aim_tools.shift import SHIFT
from aim_tools import nothing_here_is_a_module


def my_task(config, scene, seed):
    from aim_late import late

    return {"miss": aim_factors.FACTOR * np.float64(seed + 1) + SHIFT + late()}
'''
HELPERS = {
    "aim_factors.py": "FACTOR = 10.0\n",
    "aim_tools/__init__.py": "from . import shift\nnothing_here_is_a_module = 1\n",
    "aim_tools/shift.py": "from . import deeper\nSHIFT = deeper.SHIFT\n",
    "aim_tools/deeper.py": "SHIFT = 0.5\n",
    "aim_late.py": "def late():\n    return 0.0\n",
}


@pytest.mark.parametrize("executor", ["local", "processes"])
def test_an_edited_helper_is_computed_again(tmp_path, executor):
    for name, text in {"mine.py": OWN, **HELPERS}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    table = {"task": "mine.py:my_task", "scenes": ["a"], "seeds": 1, "metrics": ["miss"]}
    table["axes"] = {"dense.max_side": [512]}

    def misses():
        rows = ablate(study_from_table(table, tmp_path), tmp_path / "out", executor=executor, threads=1)
        assert not any(r.failure for r in rows)
        return {r.metrics["miss"] for r in rows}

    assert misses() == {10.5}
    for name, text, miss in (
        ("aim_factors.py", "FACTOR = 1.0\n", 1.5),
        ("aim_tools/deeper.py", "SHIFT = 2.0\n", 3.0),
        ("aim_late.py", "def late():\n    return 7.0\n", 10.0),
        ("aim_late.py", HELPERS["aim_late.py"], 3.0),  # The first rows of this text are found again
    ):
        (tmp_path / name).write_text(text, encoding="utf-8")
        assert misses() == {miss}
    assert len(list((tmp_path / "out" / "rows").iterdir())) == 2 * 4


OWN_READER = """
from pathlib import Path
import numpy as np
SCALE = float(Path(__file__).with_name("scale.txt").read_text())
def read(config, scene, seed):
    Path(__file__).with_name("seen.txt").write_text(scene)
    assert Path(__file__).with_name("seen.txt").read_text() == scene
    return {"miss": SCALE * float(np.loadtxt(scene).mean())}
"""


@pytest.mark.parametrize("executor", ["local", "processes"])
def test_edited_data_that_a_task_reads_is_computed_again(tmp_path, executor):
    scene, scale, out = tmp_path / "scene.txt", tmp_path / "scale.txt", tmp_path / "out"
    (tmp_path / "mine.py").write_text(OWN_READER, encoding="utf-8")
    table = {"task": "mine.py:read", "scenes": [str(scene)], "seeds": 1, "metrics": ["miss"]}
    table["axes"] = {"dense.max_side": [512]}

    def misses():
        study = study_from_table(table, tmp_path)
        rows = ablate(study, out, executor=executor, threads=1)
        assert len(rows) == 2
        for name in [name for name in sys.modules if name.startswith(PREFIX)]:
            del sys.modules[name]  # As in a new process, which reads the scale again
        return {r.metrics["miss"] for r in rows}

    scale.write_text("2")
    scene.write_text("1 2 3")
    assert misses() == {4.0}
    before = sorted(p.stat().st_mtime_ns for p in (out / "rows").iterdir())
    assert misses() == {4.0}
    assert sorted(p.stat().st_mtime_ns for p in (out / "rows").iterdir()) == before
    scene.write_text("4 5 6")
    assert len(read_rows(study_from_table(table, tmp_path), out)) == 0
    assert len(read_earlier_rows(study_from_table(table, tmp_path), out)) == 2
    assert misses() == {10.0}
    scale.write_text("3")
    assert misses() == {15.0}


def test_helpers_are_those_outside_installed_packages(tmp_path, monkeypatch):
    # Also a package of another environment, which this one sees by a .pth file.
    elsewhere = tmp_path / "other" / "site-packages"
    elsewhere.mkdir(parents=True)
    monkeypatch.syspath_prepend(elsewhere)
    for name, text in {"mine.py": OWN, **HELPERS, elsewhere / "aim_installed.py": ""}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    found = [helper.module for helper in helpers_of(tmp_path / "mine.py", f"import aim_installed\n{OWN}")]
    tools = ["aim_tools", "aim_tools.deeper", "aim_tools.shift"]
    assert found == ["aim_factors", "aim_late", *tools]


@pytest.mark.parametrize("executor", ["local", "processes"])
def test_a_row_that_takes_too_long_fails_alone(tmp_path, executor):
    axes = {"task.pause_s": [60.0]}
    slow = Study(axes, ["a"], seeds=1, task=Darts(log=str(tmp_path / "log")))
    rows = ablate(slow, tmp_path / "out", executor=executor, threads=1, limit_s=1.0)
    assert [r.failure for r in rows] == ["", "exceeded the time limit of 1 s"]
    assert rows[1].seconds == pytest.approx(1.0, abs=0.5)


def test_rows_on_a_dask_cluster_are_those_of_this_process(tmp_path):
    distributed = pytest.importorskip("distributed")
    here = ablate(study(tmp_path / "log"), tmp_path / "here")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        place = cluster.scheduler_address.replace("tcp", "dask")
        there = ablate(study(tmp_path / "log"), tmp_path / "there", executor=place)
    assert [r.metrics for r in there] == [r.metrics for r in here]
