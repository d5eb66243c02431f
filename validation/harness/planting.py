"""A copy of the tree in which one fault at a time is planted, with its compiled kernels."""

from __future__ import annotations

import ast
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from validation.scenes.real import ROOT

FAULTY_S = 4_000_000_000
"""Modification time of the first fault, later than any file; each fault adds a second."""


@dataclass(frozen=True)
class CopiedTree:
    """The parts ``copied`` from the repository, in the folder ``out``."""

    out: Path
    copied: tuple[str, ...] = ("thesisrecon", "validation", "fixtures", "pyproject.toml")

    @property
    def tree(self) -> Path:
        """The copy."""
        return self.out / "tree"

    @property
    def kernels(self) -> Path:
        """Compiled kernels of the copy without faults."""
        return self.out / "kernels"

    def set_up(self) -> None:
        """Copy the tree with the times of its files."""
        shutil.rmtree(self.tree, ignore_errors=True)
        self.tree.mkdir(parents=True)
        self.kernels.mkdir(exist_ok=True)
        for name in self.copied:
            source, target = ROOT / name, self.tree / name
            if source.is_dir():
                shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(source, target)

    @contextmanager
    def planted(self, file: str, text: str, number: int) -> Iterator[Path]:
        """Yield the kernel folder of the tree with the faulty ``text`` in ``file``.

        Bytecode and kernels of the module and its importers are recompiled, and removed with the fault.
        """
        path = self.tree / file
        sound, kernels = path.read_text(encoding="utf-8"), self.out / f"kernels-{number:02d}"
        shutil.rmtree(kernels, ignore_errors=True)
        shutil.copytree(self.kernels, kernels, copy_function=os.link)
        for module in compiled_from(self.tree, file):
            # numba detects changes of a kernel's own file only.
            for stale in kernels.glob(f"{module.parent.name}_*/{module.stem}.*"):
                stale.unlink()
        newer = {module: module.stat().st_mtime for module in importers(self.tree, file)}
        path.write_text(text, encoding="utf-8")
        try:
            for module in newer:
                os.utime(module, (FAULTY_S + number, FAULTY_S + number))
            yield kernels
        finally:
            path.write_text(sound, encoding="utf-8")
            for module, before in newer.items():
                os.utime(module, (before, before))
            shutil.rmtree(kernels)


def importers(root: Path, file: str) -> list[Path]:
    """Return the module and its direct and indirect importers in the package."""
    return _reached(root, file, lambda _: True)


def compiled_from(root: Path, file: str) -> list[Path]:
    """Return the modules whose compiled kernels may contain code or constants of this one.

    Kernels inline code of directly imported modules, and of further ones only through kernels.
    """
    found = _reached(root, file, lambda path: has_kernels(path) or path.name == "__init__.py")
    return [path for path in found if has_kernels(path)]


def has_kernels(path: Path) -> bool:
    """Return whether a module defines compiled functions."""
    return "@kernel" in path.read_text(encoding="utf-8")


def _reached(root: Path, file: str, passes: Callable[[Path], bool]) -> list[Path]:
    """Return the module and its importers through modules that pass."""
    modules = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sorted((root / file.split("/")[0]).rglob("*.py"))
    }
    imports = {name: imports_of(path) for name, path in modules.items()}
    allowed = {name for name, path in modules.items() if passes(path)}
    found = {name for name, path in modules.items() if path == root / file}
    while more := {name for name in allowed - found if imports[name] & found}:
        found |= more
    return [modules[name] for name in sorted(found)]


def imports_of(path: Path) -> set[str]:
    """Return the imports of a file: modules and names in them."""
    found = set[str]()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found
