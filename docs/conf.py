"""Sphinx configuration; `scripts/docs` builds the site. Warnings are errors.

Set DOCS_GALLERY=0 to build without running the examples of the tutorial.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path[:0] = [str(DOCS), str(ROOT)]
# Several processes share two cores; a thread pool under each would only get in their way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "agg")

import thesisrecon  # noqa: E402

project = "thesisrecon"
author = "the thesisrecon authors"
copyright = ""
release = version = thesisrecon.__version__
extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_gallery.gen_gallery",
    "_ext.mathml",
    "_ext.failures",
    "_ext.interface",
    "_ext.ablations",
    "_ext.modules",
    "_ext.notebooks",
    "_ext.theory_tables",
    "_ext.pictures",
]
exclude_patterns = ["_build", "_ext", "**/GALLERY_HEADER.*", "tutorial/*.ipynb", "tutorial/*.py"]
nitpicky = True
highlight_language = "none"  # blocks of Python say so
smartquotes = False  # x2' is the transpose of x2
templates_path = ["_ext/templates"]

myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
html_math_renderer = "mathml"

autosummary_generate = True
autosummary_imported_members = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"
add_module_names = False
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_theme = "furo"
html_title = "thesisrecon"
html_static_path = ["_ext/static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
html_theme_options = {
    # The system's fonts: pages open from disk and load nothing from the network.
    "light_css_variables": {
        "font-stack": "system-ui, sans-serif",
        "font-stack--monospace": "ui-monospace, monospace",
    }
}
pygments_style = "friendly"
pygments_dark_style = "monokai"

sphinx_gallery_conf = {
    "examples_dirs": str(ROOT / "examples"),
    "gallery_dirs": "tutorial",
    "filename_pattern": r"\.py$",
    "ignore_pattern": r"/_[^/]*\.py$",
    "within_subsection_order": "FileNameSortKey",
    "plot_gallery": os.environ.get("DOCS_GALLERY", "1") != "0",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "write_computation_times": False,
    "remove_config_comments": True,
    "capture_repr": (),
    "min_reported_time": 1,
    "doc_module": ("thesisrecon",),
    "backreferences_dir": "tutorial/uses",
    "reference_url": {"thesisrecon": None},
    "inspect_global_variables": False,
    "image_scrapers": ("matplotlib",),
}
# Sphinx cannot pickle the configuration of the gallery; the build is complete each time.
suppress_warnings = ["config.cache"]
