"""The pages of docs/theory: every equation has code with a test, and all that they name exists."""

import importlib
import re
from functools import cache
from pathlib import Path

import pytest

from docs._ext import theory

PAGES = Path(__file__).parents[2] / "docs" / "theory"
SECTIONS = {
    "views": ["1.2", "1.3"],
    "stereo": ["2.5"],
    "surfaces": ["2.6"],
    "geometry": ["3.2", "3.4.2", "3.4.3", "3.4.4", "3.5", "3.6", "3.6.3", "3.6.4"],
    "features": ["4.2.1", "4.2.2"],
    "fundamental-matrix": ["5.2", "5.3", "5.4", "5.5"],
    "bundle-adjustment": ["6.7"],
    "projective": ["6.2", "6.3", "6.3.1", "6.3.2", "6.3.3", "6.4", "6.5", "6.6"],
    "self-calibration": ["7.3"],
}
"""Sections of the thesis that a page must cover."""


@cache
def exists(name):
    """Say whether a dotted name is a module of thesisrecon or an attribute of one."""
    parts = ["thesisrecon", *name.split(".")]
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[cut:]:
            if not hasattr(found, attribute):
                return False
            found = getattr(found, attribute)
        return True
    return False


def test_every_numbered_equation_has_code_with_a_test():
    covered = {r.number for row in theory.rows() if row.tests for r in row.references if r.kind == "equation"}
    wanted = {f"3.{k}" for k in range(1, 43)} | {"4.1"} | {f"5.{k}" for k in range(1, 7)}
    assert wanted - covered == set()


def test_every_section_has_code():
    for page, sections in SECTIONS.items():
        numbers = {r.number for row in theory.table(page) for r in row.references}
        assert [s for s in sections if s not in numbers] == []


def test_rows_name_code_and_tests_that_exist():
    rows = theory.rows()
    assert len(rows) > 150
    assert [row.name for row in rows if not exists(row.name)] == []
    assert [row.name for row in rows if not row.tests and "_" not in row.name] == []
    for file, test in {test for row in rows for test in row.tests}:
        assert re.search(rf"^def {test}\(", (Path(__file__).parents[1] / file).read_text("utf-8"), re.M)


@pytest.mark.parametrize("page", sorted(theory.PAGES))
def test_a_page_has_its_table_and_names_what_exists(page):
    text = (PAGES / f"{page}.md").read_text("utf-8")
    assert f"```{{theory-table}} {page}\n" in text
    assert len(theory.table(page)) >= 5
    named = re.findall(r"\{py:(?:func|class)\}`thesisrecon\.([\w.]+)`", text)
    assert [name for name in named if not exists(name)] == []
    assert all(page in theory.chapters_of(name) for name in named)  # they link back


def test_functions_link_to_the_chapter_of_their_equations():
    assert theory.chapters_of("estimate_fundamental") == ["fundamental-matrix"]
    assert theory.chapters_of("geometry.strata.dual") == ["geometry"]
    assert theory.chapters_of("bundle_adjust") == ["bundle-adjustment"]
    assert theory.chapters_of("load") == []
