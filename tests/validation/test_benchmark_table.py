"""The table of ratios that a benchmark ends with."""

import json

from validation.benchmark_table import main, ratio_table, ratios_to_ours


def entry(group, method, seconds):
    return {"group": group, "extra_info": {"method": method}, "stats": {"min": seconds}}


def test_ratios_are_ours_over_each_reference(tmp_path, capsys):
    told = {"benchmarks": [entry("F", "ours", 0.002), entry("F", "OpenCV", 0.008), entry("G", "OpenCV", 1.0)]}
    (tmp_path / "b.json").write_text(json.dumps(told))
    assert main([str(tmp_path / "b.json"), "-o", str(tmp_path / "r.json")]) == 0
    assert "| F | OpenCV | 8 | **0.25** |" in capsys.readouterr().out
    assert json.loads((tmp_path / "r.json").read_text())["ours_over"] == {"F": {"OpenCV": 0.25}}


def test_a_group_without_ours_has_no_ratio():
    assert ratios_to_ours({"G": {"OpenCV": 1.0}}) == {}
    assert "| G | OpenCV | 1e+03 |  |" in ratio_table({"G": {"OpenCV": 1.0}})


def test_a_file_that_is_no_benchmark_is_named(tmp_path, capsys):
    (tmp_path / "b.json").write_text("[]")
    assert main([str(tmp_path / "b.json")]) == 2
    assert "is no benchmark of ours" in capsys.readouterr().err
