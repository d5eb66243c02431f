"""Runs whose disk fills or is taken from them: a sentence, nothing half written, and the same bytes later."""

import errno
import os
import shutil

import pytest

from tests.fake_stages import fake_config, photographs
from thesisrecon.cli.main import run_command
from thesisrecon.errors import OutputError
from thesisrecon.pipeline.reconstruction import reconstruct
from validation.studies.full_disk import Refusal, SmallRuns, disk_ends, filled, refused_at, table
from validation.studies.kill_anywhere import different, outputs


def run(out, **options):
    reconstruct(photographs(3), out, config=fake_config(), threads=1, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The outputs of a run to the model, and how many files it wrote."""
    out = tmp_path_factory.mktemp("whole") / "out"
    with disk_ends(0, 0) as written:
        run(out)
    return outputs(out), written[0]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.55, 0.7, 0.85, 1.0])
def test_a_run_whose_disk_is_full_goes_on_with_room(share, whole, tmp_path):
    wanted, count = whole
    out = tmp_path / "out"
    with disk_ends(1 + round(share * (count - 1)), errno.ENOSPC), pytest.raises(OutputError) as refused:
        run(out)
    assert str(refused.value).endswith(
        "cannot be written: No space left on device; make room there, then the same command goes on from "
        f"what is kept in {out}"
    )
    there = outputs(out)
    assert {name: wanted.get(name) for name in there} == there
    run(out)
    assert different(outputs(out), wanted) == ()


def test_a_file_in_the_place_of_a_folder_of_the_run(whole, tmp_path):
    out = tmp_path / "out"
    run(out, until="features")
    (out / "02-matches").write_text("of nobody")
    with pytest.raises(OutputError, match=r"02-matches.* move away the file that stands where a folder"):
        run(out)
    (out / "02-matches").unlink()
    run(out)
    assert different(outputs(out), whole[0]) == ()


def test_the_results_of_a_whole_run_stay_until_they_are_replaced(whole, tmp_path):
    """Written anew over a full disk, no good file is lost or cut."""
    out = tmp_path / "out"
    run(out)
    shutil.rmtree(out / "08-model")
    with disk_ends(1, errno.ENOSPC), pytest.raises(OutputError):
        run(out)
    there = outputs(out)
    assert {name: whole[0].get(name) for name in there} == there
    assert "model.glb" in there
    run(out)
    assert different(outputs(out), whole[0]) == ()


def test_the_command_says_it_in_a_sentence(tmp_path, monkeypatch, capsys):
    """On a small disk where one can be mounted, else one that is full by decree."""
    runs = SmallRuns(tmp_path, 2, 128, "features")
    wanted = runs.whole(tmp_path / "whole")
    try:
        refusal = filled(runs, 0.5, wanted)
    except PermissionError:
        refusal = refused_at(runs, 3, errno.ENOSPC, wanted)
    assert refusal.wrong == ""
    assert "No space left on device; make room there" in refusal.said

    def compile_kernels(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device", "kernels/index.nbi")

    monkeypatch.setattr("thesisrecon.pipeline.reconstruction.reconstruct", compile_kernels)
    assert run_command(["reconstruct", str(runs.images), "-o", str(tmp_path / "other")]) == 2
    said = capsys.readouterr().err
    assert said == (
        "thesisrecon: kernels/index.nbi cannot be written: No space left on device; make room there\n"
    )


def test_the_check_names_what_is_wrong():
    said = "thesisrecon: a cannot be written: no; make room there, then the same command goes on\n"
    well = Refusal("file 1: No space left on device", 2, said, (), ())
    bad = Refusal("a disk of 3 KiB", 1, "Traceback\nOSError\n", ("points.ply",), ("model.glb",))
    assert well.wrong == ""
    assert bad.wrong == (
        "exit code 1; not one sentence; names no place; does not say what to do; strange files: points.ply; "
        "differs: model.glb"
    )
    assert table([well]).splitlines()[2:] == [f"| {well.when} | 2 | {said.strip()} | nothing |"]
    assert os.strerror(errno.ENOSPC) in well.when
