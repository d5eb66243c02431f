"""The documentation site: pages for every exported name, an example on each, every command and setting."""

import importlib
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import thesisrecon
from thesisrecon.config import KINDS

DOCS = Path(__file__).parent.parent / "docs"
EXPORTED = sorted(set(thesisrecon.__all__) - {"__version__"})


@pytest.fixture(scope="module")
def site():
    """The modules that make pages; those that need Sphinx are imported where it is installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        yield lambda name: importlib.import_module(f"_site.{name}")
    for name in [name for name in sys.modules if name.split(".")[0] == "_site"]:
        del sys.modules[name]


def test_every_exported_name_has_a_page_with_an_example(site):
    listed = re.findall(r"^   (\w+)$", (DOCS / "reference" / "api.md").read_text("utf-8"), re.M)
    assert sorted(listed) == EXPORTED
    borrowed = site("examples").RETURNED_BY
    own = {name for name in EXPORTED if ">>>" in (getattr(thesisrecon, name).__doc__ or "")}
    assert own | set(borrowed) == set(EXPORTED)
    assert not own & set(borrowed)
    assert set(borrowed.values()) <= own


def test_the_pages_of_commands_and_settings_name_all_of_them(site):
    interface = site("interface")
    commands, settings = interface.command_page(), interface.settings_page()
    for command, option in (("reconstruct", "--from"), ("export", "--to"), ("interpolate", "--frames")):
        assert re.search(rf"^## {command}$.*?`{option}`", commands, re.M | re.S)
    for stage, kinds in KINDS.items():
        assert f"## {stage}\n" in settings
        assert all(f"`{stage}.kind={word}`" in settings for word in kinds)
    rows = re.findall(r"^\| (`.*)", settings, re.M)
    assert len(rows) > 100
    assert [row for row in rows if row.rstrip().endswith("|  |")] == []


def test_the_page_of_failures_has_a_remedy_for_each_message_of_the_code(site):
    failures = site("failures")
    known = failures.remedies()
    found = {text for texts in failures.messages().values() for text in texts}
    assert found == set(known) - {"failures", "parts"}
    # Messages are sorted: a remedy cannot refer to the one above it.
    assert not re.search("as above", " ".join(known[text] for text in found), re.I)
    of_stages = [row for rows in failures.stage_failures().values() for row in rows]
    assert len(of_stages) > 60
    without = {reason for reason, _, advice in of_stages if not re.search(r"\w", advice)}
    assert without == set(known["failures"])
    page = failures.page()
    assert all(f"| {reason} |" in page for reason, _, _ in of_stages)
    # A file that makes warnings is read, or known to pass them on.
    read = {file for files in failures.SOURCES.values() for file in files}
    assert failures.warning_sinks() <= read | failures.PASSED_ON
    # So is one that sets the reason why an image has no camera.
    assert {"projective/incremental.py", "metric/_resection.py"} <= failures.reason_sinks() <= read


def block(page, number=0):
    """One Python block of a page."""
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text("utf-8"), re.S)[number]


def test_the_example_of_the_conventions_runs():
    exec(compile(block("reference/conventions.md"), "conventions.md", "exec"), {})


def test_points_are_undistorted_as_the_page_of_exports_shows(monkeypatch):
    K = np.array([[800.0, 0.0, 319.5], [0.0, 800.0, 239.5], [0.0, 0.0, 1.0]])
    camera = thesisrecon.Camera(K, np.eye(3), np.ones(3), (640, 480), distortion=(0.1, 0.0, 0.0))
    monkeypatch.setattr(thesisrecon, "load", lambda _: SimpleNamespace(cameras={"0000.jpg": camera}))
    names = {}
    exec(compile(block("recipes/export.md", 1), "export.md", "exec"), names)
    back = camera.project(names["pinhole"].unproject(names["undistorted"], np.ones(2)))
    assert np.allclose(back, names["xy"])
    assert np.abs(names["undistorted"] - names["xy"]).max() > 1.0


@pytest.mark.slow
def test_the_first_reconstruction_runs_as_it_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fixtures").symlink_to(DOCS.parent / "fixtures")
    names = {}
    exec(compile(block("start/first-reconstruction.md"), "first-reconstruction.md", "exec"), names)
    assert names["result"].summary["trusted"]
    assert names["camera"].K[0, 0] == pytest.approx(908.6, rel=2e-3)
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"report.html", "cameras.json", "sparse"}
