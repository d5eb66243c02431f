"""Reports of toy stages: tasks in processes, references that fail, gates, tables, pages, two runs, stops."""

import csv
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from tests.conftest import before_each_output, failing
from tests.runtime.test_signals import is_alive
from tests.validation.runs.toy_stages import STAGES, WAYS, ToyStage
from thesisrecon.errors import STRICT_VARIABLE
from validation.command import main
from validation.references.libraries import NAMES, PACKAGES, NoReference, load
from validation.runs.page import write_pages
from validation.runs.processes import own_cores, run_process
from validation.runs.records import Judgement, ReportOptions
from validation.runs.report import run_tasks
from validation.runs.results import Gate, Results, Row, collect, read_gates, write_results
from validation.runs.tables import plot
from validation.scenes.real import ROOT
from validation.studies.robustness import stopped

LIMIT_S = 3.0
GATES = {
    "toy/yard/wheels-lost": Gate("toy/yard/wheels-lost", 1.0, True, "a toy needs wheels"),
    "toy/yard/never-reported": Gate("toy/yard/never-reported", 1.0, True, "no stage reports this"),
    "other/yard/wheels": Gate("other/yard/wheels", 1.0, True, "of a stage that did not run"),
}


def toy_options(out, *, quick):
    given = {"quick": quick, "limit_s": LIMIT_S, "stages_from": "tests.validation.runs.toy_stages"}
    return ReportOptions(out, ("yard", "elsewhere"), ("toy",), **given)


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    options, reported = toy_options(tmp_path_factory.mktemp("harness"), quick=False), list[str]()
    return options, run_tasks(options, STAGES, reported.append), reported


def test_a_busy_machine_is_no_failure_and_waiting_for_nothing_is_one(tmp_path):
    given = {"cores": own_cores()[:1], "environment": {}, "limit_s": 0.8}
    for code, late in (("import time; time.sleep(1.5)", False), ("import time; time.sleep(60.0)", True)):
        process = run_process([sys.executable, "-c", code], log=tmp_path / "log", **given)
        assert process.timed_out == late
        assert process.cpu_s < 0.8


def test_a_reference_that_fails_leaves_a_row_and_nothing_else(ran):
    _, judged, reported = ran
    assert list(judged) == [("toy", "yard")]
    judgement, outcomes = judged["toy", "yard"]
    assert tuple(outcomes) == ("after", *WAYS)
    assert {name for name, o in outcomes.items() if o.ok} == {"ours", "good", "after"}
    assert outcomes["missing"].failure == "No module named 'no_such_library'"
    assert outcomes["failing"].failure == "the toy is broken; it has 1 wheel; buy another."
    assert outcomes["crashing"].failure == "crashed with signal 11"
    assert outcomes["hanging"].failure == "exceeded the time limit of 3 processor seconds"
    values = judgement.metrics[0].values
    assert (values["ours"], values["good"], values["after"]) == (0.5, 2.0, 8.0)
    assert values["crashing"] is None
    assert len(reported) == 8


def test_gates_check_numbers_and_a_missing_number_breaks_its_gate(ran, tmp_path):
    options, judged, _ = ran
    results = collect(options, judged, GATES)
    row = results.rows[0]
    assert (row.value, row.limit, row.direction, row.verdict) == (0.5, 1.0, "at most", "reached")
    assert row.reference["good"] == 2.0
    assert results.missing == ["toy/yard/never-reported"]
    assert set(results.failures) == {f"toy/yard/{n}" for n in ("missing", "failing", "crashing", "hanging")}
    # --quick leaves methods out, which is no failure unless another one fails there.
    quick = dataclasses.replace(options, quick=True)
    assert collect(quick, judged, GATES).missing == ["toy/yard/never-reported"]
    fine = {at: (judgement, {"ours": outcomes["ours"]}) for at, (judgement, outcomes) in judged.items()}
    left_out = collect(quick, fine, GATES)
    assert (left_out.missing, left_out.not_run) == ([], ["toy/yard/never-reported"])
    strict = {row.key: dataclasses.replace(GATES[row.key], limit=0.4)}
    assert collect(options, judged, strict).broken[0].key == row.key
    write_results(tmp_path, results)
    assert len(json.loads((tmp_path / "results.json").read_text())["rows"]) == len(results.rows)
    with (tmp_path / "tables" / "toy.csv").open(encoding="utf-8") as source:
        first = next(csv.DictReader(source))
    assert (first["ours"], first["good"], first["crashing"]) == ("0.5", "2.0", "")


@pytest.mark.parametrize(
    ("value", "held"), [(1.0, True), (1.01, False), (None, False), (float("nan"), False)]
)
def test_a_gate_holds_up_to_its_limit(value, held):
    assert Gate("a/b/c", 1.0, True, "").holds(value) == held
    mirrored = None if value is None else -value
    assert Gate("a/b/c", -1.0, False, "").holds(mirrored) == held


def test_a_page_of_a_scene_that_fails_is_listed_on_the_first_page(ran, tmp_path, monkeypatch):
    options, judged, _ = ran
    options = dataclasses.replace(options, out=tmp_path)
    monkeypatch.delenv(STRICT_VARIABLE)
    before_each_output(monkeypatch, failing("scene-yard.html", ValueError("no figure")))
    index = write_pages(options, STAGES, judged, collect(options, judged, GATES))
    assert "output-not-made: scene-yard.html" in index.read_text(encoding="utf-8")
    assert not (tmp_path / "scene-yard.html").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["report", "-o", "OUT", "--scenes", "nowhere"], "no scene is called nowhere"),
        (["report", "-o", "OUT", "--images", "nowhere"], "the folder of images nowhere does not exist"),
        (["check", "-o", "OUT", "--threads", "0"], "must be positive"),
        (["report", "-o", "OUT", "--max-side", "10"], "--max-side must be at least 64 px"),
        (["report", "-o", "OUT", "--resume", "OUT", "--scenes", "street"], "another folder than --out"),
    ],
)
def test_wrong_options_are_named(arguments, words, tmp_path, capsys):
    assert main([str(tmp_path / "out") if a == "OUT" else a for a in arguments]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_run_starts_from_the_references_of_a_like_one(tmp_path):
    first = toy_options(tmp_path / "first", quick=True)
    run_tasks(first, STAGES, lambda _: None)
    # Of ours nothing is taken but the folders of a run; a reference stands as it is.
    (first.folder("toy", "yard", "good") / "value.json").write_text("7.0", encoding="utf-8")
    reported = []
    second = dataclasses.replace(toy_options(tmp_path / "second", quick=True), resume=str(first.out))
    judgement, outcomes = run_tasks(second, STAGES, reported.append)["toy", "yard"]
    assert judgement.metrics[0].values == {"ours": 0.5, "good": 7.0}
    assert [line for line in reported if "good" in line] == []
    assert outcomes["good"].folder == second.folder("toy", "yard", "good")


@pytest.mark.parametrize("change", [{"seed": 1}, {"quick": True}, {"folders": {"yard": "/other/yard"}}, None])
def test_a_run_starts_from_no_unlike_one(change, tmp_path):
    options = dataclasses.replace(toy_options(tmp_path / "now", quick=False), resume=str(tmp_path / "before"))
    options = dataclasses.replace(options, folders={"yard": "/one/yard"})
    (options.out / "data").mkdir(parents=True)
    if change is not None:
        before = dataclasses.replace(options, **change)
        (tmp_path / "before").mkdir()
        (tmp_path / "before" / "options.json").write_text(json.dumps(before.to_json()), encoding="utf-8")
    with pytest.raises(ValueError, match="use a run with the same options" if change else "holds no run"):
        run_tasks(options, STAGES, lambda _: None)
    assert (options.out / "data").is_dir(), "results of a run that is there are kept"


@pytest.mark.parametrize(
    ("value", "reference", "direction", "expected"),
    [
        (2.0, {"COLMAP": 4.0, "OpenCV": 8.0}, "at most", 0.5),
        (2.0, {"COLMAP": 4.0, "OpenCV": 8.0}, "at least", 4.0),
        (2.0, {"COLMAP": None, "ours, fast": 1.0}, "at most", None),
        (None, {"COLMAP": 1.0}, "at most", None),
        (0.0, {"COLMAP": 1.0}, "at most", None),
        (3e-14, {"COLMAP": 0.04}, "at most", None),
    ],
)
def test_a_ratio_above_one_is_always_worse(value, reference, direction, expected):
    one = Row("a/b/c", "b", "c", value, "px", direction, None, reference, "", "reported")
    assert one.ratio == expected
    assert dataclasses.replace(one, ranked=False).ratio is None


@pytest.mark.parametrize("limit", [None, 3.0])
def test_pages_without_limits_and_with_all_reached_are_written(limit, tmp_path):
    """Such a verdict has no reasons."""
    verdict = "reported" if limit is None else "reached"
    one = Row("toy/yard/c", "yard", "c", 2.0, "px", "at most", limit, {"COLMAP": 4.0}, "", verdict)
    options = toy_options(tmp_path, quick=True)
    results = Results([one], [], {}, {"commit": "none"}, options.to_json())
    page = write_pages(options, STAGES, {("toy", "yard"): (Judgement([]), {})}, results)
    word = "Nothing promised here" if limit is None else "Reached"
    for path in (page, tmp_path / "scene-yard.html"):
        assert f'<p class="word">{word}</p>' in path.read_text(encoding="utf-8")


def test_the_page_names_gates_that_moved_or_have_no_value_and_reserves_room_for_plots(tmp_path):
    rows = [
        Row(f"toy/yard/{name}", "yard", name, value, unit, "at most", 3.0, {}, "", verdict)
        for name, value, unit, verdict in (("c", 1.0, "px", "moved"), ("d", None, "", "missed"))
    ]
    plots = [plot("high", [], "x", "y", height=777), plot("any", [], "x", "y")]
    options = toy_options(tmp_path, quick=True)
    results = Results(rows, [], {}, {"commit": "none"}, options.to_json())
    assert results.broken == rows
    judged = {("toy", "yard"): (Judgement([], plots=plots), {})}
    page = write_pages(options, STAGES, judged, results).read_text(encoding="utf-8")
    assert "toy/yard/c: 1 px, at most 3, much better than measured" in page
    assert "toy/yard/d: no value, at most 3" in page
    scene = (tmp_path / "scene-yard.html").read_text(encoding="utf-8")
    assert scene.count("min-height: 777px") == 1
    assert scene.count('class="plot"') == 2


MISSING = "raise ModuleNotFoundError(\"No module named '{0}'\", name='{0}')"


def not_installed(library):
    return f"{NAMES[library]} is not installed: pip install {PACKAGES[library]}"


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """A folder whose modules come before those that are installed, in every process started from here."""
    folder = tmp_path / "stubs"
    folder.mkdir()
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(ROOT)]))
    return folder


def test_report_and_check_run_without_any(stub, tmp_path):
    for library in PACKAGES:
        (stub / f"{library}.py").write_text(MISSING.format(library))
    command = [sys.executable, "-m", "validation", "check", "--quick", "--scenes", "street"]
    command += ["--stages", "bundle", "-o", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    # Progress, a line in half a minute.
    assert all(line.startswith("[") for line in done.stderr.splitlines()), done.stderr
    reported = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    assert reported["failures"] == {"bundle/street/Ceres": not_installed("pycolmap")}
    promised = [key for key in read_gates() if key.startswith("bundle/street/")]
    assert done.returncode == int(bool(promised))
    for key in promised:
        assert f"missed   {key}: no method reported this number ({not_installed('pycolmap')})" in done.stdout
    assert "not run  cameras/courtyard, " in done.stdout
    assert f"{len(promised)} of {len(read_gates())} gates were judged" in done.stdout
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "bundle/street/Ceres" in page
    assert not_installed("pycolmap") in page


def test_a_library_that_does_not_load_states_why(stub, monkeypatch):
    (stub / "open3d.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(str(stub))
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    with pytest.raises(NoReference, match=r"^Open3D does not load: libGL\.so\.1: cannot open"):
        load("open3d")


PROGRAM = """
import sys
from pathlib import Path
from tests.validation.runs.test_report import hanging_stages, toy_options
from thesisrecon.runtime._signals import with_resume_advice, install_signal_handlers
from validation.runs.report import run_tasks
install_signal_handlers("toy")
with with_resume_advice("begin again"):
    run_tasks(toy_options(Path(sys.argv[1]), quick=False), hanging_stages(), print)
"""


class HangingStage(ToyStage):
    """All its methods hang."""

    def methods(self, scene, options):
        return ("hanging",)


def hanging_stages():
    return {"toy": HangingStage()}


def process_of(out):
    """The process of the task that hangs, 0 where it is not there yet."""
    reported = list(out.rglob("hanging/process"))
    return int(reported[0].read_text() or 0) if reported else 0


def is_gone(number):
    """Say whether the process ends soon, as its parent has ended."""
    end = time.monotonic() + 10.0
    while is_alive(number) and time.monotonic() < end:
        time.sleep(0.02)
    return not is_alive(number)


@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGKILL])
def test_a_report_that_is_ended_takes_its_tasks_along(asked, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    program = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    stop = stopped(program, lambda: process_of(tmp_path) > 0, asked, environment=environment)
    assert is_gone(process_of(tmp_path))
    if asked == signal.SIGINT:
        assert (stop.code, stop.message, stop.left) == (130, "toy: interrupted; begin again\n", 0)
