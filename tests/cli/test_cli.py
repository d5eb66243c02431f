"""The command line on the project's own photographs: one whole run, killed once, and what it prints."""

import ast
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.main import get_command

import thesisrecon
from tests.conftest import refuses
from tests.pipeline.fake_stages import kept_bytes, read
from thesisrecon.cli import common
from thesisrecon.cli.commands import app, run_command
from thesisrecon.io import _images

ROOT = Path(__file__).parents[2]
COURTYARD = ROOT / "fixtures" / "courtyard"
VIEWS = 5
SMALL = ["--max-size", "320", "--threads", "2", "--until", "metric"]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Neighbouring views of the courtyard; the folder's name has a space and a letter beyond ASCII."""
    folder = tmp_path_factory.mktemp("cli") / "my phötographs"
    folder.mkdir()
    for path in sorted((COURTYARD / "images").iterdir())[:VIEWS]:
        shutil.copy(path, folder)
    return folder


def command(*arguments):
    return [sys.executable, "-m", "thesisrecon", *map(str, arguments)]


@pytest.fixture(scope="module")
def killed_and_resumed(photographs):
    """The output of a run that was killed while it matched and started again; how many pairs were kept."""
    out = photographs.parent / "out"
    arguments = command("reconstruct", photographs, "-o", out, *SMALL)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(arguments, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 300
    while len(list((out / "02-matches").glob("*.npz"))) < 2:
        assert process.poll() is None, "the run ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    kept = len(list((out / "02-matches").glob("*.npz")))
    assert not (out / "summary.json").exists()
    run = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    # No terminal: a line per stage.
    lines = run.stderr.splitlines()
    assert all(re.fullmatch(r"[a-z() -]+: \d+ of \d+, \d+ s", line) for line in lines), run.stderr
    assert f"corners: {VIEWS} of {VIEWS}" in run.stderr
    assert f"{VIEWS} of {VIEWS} images registered" in run.stdout
    return out, kept


def test_a_killed_run_goes_on_and_reconstructs_the_courtyard(killed_and_resumed, capsys):
    out, kept = killed_and_resumed
    assert kept >= 2
    summary = read(out / "summary.json")
    assert run_command(["inspect", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == summary
    assert summary["registered"] == VIEWS
    assert summary["trusted"]
    truth = read(COURTYARD / "cameras.json")
    focal = truth["cameras"][0]["K"][0][0]
    assert summary["cameras"][0]["focal_px"]["value"] == pytest.approx(focal, rel=0.02)
    assert summary["points"] > 300
    assert run_command(["inspect", str(out)]) == 0
    printed = capsys.readouterr().out
    assert f"{VIEWS} of {VIEWS} images registered" in printed
    assert "camera 0: focal length" in printed


def test_a_kill_and_the_number_of_threads_change_no_byte(killed_and_resumed, photographs, tmp_path):
    out, _ = killed_and_resumed
    # A process of its own: the command caps the threads of linear algebra before NumPy is imported.
    arguments = command("reconstruct", photographs, "-o", tmp_path / "out", *SMALL, "--threads", "1")
    subprocess.run(arguments, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True, capture_output=True)
    assert kept_bytes(tmp_path / "out") == kept_bytes(out)


def test_the_preset_of_the_thesis_runs_to_the_end(photographs, tmp_path, capsys):
    out = tmp_path / "out"
    assert run_command(["reconstruct", str(photographs), "-o", str(out), "--preset", "thesis", *SMALL]) == 0
    assert "images registered" in capsys.readouterr().out
    summary = read(out / "summary.json")
    assert summary["registered"] >= 4
    assert summary["registered"] + len(summary["refused"]) == VIEWS


def test_a_run_is_exported_with_the_images_that_it_was_made_from(killed_and_resumed, photographs, tmp_path):
    out, _ = killed_and_resumed
    assert run_command(["export", str(out), "--to", "nerfstudio", "-o", str(tmp_path)]) == 0
    table = read(tmp_path / "transforms.json")
    written = [frame["file_path"] for frame in table["frames"]]
    assert written == [f"images/{path.name}" for path in sorted(photographs.iterdir())]
    assert all((tmp_path / name).is_file() for name in written)
    summary = read(out / "summary.json")
    assert summary["images_folder"] == str(photographs)
    assert table["fl_x"] == pytest.approx(summary["cameras"][0]["focal_px"]["value"])


def test_an_early_end_prints_the_results_of_its_stage(photographs, tmp_path, capsys):
    few, out = tmp_path / "few", tmp_path / "out"
    few.mkdir()
    for path in sorted(photographs.iterdir())[:2]:
        shutil.copy(path, few)
    wanted = {
        "features": r"^\d{3,} corners in 2 images\n",
        "matches": r"^1 of 1 image pair accepted, \d\d+ verified",
    }
    for until, words in wanted.items():
        arguments = ["reconstruct", str(few), "-o", str(out), "--until", until, "--max-size", "320"]
        assert run_command(arguments) == 0
        assert re.match(words, capsys.readouterr().out)
        assert run_command(["inspect", str(out)]) == 0
        assert re.match(words, capsys.readouterr().out)


def test_a_finished_run_is_not_touched_by_another_config_and_its_own_runs_again(
    killed_and_resumed, photographs, refused, capsys
):
    out, _ = killed_and_resumed
    before = (out / "summary.json").read_bytes()
    arguments = ["reconstruct", str(photographs), "-o", str(out)]
    assert "images.max_size_px was 320 and is now 700" in refused([*arguments, "--max-size", "700"])
    assert (out / "summary.json").read_bytes() == before
    own = ["--config", str(out / "config.toml"), "--threads", "2", "--until", "metric"]
    assert run_command([*arguments, *own]) == 0
    assert "registered" in capsys.readouterr().out
    assert set(read(out / "summary.json")["resumed"]) >= {"features", "matches", "tracks", "metric"}


NAMELESS = "the folder has no name"
# Commands with words of the one sentence; "''" is an empty word.
WRONG = [
    ("reconstruct", "give the output folder"), ("rebuild", "rebuild"), ("inspect nowhere", "no summary"),
    ("reconstruct nowhere -o out", "there is no folder nowhere"),
    ("reconstruct . -o out --preset best", "--preset"), ("reconstruct . -o out --cameras two", "--cameras"),
    ("reconstruct . -o out --no-such-option", "--no-such-option"),
    ("reconstruct . -o out --set features.kin=x", "did you mean features.kind"),
    ("reconstruct . -o out --config nowhere.toml", "nowhere.toml cannot be read"),
    ("reconstruct . -o out --until surface", "unknown stage"),
    ("reconstruct . -o out --executor dask://x", "given as dask://HOST:PORT"),
    ("reconstruct . -o out --max-size 5", "at least 64"),
    ("reconstruct . -o out --pairs window:0", "must be at least 1; got 0"),
    ("reconstruct . -o out --pairs window", "takes a whole number"),
    ("reconstruct . -o out --pairs window:--5", "takes a whole number"),
    ("reconstruct . -o out --pairs most", "all, overlap, window:N, or a file"),
    ("reconstruct . -o out --set pairs.kind=some", "unknown kind of pairs"),
    ("reconstruct . -o ''", NAMELESS), ("reconstruct '' -o out", NAMELESS), ("demo -o ' '", NAMELESS),
    ("reconstruct --from '' -o out", NAMELESS), ("reconstruct --from a.db --images '' -o out", NAMELESS),
    ("export . --to colmap --images '' -o out", NAMELESS),
    ("reconstruct -o out", "give the folder of the images, or --from"),
    ("reconstruct a --from b -o out", "with --from the images are given by --images"),
    ("reconstruct a --images b -o out", "give the folder of the images, or --from"),
]  # fmt: skip


@pytest.mark.parametrize(("line", "words"), WRONG)
def test_a_wrong_command_gets_one_sentence_and_exit_2(line, words, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    assert words in refused(shlex.split(line))
    assert list(tmp_path.iterdir()) == []


def test_an_error_in_the_program_is_a_sentence_too(photographs, tmp_path, monkeypatch, refused):
    def fail(*_, **__):
        raise IndexError("index 3 is out of bounds")

    monkeypatch.delenv(common.DEBUG_VARIABLE, raising=False)
    monkeypatch.setattr("thesisrecon.api.reconstruct.reconstruct", fail)
    arguments = ["reconstruct", str(photographs), "-o", str(tmp_path / "out")]
    assert re.search(r"IndexError in test_cli\.py line \d+: index 3 is out", refused(arguments, 1))
    monkeypatch.setenv(common.DEBUG_VARIABLE, "1")
    refuses(IndexError, None, run_command, arguments)


def test_help_and_version(capsys):
    for arguments in (["--version"], [], ["reconstruct", "-h"]):
        assert run_command(arguments) == 0
    printed = capsys.readouterr().out
    for option in ("preset", "cameras", "config", "set", "seed", "threads", "max-size", "until", "executor"):
        assert f"--{option}" in printed


def test_the_demo_without_images_states_the_searched_folder(monkeypatch, tmp_path, refused):
    monkeypatch.setattr(_images, "__file__", str(tmp_path / "thesisrecon" / "io" / "_images.py"))
    assert str(tmp_path / "thesisrecon" / "fixtures") in refused(["demo", "-o", tmp_path / "out"])


def test_a_list_of_pairs_is_read_matched_and_reported(photographs, tmp_path, capsys, refused):
    names = sorted(path.name for path in photographs.iterdir())
    pairs, out = tmp_path / "pairs.txt", tmp_path / "out"
    given = ["reconstruct", photographs, "-o", out, *SMALL, "--until", "matches", "--pairs", pairs]
    wrong = (f"{names[0]} nope.jpg", "'nope.jpg', which is not among"), ("", "leaves no pair")
    pairs.write_text(wrong[0][0], encoding="utf-8")
    assert wrong[0][1] in refused(given)
    # A corrected list needs no --overwrite.
    pairs.write_text(f"{names[1]} {names[0]}\n{names[1]} {names[2]}\n", encoding="utf-8")
    assert run_command([str(word) for word in given]) == 0
    assert "of 2 image pairs accepted (10 are possible)" in capsys.readouterr().out
    found = read(out / "summary.json")["pairs"]
    assert (found["matched"], found["possible"], found["selection"]) == (2, 10, "the listed pairs")
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "2 of 10 pairs were matched: the listed pairs." in page
    for line, words in wrong:
        pairs.write_text(line, encoding="utf-8")
        assert words in refused([*given, "--overwrite"])
    # The run that was there is whole.
    assert read(out / "run.json")["settings"]["pairs"]["listed"][0] == [names[1], names[0]]
    assert (out / "report.html").is_file()


def test_messages_name_only_options_that_exist():
    commands = get_command(app).commands.values()
    options = {option for command in commands for given in command.params for option in given.opts}
    package, texts = Path(thesisrecon.__file__).parent, []
    for path in package.rglob("*.py"):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        texts += [n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    texts.append((package / "messages.toml").read_text(encoding="utf-8"))
    named = {option for text in texts if " " in text for option in re.findall(r"--[a-z][a-z-]+", text)}
    assert len(named) > 10
    of_dask = {"--memory-limit", "--nthreads"}  # of `dask worker`
    assert named <= options | of_dask | {"--help", "--version"}
