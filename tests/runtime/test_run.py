"""Where an unfinished run stands, from its folder: stage, items done, time left, running or interrupted."""

import os
import re
import time

import numpy as np
import pytest

from tests.pipeline.fake_stages import fake_config, interrupt_at, photographs
from thesisrecon import reconstruct
from thesisrecon.cli.main import run_command
from thesisrecon.io._files import write_json
from thesisrecon.io._outputs import LOCK_FILE
from thesisrecon.pipeline import algorithm1
from thesisrecon.records import PairChoice, StageReport
from thesisrecon.runtime._run import run_position
from thesisrecon.runtime._run_folder import RunDirectory, StageFolder

IMAGES = 10


@pytest.fixture
def folder(tmp_path):
    """A run whose features were done 100 s ago, and 5 of 45 pairs since."""
    now = time.time()
    write_json(tmp_path / "run.json", {"images": {f"{i}.jpg": "" for i in range(IMAGES)}})
    os.utime(tmp_path / "run.json", (now - 300, now - 300))
    pairs = np.array([(i, j) for i in range(IMAGES) for j in range(i + 1, IMAGES)])
    stages = {"01-features": IMAGES, "02-matches": 5}
    for name, count in stages.items():
        for n in range(count):
            path = tmp_path / name / f"{n:05d}.npz"
            path.parent.mkdir(exist_ok=True)
            path.touch()
            os.utime(path, (now - 100 - n, now - 100 - n) if name == "01-features" else (now - n, now - n))
    choice = StageFolder(tmp_path / "02-pairs")
    choice.save("choice", "key", PairChoice(pairs, "all"))
    choice.finish(StageReport("pairs", 0.0, {}, {}, ()), {}, {"choice": "key"})
    for path in (tmp_path / "02-pairs").iterdir():
        os.utime(path, (now - 100, now - 100))
    return tmp_path


def test_a_running_folder_tells_its_stage_and_the_time_left(folder, capsys):
    with RunDirectory(folder).claim({}, overwrite=True):
        os.utime(folder / LOCK_FILE, (begun := time.time() - 200.0, begun))
        assert run_command(["inspect", str(folder)]) == 0
    # 5 pairs in 100 s, 40 are left: 800 s.
    assert re.match(
        r"running: matches, 5 of 45 done, about 1[34] min left in this stage\n", capsys.readouterr().out
    )


def test_a_killed_run_tells_how_to_go_on(folder):
    expected = "interrupted: matches, 5 of 45 done; repeat the command to resume"
    assert run_position(folder) == expected


def test_resumed_items_do_not_count_for_the_rate(folder):
    with RunDirectory(folder).claim({}, overwrite=True):
        assert run_position(folder) == "running: matches, 5 of 45 done"


def test_records_of_a_replaced_run_are_not_counted(tmp_path, monkeypatch):
    def run(images, **options):
        return reconstruct(photographs(images), tmp_path, config=fake_config(), threads=1, **options)

    run(4)
    with pytest.raises(KeyboardInterrupt):
        run(5, seed=1, overwrite=True, progress=interrupt_at("matches", 2))
    assert run_position(tmp_path) == "interrupted: matches, 2 of 10 done; repeat the command to resume"
    # Killed while it compiles: what the run had done before still counts.
    with monkeypatch.context() as patch:
        patch.setattr(algorithm1, "precompile", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run(5, seed=1)
    assert run_position(tmp_path) == "interrupted: matches, 2 of 10 done; repeat the command to resume"
    with pytest.raises(KeyboardInterrupt):
        run(5, seed=1, progress=interrupt_at("matches", 3))
    assert run_position(tmp_path) == "interrupted: matches, 3 of 10 done; repeat the command to resume"


def test_a_folder_without_a_run_has_no_position(tmp_path):
    assert run_position(tmp_path) == ""
