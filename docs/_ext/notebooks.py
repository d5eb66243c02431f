"""Notebooks of the tutorial: those of sphinx-gallery, in Markdown that Jupyter and VS Code show."""

import copy
import json
import re
from pathlib import Path

NEEDS = "*This notebook needs the packages `thesisrecon` and `matplotlib`; data come with `thesisrecon`.*"


def tidy(text):
    """Markdown without roles and environments of LaTeX that are left by sphinx-gallery."""
    text = re.sub(r":\w+:`([^`<]+?)\s*(?:<[^>]*>)?`", r"*\1*", text)
    text = re.sub(r"\\begin\{align\}(.*?)\\end\{align\}", _displayed, text, flags=re.S)
    return re.sub(r"(?<!`)``(?!`)", "`", text).strip()


def _displayed(found):
    # Markdown takes lines that are indented for code.
    return "$$" + " ".join(found[1].split()) + "$$"


def rewrite(notebook):
    """The notebook with tidy texts; the first one says what it needs."""
    for cell in notebook["cells"]:
        if cell["cell_type"] == "markdown":
            cell["source"] = [tidy("".join(cell["source"]))]
    notebook["cells"][0]["source"].append(f"\n\n{NEEDS}")
    return notebook


def notebook_of(script):
    """The notebook of a script as the site offers it."""
    from sphinx_gallery.gen_gallery import DEFAULT_GALLERY_CONF
    from sphinx_gallery.notebook import jupyter_notebook
    from sphinx_gallery.py_source_parser import split_code_and_text_blocks

    _, blocks = split_code_and_text_blocks(script)
    return rewrite(jupyter_notebook(blocks, copy.deepcopy(DEFAULT_GALLERY_CONF), Path(script).parent))


def _rewrite_all(app):
    for script in (Path(app.srcdir).parent / "examples").glob("*.py"):
        place = Path(app.srcdir) / "tutorial" / f"{script.stem}.ipynb"
        place.write_text(json.dumps(notebook_of(script), indent=1), encoding="utf-8")


def setup(app):
    # Sphinx-gallery writes its notebooks when the builder is made.
    app.connect("builder-inited", _rewrite_all, priority=900)
    return {"parallel_read_safe": True}
