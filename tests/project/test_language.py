"""The words of messages, docstrings, comments and guides are plain English."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "fixtures" / "README.md"]
FOLDERS = ("thesisrecon", "tests", "validation", "benchmarks")
FILES += [p for folder in FOLDERS for p in (ROOT / folder).rglob("*.py")]
FILES += [*(ROOT / "validation").rglob("*.toml"), *(p for p in (ROOT / "scripts").iterdir() if p.is_file())]
FILES = sorted(set(FILES) - {Path(__file__)})
ODD_WORDS = re.compile(
    r"(?<![\w/-])(told|tells? of|wish(es|ed)?|whoever|anew|mend(s|ed|ing)?|feign(s|ed)?|betrays?"
    r"|believes?|hears?|as far as)(?![\w-])"
    r"|(?:^|[,;:.]\s+)of which\b"
    # No sentence begins with a clause such as "What the data do not fix is ...".
    r"|(?:^|[.?!]\s+)(?-i:What)(?!\s+(is|are|does|do|can|to|happens)\b)[^.?!\n]*\b(is|are)\b",
    re.IGNORECASE | re.MULTILINE,
)
"""Words and sentences that readers of the field would not use."""


def strings_of(text):
    """Yield all strings with spaces (messages and docstrings) and comments of a module, with their lines."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value
    for number, line in enumerate(text.splitlines(), 1):
        for piece in line.split("#")[1:]:  # a comment, or a part of a string, which is searched twice
            yield number, piece.lstrip()


def offenders(path):
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py" or text.startswith("#!/usr/bin/env python"):
        pieces = strings_of(text)
    else:
        pieces = [(1, re.sub(r"(?s)```.*?```|`[^`\n]*`", "", text) if path.suffix == ".md" else text)]
    found = []
    for first, piece in pieces:
        for match in ODD_WORDS.finditer(piece):
            line = first + piece.count("\n", 0, match.start())
            found.append(f"{path.relative_to(ROOT)}:{line}: {' '.join(match[0].split())}")
    return found


def test_strings_comments_and_guides_are_plain_english():
    assert [found for path in FILES for found in offenders(path)] == []


def test_the_rule_finds_odd_sentences():
    assert ODD_WORDS.search("What no camera sees is left out.")
    assert ODD_WORDS.search("It is told what to do.")
    assert not ODD_WORDS.search("What is a view? Two views, one of which is recommended.")


if __name__ == "__main__":
    for path in FILES:
        print("".join(f"{line}\n" for line in offenders(path)), end="")
