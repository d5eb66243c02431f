"""The command, and the page it leaves."""

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.report.synthetic import Witness
from tests.validation.ablation.toy import Darts, marks
from validation.ablation import Measure, Study, ablate, analyse, write_analysis
from validation.command import main
from validation.scenes.real import ROOT
from validation.studies.robustness import stopped

EVIL = "<img src=x onerror=alert(1)>"
STUDY = """
title = "Throws"
task = {{ kind = "{toy}:Darts" }}
scenes = ["a", "{scene}"]
seeds = 3

[axes]
"task.aim" = [1.0, 4.0]
"""


def write_study(folder, scene="bb"):
    path = folder / "study.toml"
    toy = Path(__file__).with_name("toy.py")
    path.write_text(STUDY.format(toy=toy, scene=scene), encoding="utf-8")
    return path


def test_a_study_of_a_file_leaves_a_page_and_tables(tmp_path, capsys):
    options = ["ablate", str(write_study(tmp_path)), "-o", str(tmp_path / "out"), "--executor", "local"]
    assert main([*options, "--plan"]) == 0
    assert "3 variants: unchanged; aim = 1; aim = 4" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    assert main([*options, "--threads", "1"]) == 0
    reported = capsys.readouterr()
    assert reported.out.startswith("18 rows; the page is ")
    assert reported.err == "", "nobody looks at a terminal"
    assert "aim = 4" in (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert (tmp_path / "out" / "rows.csv").is_file()
    assert main([*options, "--read"]) == 0


def test_an_interrupted_study_states_how_to_resume(tmp_path):
    file = write_study(tmp_path)
    file.write_text(file.read_text().replace(":Darts", f':Darts", pause_s = 600, log = "{tmp_path / "log"}'))
    options = ["ablate", str(file), "-o", str(tmp_path / "out"), "--threads", "2"]
    stop = stopped(
        [sys.executable, "-m", "validation", *options],
        lambda: len(marks(tmp_path / "log")) == 2,
        signal.SIGINT,
        environment={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    kept = f"run the same command to continue from the finished rows in {tmp_path / 'out'}"
    assert (stop.code, stop.message, stop.left) == (130, f"validation: interrupted; {kept}\n", 0)


def test_failed_rows_and_wrong_options_have_their_exit_codes(tmp_path, capsys):
    out = ["-o", str(tmp_path / "out"), "--executor", "local", "--threads", "1"]
    some = write_study(tmp_path, "refuses")
    assert main(["ablate", str(some), *out]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[:3] == [
        f"{name} failed on refuses (3 seeds): no board; nothing hangs there; hang one up."
        for name in ("unchanged", "aim = 1", "aim = 4")
    ]
    assert said[3].startswith("18 rows, 9 of them failed; the page is ")
    table = (tmp_path / "out" / "tables.md").read_text(encoding="utf-8")
    assert "| aim = 4 | refuses (3 seeds) | no board" in table
    assert main(["ablate", str(tmp_path / "none.toml"), *out]) == 2
    assert "none.toml cannot be read" in capsys.readouterr().err


@pytest.mark.browser
@pytest.mark.parametrize(("folder", "width"), [("two", 1300), ("one", 420)])
def test_the_page_draws_and_reaches_out_nowhere(folder, width, browser, tmp_path):
    study = Study(
        {"task.aim": [1.0, 4.0], EVIL: {EVIL: {"task.spread": 3.0}}},
        ["a", "refuses"],
        seeds=8,
        task=Darts(),
        conditions={"epipolar.threshold_px": [0.5, 2.0]},
        metrics=["miss", Measure("score", better="more", definition=EVIL)],
        title=EVIL,
        words=EVIL,
    )
    if folder == "one":
        study = replace(study, conditions={}, scenes=["a"])
    page = write_analysis(analyse(ablate(study, tmp_path)), tmp_path)
    drawn = ("plot-miss-forest", "plot-miss-over" if folder == "two" else "plot-miss-cost")
    witness = Witness(browser, page, width, drawn=drawn)
    try:
        assert witness.errors == []
        assert all(r.startswith(("file:", "data:", "blob:")) for r in witness.requests)
        assert witness.page.locator("img[onerror]").count() == 0
        assert witness.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert witness.page.locator("td.bad").count() >= 2
        assert ("no board; nothing hangs there" in witness.page.inner_text("main")) == (folder == "two")
    finally:
        witness.context.close()
