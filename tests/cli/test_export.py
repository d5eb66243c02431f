"""The command ``export`` on a COLMAP model: metres, residuals, and one sentence for wrong input."""

import numpy as np
import pytest

from tests.api.test_alignment import make_model, true_positions
from thesisrecon import export
from thesisrecon.cli.main import run_command
from thesisrecon.io._models import read_model


@pytest.fixture
def colmap(tmp_path):
    export(make_model(6), tmp_path / "model", to="colmap")
    return tmp_path / "model"


def write_positions(path, *, header):
    rows = [f"{name}, {x}, {y}, {z}" for name, (x, y, z) in true_positions(make_model(6)).items()]
    path.write_text(
        "\n".join([*(["image,x,y,z"] if header else []), "# metres", "", *rows, "other.jpg,0,0,0"])
    )
    return path


@pytest.mark.parametrize("header", [False, True])
def test_positions_put_a_model_in_their_frame(colmap, tmp_path, capsys, header):
    positions = write_positions(tmp_path / "positions.csv", header=header)
    out = tmp_path / "out"
    arguments = ["export", str(colmap), "--to", "colmap", "-o", str(out), "--align", str(positions)]
    assert run_command(arguments) == 0
    printed = capsys.readouterr().out
    assert "6 of 6 positions used" in printed
    assert "1 position without an image, such as other.jpg" in printed
    assert printed.splitlines()[-1] == f"6 images and 20 points: {out / 'sparse' / '0'}"
    for view in read_model(out).views:
        np.testing.assert_allclose(view.centre, true_positions(make_model(6))[view.name], atol=1e-6)


def test_a_known_distance_scales_a_model(colmap, tmp_path):
    out = tmp_path / "out"
    arguments = ["--to", "colmap", "-o", str(out), "--scale", "0.jpg", "5.jpg", "3.25"]
    assert run_command(["export", str(colmap), *arguments]) == 0
    views = read_model(out).views
    assert np.linalg.norm(views[0].centre - views[5].centre) == pytest.approx(3.25)


def test_wrong_input_is_refused_in_one_sentence(colmap, tmp_path, refused):
    positions = tmp_path / "positions.csv"
    start = ["export", str(colmap), "-o", str(tmp_path / "out"), "--to"]
    positions.write_text("name,x,y,z\n0.jpg,1,2,3\n1.jpg,1,2\n")
    assert "line 3 of" in refused([*start, "colmap", "--align", str(positions)])
    positions.write_text("0.jpg,1,2,3\n0.jpg,1,2,4\n")
    assert "one line per image" in refused([*start, "colmap", "--align", str(positions)])
    positions.write_text("0.jpg,1,x,3\n")
    assert "line 1 of" in refused([*start, "colmap", "--align", str(positions)])
    both = ["--align", str(positions), "--scale", "0.jpg", "1.jpg", "2"]
    assert "exclude each other" in refused([*start, "colmap", *both])
    assert "give it with --images" in refused([*start, "nerfstudio"])
    assert "unknown export format" in refused([*start, "obj"])
    assert "holds the model" in refused(["export", str(colmap), "-o", str(colmap), "--to", "colmap"])
    assert not (tmp_path / "out").exists()
