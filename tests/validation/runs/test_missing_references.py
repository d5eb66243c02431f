"""A reference that is missing, crashes or hangs leaves rows that say so; the report stands."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.validation.runs.reference_stages import METHODS, STAGES
from validation.references.libraries import NAMES, PACKAGES, NoReference, load
from validation.runs.page import write_pages
from validation.runs.processes import own_cores
from validation.runs.records import ReportOptions
from validation.runs.report import run_tasks
from validation.runs.results import collect, read_gates

ROOT = Path(__file__).parents[3]
MISSING = "raise ModuleNotFoundError(\"No module named '{0}'\", name='{0}')"
CRASHING = "import os; os.abort()"
HANGING = "import time; time.sleep(600)"


def not_installed(library):
    return f"{NAMES[library]} is not installed: pip install {PACKAGES[library]}"


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """A folder whose modules come before those that are installed, in every process started from here."""
    folder = tmp_path / "stubs"
    folder.mkdir()
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(ROOT)]))
    return folder


def options_for(out, scene, limit_s=60.0):
    return ReportOptions(
        out,
        (scene,),
        ("references",),
        threads=len(own_cores()),
        limit_s=limit_s,
        stages_from="tests.validation.runs.reference_stages",
    )


@pytest.mark.parametrize("library", METHODS)
def test_one_that_is_missing_leaves_the_others(library, stub, tmp_path):
    (stub / f"{library}.py").write_text(MISSING.format(library))
    other = "cv2" if library == "poselib" else "poselib"
    options = options_for(tmp_path / "out", f"{library}-{other}")
    (judged,) = run_tasks(options, STAGES, lambda _: None).values()
    assert judged[1][library].failure == not_installed(library)
    assert judged[0].metrics[0].values == {library: None, other: 1.0}


def test_crashing_hanging_and_missing_ones_leave_rows_that_say_so(stub, tmp_path):
    stubs = {"cv2": CRASHING, "pycolmap": HANGING, "open3d": MISSING.format("open3d")}
    for library, text in stubs.items():
        (stub / f"{library}.py").write_text(text)
    options = options_for(tmp_path, "-".join(stubs), limit_s=12.0)
    judged = run_tasks(options, STAGES, lambda _: None)
    ((_, outcomes),) = judged.values()
    failures = {
        "cv2": "crashed with signal 6",
        "pycolmap": "exceeded the time limit of 12 s",
        "open3d": not_installed("open3d"),
    }
    assert {name: o.failure for name, o in outcomes.items()} == failures
    page = write_pages(options, STAGES, judged, collect(options, judged, {})).read_text(encoding="utf-8")
    assert all(words in page for words in failures.values())


def test_report_and_check_run_without_any(stub, tmp_path):
    for library in METHODS:
        (stub / f"{library}.py").write_text(MISSING.format(library))
    command = [sys.executable, "-m", "validation", "check", "--quick", "--scenes", "street"]
    done = subprocess.run(
        [*command, "--stages", "bundle", "-o", str(tmp_path / "out")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stderr == ""
    reported = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    assert reported["failures"] == {"bundle/street/Ceres": not_installed("pycolmap")}
    promised = [key for key in read_gates() if key.startswith("bundle/street/")]
    assert done.returncode == int(bool(promised))
    for key in promised:
        assert f"missed   {key}: no method reported this number ({not_installed('pycolmap')})" in done.stdout
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "bundle/street/Ceres" in page
    assert not_installed("pycolmap") in page


def test_a_library_that_does_not_load_states_why(stub, monkeypatch):
    (stub / "open3d.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(str(stub))
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    with pytest.raises(NoReference, match=r"^Open3D does not load: libGL\.so\.1: cannot open"):
        load("open3d")
