"""How a command ends: an exit code, and one sentence where it did not do what it was told."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from signal import SIGINT

import typer

from thesisrecon.errors import DISK, StageFailure, Unwritable, UsageError
from thesisrecon.io.text import printable, shortened, without_middle
from thesisrecon.stops import CODES, REASONS, advised

DONE, INTERNAL, USAGE, IMPOSSIBLE = 0, 1, 2, 3
DEBUG_VARIABLE = "THESISRECON_DEBUG"
NO_CACHE = (
    "the compiled kernels can be kept neither beside the code nor in the user's cache folder; name a folder "
    "that can be written in the variable NUMBA_CACHE_DIR"
)
"""numba's own words for that name one of our functions and no remedy."""


class Interrupted(Exception):
    """Ctrl-C in a command."""


@contextmanager
def interruptible(advice: str) -> Iterator[None]:
    """What is advised where the block is interrupted; the parser has words of its own for a
    ``KeyboardInterrupt``."""
    try:
        with advised(advice):
            yield
    except KeyboardInterrupt as stop:
        raise Interrupted(*stop.args) from None


def exit_code_of(command: Callable[[], object]) -> int:
    """Carry out a command: its exit code; errors become one sentence on stderr."""
    try:
        code = command()
        return code if isinstance(code, int) else DONE
    except UsageError as error:
        return _say(str(error), USAGE)
    except StageFailure as failure:
        return _say(str(failure), IMPOSSIBLE)
    except (Interrupted, KeyboardInterrupt) as stop:
        # Where somebody else's program runs the command: ours is ended by `obey_signals`.
        return _say("; ".join((REASONS[SIGINT], *map(str, stop.args))), CODES[SIGINT])
    except MemoryError:
        return _say("out of memory; try a smaller --max-size or fewer --threads", IMPOSSIBLE)
    except OSError as error:
        if error.errno in DISK:
            # Kernels are kept on a disk too, and what is printed may go to a file.
            return _say(str(Unwritable(error.filename or "what the command writes", error)), USAGE)
        if os.environ.get(DEBUG_VARIABLE):
            raise
        place = f"{shortened(str(error.filename))}: " if error.filename is not None else ""
        return _say(f"{place}{error.strerror or error}", USAGE)
    except Exception as error:
        # The parser's own errors carry their sentence, in some versions with all that was given; its classes
        # differ between its versions.
        if hasattr(error, "format_message"):
            return _say(f"{without_middle(error.format_message())} (see thesisrecon --help)", USAGE)
        if os.environ.get(DEBUG_VARIABLE):
            raise
        if "no locator available" in str(error):
            return _say(NO_CACHE, USAGE)
        return _say(
            f"an error in the program: {type(error).__name__}: {error}; {DEBUG_VARIABLE}=1 shows where",
            INTERNAL,
        )


def _say(sentence: str, code: int) -> int:
    typer.echo(f"thesisrecon: {printable(' '.join(sentence.split()))}", err=True)
    return code
