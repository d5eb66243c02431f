"""The comparison with COLMAP: rows and verdicts, runs in processes, models of pycolmap."""

import json
import sys

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pycolmap")

from tests.validation.test_metrics import N, V, _reconstruction, _truth
from thesisrecon.io._colmap import write_colmap_model
from validation.metrics.cameras import TrueCameras, measure_cameras
from validation.references.colmap import read_run, reconstruct_with_pycolmap
from validation.runs.results import read_gates
from validation.runs.study import run_study
from validation.runs.tables import markdown_table
from validation.scenes.real import Scene, load_fixture_scene
from validation.studies import against_colmap
from validation.studies.against_colmap import COLMAP, OURS, Outcome, check_reconstruction


def _fake_scene(folder):
    images = folder / "images"
    images.mkdir()
    paths = tuple(images / f"{i}.jpg" for i in range(V))
    for path in paths:
        path.touch()
    truth = _truth()
    return Scene("fountain-P11", paths, truth.K, truth.R, truth.C)


def _save_run(out, scene):
    write_colmap_model(
        out / "sparse" / "0",
        _reconstruction(_truth()),
        [path.name for path in scene.image_paths],
        colors=np.zeros((N, 3), np.uint8),
        groups=np.zeros(V, dtype=np.int64),
        scales=np.ones(V),
        original_sizes=np.full((V, 2), 640),
    )
    (out / "summary.json").write_text(json.dumps({"reprojection_rms_px": 0.0, "seconds": {"features": 1.5}}))
    (out / "seconds.json").write_text(json.dumps({"extract": 3.0, "match": 1.0, "map": 2.0}))


def test_the_table_is_made_from_saved_results(tmp_path, monkeypatch, capsys):
    scene, saved = _fake_scene(tmp_path), tmp_path / "saved"
    _save_run(saved, scene)
    copy = "import shutil, sys; shutil.copytree(sys.argv[1], sys.argv[2])"

    def pretend(method, _images, out, _threads):
        source = saved if method in (OURS, COLMAP) else tmp_path / "nothing"
        return [sys.executable, "-c", copy, str(source), str(out)]

    monkeypatch.setattr(against_colmap, "_command", pretend)
    monkeypatch.setattr(against_colmap, "scenes_here", lambda _names: [scene])
    assert run_study("against-colmap", ["-o", str(tmp_path / "out"), "--scenes", "fountain-P11"]) == 1

    rows = {row["name"]: row for row in json.loads((tmp_path / "out" / "against-colmap.json").read_text())}
    assert rows["focal error"]["verdict"] == "reached"
    assert rows["wall time"]["values"][COLMAP] == 6.0
    text = (tmp_path / "out" / "against-colmap.md").read_text()
    assert f"- {OURS}: features 1.50 s" in text
    assert text.count(" failed: ") == 2
    assert "## fountain-P11" in text
    made_with, tables = text.split("\n\n", 1)
    assert made_with.startswith("Commit ")
    assert tables in capsys.readouterr().out


def test_models_of_pycolmap_are_returned_in_our_types(tmp_path):
    scene = load_fixture_scene()
    images = tmp_path / "images"
    images.mkdir()
    views = slice(4, 9)
    for path in scene.image_paths[views]:
        with Image.open(path) as whole:
            small = whole.resize((whole.width // 2, whole.height // 2))
        exif = Image.Exif()
        exif[0x8769] = {0x920A: 5.0, 0xA405: 300}
        small.save(images / path.name, quality=95, exif=exif)
    reconstruct_with_pycolmap(images, tmp_path / "out")
    run = read_run(images, tmp_path / "out")
    assert run.names == tuple(path.name for path in scene.image_paths[views])
    assert run.reconstruction.registered.sum() == 5
    assert set(run.seconds) == {"extract", "match", "map"}
    K = np.diag([0.5, 0.5, 1.0]) @ scene.K[views]
    errors = measure_cameras(run.reconstruction, TrueCameras(K, scene.R[views], scene.C[views]))
    # A focal length of 300 mm in EXIF would have been believed and barely refined.
    assert errors.focal_error_pct < 5
    assert errors.rotation_error_deg < 1
    again = read_run(images, tmp_path / "out")
    np.testing.assert_array_equal(again.reconstruction.P, run.reconstruction.P)


def _rows(scene, outcomes, *, n_views=V):
    return {row.name: row for row in check_reconstruction(scene, n_views, _truth(), outcomes)}


def test_rows_hold_both_methods_and_judge_ours():
    model = _reconstruction(_truth())
    ours, colmap = Outcome(model, 9.0, 500.0, 12.0, claimed_rms_px=1.0), Outcome(model, 10.0, 300.0, 15.0)
    rows = _rows("fountain-P11", {OURS: ours, COLMAP: colmap})
    assert rows["wall time"].target == 10.0
    # The residuals here are zero, so a claim of one pixel is far off.
    verdicts = {f"cameras registered of {V}": "reached", "focal error": "reached", "wall time": "reached"}
    verdicts |= {"rms it claims off by": "missed", "points": "reported"}
    assert {name: rows[name].verdict for name in verdicts} == verdicts


def test_a_failure_misses_its_targets_and_breaks_nothing():
    failed = Outcome(None, 3.0, 100.0, 5.0, failure="no pair was found")
    rows = _rows(
        "fountain-P11", {OURS: failed, COLMAP: Outcome(_reconstruction(_truth()), 10.0, 300.0, 15.0)}
    )
    assert rows["focal error"].verdict == "missed"
    assert rows["focal error"].values[OURS] is None
    assert rows[f"cameras registered of {V}"].values[OURS] == 0
    assert "| focal error, % | - |" in markdown_table(list(rows.values()))


def test_the_bounds_are_the_gates_of_the_report_whatever_reasons_are_given():
    reasons = {f"{n}.jpg": "too few points in common" for n in range(11 - V)}
    ours = Outcome(_reconstruction(_truth()), 3.0, 100.0, 5.0, reasons=reasons)
    rows = {row.name: row for row in check_reconstruction("kermit", 11, None, {OURS: ours})}
    assert rows["cameras registered of 11"].target == 9.0
    assert rows["cameras registered of 11"].verdict == "missed"
    rows = _rows("fountain-P11", {OURS: ours})
    for name, gate in (("focal error", "focal-error"), ("mean camera-centre error", "centre-error")):
        assert rows[name].target == read_gates()[f"cameras/fountain-P11/{gate}"].limit
    assert all(
        row.target is None for name, row in _rows("a set", {OURS: ours}).items() if "claims" not in name
    )
