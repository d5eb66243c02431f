"""Equations as MathML with a mathematical font beside the pages: neither scripts nor the network are needed.

A displayed formula may hold ``\\tag{...}``: its number in the thesis or in Hartley and Zisserman.
"""

from __future__ import annotations

import importlib.resources
import re
import shutil
from html import escape
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.errors import SphinxError

FONT = "STIXTwoMath-Regular.ttf"
TAG = re.compile(r"\\tag\*?\{([^{}]*)\}")
ALIGN = re.compile(r"\\(begin|end)\{(align|equation|gather)\}")
PRIMED = re.compile(r"('+)\^(\{[^{}]*\}|\\[A-Za-z]+|[^\\{}\s])")
"""A prime with a superscript, which TeX joins."""
ARG = re.compile(r"\\(arg|sgn|rank|diag)(?![A-Za-z])")


def mathml(latex: str, display: str, where: str) -> str:
    """Convert one formula, or fail with its place and text."""
    text = PRIMED.sub(lambda m: "^{" + r"\prime " * len(m[1]) + m[2] + "}", latex)
    text = ALIGN.sub(r"\\\1{\2*}", ARG.sub(r"\\operatorname{\1}", text))
    try:
        found = convert(text, display=display)
    except Exception as error:
        raise SphinxError(f"{where}: this formula cannot be converted: {latex!r}: {error!r}") from error
    unknown = re.search(r"\\[A-Za-z]+", found)
    if unknown:
        raise SphinxError(f"{where}: {unknown[0]} has no MathML here, in the formula {latex!r}")
    return found


def place(node: nodes.Node) -> str:
    """Return file and line of a formula."""
    return f"{node.source or (node.document and node.document.get('source'))}:{node.line or '?'}"


def visit_inline(self, node):
    """Write a formula within a line."""
    self.body.append(mathml(node.astext(), "inline", place(node)))
    raise nodes.SkipNode


def visit_block(self, node):
    """Write a displayed formula, its number at the right."""
    latex = node.astext()
    tags = TAG.findall(latex)
    number = f'<span class="eqno">({escape(", ".join(tags))})</span>' if tags else ""
    for name in node.get("ids", ()):
        self.body.append(f'<span id="{name}"></span>')
    self.body.append('<div class="math-block">')
    self.body.append(mathml(TAG.sub("", latex).strip(), "block", place(node)))
    self.body.append(f"{number}</div>\n")
    raise nodes.SkipNode


def copy_font(app, error) -> None:
    """Put the font that the package ziamath brings beside the style sheet."""
    if error is None and app.builder.format == "html":
        with importlib.resources.as_file(importlib.resources.files("ziamath.fonts") / FONT) as font:
            shutil.copy(font, Path(app.outdir) / "_static" / FONT)


def setup(app):
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    app.connect("build-finished", copy_font)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
