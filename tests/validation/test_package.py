"""The package as it is built and installed: what can be told without building it, and where a run writes."""

from __future__ import annotations

import shutil
import sys
import tomllib
from pathlib import Path

import pytest

from thesisrecon.io.demo import COUNT, demo_photographs
from validation.checks.package.built import NEEDED, wheel_faults
from validation.checks.package.environments import dependencies, lowest_versions
from validation.checks.package.quiet import Watched, trespasses, watch
from validation.scenes.real import ROOT


def test_the_wheel_carries_the_photographs_of_the_demo() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    laid_in = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    for source, target in laid_in.items():
        assert target == source.replace("fixtures/", "thesisrecon/")
        assert (ROOT / source).is_file()
    photographs = [ROOT / source for source in laid_in if source.endswith(".jpg")]
    assert sorted(photographs) == demo_photographs()
    assert len(photographs) == COUNT


def test_lowest_versions_are_those_of_the_project_and_need_a_bound() -> None:
    assert lowest_versions(["numpy>=1.26", "typer >= 0.18"]) == ["numpy==1.26", "typer==0.18"]
    assert len(lowest_versions(dependencies())) == len(dependencies())
    with pytest.raises(ValueError, match="NAME>=VERSION; got 'scipy'"):
        lowest_versions(["scipy"])


def test_what_is_missing_or_does_not_belong_in_a_wheel_is_told() -> None:
    photographs = [f"thesisrecon/courtyard/images/{i:04d}.jpg" for i in range(COUNT)]
    good = [*NEEDED, *photographs, "thesisrecon/cli.py", "thesisrecon-0.1.0.dist-info/METADATA"]
    assert wheel_faults(good, 1_000_000) == []
    strangers = ["tests/test_cli.py", "thesisrecon/__pycache__/cli.cpython-311.pyc"]
    told = wheel_faults([*good[1:], *strangers], 9_000_000)
    assert told[0] == "thesisrecon/py.typed is missing"
    assert told[1:3] == [f"{name} does not belong there" for name in strangers]
    assert "9.00 MB" in told[3]
    assert wheel_faults(good[: len(NEEDED)], 1) == [f"0 photographs instead of {COUNT}"]


def test_a_run_writes_into_its_folder_alone_and_speaks_to_nobody(tmp_path: Path) -> None:
    photographs, result = tmp_path / "photographs", tmp_path / "result"
    photographs.mkdir()
    for path in demo_photographs()[:3]:
        shutil.copy(path, photographs)
    command = ["reconstruct", str(photographs), "-o", str(result), "--max-size", "400"]
    command += ["--set", "dense.max_side=160", "--set", "dense.match_side=160"]
    run = watch(sys.executable, command, tmp_path / "watched", PYTHONPATH=str(ROOT))
    # The cache of kernels stands beside the code where that can be written.
    caches = [path for path in (ROOT / "thesisrecon").rglob("__pycache__") if path.is_dir()]
    assert trespasses(run, result, *caches) == []
    assert result.resolve() / "report.html" in run.written | {p.resolve() for p in result.iterdir()}
    assert len(run.outside(tmp_path / "elsewhere")) > 10


def test_what_a_run_should_not_have_done_is_told(tmp_path: Path) -> None:
    wrong = Watched(
        3, frozenset([tmp_path / "a", tmp_path / "out" / "b"]), ("socket.connect",), ("ls",), (), "no"
    )
    assert trespasses(wrong, tmp_path / "out") == [
        "the run ended with code 3: no",
        f"{tmp_path / 'a'} was written",
        "it spoke: socket.connect",
        "it started a program: ls",
    ]
