"""Options that messages name are accepted by the commands that print them."""

import ast
import re
from pathlib import Path

import pytest
from typer.main import get_command

import thesisrecon
from thesisrecon.cli.main import app

PACKAGE = Path(thesisrecon.__file__).parent
WRITERS = ("reconstruct", "demo", "compare", "render", "interpolate", "export")
COMMANDS = {
    "api/models.py": ("export",), "api/export.py": ("export",), "io/_images.py": ("export",),
    "cli/results.py compare": ("compare",), "cli/results.py export": ("export",),
    "cli/runs.py": ("reconstruct",), "cli/results.py _size": ("render",),
    "cli/results.py _color": ("render",), "cli/results.py interpolate": ("interpolate",),
    "api/reconstruct.py": ("reconstruct",), "io/_outputs.py": WRITERS, "runtime/_run_folder.py": WRITERS,
    "runtime/_executors.py": ("reconstruct",), "cli/view_files.py": ("reconstruct",),
}  # fmt: skip
"""Commands that print the messages of a file or function, unless the message names its command."""
OPTION = re.compile(r"--[a-z][a-z-]+")


def accepted():
    """Options of each command."""
    commands = get_command(app).commands
    return {name: {o for p in command.params for o in p.opts} for name, command in commands.items()}


def messages():
    """(file, function, text) of the texts with options in errors and in constants of advice, without help."""
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE).as_posix()
        for scope in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(scope, ast.FunctionDef):
                continue
            body = scope.body[1:] if ast.get_docstring(scope) else scope.body
            for node in (n for statement in body for n in ast.walk(statement)):
                text = ""
                if isinstance(node, ast.JoinedStr):
                    text = "".join(v.value for v in node.values if isinstance(v, ast.Constant))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    text = node.value
                # Names of the parser, such as "--set", are no advice.
                if OPTION.search(text) and " " in text:
                    yield file, scope.name, text


@pytest.mark.parametrize(
    ("file", "function", "text"), [pytest.param(*m, id=f"{m[0]}-{m[1]}") for m in messages()]
)
def test_a_message_names_only_options_of_its_command(file, function, text):
    options = accepted()
    named = re.search(rf"\b({'|'.join(options)})\b", text)
    if named is not None and named[0] in text.split(OPTION.search(text)[0])[0]:
        commands = (named[0],)
    else:
        commands = COMMANDS.get(f"{file} {function}") or COMMANDS.get(file)
    if commands is None:
        assert "--help" in text, f"name the commands of {file}"
        return
    for command in commands:
        assert set(OPTION.findall(text)) <= options[command] | {"--help"}, (command, text)
