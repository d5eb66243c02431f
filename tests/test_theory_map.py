"""docs/theory-map.md names only code and tests that exist, and every numbered equation of its chapters."""

import ast
import importlib
import re
from functools import cache
from pathlib import Path

TESTS = Path(__file__).parent
TEXT = (TESTS.parent / "docs" / "theory-map.md").read_text(encoding="utf-8")
ROWS = [[cell.strip() for cell in line.split("|")[1:-1]] for line in TEXT.splitlines() if "`" in line]
ROWS = [cells for cells in ROWS if len(cells) == 4]
NAMES = sorted(
    {name for cells in ROWS for name in re.findall(r"`([a-z_0-9.]+[A-Za-z_0-9]+)`", "".join(cells))}
)
CODE = [name for name in NAMES if "/" not in name and not name.endswith(".py")]
NAMED_TESTS = sorted({name for cells in ROWS for name in re.findall(r"`([^`]+\.py[^`]*)`", cells[3])})


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


@cache
def functions_of(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_all_named_code_exists():
    assert [name for name in CODE if not exists(name)] == []


def test_all_named_tests_exist():
    missing = []
    for name in NAMED_TESTS:
        file, _, function = name.partition("::")
        if not (TESTS / file).is_file() or (function and function not in functions_of(TESTS / file)):
            missing.append(name)
    assert missing == []


def test_every_row_names_code_and_every_equation_has_a_row():
    assert len(CODE) > 80
    assert len(NAMED_TESTS) > 50
    assert all("`" in cells[2] or "`" in cells[3] for cells in ROWS)
    covered = set()
    for cells in ROWS:
        numbers = [(int(a), int(b)) for a, b in re.findall(r"\((\d)\.(\d+)\)", cells[0])]
        covered.update(numbers)
        if " - " in cells[0] and len(numbers) == 2:
            covered.update((numbers[0][0], k) for k in range(numbers[0][1], numbers[1][1]))
    assert covered >= {(3, k) for k in range(1, 43)} | {(5, k) for k in range(1, 7)}
