"""A copy of the tree in which one fault at a time is planted."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from validation.scenes.real import ROOT


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
    def environment(self) -> dict[str, str]:
        """Environment of a process that imports the copy; its kernels outlive the copy."""
        return {"PYTHONPATH": str(self.tree), "THESISRECON_KERNEL_CACHE": str(self.out / "kernels")}

    def set_up(self) -> None:
        """Copy the tree with the times of its files."""
        shutil.rmtree(self.tree, ignore_errors=True)
        self.tree.mkdir(parents=True)
        for name in self.copied:
            source, target = ROOT / name, self.tree / name
            if source.is_dir():
                shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(source, target)

    @contextmanager
    def planted(self, file: str, text: str) -> Iterator[None]:
        """Replace ``file`` by the faulty ``text`` for a while.

        Kernels are cached by the code they are made from, bytecode by the time of the file.
        """
        path = self.tree / file
        sound, before = path.read_text(encoding="utf-8"), path.stat().st_mtime
        path.write_text(text, encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(sound, encoding="utf-8")
            os.utime(path, (before, before))
