"""Reports of toy stages: tasks in processes, references that fail, gates, tables, pages, two runs."""

import csv
import dataclasses
import json
import re

import pytest

from tests.conftest import before_each_output, failing
from tests.validation.runs.toy_stages import STAGES, WAYS
from thesisrecon.errors import STRICT_VARIABLE
from validation.command import main
from validation.runs.page import write_pages
from validation.runs.records import ReportOptions
from validation.runs.report import run_tasks
from validation.runs.results import Gate, collect, read_gates, read_results, write_results
from validation.runs.scenes import QUICK
from validation.stages import STAGES as REPORTED

LIMIT_S = 8.0
GATES = {
    "toy/yard/wheels-lost": Gate("toy/yard/wheels-lost", 1.0, True, "a toy needs wheels"),
    "toy/yard/never-reported": Gate("toy/yard/never-reported", 1.0, True, "no stage reports this"),
    "other/yard/wheels": Gate("other/yard/wheels", 1.0, True, "of a stage that did not run"),
}


def toy_options(out, *, quick):
    return ReportOptions(
        out,
        ("yard", "elsewhere"),
        ("toy",),
        quick=quick,
        limit_s=LIMIT_S,
        stages_from="tests.validation.runs.toy_stages",
    )


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    options, reported = toy_options(tmp_path_factory.mktemp("harness"), quick=False), list[str]()
    return options, run_tasks(options, STAGES, reported.append), reported


def test_a_reference_that_fails_leaves_a_row_and_nothing_else(ran):
    _, judged, reported = ran
    assert list(judged) == [("toy", "yard")]
    judgement, outcomes = judged["toy", "yard"]
    assert tuple(outcomes) == ("after", *WAYS)
    assert {name for name, o in outcomes.items() if o.ok} == {"ours", "good", "after"}
    assert outcomes["missing"].failure == "No module named 'no_such_library'"
    assert outcomes["failing"].failure == "the toy is broken; it has 1 wheel; buy another."
    assert outcomes["crashing"].failure == "crashed with signal 11"
    assert outcomes["hanging"].failure == "exceeded the time limit of 8 s"
    assert outcomes["hanging"].wall_s < 3 * LIMIT_S
    values = judgement.metrics[0].values
    assert (values["ours"], values["good"], values["after"]) == (0.5, 2.0, 8.0)
    assert values["crashing"] is None
    assert len(reported) == 8


def test_gates_check_numbers_and_a_missing_number_breaks_its_gate(ran):
    options, judged, _ = ran
    results = collect(options, judged, GATES)
    row = results.rows[0]
    assert (row.key, row.value, row.limit, row.direction, row.verdict) == (
        "toy/yard/wheels-lost",
        0.5,
        1.0,
        "at most",
        "reached",
    )
    assert row.reference["good"] == 2.0
    assert results.missing == ["toy/yard/never-reported"]
    assert set(results.failures) == {f"toy/yard/{n}" for n in ("missing", "failing", "crashing", "hanging")}
    strict = {row.key: dataclasses.replace(GATES[row.key], limit=0.4)}
    assert collect(options, judged, strict).broken[0].key == row.key


@pytest.mark.parametrize("name", REPORTED)
def test_a_quick_report_includes_all_gated_numbers(name, tmp_path):
    quick = ReportOptions(tmp_path, ("courtyard",), (name,), quick=True)
    asked = dataclasses.replace(quick, gates_only=True)
    stage = REPORTED[name]
    scenes = [s for s in QUICK if stage.takes(s, quick)]
    for scene in scenes:
        keys = [key for key in read_gates() if key.startswith(f"{name}/{scene}/")]
        if keys:
            assert set(stage.methods(scene, asked)) <= set(stage.methods(scene, quick)), keys


@pytest.mark.parametrize(
    ("value", "held"), [(1.0, True), (1.01, False), (None, False), (float("nan"), False)]
)
def test_a_gate_holds_up_to_its_limit(value, held):
    assert Gate("a/b/c", 1.0, True, "").holds(value) == held
    mirrored = None if value is None else -value
    assert Gate("a/b/c", -1.0, False, "").holds(mirrored) == held


def test_results_are_written_and_read(ran, tmp_path):
    options, judged, _ = ran
    results = collect(options, judged, GATES)
    write_results(tmp_path, results)
    assert read_results(tmp_path).rows == results.rows
    with (tmp_path / "tables" / "toy.csv").open(encoding="utf-8") as source:
        first = next(csv.DictReader(source))
    assert (first["key"], first["ours"], first["good"], first["crashing"]) == (
        "toy/yard/wheels-lost",
        "0.5",
        "2.0",
        "",
    )


def test_the_pages_escape_their_input(ran):
    options, judged, _ = ran
    results = collect(options, judged, GATES)
    index = write_pages(options, STAGES, judged, results)
    whole, scene = (options.out / n for n in ("index.html", "scene-yard.html"))
    assert index == whole
    text = whole.read_text(encoding="utf-8")
    assert "A &lt;b&gt;toy&lt;/b&gt;" in text
    assert "1 of 2 limits are reached" in text
    assert "crashed with signal 11" in text
    page = scene.read_text(encoding="utf-8")
    assert "A &lt;/script&gt; note." in page
    assert "data:image/jpeg;base64," in page
    # Without plotly's own script.
    markup = "".join(html.split("<script>")[0] for html in (text, page))
    assert not re.search(r'(?:src|href)="(?!data:|#|scene-|index)', markup)


@pytest.mark.parametrize("error", [ValueError("no figure"), MemoryError(), OSError(28, "No space left")])
def test_a_page_of_a_scene_that_fails_is_listed_on_the_first_page(ran, tmp_path, monkeypatch, error):
    options, judged, _ = ran
    options = dataclasses.replace(options, out=tmp_path)
    monkeypatch.delenv(STRICT_VARIABLE)
    before_each_output(monkeypatch, failing("scene-yard.html", error))
    index = write_pages(options, STAGES, judged, collect(options, judged, GATES))
    assert "output-not-made: scene-yard.html" in index.read_text(encoding="utf-8")
    assert not (tmp_path / "scene-yard.html").exists()


def test_no_gate_without_its_reason(tmp_path):
    gates = read_gates()
    assert gates
    for words in ("at_most = 1.0", 'at_most = 1.0\nat_least = 0.0\nreason = "r"', 'reason = "r"'):
        (tmp_path / "gates.toml").write_text(f'["a/b/c"]\n{words}\n')
        with pytest.raises(ValueError, match="a gate has one of"):
            read_gates(tmp_path / "gates.toml")
    (tmp_path / "gates.toml").write_text('["a/c"]\nat_most = 1.0\nreason = "r"\n')
    with pytest.raises(ValueError, match="stage/scene/number"):
        read_gates(tmp_path / "gates.toml")


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
