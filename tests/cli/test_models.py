"""``thesisrecon compare`` and ``export`` on models: output, files, and one sentence for wrong input."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.api.test_alignment import make_model, true_positions
from tests.io.test_colmap import export as write_colmap
from tests.io.test_colmap import scene
from thesisrecon import compare_models, export
from thesisrecon.cli.commands import run_command
from thesisrecon.io._models import read_model

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "cameras.json"
NAMES = ["a <b>.jpg", "böld.jpg", "c.jpg", "d.jpg", "e.jpg"]


@pytest.fixture
def models(tmp_path):
    """Two COLMAP models; camera and points of the second are slightly other ones."""
    ours = scene()
    write_colmap(tmp_path / "a", ours, names=NAMES)
    P = ours.P + np.where(ours.registered[:, None, None], [[0, 0, 0, 0.5], [0, 0, 0, 0.1], [0, 0, 0, 0]], 0.0)
    P *= np.linspace(1, 1.01, len(P))[:, None, None]
    write_colmap(tmp_path / "b", replace(ours, P=P), names=NAMES)
    return tmp_path / "a", tmp_path / "b"


def test_the_table_and_the_json_say_the_same(models, tmp_path, capsys):
    found = compare_models(*models)
    options = ["--json", str(tmp_path / "out.json")]
    assert run_command(["compare", *map(str, models), *options]) == 0
    lines = capsys.readouterr().out.splitlines()
    statistics = found.summary["centre_error"]
    row = next(line for line in lines if line.startswith("centre"))
    assert row.split()[-4:] == [f"{value:.4g}" for value in statistics.values()]
    row = next(line for line in lines if line.startswith("a <b>.jpg"))
    assert row.split()[2] == f"{found.centre_error[0]:.4g}"
    row = next(line for line in lines if line.startswith("median distance (unit of B)"))
    assert row.split()[-2:] == [f"{found.points.a_to_b:.4g}", f"{found.points.b_to_a:.4g}"]
    written = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert written["cameras"][0]["centre_error"] == found.centre_error[0] > 0
    assert written["summary"]["centre_error"]["mean"] == pytest.approx(found.centre_error.mean())
    assert written["points"]["thresholds"] == found.points.thresholds.tolist()


def test_limits_have_an_exit_code_and_what_is_missing_is_beyond_any(models, capsys, tmp_path):
    found, command = compare_models(*models), ["compare", *map(str, models)]
    largest = {"centre": found.centre_error.max(), "rotation": found.rotation_error_deg.max()}
    largest["focal"] = 100.0 * np.abs(found.focal_error_rel).max()
    inside = [
        word for name, size in largest.items() for word in (f"--max-{name}-error", str(1.001 * size + 1e-9))
    ]
    assert run_command([*command, *inside]) == 0
    assert "limit:" not in capsys.readouterr().out
    assert run_command([*command, "--max-centre-error", str(0.9 * largest["centre"])]) == 4
    worst = found.names[int(found.centre_error.argmax())]
    assert f"limit: the centre error of {worst} is {largest['centre']:.4g}" in capsys.readouterr().out
    cameras = json.loads(COURTYARD.read_text(encoding="utf-8"))["cameras"]
    (tmp_path / "two.json").write_text(json.dumps({"cameras": cameras[:2]}), encoding="utf-8")
    assert (
        run_command(["compare", str(tmp_path / "two.json"), str(COURTYARD), "--max-centre-error", "1e9"]) == 4
    )
    printed = capsys.readouterr().out
    assert "is inf, the limit is 1e+09" in printed
    assert "limit: 12 cameras of B missing in A" in printed


def test_models_that_cannot_be_aligned_are_compared_by_their_rotations(tmp_path, capsys):
    cameras = json.loads(COURTYARD.read_text(encoding="utf-8"))["cameras"]
    (tmp_path / "two.json").write_text(json.dumps({"cameras": cameras[:2]}), encoding="utf-8")
    command = ["compare", str(tmp_path / "two.json"), str(COURTYARD)]
    assert run_command(command) == 0
    printed = capsys.readouterr().out
    assert "2 common cameras, 12 only in B" in printed
    assert "note: 2 common cameras cannot be aligned" in printed


@pytest.mark.parametrize(
    ("a", "words"), [("nowhere", "there is no nowhere; give the folder of a run"), (".", "holds no model")]
)
def test_what_is_no_model_is_refused_in_one_sentence(a, words, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    assert words in refused(["compare", a, COURTYARD])


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


WRONG = [
    ("name,x,y,z\n0.jpg,1,2,3\n1.jpg,1,2\n", "--to colmap --align P", "line 3 of"),
    ("0.jpg,1,2,3\n0.jpg,1,2,4\n", "--to colmap --align P", "one line per image"),
    ("0.jpg,1,x,3\n", "--to colmap --align P", "line 1 of"),
    ("0.jpg,1,x,3\n", "--to colmap --align P --scale 0.jpg 1.jpg 2", "exclude each other"),
    ("", "--to nerfstudio", "give it with --images"), ("", "--to obj", "unknown export format"),
    ("", "--to colmap -o MODEL", "holds the model"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "options", "words"), WRONG)
def test_wrong_input_of_an_export_is_refused_in_one_sentence(text, options, words, colmap, tmp_path, refused):
    (tmp_path / "positions.csv").write_text(text)
    places = {"P": tmp_path / "positions.csv", "MODEL": colmap}
    given = [places.get(word, word) for word in options.split()]
    assert words in refused(["export", colmap, "-o", tmp_path / "out", *given])
    assert not (tmp_path / "out").exists()
