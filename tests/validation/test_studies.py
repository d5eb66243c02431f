"""Studies of growth, subsets, killed runs and cost: what they compute."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest

from tests.pipeline.fake_stages import CALLS, fake_config, photographs
from tests.synthetic import make_scene, true_pairs
from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError
from thesisrecon.geometry.two_view import sampson_residuals
from validation import command
from validation.ablation.command import STUDIES
from validation.metrics.cameras import TrueCameras, measure_cameras
from validation.runs.processes import call_apart
from validation.runs.study import MODULES, OF_PAGES, load_study, run_studies, run_study, study_parser
from validation.runs.tables import Metric, text_table
from validation.scenes.many_tracks import GATE_PX, make_tracks
from validation.scenes.many_views import walk
from validation.studies import benchmark_table, coverage_real
from validation.studies import growth_of_cost as growth
from validation.studies.benchmark_table import ratio_table, ratios_to_ours
from validation.studies.coverage_real import draw_neighbours
from validation.studies.growth_of_cost import Cost, Meter, exponent
from validation.studies.large_images import FORMATS, read_one, write_image
from validation.studies.robustness import TORN, Kill, different, kill_table, outputs
from validation.studies.subsets import OUTCOMES, Matched, Trial, run_trial, solve, table_row, take_views
from validation.studies.wide_baseline import WideResult, check_step


def test_the_exponent_is_that_of_a_power():
    assert exponent([10, 30, 100], [3 * n**1.5 for n in (10, 30, 100)]) == pytest.approx(1.5)


def test_simulated_tracks_are_those_of_the_true_cameras():
    found = make_tracks("street", 8)
    t = found.tracks
    assert t.n_views == 8
    assert (np.diff(t.point_index * 8 + t.view_index) > 0).all()
    assert np.bincount(t.point_index).min() >= 2
    assert {(p.i, p.j) for p in found.pairs} >= {(k, k + 1) for k in range(7)}
    for pair in found.pairs:
        assert pair.inliers >= 0.9 * pair.candidates
        assert np.abs(sampson_residuals(pair.F, pair.xy1, pair.xy2)).max() < GATE_PX
        assert pair.homography_inlier_ratio < 1.0


def matched_scene():
    scene = make_scene(views=9, points=400, sigma_px=0.3, seed=4)
    return Matched("synthetic", scene.tracks, true_pairs(scene), scene.sizes, scene.K[:, 0, 0])


def test_a_subset_holds_the_views_their_pairs_and_the_points_that_two_of_them_see():
    whole, views = matched_scene(), np.array([1, 4, 7])
    kept = np.arange(400) < 250
    part = take_views(whole, views, kept)
    assert part.tracks.n_views == 3
    assert np.bincount(part.tracks.point_index).min() >= 2
    assert {(pair.i, pair.j) for pair in part.pairs} == {(0, 1), (0, 2), (1, 2)}
    t = whole.tracks
    seen = np.zeros((9, 400), dtype=bool)
    seen[t.view_index, t.point_index] = True
    assert part.tracks.n_points == int(((seen[views].sum(axis=0) >= 2) & kept).sum())
    mine = part.tracks.xy[part.tracks.view_index == 1]
    theirs = t.xy[t.view_index == 4]
    assert all((np.abs(theirs - xy).max(axis=1) == 0.0).any() for xy in mine)


def test_a_trial_finds_the_focal_length_and_is_the_same_twice():
    first, again = (run_trial(matched_scene(), "shared", 3) for _ in range(2))
    assert first.right
    assert not first.failed_checks
    assert first.registered == len(first.views)
    assert replace(first, seconds=0.0) == replace(again, seconds=0.0)


def test_outcomes_of_a_trial_are_distinguished():
    wrong = Trial(0, (0, 1), 2, 10.0, 12.0, (), 1, 1.0)
    shifted = replace(wrong, median_pct=np.nan, reasons=("pure translation",))
    trials = {
        "right": replace(wrong, median_pct=1.0),
        "open": replace(wrong, interval_pct=11.0),
        "refused": replace(shifted, failed_checks=("close to a pure translation",)),
        "refused, another reason": replace(shifted, failed_checks=("too few points",)),
        "right, not trusted": replace(wrong, median_pct=1.0, failed_checks=("no",)),
        "wrong": wrong,
        "crash": replace(wrong, median_pct=np.nan, crash="ValueError: no"),
    }
    assert tuple(trials) == OUTCOMES
    assert [trial.outcome for trial in trials.values()] == list(OUTCOMES)
    assert replace(wrong, failed_checks=("no",)).outcome == "refused"
    assert shifted.outcome == "wrong"
    row = text_table([], [table_row("s", "shared", [*trials.values()])])
    assert "| s | shared | 7 | 1 | 1 | 1 | 1 | 1 | 1 | 1 | 5.50 |" in row


def write(folder, seconds, focal):
    folder.mkdir()
    summary = {"seconds": {"total": seconds}, "cameras": [{"focal_px": focal}]}
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "points.ply").write_bytes(b"ply")
    (folder / "report.html").write_text(f"{seconds} s")


def test_times_are_no_difference_and_numbers_and_missing_files_are(tmp_path):
    for name, seconds, focal in (("a", 1.0, 900.0), ("b", 2.0, 900.0), ("c", 1.0, 900.5)):
        write(tmp_path / name, seconds, focal)
    a, b, c = (outputs(tmp_path / name) for name in "abc")
    assert different(a, b) == ()
    assert different(a, c) == ("summary.json",)
    (tmp_path / "b" / "points.ply").unlink()
    assert different(a, outputs(tmp_path / "b")) == ("points.ply",)
    rows = [
        Kill("after 5 % of the time", True, 3, ()),
        Kill("after 95 % of the time", False, 9, ("points.ply",)),
    ]
    assert kill_table(rows).splitlines()[2:] == [
        "| after 5 % of the time | 3 | none |",
        "| after 95 % of the time (had ended) | 9 | points.ply |",
    ]


def test_a_torn_write_leaves_no_half_file_under_its_name(tmp_path):
    images = Path(__file__).parents[2] / "fixtures" / "courtyard" / "images"
    options = ["reconstruct", str(images), "-o", str(tmp_path / "out"), "--max-size", "128"]
    program = [sys.executable, "-c", TORN, "2", *options, "--until", "features", "--threads", "1"]
    ended = subprocess.run(program, check=False, capture_output=True)
    assert ended.returncode == -signal.SIGKILL
    whole = [path for path in (tmp_path / "out").rglob("*") if path.is_file() and path.name[0] != "."]
    torn = list((tmp_path / "out").rglob(".*.partial"))
    assert len(whole) == len(torn) == 1


def entry(group, method, seconds):
    return {"group": group, "extra_info": {"method": method}, "stats": {"min": seconds}}


def test_ratios_are_ours_over_each_reference(tmp_path, capsys):
    timings = {
        "benchmarks": [entry("F", "ours", 0.002), entry("F", "OpenCV", 0.008), entry("G", "OpenCV", 1.0)]
    }
    (tmp_path / "b.json").write_text(json.dumps(timings))
    options = ["--benchmark", str(tmp_path / "b.json"), "--ratios", str(tmp_path / "r.json")]
    assert run_study("benchmark-table", options) == 0
    assert "| F | OpenCV | 8 | **0.25** |" in capsys.readouterr().out
    assert json.loads((tmp_path / "r.json").read_text())["ours_over"] == {"F": {"OpenCV": 0.25}}


def test_a_group_without_ours_has_no_ratio():
    assert ratios_to_ours({"G": {"OpenCV": 1.0}}) == {}
    assert "| G | OpenCV | 1e+03 |  |" in ratio_table({"G": {"OpenCV": 1.0}})


def test_a_file_without_benchmarks_is_named(tmp_path, capsys):
    (tmp_path / "b.json").write_text("[]")
    assert run_study("benchmark-table", ["--benchmark", str(tmp_path / "b.json")]) == 2
    assert "is not a JSON file of our benchmarks" in capsys.readouterr().err


def test_a_longer_walk_begins_with_the_shorter_and_looks_at_the_yard():
    few, many = walk(5, (480, 360)), walk(40, (480, 360))
    for a, b in zip(few, many, strict=False):
        np.testing.assert_array_equal(a.R, b.R)
        np.testing.assert_array_equal(a.C, b.C)
    centres = np.array([pose.C for pose in many])
    angle = np.sort(np.degrees(np.arctan2(centres[:, 0], -1.4 - centres[:, 1])))
    assert np.diff(angle).max() < 8.0, "the arc has no gap"
    middle = np.array([pose.R @ (np.array([0.0, -1.1, 1.7]) - pose.C) for pose in many])
    assert (middle[:, 2] > 4.0).all()


def test_costs_go_to_the_stage_that_ran_and_powers_are_those_of_the_numbers(tmp_path):
    CALLS.clear()
    meter = Meter()
    reconstruct(photographs(4), tmp_path, config=fake_config(), until="model", progress=meter.progress)
    meter.enter("end")
    assert set(growth.STAGES) <= set(meter.cpu_s)
    assert all(peak > 20.0 for peak in meter.peak_mb.values())
    costs = [
        Cost(n, dict.fromkeys(growth.STAGES, n**1.5), {"images": 3.0 * n}, {"points": n**2}, 1.0, 0.01)
        for n in (10, 100)
    ]
    rows = growth.cost_table(costs).splitlines()
    assert next(row for row in rows if row.startswith("| matches, processor s")).endswith("| 1.50 |")
    assert next(row for row in rows if row.startswith("| whole run, peak MB")).endswith("| 1.00 |")
    assert next(row for row in rows if row.startswith("| points")).endswith("| 2.00 |")
    assert not any("dense, peak MB" in row for row in rows), "rows of zeros are left out"


def test_a_size_that_failed_leaves_the_numbers_of_the_others():
    stages = dict.fromkeys(growth.STAGES, 1.0)
    failed = Cost(10, stages, {"images": 30.0}, {"points": 0}, 1.0, np.nan, failure="no pair was found")
    counts, colmap = {"points": 7, "report.html, kB": 5}, {"wall s": 20.0}
    whole = Cost(100, stages, {"images": 90.0}, counts, 9.0, 0.01, 0.02, colmap=colmap)
    for costs, walls in (((failed, whole), "nan | 20"), ((whole, failed), "20 | nan")):
        rows = growth.cost_table(costs).splitlines()
        assert f"| COLMAP, wall s | {walls} | - |" in rows
        assert next(row for row in rows if row.startswith("| focal error, %")).endswith("| - |")
        assert any(row.startswith("| report.html, kB") for row in rows)
        assert rows[-1] == "10 images: no pair was found"


def test_imports_do_not_count_as_time_of_colmap(monkeypatch):
    calls = []
    monkeypatch.setattr(growth, "load", lambda name: calls.append(name) or time.sleep(0.3))
    monkeypatch.setattr(growth, "reconstruct_with_pycolmap", lambda *_, **given: calls.append(given["pairs"]))
    assert growth.run_colmap("images", "out", "pairs.txt", 1)["wall s"] < 0.2
    assert calls == ["pycolmap", Path("pairs.txt")]


def test_images_of_another_scene_or_size_are_not_taken_for_those_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(growth, "WALKS", {s: (None, lambda *_, **__: None) for s in ("place", "street")})
    asked = [("place", 480), ("street", 480), ("place", 640)]
    folders = [growth.write_scene(tmp_path, scene, 3, side, 1) for scene, side in asked]
    assert len(set(folders)) == 3


@pytest.mark.parametrize("name", MODULES)
def test_every_study_has_options_with_help(name):
    function = load_study(name)
    text = " ".join(study_parser(name, function).format_help().split())
    assert function.__doc__.partition("\n")[0] in text
    parser = study_parser(name, function)
    assert all(action.help for action in parser._actions)


def test_a_study_prints_writes_and_judges_its_tables(tmp_path, capsys, monkeypatch):
    rows = [Metric("a set", "error", "px", {"ours": 2.0}, "ours", 1.0)]

    def toy_study(out: Path, numbers: Sequence[int] = (1, 2), kind: Literal["a", "b"] = "a"):
        """Measure a toy."""
        (out / "made").touch()
        yield f"{sum(numbers)} {kind}"
        yield rows if kind == "b" else rows[:0]

    monkeypatch.setitem(MODULES, "toy", "benchmark_table")
    monkeypatch.setattr(benchmark_table, "toy_study", toy_study, raising=False)
    toy_study.__annotations__ = {"out": Path, "numbers": Sequence[int], "kind": Literal["a", "b"]}
    assert run_studies(["toy", "--numbers", "3", "4"]) == 0
    assert capsys.readouterr().out == "7 a\n\n"
    out = tmp_path / "out"
    assert run_studies(["toy", "--kind", "b", "-o", str(out), "--json", str(tmp_path / "rows.json")]) == 1
    assert "| error, px | 2 | <= 1 | missed |" in (out / "toy.md").read_text()
    assert json.loads((tmp_path / "rows.json").read_text())[0]["verdict"] == "missed"
    assert (out / "toy.json").read_bytes() == (tmp_path / "rows.json").read_bytes()
    assert (out / "made").exists()
    # "all" runs every study with the options of the pages, every ablation and the report, each in a folder.
    for name in set(MODULES) - {"toy"}:
        monkeypatch.delitem(MODULES, name)
    monkeypatch.setitem(OF_PAGES, "toy", [[], ["--numbers", "7"]])
    others = []
    monkeypatch.setattr(command, "main", lambda arguments: others.append(arguments) or 0)
    assert command.run_all(tmp_path / "all") == 0
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == ["toy", "toy-2"]
    text = (tmp_path / "all" / "toy" / "toy.md").read_text()
    assert re.match(r"Commit \S+; .* cores, .*; Python [\d.]+\.\n\n3 a\n", text)
    assert "\n\n7 a\n" in (tmp_path / "all" / "toy-2" / "toy.md").read_text()
    assert ["ablate", "thesis-fundamental", "-o", str(tmp_path / "all" / "thesis-fundamental")] in others
    assert others[-1] == ["report", "-o", str(tmp_path / "all" / "report")]
    assert len(others) == 1 + len(list(STUDIES.glob("*.toml")))
    # A study that cannot run, or ends with an error, shows in the exit code and ends no other.
    failures = [ZeroDivisionError("a fault"), UsageError("no images")]

    def failing_study():
        """Fail."""
        yield "begun"
        raise failures.pop()

    monkeypatch.setattr(benchmark_table, "toy_study", failing_study)
    monkeypatch.setitem(OF_PAGES, "toy", [[]])
    for code in (2, 1):
        others.clear()
        assert command.run_all(tmp_path / f"failing-{code}") == code
        assert others[-1][0] == "report"


def test_studies_run_with_the_options_of_the_pages():
    """Each has a parser that takes them and no argument that "all" lacks."""
    for name in MODULES:
        for options in OF_PAGES.get(name, [[]]):
            study_parser(name, load_study(name)).parse_args([*options, "-o", "out"])


def test_missing_data_and_unknown_names_end_with_code_2(capsys, monkeypatch):
    monkeypatch.setenv("THESISRECON_DATA", "/nowhere")
    assert run_study("dinosaur") == 2
    assert "not on this machine" in capsys.readouterr().err
    for options in (["epipolar-methods", "--methods", "nobody's"], ["harsh", "--kinds", "nobody's"]):
        assert run_studies(options) == 2
        assert "choose from" in capsys.readouterr().err


def test_records_differ_in_bytes_and_in_runs_that_one_of_them_lacks(tmp_path):
    run = {"code": 0, "summary": {"/points": 3.0}, "files": {"points.ply": "ab"}, "stages": {"01": "cd"}}
    other = run | {"files": {"points.ply": "ef"}}
    files = []
    for number, runs in enumerate(({"a": run}, {"a": run}, {"a": other}, {"b": run}, {"a": {}})):
        files.append(tmp_path / f"{number}.json")
        files[-1].write_text(json.dumps(runs))
    first, same, changed, disjoint, empty = map(str, files)
    assert run_study("record", ["--compare-with", first, same]) == 0
    for differs in (changed, disjoint, empty):
        assert run_study("record", ["--compare-with", first, differs]) == 1


def test_a_call_in_a_process_of_its_own_returns_its_answer():
    assert call_apart(exponent, [1.0, 10.0], [1.0, 100.0])[0] == pytest.approx(2.0)
    with pytest.raises(RuntimeError, match=r"ZeroDivisionError|ValueError"):
        call_apart(exponent, [], [])


def test_wide_steps_are_counted_without_our_front_end_too():
    view = true_pairs(make_scene(views=2, points=100))[0]
    found = [WideResult(None, view, error_rel) for error_rel in (0.0, 0.1)]
    for methods, verdict in (({"SIFT": found}, "reported"), ({"ours": found, "SIFT": found}, "missed")):
        pairs, wrong = check_step("a step", methods)
        assert pairs.name == "pairs found, of 2"
        assert wrong.values == dict.fromkeys(methods, 1.0)
        assert wrong.verdict == verdict


def test_the_error_of_centres_is_after_a_similarity():
    scene = make_scene(views=6, points=200)
    subset = replace(matched_scene(), tracks=scene.tracks, pairs=true_pairs(scene), sizes=scene.sizes)
    found, *_ = solve(subset, PipelineConfig(), seed=0, first=0)

    def error_mm(centres):
        return measure_cameras(found.reconstruction, TrueCameras(scene.K, scene.R, centres)).centre_error_mm

    assert error_mm(5.0 * scene.centres) < 0.05
    corrupted = 5.0 * scene.centres + [[1e-3, 0.0, 0.0]] * np.array([1, 0, 0, 0, 0, -1])[:, None]
    assert 0.2 < error_mm(corrupted) < 0.5


@pytest.mark.parametrize("name", FORMATS)
def test_images_of_every_format_are_written_and_read(tmp_path, name):
    path = tmp_path / f"some.{FORMATS[name][1]}"
    write_image(name, 96, str(path))
    assert read_one(str(path), 64) == ""


def test_memory_of_large_images_is_measured(tmp_path, capsys):
    assert run_study("large-images", ["--long-side", "96", "--formats", "GIF", "-o", str(tmp_path)]) == 0
    assert re.search(r"^\| GIF \| 0\.0 \| \d+ \|  \|$", capsys.readouterr().out, re.M)
    assert not list(tmp_path.glob("large.*"))


@pytest.mark.parametrize(
    "arguments",
    [
        ["report", "--scenes", "courtyard", "--stages", "fundamental", "--quick", "-o"],
        ["ablate", "ransac", "-o"],
        ["study", "critical-motions", "-o"],
    ],
)
def test_files_of_the_user_in_an_output_folder_survive(arguments, tmp_path, capsys):
    names = ("data/a.jpg", "work/a.jpg", "study.json", "index.html", "critical-motions.md")
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"of the user")
    run = run_studies if arguments[0] == "study" else command.main
    assert run([*arguments[run is run_studies :], str(tmp_path)]) == 2
    assert "was not written by thesisrecon, or was changed since; move it, or" in capsys.readouterr().err
    assert {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()} == set(names)


def test_a_file_of_numbers_is_not_replaced(tmp_path, capsys):
    (tmp_path / "x.json").write_bytes(b"of the user")
    assert run_studies(["critical-motions", "--json", str(tmp_path / "x.json")]) == 2
    assert "x.json exists already" in capsys.readouterr().err
    assert (tmp_path / "x.json").read_bytes() == b"of the user"


def test_subsets_of_images_are_connected_by_verified_matches():
    pairs = [SimpleNamespace(i=i, j=i + 1, accepted=i != 3, inliers=100) for i in range(7)]
    matched = Matched("row", None, pairs, np.full((8, 2), 100), np.ones(8))
    for seed in range(20):
        drawn = draw_neighbours(matched, np.random.default_rng(seed), 3)
        assert len(set(drawn)) == 3
        assert drawn[-1] - drawn[0] == 2
        assert not {3, 4} <= set(drawn)


def test_coverage_counts_trusted_results_only():
    right = np.array([0.5]), np.array([1.5, -3.0]), np.array([0.1, 2.2]), np.array([-0.2, 0.3])
    wrong = tuple(np.full(len(z), 9.0) for z in right)
    trials = [coverage_real.Trial("a", 3, 9.0, trusted, z) for trusted, z in ((True, right), (False, wrong))]
    row = coverage_real.table_row("a", trials)
    assert row == ["a", 2, 1, "100 100 100", "0 50 50", "50 50 100", "100 100 100", "0.5 3.0 2.2 0.3"]
