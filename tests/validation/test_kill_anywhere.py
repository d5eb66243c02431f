"""What the check of killed runs compares, and that a torn write is one."""

import json
import signal
import subprocess
import sys
from pathlib import Path

from validation.studies.kill_anywhere import TORN, Kill, different, outputs, table


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
    assert table(rows).splitlines()[2:] == [
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
