"""Entry point of the command line: the commands and the program that runs one of them."""

from __future__ import annotations

import io
import os
import sys
import warnings
from typing import Annotated

import typer

from thesisrecon import __version__
from thesisrecon.cli.commands import compare, demo, export, inspect, interpolate, reconstruct, render
from thesisrecon.cli.common import DEBUG_VARIABLE, exit_code_of
from thesisrecon.runtime._signals import set_error_stream

app = typer.Typer(
    name="thesisrecon", help="From uncalibrated images to metric cameras, points and a textured model.",
    add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False,
)  # fmt: skip
for _command in (reconstruct, demo, inspect, compare, render, interpolate, export):
    app.command()(_command)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        typer.echo(f"thesisrecon {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit


def run_command(arguments: list[str]) -> int:
    """Run one command line (without the program name); an error becomes one sentence on stderr."""
    with warnings.catch_warnings():
        # Unreadable images are reported by this program, in one sentence.
        warnings.filterwarnings("ignore", module=r"PIL\.")
        return exit_code_of(lambda: app(arguments, standalone_mode=False))


def _silence_c_libraries() -> None:
    """Discard messages of C libraries on stderr: libtiff prints a line for each damaged byte."""
    try:
        ours, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:
        # stderr is closed.
        return
    os.dup2(nowhere, 2)
    os.close(nowhere)
    set_error_stream(ours)
    encoding = getattr(sys.stderr, "encoding", None)
    sys.stderr = os.fdopen(ours, "w", buffering=1, encoding=encoding, errors="backslashreplace")


def main() -> None:
    """Run the command line of this process and exit with its code."""
    # File names may hold characters that the terminal cannot encode.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    if not os.environ.get(DEBUG_VARIABLE):
        _silence_c_libraries()
    sys.exit(run_command(sys.argv[1:]))
