"""Load user classes and functions named as ``path/to/file.py:Name``.

The source text is sent with every row that needs it, so workers need no copy of the file.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from thesisrecon.errors import UsageError, unknown_word

PREFIX = "ablation_own_"


@dataclass(frozen=True)
class Source:
    """User source file: module name, path and text."""

    module: str
    path: str
    text: str

    def install(self) -> ModuleType:
        """The module of this text, run once in each process.

        Its name tells its text, so that a file that was changed is another module.
        """
        if self.module not in sys.modules:
            module = ModuleType(self.module)
            module.__file__ = self.path
            # A dataclass looks up its module during creation.
            sys.modules[self.module] = module
            try:
                exec(compile(self.text, self.path, "exec"), module.__dict__)
            except BaseException:
                del sys.modules[self.module]
                raise
        return sys.modules[self.module]


_SOURCES: dict[str, Source] = {}


def is_own(word: str) -> bool:
    """Return whether a word names something of a file: ``corners.py:MyCorners``."""
    file, colon, name = word.rpartition(":")
    return bool(colon) and file.endswith(".py") and name.isidentifier()


def load_own(word: str, where: str, folder: Path = Path()) -> Any:
    """Return the object named by ``word``, with a file relative to ``folder``.

    Raises :class:`UsageError`, beginning with ``where``, for a file that is not there or cannot be run, and a
    name that it does not have.
    """
    file, _, name = word.rpartition(":")
    path = (folder / file).resolve()
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise UsageError(f"{where}: there is no file {path} to read {name} from") from None
    digest = hashlib.sha256(f"{path}\0{text}".encode()).hexdigest()[:16]
    source = Source(f"{PREFIX}{path.stem}_{digest}", str(path), text)
    try:
        module = source.install()
    except Exception as error:
        raise UsageError(f"{where}: {path} does not run: {type(error).__name__}: {error}") from None
    _SOURCES[source.module] = source
    if not hasattr(module, name):
        public = [k for k, v in vars(module).items() if getattr(v, "__module__", "") == source.module]
        raise UsageError(f"{where}: {unknown_word(f'name in {path.name}', name, public)}")
    return getattr(module, name)


def sources_of(modules: Iterable[str]) -> tuple[Source, ...]:
    """The sources of those modules that are files of the user."""
    return tuple(_SOURCES[m] for m in sorted(set(modules)) if m in _SOURCES)
