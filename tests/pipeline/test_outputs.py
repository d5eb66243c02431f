"""Figures, pages and files of a run that cannot be made: each costs one warning, and the rest is complete."""

import errno
import json
import re
from pathlib import Path

import PIL.Image
import pytest

from tests.conftest import before_each_output, failing, refuses
from tests.pipeline.fake_stages import fake_config, photographs, read
from thesisrecon import errors
from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.cli.commands import run_command
from thesisrecon.errors import NOT_MADE, OutputError, made
from thesisrecon.surface.model import SurfaceModel
from validation.studies.robustness import disk_ends

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard"
ERRORS = {
    "error": ValueError("the left 3x3 part of P is singular"),
    "memory": MemoryError(),
    "disk": OSError(errno.ENOSPC, "No space left on device"),
}
RECORDS = {"cameras.json", "summary.json", "config.toml", "run.json"}


@pytest.fixture(autouse=True)
def _lenient(monkeypatch):
    monkeypatch.delenv(errors.STRICT_VARIABLE)


def run(out):
    """A run to a model that is larger than its limit, so that each kind of output is written."""
    model = SurfaceModel()
    object.__setattr__(model, "max_glb_mb", 0.003)
    return reconstruct(photographs(4), out, config=fake_config(model=model), threads=1)


def files(out):
    """The files of a run beside the results of its stages, those of the model by their folder."""
    names = [str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()]
    return {re.sub(r"^sparse/0/.*", "sparse/0", name) for name in names if not name[0].isdigit()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The names of all outputs that a run makes, its files and the elements of its page."""
    out, names = tmp_path_factory.mktemp("whole") / "out", []
    with pytest.MonkeyPatch.context() as patch:
        before_each_output(patch, names.append)
        result = run(out)
    assert not [text for text in result.warnings if NOT_MADE in text]
    return list(dict.fromkeys(names)), files(out), elements(out)


def elements(out):
    """The figures and pictures of the page by their sections."""
    text = (out / "report.html").read_text(encoding="utf-8")
    return re.findall(r'<section id="(\w+)"|id="(\w+-figure)"|(<img)', text)


@pytest.mark.parametrize("error", ERRORS)
def test_each_output_that_fails_costs_one_warning(whole, tmp_path, monkeypatch, error):
    names, there, drawn = whole
    assert {"report.html", "points.ply", "sparse/0", "model.glb", "model-full.glb"} < set(names)
    assert len(names) >= 15
    assert there >= RECORDS
    for k, what in enumerate(names):
        out = tmp_path / str(k)
        with monkeypatch.context() as patch:
            before_each_output(patch, failing(what, ERRORS[error]))
            result = run(out)
        (warning,) = [text for text in result.warnings if text.startswith(NOT_MADE)]
        assert warning.startswith(f"{NOT_MADE}: {what} (")
        assert str(ERRORS[error]) in warning
        assert result.summary["warnings"] == list(result.warnings)
        if what != "summary.json":
            assert warning in read(out / "summary.json")["warnings"]
        assert len(result.cameras) == 4
        lost = there - files(out)
        dependent = {"model-full.glb"} if what == "model.glb" else set()
        assert lost <= {what} | dependent
        if what == "report.html":
            continue
        page = (out / "report.html").read_text(encoding="utf-8")
        assert NOT_MADE in page or what == "summary.json"
        sections = {section for section, _, _ in drawn} - {"model", "depth"}
        assert sections <= {section for section, _, _ in elements(out)}
        if "report.html" not in what:
            assert len(elements(out)) >= len(drawn) - 1


def test_several_outputs_that_fail_are_all_reported(whole, tmp_path, monkeypatch):
    names, *_ = whole

    def make(_):
        raise MemoryError

    before_each_output(monkeypatch, make)
    result = run(tmp_path / "out")
    assert len(result.cameras) == 4
    assert files(tmp_path / "out") >= RECORDS
    reported = {text.split(": ")[1].split(" (")[0] for text in result.warnings if NOT_MADE in text}
    assert {"points.ply", "sparse/0", "model.glb", "report.html", "summary.json"} <= reported <= set(names)


def test_an_interrupt_ends_the_run(whole, tmp_path, monkeypatch):
    for k, what in enumerate(whole[0]):
        with monkeypatch.context() as patch:
            before_each_output(patch, failing(what, KeyboardInterrupt()))
            refuses(KeyboardInterrupt, None, run, tmp_path / str(k))


def test_the_disk_is_full_once_the_summary_is_there(tmp_path):
    with disk_ends(0, 0) as written:
        run(tmp_path / "whole")
    refused, summary_there = 0, 0
    for first in range(1, written[0] + 1, 3):
        out = tmp_path / str(first)
        with disk_ends(first, errno.ENOSPC):
            try:
                result = run(out)
            except OutputError:
                assert not (out / "summary.json").exists() or not (out / "config.toml").exists()
                refused += 1
                continue
        summary_there += 1
        assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["registered"] == 4
        assert len(result.cameras) == 4
        assert any("free space there" in text for text in result.warnings if NOT_MADE in text)
        assert {*map(str, result.summary["warnings"])} == {*result.warnings}
    assert refused > 2
    assert summary_there > 2


@pytest.mark.parametrize("error", ERRORS)
def test_the_command_prints_a_warning_and_ends_well(error, tmp_path, monkeypatch, capsys):
    (tmp_path / "in").mkdir()
    for image in photographs(2):
        PIL.Image.fromarray(image.rgb).save(tmp_path / "in" / image.name)
    command = ["reconstruct", str(tmp_path / "in"), "--until", "features", "-o", str(tmp_path / "out")]
    names = []
    with monkeypatch.context() as patch:
        before_each_output(patch, names.append)
        assert run_command(command) == 0
    assert names
    for what in names:
        capsys.readouterr()
        with monkeypatch.context() as patch:
            before_each_output(patch, failing(what, ERRORS[error]))
            assert run_command(command) == 0
        said = capsys.readouterr().out
        assert said.count(f"warning: {NOT_MADE}: {what} (") == said.count("warning:") == 1


def test_outputs_of_one_name_are_one_warning_and_a_refusal_is_none(monkeypatch):
    def fail(error):
        def make():
            raise error

        return make

    found, small = [], fail(ValueError("too\nsmall"))
    assert [made("a thumbnail", small, found, k) for k in range(3)] == [0, 1, 2]
    assert len(found) == 1
    assert "(ValueError: too small)" in found[0]
    assert made("a thumbnail", lambda: 7, found, 0) == 7
    refusal = errors.UsageError("it was changed by another program")
    refuses(errors.UsageError, "another program", made, "a", fail(refusal), [], None)
    monkeypatch.setenv(errors.STRICT_VARIABLE, "1")
    refuses(ValueError, "small", made, "a", small, [], None)
