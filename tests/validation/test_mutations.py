"""The list of planted faults, and the bench that plants them; the faults themselves take their time."""

import re

import pytest

from validation.harness.gates import Gate
from validation.harness.results import Results, Row
from validation.harness.stages import STAGES
from validation.mutations import Bench, Checked, Fate, Mutation, main, read_mutations, table, write_fates
from validation.scenes.real import ROOT

MUTATIONS = read_mutations()
LEAST = 25
FOLDERS = {
    "stereo",
    "epipolar",
    "features",
    "geometry",
    "io",
    "matching",
    "metric",
    "numerics",
    "projective",
    "selfcalibration",
    "views",
}
"""Parts of the library that have faults of their own."""


def test_every_fault_can_be_planted_and_is_python():
    problems = []
    for mutation in MUTATIONS:
        try:
            compile(mutation.apply(ROOT), mutation.file, "exec")
        except (OSError, ValueError, SyntaxError) as error:
            problems.append(f"{mutation.name}: {error}")
        if not set(mutation.stages) <= set(STAGES):
            problems.append(f"{mutation.name}: unknown stage in {mutation.stages}")
    assert problems == []


def test_the_faults_are_many_and_everywhere():
    assert len(MUTATIONS) >= LEAST
    assert {m.file.split("/")[1] for m in MUTATIONS} >= FOLDERS
    assert {stage for m in MUTATIONS for stage in m.stages} >= {
        "features", "fundamental", "triangulation", "cameras", "bundle", "disparity", "between",
    }  # fmt: skip


def test_the_guide_names_the_file_of_every_fault():
    guide = (ROOT / "docs" / "development" / "gates.md").read_text(encoding="utf-8")
    listed = guide.split("<!-- mutations: begin -->")[1].split("<!-- mutations: end -->")[0]
    rows = [line.split(" | ")[:2] for line in listed.strip().splitlines()[2:]]
    named = {name.removeprefix("| "): f"thesisrecon/{file.strip('`')}" for name, file in rows}
    assert named == {mutation.name: mutation.file for mutation in MUTATIONS}


WRONG = {
    'file = "a.py"\nold = "a"\nnew = "b"\ncheck = ["bundle/street"]': "a mutation has",
    'name = "n"\nfile = "a.py"\nold = "a"\nnew = "a"\ncheck = ["bundle/street"]': "old differs from new",
    'name = "n"\nfile = "a.py"\nold = "a"\nnew = "b"\ncheck = ["a/moon"]': "no gate is called a/moon",
}


@pytest.mark.parametrize("entry", WRONG)
def test_a_wrong_entry_is_refused_in_a_sentence(entry, tmp_path):
    listed = tmp_path / "list.toml"
    listed.write_text(f"[[mutation]]\n{entry}\n", encoding="utf-8")
    with pytest.raises(ValueError, match=re.escape(WRONG[entry])):
        read_mutations(listed)


def test_a_name_twice_is_refused(tmp_path):
    entry = '[[mutation]]\nname = "n"\nfile = "a.py"\nold = "a"\nnew = "b"\ncheck = ["bundle/street"]\n'
    (tmp_path / "list.toml").write_text(2 * entry, encoding="utf-8")
    with pytest.raises(ValueError, match="two mutations are called"):
        read_mutations(tmp_path / "list.toml")


@pytest.mark.parametrize("text", ["", "a = 1\n", "x = 1\nx = 1\n"])
def test_an_old_text_that_does_not_stand_there_once_is_refused(text, tmp_path):
    if text:
        (tmp_path / "a.py").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"must occur in a\.py once, it occurs [02] times"):
        Mutation("n", "a.py", "x = 1", "x = 2", ("bundle/street",)).apply(tmp_path)


def test_a_fault_is_there_for_a_while(tmp_path):
    bench = Bench(tmp_path)
    bench.tree.mkdir()
    path = bench.tree / "small.py"
    path.write_text("VALUE = 1\n", encoding="utf-8")
    before = path.stat().st_mtime
    fault = Mutation("n", "small.py", "VALUE = 1", "VALUE = 2", ("bundle/street",))
    with bench.planted(fault.file, fault.apply(bench.tree)):
        assert path.read_text(encoding="utf-8") == "VALUE = 2\n"
    assert (path.read_text(encoding="utf-8"), path.stat().st_mtime) == ("VALUE = 1\n", before)


def test_gates_are_broken_by_numbers_beyond_them_and_by_none():
    gates = {
        key: Gate(key, 1.0, True, "a reason") for key in ("a/s/far", "a/s/near", "a/s/untold", "b/s/other")
    }
    rows = [
        Row(f"a/s/{name}", value, "px", "at most", None, {}, "", "reported")
        for name, value in {"far": 2.0, "near": 0.5}.items()
    ]
    found = Checked(Results(rows, [], {}, {}, {}), ("a/s",), 1.0)
    assert found.broken(gates) == ("a/s/far", "a/s/untold")


def test_the_table_lists_caught_and_surviving_faults(tmp_path):
    fates = [
        Fate("one", "a.py", ("a/s/far", "a/s/untold"), 1.2),
        Fate("two", "b.py", (), 3.0),
        Fate("three", "c.py", (), 0.0, skipped="Mars is not on this machine"),
        Fate("four", "d.py", ("a/s/untold",), 1.0, ("no photograph fits",)),
    ]
    assert [fate.survived for fate in fates] == [False, True, False, False]
    lines = table(fates).splitlines()
    assert lines[2] == "| one | a.py | a/s/far, a/s/untold | 1 |"
    assert "**nothing**" in lines[3]
    assert "not planted: Mars" in lines[4]
    assert "a/s/untold (ended: no photograph fits)" in lines[5]
    write_fates(tmp_path, fates)
    assert (tmp_path / "mutations.md").read_text(encoding="utf-8") == "\n".join(lines) + "\n"


def test_an_unknown_name_ends_the_command_in_a_sentence(capsys):
    assert main(["--only", "no such fault"]) == 2
    assert 'no mutation is called "no such fault"' in capsys.readouterr().err
