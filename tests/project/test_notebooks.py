"""The notebooks of the tutorial run with the built package alone, without a clone."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted((ROOT / "examples").glob("[0-9]*.py"))
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A folder with what the wheel installs."""
    place = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(place), str(ROOT)]
    subprocess.run(build, check=True)
    (wheel,) = place.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(place / "installed")
    compiled = Path("thesisrecon", "__pycache__", "kernels")
    (place / "installed" / compiled).parent.mkdir()
    (place / "installed" / compiled).symlink_to(ROOT / compiled)
    return place / "installed"


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_notebook_runs_with_the_wheel(script, package, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="the extra dev")
    nbformat = pytest.importorskip("nbformat", reason="the extra dev")
    pytest.importorskip("ipykernel", reason="the extra dev")
    pytest.importorskip("sphinx_gallery", reason="the extra docs")
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from _ext.notebooks import notebook_of

    book = nbformat.reads(json.dumps(notebook_of(script)), as_version=4)
    texts = "".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    assert not [mark for mark in (":term:", ":class:", ":doc:", ".. ", "``", "{align}") if mark in texts]
    book.cells.append(nbformat.v4.new_code_cell("thesisrecon.__file__"))
    monkeypatch.setitem(os.environ, "PYTHONPATH", str(package))
    monkeypatch.chdir(tmp_path)
    nbclient.NotebookClient(book, timeout=600, kernel_name="python3").execute()
    outputs = [out for cell in book.cells if cell.cell_type == "code" for out in cell.outputs]
    assert [out["text"] for out in outputs if out.get("name") == "stderr"] == []
    assert any("image/png" in out.get("data", ()) for out in outputs)
    assert str(package) in outputs[-1]["data"]["text/plain"]
