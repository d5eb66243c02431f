"""The directive ``theory-table PAGE``, and links from the reference to the chapters of the theory."""

from __future__ import annotations

import re

from docutils import nodes
from sphinx.roles import XRefRole
from sphinx.util.docutils import SphinxDirective

from _ext import theory


class CodeRole(XRefRole):
    """A link to the reference, plain text for code that has no page there."""

    def process_link(self, _env, refnode, _explicit, title, target):
        refnode.attributes |= {"refdomain": "py", "reftype": "obj", "theory": True}
        return title, target


def plain_code(_app, _env, node, contnode):
    """Leave the text of internal names without a link."""
    return contnode if node.get("theory") else None


class TheoryTable(SphinxDirective):
    """The table of a chapter: where in the thesis, which code, what it does, which tests show it.

    Two columns, so that it fits a narrow page. The content is for readers of the file alone: it is not shown.
    """

    required_arguments, has_content = 1, True

    def run(self):
        lines = ["| thesis | code, and the tests that show it |", "| --- | --- |"]
        for row in theory.table(self.arguments[0]):
            places = ", ".join(reference.label for reference in row.references)
            places += "".join(f"; HZ {one}" for one in row.hartley_zisserman)
            module, _, leaf = row.name.rpartition(".")
            target = leaf if theory.exported().get(leaf) == module else row.name
            tests = "; ".join(f"{words(test)} ({file.removesuffix('.py')})" for file, test in row.tests)
            summary, tests = (
                re.sub(r"([|*\\_<>\[\]`$])", r"\\\1", t.replace("``", "")) for t in (row.summary, tests)
            )
            code = f"{{code-ref}}`{leaf} <thesisrecon.{target}>` ({module.replace('_', chr(92) + '_')})"
            lines.append(f"| {places} | {code}: {summary} *Tests:* {tests}. |")
        return [nodes.container("", *self.parse_text_to_nodes("\n".join(lines)), classes=["theory-table"])]


def words(test: str) -> str:
    """The name of a test as a sentence, without the number of its equation."""
    name = re.sub(r"^test_((\d_)+(\d+_)*(to_|and_)?)*", "", test)
    return name.removeprefix("test_").replace("_", " ")


def link_to_chapter(_app, what, name, _obj, _options, lines):
    """Add the chapters that the docstring of a function or class refers to, or that link to it."""
    pages = theory.chapters_of(name.removeprefix("thesisrecon.")) if what in ("function", "class") else []
    links = ", ".join(f":doc:`/theory/{page}`" for page in pages)
    if links:
        lines += ["", ".. rubric:: Theory", "", links, ""]


def setup(app):
    """Register the directive, the role and the links."""
    app.add_directive("theory-table", TheoryTable)
    app.add_role("code-ref", CodeRole())
    app.connect("missing-reference", plain_code)
    # After numpydoc.
    app.connect("autodoc-process-docstring", link_to_chapter, priority=900)
    return {"parallel_read_safe": True}
