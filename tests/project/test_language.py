"""The words of messages, docstrings, comments and guides are plain English."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = [p for folder in ("docs", "fixtures") for p in (ROOT / folder).rglob("*.md")]
FILES += [p for p in (ROOT / "scripts").iterdir() if p.is_file()]
FILES += [p for folder in ("tests", "benchmarks") for p in (ROOT / folder).rglob("*.py")]
FILES += [
    p for f in ("thesisrecon", "validation") for p in (ROOT / f).rglob("*") if p.suffix in (".py", ".toml")
]
FILES = sorted({p for p in (*FILES, ROOT / "README.md") if p.is_file()} - {Path(__file__)})
ODD_WORDS = re.compile(
    r"(?<![\w/`-])(told|tells? of|wish(es|ed)?|whoever|anew|mend(s|ed|ing)?|feign(s|ed)?|betrays?"
    r"|believes?|hears|as far as)(?![\w`(-]|\.\w|\s*\+?= | or \[)|[,;:.]\s+of which\b|#\s*of which\b",
    re.IGNORECASE,
)
"""Words that readers of the field would not use."""


def test_strings_comments_and_guides_are_plain_english():
    lines = ((p, n, line) for p in FILES for n, line in enumerate(p.read_text("utf-8").splitlines(), 1))
    found = [(p.relative_to(ROOT), n, match[0]) for p, n, line in lines for match in ODD_WORDS.finditer(line)]
    assert [f"{path}:{n}: {word}" for path, n, word in found] == []
