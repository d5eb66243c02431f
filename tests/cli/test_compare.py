"""``thesisrecon compare``: what it prints, its JSON and its page."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.io.test_colmap import export, scene
from thesisrecon import compare_models
from thesisrecon.cli.main import run_command
from thesisrecon.errors import STRICT_VARIABLE

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "cameras.json"
NAMES = ["a <b>.jpg", "böld.jpg", "c.jpg", "d.jpg", "e.jpg"]


@pytest.fixture
def models(tmp_path):
    """Two COLMAP models; camera and points of the second are slightly other ones."""
    ours = scene()
    export(tmp_path / "a", ours, names=NAMES)
    P = ours.P + np.where(ours.registered[:, None, None], [[0, 0, 0, 0.5], [0, 0, 0, 0.1], [0, 0, 0, 0]], 0.0)
    export(tmp_path / "b", replace(ours, P=P * np.linspace(1, 1.01, len(P))[:, None, None]), names=NAMES)
    return tmp_path / "a", tmp_path / "b"


def test_the_table_the_json_and_the_page_say_the_same(models, tmp_path, capsys):
    found = compare_models(*models)
    options = ["--json", str(tmp_path / "out.json"), "--page", str(tmp_path / "out.html")]
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
    page = (tmp_path / "out.html").read_text(encoding="utf-8")
    assert "a &lt;b&gt;.jpg" in page
    assert "<b>.jpg" not in page
    assert len(page) < 2_500_000


def test_a_page_that_cannot_be_written_costs_a_warning(models, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv(STRICT_VARIABLE)
    place = tmp_path / "file" / "out.html"
    place.parent.touch()
    options = ["--json", str(tmp_path / "out.json"), "--page", str(place)]
    assert run_command(["compare", *map(str, models), *options]) == 0
    said = capsys.readouterr().out
    assert said.count("warning: ") == said.count(f"warning: output-not-made: {place} (") == 1
    assert len(json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))["cameras"]) > 0
    options[1] = str(place)
    assert run_command(["compare", *map(str, models), *options[:2]]) == 2


def test_models_that_cannot_be_aligned_have_no_figure(tmp_path, capsys):
    cameras = json.loads(COURTYARD.read_text(encoding="utf-8"))["cameras"]
    (tmp_path / "two.json").write_text(json.dumps({"cameras": cameras[:2]}), encoding="utf-8")
    command = ["compare", str(tmp_path / "two.json"), str(COURTYARD), "--page", str(tmp_path / "out.html")]
    assert run_command(command) == 0
    printed = capsys.readouterr().out
    assert "2 common cameras, 12 only in B" in printed
    assert "note: 2 common cameras cannot be aligned" in printed
    page = (tmp_path / "out.html").read_text(encoding="utf-8")
    assert "2 common cameras cannot be aligned" in page
    assert len(page) < 50_000


@pytest.mark.parametrize(
    ("a", "words"), [("nowhere", "there is no nowhere; give the folder of a run"), (".", "holds no model")]
)
def test_what_is_no_model_is_refused_in_one_sentence(a, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(["compare", a, str(COURTYARD)]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
