"""Small faults of the library are found and listed; the long mutation run is started by hand."""

import ast
from pathlib import Path

from validation import mutants
from validation.mutants import Bench, Mutant, Verdict, imports_of, mutants_of, table
from validation.scenes.real import ROOT

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


def faults(root):
    """The lines that the faults of a small module change, as they become."""
    folder = root / "thesisrecon" / "geometry"
    folder.mkdir(parents=True)
    (folder / "small.py").write_text(SOURCE, encoding="utf-8")
    found = []
    sound = ast.unparse(ast.parse(SOURCE)).splitlines()
    for mutant in mutants_of(root, "geometry"):
        lines = mutant.apply(SOURCE).splitlines()
        (changed,) = [line for line, before in zip(lines, sound, strict=True) if line != before]
        found.append(changed.strip())
    return found


def test_one_thing_changes_in_functions_and_nothing_in_settings_or_words(tmp_path):
    assert sorted(faults(tmp_path)) == sorted(
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


def test_the_table_has_the_score_of_each_package_and_every_fault():
    fault = Mutant("thesisrecon/geometry/a.py", 3, "a | b", "a & b", 0)
    verdicts = [Verdict(fault, "tests/geometry/test_a.py::test", 1.0), Verdict(fault, "", 2.0)]
    text = table(verdicts)
    assert "| geometry | 2 | 1 | 50 % |" in text
    assert "| thesisrecon/geometry/a.py | 3 | `a \\| b` | `a & b` | **not caught** |" in text


def test_surviving_faults_are_tested_again_and_the_rest_is_kept(monkeypatch, tmp_path, capsys):
    judged = []

    def judge_all(bench, chosen, *, warm):
        del bench, warm
        judged.append(len(chosen))
        for number, mutant in enumerate(chosen):
            yield Verdict(mutant, "a test" if number or len(judged) > 1 else "", 1.0)

    monkeypatch.setattr(mutants, "judge_all", judge_all)
    options = ["-o", str(tmp_path), "--packages", "geometry", "--sample", "4", "--warm"]
    assert mutants.main(options) == 1
    assert "4 faults, 75 % caught" in capsys.readouterr().out
    assert mutants.main([*options, "--again"]) == 0
    assert judged == [4, 1]
    assert "4 faults, 100 % caught" in capsys.readouterr().out
    assert len(mutants.read_verdicts(tmp_path / "mutants.json")) == 4
