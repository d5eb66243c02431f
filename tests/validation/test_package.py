"""The package as it is built and installed: checks without building it, and where a run writes."""

import shutil
import sys
import tomllib

import pytest

from thesisrecon.io._images import DEMO_IMAGES, demo_images
from validation.scenes.real import ROOT
from validation.studies.package.built import NEEDED, wheel_faults
from validation.studies.package.environments import dependencies, lowest_versions, run_suite
from validation.studies.package.installed import Watched, trespasses, watch


def test_the_wheel_carries_the_photographs_of_the_demo():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    laid_in = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    for source, target in laid_in.items():
        assert target == source.replace("fixtures/", "thesisrecon/")
        assert (ROOT / source).is_file()
    photographs = [ROOT / source for source in laid_in if source.endswith(".jpg")]
    assert sorted(photographs) == demo_images()
    assert len(photographs) == DEMO_IMAGES


def test_lowest_versions_are_those_of_the_project_and_need_a_bound():
    assert lowest_versions(["numpy>=1.26", "typer >= 0.18"]) == ["numpy==1.26", "typer==0.18"]
    assert len(lowest_versions(dependencies())) == len(dependencies())
    with pytest.raises(ValueError, match="NAME>=VERSION; got 'scipy'"):
        lowest_versions(["scipy"])


def test_the_suite_is_run_by_the_interpreter_of_its_folder(tmp_path):
    interpreter = tmp_path / "bin" / "python"
    interpreter.parent.mkdir()
    interpreter.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n', encoding="utf-8")
    interpreter.chmod(0o755)
    file = tmp_path / "test_a.py"
    for value, faults in ((1, []), (0, ["pytest ended with code 1"])):
        file.write_text(f"def test_a(): assert {value}\n", encoding="utf-8")
        assert run_suite(tmp_path, ["-c", "/dev/null", "--rootdir", str(tmp_path), str(file)]) == faults


def test_missing_and_foreign_files_of_a_wheel_are_reported():
    photographs = [f"thesisrecon/courtyard/images/{i:04d}.jpg" for i in range(DEMO_IMAGES)]
    good = [*NEEDED, *photographs, "thesisrecon/cli/main.py", "thesisrecon-0.1.0.dist-info/METADATA"]
    assert wheel_faults(good, 1_000_000) == []
    strangers = ["tests/cli/test_cli.py", "thesisrecon/__pycache__/cli.cpython-311.pyc"]
    reported = wheel_faults([*good[1:], *strangers], 9_000_000)
    assert reported[0] == "thesisrecon/py.typed is missing"
    assert reported[1:3] == [f"{name} does not belong there" for name in strangers]
    assert "9.00 MB" in reported[3]
    assert wheel_faults(good[: len(NEEDED)], 1) == [f"0 images instead of {DEMO_IMAGES}"]


def test_a_run_writes_only_into_its_folder_and_opens_no_connection(tmp_path):
    photographs, result = tmp_path / "photographs", tmp_path / "result"
    photographs.mkdir()
    for path in demo_images()[:3]:
        shutil.copy(path, photographs)
    command = ["reconstruct", str(photographs), "-o", str(result), "--max-size", "400"]
    command += ["--set", "dense.max_side=160", "--set", "dense.match_side=160"]
    run = watch(sys.executable, command, tmp_path / "watched", PYTHONPATH=str(ROOT))
    # The cache of kernels stands beside the code where that can be written.
    caches = [path for path in (ROOT / "thesisrecon").rglob("__pycache__") if path.is_dir()]
    assert trespasses(run, result, *caches) == []
    assert result.resolve() / "report.html" in run.written | {p.resolve() for p in result.iterdir()}
    assert len(run.outside(tmp_path / "elsewhere")) > 10


def test_forbidden_actions_of_a_run_are_reported(tmp_path):
    wrong = Watched(
        3, frozenset([tmp_path / "a", tmp_path / "out" / "b"]), ("socket.connect",), ("ls",), (), "no"
    )
    assert trespasses(wrong, tmp_path / "out") == [
        "the run ended with code 3: no",
        f"{tmp_path / 'a'} was written",
        "network call: socket.connect",
        "it started a program: ls",
    ]
