"""The command, and the page it leaves."""

import csv
import os
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.report.synthetic import Witness
from tests.validation.ablation.toy import Darts, marks
from validation.ablation import Measure, Study, ablate, analyse, read_rows, write_analysis
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


def test_tables_and_figures_of_a_paper(tmp_path):
    pytest.importorskip("matplotlib")
    axes = {"task.aim": [1.0, 4.0], "named & 5 %": {"a_b": {"task.aim": 2.0}}}
    conditions = {"task.spread": [0.5, 1.0, 2.0], "task.pause_s": [0.0, 1e-9]}
    study = Study(axes, ["a", "refuses"], seeds=3, task=Darts(), conditions=conditions, metrics=["miss"])
    write_analysis(analyse(ablate(study, tmp_path)), tmp_path)
    text = (tmp_path / "tables.tex").read_text(encoding="utf-8")
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 2
    assert r"a\_b" in text
    assert not re.search(
        r"(?<!\\)[_#]", re.sub(r"\\(label|usepackage|begin|end)\{[^}]*\}|^%.*$", "", text, flags=re.M)
    )
    rows = [
        line
        for block in re.findall(r"\\midrule\n(.*?)\\bottomrule", text, re.S)
        for line in block.splitlines()
    ]
    columns = [len(c) for c in re.findall(r"\\begin\{tabular\}\{(l[r]*)\}", text)]
    assert {len(re.split(r"(?<!\\)&", row)) for row in rows} == set(columns)
    names = {f"miss-{name}.{kind}" for kind in ("pdf", "svg") for name in CURVES}
    assert {path.name for path in (tmp_path / "figures").iterdir()} == names
    first = (tmp_path / "figures" / "miss-differences.svg").read_bytes()
    assert b'width="241.2pt"' in first, "a column is 3.35 inches wide"
    write_analysis(analyse(read_rows(study, tmp_path)), tmp_path)
    assert (tmp_path / "figures" / "miss-differences.svg").read_bytes() == first


CURVES = ("differences", "over-spread-pause-s-0", "over-spread-pause-s-1e-09")


def test_what_changed_between_two_runs(tmp_path, capsys):
    command = ["ablate", str(write_study(tmp_path)), "--executor", "local", "-o"]
    assert main([*command, str(tmp_path / "old")]) == 0
    # An edited toy: the same rows by name, other numbers under other keys.
    toy = Path(__file__).with_name("toy.py").read_text(encoding="utf-8")
    (tmp_path / "toy.py").write_text(toy.replace("+ threshold\n", "+ threshold + 0.5 + 0.01 * seed\n"))
    text = (tmp_path / "study.toml").read_text().replace(str(Path(__file__).with_name("toy.py")), "toy.py")
    (tmp_path / "study.toml").write_text(text, encoding="utf-8")
    assert main([*command, str(tmp_path / "new"), "--against", str(tmp_path / "old")]) == 0
    assert "before and after: " in capsys.readouterr().out
    with (tmp_path / "new" / "against-old" / "comparisons.csv").open(encoding="utf-8") as file:
        found = [r for r in csv.DictReader(file) if r["metric"] == "miss"]
    assert [r["condition"] for r in found] == ["unchanged", "aim = 1", "aim = 4"]
    assert [float(r["mean"]) for r in found] == pytest.approx([0.51] * 3)
    assert {r["verdict"] for r in found} == {"worse"}
    assert main([*command, str(tmp_path / "new"), "--against", str(tmp_path / "none")]) == 2
    assert "none has no rows of this study" in capsys.readouterr().err


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
    drawn = ("plot-miss-forest", "plot-miss-over-0" if folder == "two" else "plot-miss-cost")
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
