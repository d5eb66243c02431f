"""Files of the user that a study names: they run once in each process, with the files that they import.

The text of a file and of all that it imports from outside installed packages is part of its name, so that
rows of an edited file, or of an edited helper, are computed again. Workers get the texts, not the paths: a
file that is edited while a study runs changes nothing. Data files that own code reads are watched: a row is
found again only if all of them are as they were.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from thesisrecon import _numba
from thesisrecon.errors import UsageError, unknown_word
from validation.scenes.real import cache_folder

PREFIX = "ablation_own_"
OURS = ("thesisrecon", "validation")
INSTALLED = [Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "purelib", "platlib")]
# Also the folders of another environment or of the system that this one sees.
PACKAGES = {"site-packages", "dist-packages"}


class Helper(NamedTuple):
    """A file that a file of the user imports: module name, path and text."""

    module: str
    path: str
    text: str


class Source(NamedTuple):
    """A file of the user: module name, path, text, and what it imports from outside installed packages."""

    module: str
    path: str
    text: str
    helpers: tuple[Helper, ...] = ()

    def install(self) -> ModuleType:
        """The module of this text, run once in each process."""
        _FINDER.offer(self.helpers)
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


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports helpers from their texts."""

    def __init__(self) -> None:
        self.known: dict[str, Helper] = {}

    def offer(self, helpers: Sequence[Helper]) -> None:
        """Import these texts from now on; a module of another text under one of their names is run again."""
        if self not in sys.meta_path:
            sys.meta_path.insert(0, self)
        changed = [h.module for h in helpers if self.known.get(h.module) != h]
        self.known.update((h.module, h) for h in helpers)
        # What imported a changed helper holds its old objects.
        for name in {h.module for h in helpers} if changed else ():
            sys.modules.pop(name, None)

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> Any:
        if (found := self.known.get(fullname)) is None:
            return None
        package = Path(found.path).name == "__init__.py"
        spec = importlib.machinery.ModuleSpec(fullname, self, origin=found.path, is_package=package)
        spec.has_location = True
        return spec

    def exec_module(self, module: ModuleType) -> None:
        found = self.known[module.__name__]
        exec(compile(found.text, found.path, "exec"), module.__dict__)


_FINDER = _Finder()
_SOURCES: dict[str, Source] = {}


def is_own(word: str) -> bool:
    """Return whether a word names something of a file: ``corners.py:MyCorners``."""
    file, colon, name = word.rpartition(":")
    return bool(colon) and file.endswith(".py") and name.isidentifier()


def load_own(word: str, where: str, folder: Path = Path()) -> Any:
    """Return the object named by ``word``, with a file relative to ``folder``."""
    file, _, name = word.rpartition(":")
    path = (folder / file).resolve()
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise UsageError(f"{where}: there is no file {path} to read {name} from") from None
    helpers = helpers_of(path, text)
    content = "\0".join([str(path), text, *(part for h in helpers for part in h)])
    digest = hashlib.sha256(content.encode()).hexdigest()[:16]
    source = Source(f"{PREFIX}{path.stem}_{digest}", str(path), text, helpers)
    try:
        with watched():
            module = source.install()
    except Exception as error:
        raise UsageError(f"{where}: {path} does not run: {type(error).__name__}: {error}") from None
    _SOURCES[source.module] = source
    if not hasattr(module, name):
        public = [k for k, v in vars(module).items() if getattr(v, "__module__", "") == source.module]
        raise UsageError(f"{where}: {unknown_word(f'name in {path.name}', name, public)}")
    return getattr(module, name)


def loaded_sources() -> tuple[Source, ...]:
    """The files of the user that were read in this process."""
    return tuple(_SOURCES.values())


def helpers_of(path: Path, text: str) -> tuple[Helper, ...]:
    """Return all that a file imports, directly or not, from its folder or from elsewhere outside installed
    packages, by name.
    """
    found, waiting = dict[str, Helper](), [("", text)]
    while waiting:
        package, content = waiting.pop()
        for name in _imported(content, package):
            if name in found or (where := _file_of(name, path.parent)) is None:
                continue
            try:
                found[name] = Helper(name, str(where), where.read_text(encoding="utf-8"))
            except (OSError, UnicodeDecodeError):
                continue  # Python says why when it imports the file
            own = name if where.name == "__init__.py" else name.rpartition(".")[0]
            waiting.append((own, found[name].text))
    return tuple(found[name] for name in sorted(found))


def _imported(text: str, package: str) -> Iterator[str]:
    """Names of all modules that a text may import, with the packages that they are in."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parts, *([node.module] if node.module else [])])
            names = [base, *(f"{base}.{alias.name}".lstrip(".") for alias in node.names)]
        for name in names:
            parts = name.split(".")
            yield from (".".join(parts[: n + 1]) for n in range(len(parts)))


def _file_of(module: str, folder: Path) -> Path | None:
    """The file of a module outside the library and installed packages; None if there is no such file."""
    first = module.partition(".")[0]
    loaded = getattr(sys.modules.get(first), "__file__", None)
    if first in OURS or first in sys.builtin_module_names or _is_installed(loaded):
        return None
    for base in (folder, *map(Path, sys.path)):
        stem = base.joinpath(*module.split("."))
        for file in (stem / "__init__.py", stem.with_name(f"{stem.name}.py")):
            if file.is_file():
                return None if _is_installed(file) else file.resolve()
    return None


def _is_installed(file: str | Path | None) -> bool:
    """Whether a file belongs to Python or to an installed package."""
    if file is None:
        return False
    path = Path(file).resolve()
    return not PACKAGES.isdisjoint(path.parts) or any(path.is_relative_to(folder) for folder in INSTALLED)


# ---------------------------------------------------------------- data files


class _Watch:
    """Files that this process opens while own code runs; also in earlier rows, whose data code may keep."""

    def __init__(self) -> None:
        self.running, self.installed = False, False
        self.read, self.written = set[str](), set[str]()

    def __call__(self, event: str, details: tuple[Any, ...]) -> None:
        if self.running and event == "open" and isinstance(details[0], str | os.PathLike):
            writes = details[2] & (os.O_WRONLY | os.O_RDWR)
            (self.written if writes else self.read).add(str(Path(details[0]).absolute()))


_WATCH = _Watch()


@contextmanager
def watched() -> Iterator[None]:
    """Note the files that are opened in the block."""
    if not _WATCH.installed:
        sys.addaudithook(_WATCH)
    _WATCH.installed, before, _WATCH.running = True, _WATCH.running, True
    try:
        yield
    finally:
        _WATCH.running = before


def read_files(out: Path) -> dict[str, str]:
    """Data files that own code has read in this process, with digests; without those of ``out``, of caches,
    of the system and of installed packages, and those that it writes.
    """
    aside = (out, cache_folder(""), *map(Path, map(os.path.expanduser, SYSTEM)), _numba.cache_folder())
    paths = [Path(name) for name in sorted(_WATCH.read - _WATCH.written)]
    kept = [p for p in paths if not _is_installed(p) and not any(p.is_relative_to(f) for f in aside)]
    return {str(p): digest_of(str(p)) for p in kept if p.is_file() and p.suffix not in (".py", ".pyc")}


SYSTEM = ("/proc", "/sys", "/dev", "/etc", "/usr", "~/.cache", "~/.config")


def digest_of(path: str) -> str:
    """Digest of the content of a file, empty if it cannot be read."""
    try:
        state = Path(path).stat()
        return _digest(path, state.st_mtime_ns, state.st_size)
    except OSError:
        return ""


@cache
def _digest(path: str, *_: int) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]
