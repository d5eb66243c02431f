"""The fuzzing of COLMAP's binary files: its good inputs are good, and what the reader does wrong is found."""

from thesisrecon.io.colmap_files import read_colmap_model
from thesisrecon.io.colmap_model import MODEL_NUMBERS, inconsistency
from validation.studies import fuzz_colmap


def test_good_inputs_are_models(tmp_path):
    inputs = fuzz_colmap.corpus()
    assert len(inputs) == len(MODEL_NUMBERS) + 6
    assert max(map(len, inputs)) <= fuzz_colmap.LARGEST_INPUT
    for data in inputs:
        fuzz_colmap.read_input(data)
        first, second = fuzz_colmap.LENGTHS.unpack_from(data)
        rest = data[fuzz_colmap.LENGTHS.size :]
        for name, part in (
            ("cameras", rest[:first]),
            ("images", rest[first : first + second]),
            ("points3D", rest[first + second :]),
        ):
            (tmp_path / f"{name}.bin").write_bytes(part)
        assert inconsistency(read_colmap_model(tmp_path)) == ""


def test_nothing_is_found_and_a_fault_is(monkeypatch, capsys):
    assert fuzz_colmap.main(["--plain", "--seconds", "1"]) == 0
    assert "nothing found" in capsys.readouterr().out

    def careless(data, _):
        return data[100_000]

    monkeypatch.setattr(fuzz_colmap, "read_cameras", careless)
    assert fuzz_colmap.main(["--plain", "--seconds", "1"]) == 1
    assert "IndexError" in capsys.readouterr().out
