"""Small faults of the library are found and listed; the long mutation run is started by hand."""

import ast
from pathlib import Path

import pytest

from validation import mutants
from validation.mutants import Bench, Verdict, imports_of, mutants_of, read_faults
from validation.runs.results import read_gates
from validation.scenes.real import ROOT

LIST = ROOT / "validation" / "faults.toml"

SOURCE = '''
LIMIT = 3.0


def distance(a: float, b: float = 2.0, *, whole: bool = True) -> float:
    """A docstring with a + b."""
    if len([a]) < 2 and not whole:
        raise ValueError("1 + 1")
    a += b  # über a + b
    return (a) - (
        -b
    )
'''


def test_one_thing_changes_in_functions_and_nothing_in_settings_or_words(tmp_path):
    folder = tmp_path / "thesisrecon" / "geometry"
    folder.mkdir(parents=True)
    (folder / "small.py").write_text(SOURCE, encoding="utf-8")
    found, sound = [], ast.unparse(ast.parse(SOURCE)).splitlines()
    for mutant in mutants_of(tmp_path, "geometry"):
        lines = mutant.apply(SOURCE).splitlines()
        (changed,) = [line for line, before in zip(lines, sound, strict=True) if line != before]
        found.append(changed.strip())
    assert sorted(found) == sorted(
        [
            "if not (len([a]) < 2 and (not whole)):",
            "if len([a]) >= 2 and (not whole):",
            "if len([a]) <= 2 and (not whole):",
            "if len([a]) < 3 and (not whole):",
            "if len([a]) < 2 or not whole:",
            "if len([a]) < 2 and whole:",
            "a -= b",
            "pass",
            "return a + -b",
            "return a - b",
        ]
    )


def test_tests_of_the_module_come_first_and_then_those_of_its_users(monkeypatch):
    monkeypatch.setattr(Bench, "tree", ROOT)
    own, others = Bench(Path("nowhere")).judges("thesisrecon/geometry/three_view.py")
    assert "thesisrecon.geometry.three_view" in imports_of(ROOT / own[0])
    assert all(file.startswith("tests/geometry/") for file in own)
    assert others
    assert not any(file.startswith(("tests/geometry/", "tests/validation/")) for file in others)
    # Through a public function.
    assert (
        "tests/api/test_relative_pose.py"
        in Bench(Path("nowhere")).judges("thesisrecon/epipolar/essential.py")[1]
    )


def test_surviving_faults_are_tested_again_and_the_rest_is_kept(monkeypatch, tmp_path, capsys):
    judged = []

    def judge_all(_, chosen):
        judged.append(len(chosen))
        for number, mutant in enumerate(chosen):
            yield Verdict(mutant, "a test" if number or len(judged) > 1 else "", 1.0)

    monkeypatch.setattr(mutants, "judge_all", judge_all)
    options = ["-o", str(tmp_path), "--packages", "geometry", "--sample", "4"]
    assert mutants.main(options) == 1
    assert "4 faults, 75 % caught" in capsys.readouterr().out
    assert mutants.main([*options, "--again"]) == 0
    assert judged == [4, 1]
    assert "4 faults, 100 % caught" in capsys.readouterr().out
    assert len(mutants.read_verdicts(tmp_path / "mutants.json")) == 4


def test_every_listed_fault_changes_code_and_names_tests_or_gates_that_exist():
    gates = {key.rpartition("/")[0] for key in read_gates()}
    for fault in read_faults(LIST):
        sound = (ROOT / fault.file).read_text(encoding="utf-8")
        assert ast.dump(ast.parse(fault.apply(sound))) != ast.dump(ast.parse(sound)), fault.name
        assert fault.old in "\n".join(sound.splitlines()[fault.line - 1 :]), fault.name
        assert fault.judges
        assert all((ROOT / judge).is_file() or judge in gates for judge in fault.judges), fault.name
    with pytest.raises(ValueError, match="has no fault called 'none'"):
        read_faults(LIST, ["none"])


def test_tests_judge_a_listed_fault_before_gates(monkeypatch, tmp_path, capsys):
    judged = []

    def run_tests(_, files, name, **__):
        judged.append((name, files))
        return (0, 1.0, "") if name == "sound" or files[0].endswith(".py") else (1, 1.0, "depth/courtyard/x")

    monkeypatch.setattr(Bench, "run_tests", run_tests)
    monkeypatch.setattr(Bench, "set_up", lambda _: None)
    monkeypatch.setattr(Bench, "tree", ROOT)
    monkeypatch.setattr(Bench, "planted", lambda *_: pytest.MonkeyPatch.context())
    options = ["-o", str(tmp_path), "--list", str(LIST), "--names", "depth-maps-too-deep"]
    assert mutants.main(options) == 0
    tests, gates = ["tests/stereo/test_depth.py"], ["depth/courtyard"]
    sound = [("sound", tests), ("sound", gates)]
    assert judged == [*sound, ("depth-maps-too-deep", tests), ("depth-maps-too-deep", gates)]
    assert "depth/courtyard/x" in capsys.readouterr().out
    (verdict,) = mutants.read_verdicts(tmp_path / "mutants.json")
    assert verdict.mutant == read_faults(LIST, ["depth-maps-too-deep"])[0]
    judged.clear()
    assert mutants.main([*options, "--gates"]) == 0
    assert judged == [("sound", gates), ("depth-maps-too-deep", gates)]
