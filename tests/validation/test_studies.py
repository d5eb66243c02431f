"""Studies of growth, subsets, killed runs and cost: what they compute."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest

from tests.pipeline.fake_stages import CALLS, fake_config, photographs
from tests.surface.sphere import photograph, ring_of
from tests.synthetic import make_scene, true_pairs
from tests.validation.references.conftest import skip_without
from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.errors import UsageError
from thesisrecon.records import DepthMap, Reconstruction, Tracks
from validation import command
from validation.ablation.plan import STUDIES
from validation.metrics import depth
from validation.runs.processes import call_apart
from validation.runs.study import MODULES, OF_PAGES, load_study, run_studies, run_study, study_parser
from validation.runs.tables import Metric
from validation.scenes.real import load_fixture_scene
from validation.stages import views as views_stage
from validation.studies import benchmarks, look_alikes, subsets
from validation.studies import growth_of_cost as growth
from validation.studies.growth_of_cost import Meter, exponent
from validation.studies.robustness import different, outputs


def matched_scene():
    scene = make_scene(views=9, points=400, sigma_px=0.3, seed=4)
    return subsets.Matched("synthetic", scene.tracks, true_pairs(scene), scene.sizes)


def test_a_subset_holds_the_views_their_pairs_and_the_points_that_two_of_them_see():
    whole, views = matched_scene(), np.array([1, 4, 7])
    part = subsets.take_views(whole, views)
    assert part.tracks.n_views == 3
    assert np.bincount(part.tracks.point_index).min() >= 2
    assert {(pair.i, pair.j) for pair in part.pairs} == {(0, 1), (0, 2), (1, 2)}
    t = whole.tracks
    seen = np.zeros((9, 400), dtype=bool)
    seen[t.view_index, t.point_index] = True
    assert part.tracks.n_points == int((seen[views].sum(axis=0) >= 2).sum())
    mine = part.tracks.xy[part.tracks.view_index == 1]
    theirs = t.xy[t.view_index == 4]
    assert all((np.abs(theirs - xy).max(axis=1) == 0.0).any() for xy in mine)


def test_times_are_no_difference_and_numbers_and_missing_files_are(tmp_path):
    for name, seconds, focal in (("a", 1.0, 900.0), ("b", 2.0, 900.0), ("c", 1.0, 900.5)):
        (tmp_path / name).mkdir()
        summary = {"seconds": {"total": seconds}, "cameras": [{"focal_px": focal}]}
        (tmp_path / name / "summary.json").write_text(json.dumps(summary))
        (tmp_path / name / "points.ply").write_bytes(b"ply")
        (tmp_path / name / "report.html").write_text(f"{seconds} s")
    a, b, c = (outputs(tmp_path / name) for name in "abc")
    assert different(a, b) == ()
    assert different(a, c) == ("summary.json",)
    (tmp_path / "b" / "points.ply").unlink()
    assert different(a, outputs(tmp_path / "b")) == ("points.ply",)


def entry(group, method, seconds):
    return {"group": group, "extra_info": {"method": method}, "stats": {"median": seconds}}


def test_ratios_are_ours_over_each_reference(tmp_path, capsys):
    timings = {
        "benchmarks": [entry("F", "ours", 0.002), entry("F", "OpenCV", 0.008), entry("G", "OpenCV", 1.0)]
    }
    (tmp_path / "b.json").write_text(json.dumps(timings))
    options = ["--benchmark", str(tmp_path / "b.json"), "--ratios", str(tmp_path / "r.json")]
    assert run_study("benchmark-table", options) == 0
    assert "| F | OpenCV | 8 | **0.25** |" in capsys.readouterr().out
    assert json.loads((tmp_path / "r.json").read_text())["ours_over"] == {"F": {"OpenCV": 0.25}}


def test_a_slowdown_of_ten_per_cent_is_found_and_nothing_else():
    found, false = 0, 0
    works = {f"work {k}": 10.0 ** (-k % 4) for k in range(25)}
    for trial in range(20):
        rng = np.random.default_rng(trial)

        def measure(root, _, rng=rng):
            # Both versions suffer from what else the machine does, and each piece of work from itself.
            machine = 1.0 + 0.3 * rng.random()
            slow = {"work 7": 1.1} if root.name == "now" else {}
            return {w: machine * slow.get(w, 1.0) * s * np.exp(0.03 * rng.normal()) for w, s in works.items()}

        trees = {"then": Path("then"), "now": Path("now")}
        text = benchmarks.compare_trees(trees, 11, measure, Path())
        rows = [line for line in text.splitlines() if line.endswith("| slower |")]
        found += any(row.startswith("| work 7 ") for row in rows)
        false += sum(not row.startswith("| work 7 ") for row in rows)
    assert found >= 19
    assert false <= 2


def test_stored_runs_are_drawn(tmp_path, monkeypatch):
    for n, seconds in enumerate((0.002, 0.001)):
        run = {"commit_info": {"id": f"abcdef012345{n}"}, "machine_info": {"cpu": {"brand_raw": "a chip"}}}
        run |= {
            "datetime": f"2026-01-0{2 - n}",
            "benchmarks": [entry("F", "ours", seconds), entry("F", "X", 0.004)],
        }
        (tmp_path / f"{n}.json").write_text(json.dumps(run))
    (tmp_path / "other.json").write_text("{}")
    page = benchmarks.write_trend(sorted(tmp_path.glob("*.json")), tmp_path).read_text(encoding="utf-8")
    assert '"y": [1.0, 2.0]' in page or '"y":[1.0,2.0]' in page, "in the order of the dates"
    assert "abcdef0123 on a chip" in page
    monkeypatch.setattr(benchmarks, "STORE", tmp_path / "none")
    assert run_study("benchmark-against", ["--trend"]) == 2
    assert run_study("benchmark-against", ["--against", "no-such-revision"]) == 2


def test_costs_go_to_the_stage_that_ran_and_powers_are_those_of_the_numbers(tmp_path):
    CALLS.clear()
    meter = Meter()
    reconstruct(photographs(4), tmp_path, config=fake_config(), until="model", progress=meter.progress)
    meter.enter("end")
    assert set(growth.STAGES) <= set(meter.cpu_s)
    assert all(peak > 20.0 for peak in meter.peak_mb.values())
    costs = [growth.costs_of(meter) | {"images": n, "matches, processor s": n**1.5} for n in (10.0, 100.0)]
    table = growth.cost_table(costs).splitlines()
    powers = {row.split("|")[1].strip(): row.split("|")[-2].strip() for row in table}
    assert powers["matches, processor s"] == "1.50"


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

    monkeypatch.setitem(MODULES, "toy", "benchmarks")
    monkeypatch.setattr(benchmarks, "toy_study", toy_study, raising=False)
    toy_study.__annotations__ = {"out": Path, "numbers": Sequence[int], "kind": Literal["a", "b"]}
    assert run_studies(["toy", "--numbers", "3", "4"]) == 0
    assert capsys.readouterr().out == "7 a\n\n"
    out = tmp_path / "out"
    assert run_studies(["toy", "--kind", "b", "-o", str(out)]) == 1
    assert "| error, px | 2 | <= 1 | missed |" in (out / "toy.md").read_text()
    assert json.loads((out / "toy.json").read_text())[0]["verdict"] == "missed"
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

    monkeypatch.setattr(benchmarks, "toy_study", failing_study)
    monkeypatch.setitem(OF_PAGES, "toy", [[]])
    for code in (2, 1):
        others.clear()
        assert command.run_all(tmp_path / f"failing-{code}") == code
        assert others[-1][0] == "report"


def test_missing_data_and_unknown_names_end_with_code_2(capsys, monkeypatch):
    monkeypatch.setenv("THESISRECON_DATA", "/nowhere")
    assert run_study("dinosaur") == 2
    assert "not on this machine" in capsys.readouterr().err
    for options in (["epipolar-methods", "--methods", "nobody's"], ["harsh", "--kinds", "nobody's"]):
        assert run_studies(options) == 2
        assert "choose from" in capsys.readouterr().err


def test_a_call_in_a_process_of_its_own_returns_its_answer():
    assert call_apart(exponent, [1.0, 10.0], [1.0, 100.0])[0] == pytest.approx(2.0)
    with pytest.raises(RuntimeError, match=r"ZeroDivisionError|ValueError"):
        call_apart(exponent, [], [])


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


def test_subsets_of_images_are_connected_by_verified_matches():
    pairs = [SimpleNamespace(i=i, j=i + 1, accepted=i != 3, inliers=100) for i in range(7)]
    matched = subsets.Matched("row", None, pairs, np.full((8, 2), 100))
    for seed in range(20):
        drawn = subsets.draw_neighbours(matched, np.random.default_rng(seed), 3)
        assert len(set(drawn)) == 3
        assert drawn[-1] - drawn[0] == 2
        assert not {3, 4} <= set(drawn)


def test_coverage_counts_trusted_results_only():
    right = np.array([0.5]), np.array([1.5, -3.0]), np.array([0.1, 2.2]), np.array([-0.2, 0.3])
    wrong = tuple(np.full(len(z), 9.0) for z in right)
    trials = [
        subsets.CoverageTrial("a", 3, 9.0, trusted, off, z)
        for trusted, off, z in ((True, 4.0, right), (False, 2.0, wrong), (False, 5.0, wrong))
    ]
    row = subsets.coverage_row("a", trials)
    assert row == ["a", 3, 1, 1, 1, "100 100 100", "0 50 50", "50 50 100", "100 100 100", "0.5 3.0 2.2 0.3"]


skip_without("open3d")


def courtyard_map(view, factor, std):
    """The true depth of a view, ``factor`` times too far, in a world of half the size."""
    scene = load_fixture_scene("courtyard")
    true, stride, _ = depth.true_depth(scene, view)
    K = np.diag([1.0 / stride, 1.0 / stride, 1.0]) @ scene.K[view]
    P = K @ scene.R[view] @ np.column_stack([np.eye(3), -0.5 * scene.C[view]])
    wrong = (0.5 * factor * true).astype(np.float32)
    return DepthMap(view, P, wrong, np.full_like(wrong, std), np.ones(wrong.shape, np.uint8))


def test_a_depth_that_is_too_far_is_measured():
    scene = load_fixture_scene("courtyard")
    maps = {view: courtyard_map(view, 1.002, 0.01) for view in (0, 5, 9)}
    align = depth.true_from_maps(maps, scene)
    assert align.scale == pytest.approx(2.0)
    truth = depth.true_depth(scene, 5)
    one = depth.judge_against_truth(maps[5], truth, align.scale)
    measured = depth.together([one])
    assert measured["depth error, median"] == pytest.approx(0.2, rel=0.05)
    assert measured["depth error, bias"] == pytest.approx(0.2, rel=0.05)
    assert measured["within 1 %"] == pytest.approx(measured["known"])
    assert measured["known"] > 99.0
    expected = 0.002 * np.nanmedian(truth[0]) / 0.02 / 0.6745
    assert measured["error in deviations"] == pytest.approx(expected, rel=0.2)
    far = depth.judge_against_truth(replace(maps[5], depth=maps[5].depth * 1.02), truth, align.scale)
    assert far.right == pytest.approx(0.0, abs=0.01)
    with pytest.raises(ValueError, match="no depth map"):
        depth.together([])


def test_depth_is_read_where_sparse_points_are_seen():
    z = np.full((20, 30), 4.0, np.float32)
    z[:, 15:] = np.nan
    P = np.array([[10.0, 0.0, 15.0, 0.0], [0.0, 10.0, 10.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    found = DepthMap(0, P, z, np.full_like(z, 0.1), np.ones(z.shape, np.uint8))
    X = np.array([[-2.0, 0.0, 4.0, 1.0], [-2.0, 1.0, 4.2, 1.0], [2.0, 0.0, 4.0, 1.0], [0.0, 0.0, 9.0, 1.0]])
    # The last is another view's.
    tracks = Tracks(np.array([0, 0, 0, 1]), np.arange(4), np.zeros((4, 2)), 2, 4)
    seen = np.ones(4, dtype=bool)
    cameras, sizes = np.stack([P, P]), np.full((2, 2), 20)
    model = Reconstruction("metric", cameras, X, seen[:2], seen, seen, tracks, sizes, 1.0, ("", ""))
    one = depth.judge_against_points(found, model)
    np.testing.assert_allclose(one.error, [0.0, 4.0 / 4.2 - 1.0], atol=1e-6)
    np.testing.assert_allclose(one.deviations, [0.0, 2.0], atol=1e-4)
    assert one.known == pytest.approx(2 / 3)
    assert one.right == pytest.approx(1 / 3)


def test_an_image_is_left_out(tmp_path):
    maps = {m.view: m for m in ring_of(12)}
    views = {i: photograph(m, 0.9 if i % 2 else 1.1) for i, m in maps.items()}
    others = [i for i in maps if i != 3]
    given = [maps[i] for i in others], [views[i] for i in others]
    camera = views_stage.Camera.from_matrix(views[3].P, (160, 120))
    drawn = {}
    for method in (views_stage.OURS, views_stage.FINE, views_stage.LEVELLED):
        mesh = views_stage._model(method, *given, tmp_path / "surface.npz")
        drawn[method] = views_stage.render(mesh, camera)
    found, compared = views_stage.compare(views[3], drawn)
    assert compared.any()
    assert found[views_stage.OURS]["PSNR"] > 30.0
    for name, one in found.items():
        assert one["PSNR"] > 22.0, name
        assert one["PSNR as it is"] < one["PSNR"] + 1e-9
        assert 10.0 < one["covered"] < 50.0
    level = views_stage._equally_bright(views_stage._read_surface(tmp_path / "surface.npz"), given[1])
    bright = level[2].rgb, views[2].rgb
    seen = bright[1] > 40
    assert np.median(bright[0][seen] / bright[1][seen]) == pytest.approx(np.sqrt(0.9 / 1.1), abs=0.03)


def test_look_alikes_are_counted_by_their_verdicts(monkeypatch):
    monkeypatch.setattr(look_alikes, "verdict", lambda *scene: look_alikes.VERDICTS[scene[1]])
    (table,) = look_alikes.look_alikes_study(kinds=["rooms", "flat tower, 3"])
    assert "| two equal rooms | 2 | 2 | 0 | 0 | 0 |" in re.sub(" +", " ", table)
    assert "| flat tower, 3 equal sides | 2 | 2 | 2 | 0 | 0 |" in re.sub(" +", " ", table)
    assert len(look_alikes.SCENES) == 60
    assert {kind for kind, *_ in look_alikes.SCENES} == set(look_alikes.KINDS)
