"""Limits follow measured values and their noise; the file of the gates is written without other changes."""

import json

import pytest

from validation.command import main
from validation.runs import limits
from validation.runs.limits import MARGIN, find_moves, limit_of, move_limits, moved_gate, write_gates
from validation.runs.results import GATES_FILE, Gate, read_gates

ERROR = Gate("a/b/error", 1.05, True, "{measured} px", 1.0, 0.01, fixed=False, references={"COLMAP": 3.0})
SHARE = Gate("a/b/share", 87.5, False, "%", 90.0, 0.5, fixed=False)
RANK = Gate("a/b/rank", 1e-6, True, "rank 2", 1e-12, 0.0)
GATES = {gate.key: gate for gate in (ERROR, SHARE, RANK)}


def a_run(error=1.0, share=90.0, colmap=3.0):
    values = {ERROR.key: error, SHARE.key: share, RANK.key: 2e-12}
    return {"rows": [{"key": k, "value": v, "reference": {"COLMAP": colmap}} for k, v in values.items()]}


@pytest.mark.parametrize("values", [[1.009], [1.005, 0.996], [1.0, 1.001, 1.002]])
def test_a_value_within_its_noise_moves_nothing(values):
    assert moved_gate(ERROR, values, {}) == ERROR


def test_limits_stand_five_noise_units_from_the_mean_and_fixed_ones_stay():
    moved = moved_gate(ERROR, [2.0, 2.1, 2.2], {"COLMAP": 4.0})
    assert (moved.measured, moved.noise, moved.limit) == (2.1, 0.1, 2.6)
    assert moved.references == {"COLMAP": 4.0}
    one = moved_gate(SHARE, [80.0], {})
    assert (one.measured, one.noise, one.limit) == (80.0, 0.5, 80.0 - MARGIN * 0.5)
    sharp = moved_gate(RANK, [2e-12], {})
    assert (sharp.measured, sharp.limit) == (2e-12, 1e-6)


def test_five_runs_show_less_noise_and_fewer_do_not():
    steady = [1.0, 1.001, 0.999, 1.0005, 1.0002]
    assert moved_gate(ERROR, steady[:4], {}) == ERROR
    assert moved_gate(ERROR, steady, {}).limit == pytest.approx(1.0 + MARGIN * 0.001, abs=2e-3)


def test_a_number_much_better_than_measured_has_moved():
    verdicts = {value: ERROR.verdict(value) for value in (1.06, 1.04, 0.96, 0.94, None, float("nan"))}
    assert list(verdicts.values()) == ["missed", "reached", "reached", "moved", "missed", "missed"]
    assert [SHARE.verdict(value) for value in (87.0, 92.0, 93.0)] == ["missed", "reached", "moved"]
    assert RANK.verdict(0.0) == "reached"


def test_only_moved_gates_are_written_in_the_same_order(tmp_path, capsys):
    path, runs = tmp_path / "gates.toml", [a_run(error=2.0, colmap=4.0)]
    write_gates(GATES, path)
    assert read_gates(path) == GATES
    moves = move_limits(runs, write=False, path=path)
    assert [m.after.key for m in moves] == [ERROR.key, RANK.key]
    assert [m.loosened for m in moves] == [True, False]
    assert read_gates(path) == GATES
    move_limits(runs, write=True, path=path)
    new = read_gates(path)
    assert list(new) == list(GATES)
    assert new[SHARE.key] == SHARE
    assert new[ERROR.key].reason == "2 px"
    assert "1 -> 2" in capsys.readouterr().out
    before = path.read_bytes()
    assert find_moves(runs, new) == []
    move_limits(runs, write=True, path=path)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("at_most = 1.0\nreason = 'x'", "measured and noise, or a fixed limit"),
        ("at_most = 1.0\nmeasured = 1.0\nreason = 'x'", "measured and noise"),
        ("at_most = 1.0\nfixed = true\nreason = '{OpenCV}'", "'OpenCV', which the gate does not have"),
    ],
)
def test_an_entry_without_its_values_is_refused(entry, words, tmp_path):
    path = tmp_path / "gates.toml"
    path.write_text(f'["a/b/c"]\n{entry}\n')
    with pytest.raises(ValueError, match=words):
        read_gates(path)


def test_the_shipped_file_is_as_the_command_writes_it(tmp_path):
    gates = read_gates()
    write_gates(gates, tmp_path / "gates.toml")
    assert (tmp_path / "gates.toml").read_bytes() == GATES_FILE.read_bytes()
    wrong = [g.key for g in gates.values() if not g.fixed and g.limit != limit_of(g)]
    assert not wrong, "limits are written by the command"


def test_the_command_reads_earlier_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(limits.move_limits.__kwdefaults__, "path", tmp_path / "gates.toml")
    write_gates(GATES, tmp_path / "gates.toml")
    assert main(["limits", str(tmp_path)]) == 2
    assert "holds no results" in capsys.readouterr().err
    (tmp_path / "results.json").write_text(json.dumps(a_run(share=80.0)))
    assert main(["limits", str(tmp_path), "--write"]) == 0
    assert read_gates(tmp_path / "gates.toml")[SHARE.key].measured == 80.0
