"""The package as it is built and installed: checks without building it, and where a run writes."""

import shutil
import sys
import tomllib
from pathlib import Path

import pytest

from thesisrecon.io._images import DEMO_IMAGES, demo_images
from validation.scenes.real import ROOT
from validation.studies.package.built import NEEDED, wheel_faults
from validation.studies.package.environments import (
    Part,
    counted,
    dependencies,
    lowest_versions,
    quick_parts,
    run_part,
    suite_faults,
)
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


def test_every_test_but_those_of_validation_is_in_one_part_of_the_quick_suite():
    asked = [Path(word) for words in quick_parts().values() for word in words if word.startswith("/")]
    found = [file for path in asked for file in ([path] if path.is_file() else path.rglob("test_*.py"))]
    tests = ROOT / "tests"
    assert sorted(found) == sorted(
        p for p in tests.rglob("test_*.py") if tests / "validation" not in p.parents
    )


def test_a_part_is_run_by_the_interpreter_of_its_folder_and_counted(tmp_path):
    interpreter = tmp_path / "bin" / "python"
    interpreter.parent.mkdir()
    interpreter.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n', encoding="utf-8")
    interpreter.chmod(0o755)
    (tmp_path / "test_a.py").write_text("def test_a(): assert 1\ndef test_b(): assert 0\n", encoding="utf-8")
    asked = ["-c", "/dev/null", "--rootdir", str(tmp_path), str(tmp_path / "test_a.py")]
    part = run_part(tmp_path, "some/part", asked)
    assert (part.counts, part.code) == ({"passed": 1, "failed": 1}, 1)
    assert "assert 0" in (tmp_path / "logs" / "some-part.log").read_text(encoding="utf-8")
    assert suite_faults([part]) == ["some/part ended with code 1"]


def test_a_suite_is_well_where_something_passed_and_nothing_broke():
    well = Part("a", counted(["7 passed, 2 skipped, 1 deselected in 3.2s"]), 0, 3.0)
    assert well.counts == {"passed": 7, "skipped": 2}
    empty, crashed = Part("b", {}, 5, 1.0), Part("c", counted(["Segmentation fault"]), -11, 1.0)
    assert suite_faults([well, empty]) == []
    assert suite_faults([empty]) == ["no test ran"]
    assert suite_faults([well, crashed]) == ["c ended with code -11"]


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
