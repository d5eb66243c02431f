"""Disks that fill and places that cannot be written: ``python -m validation.studies.full_disk``.

For every file that a small run of the courtyard writes, a run is made whose disk is full from that file on
or, in every other one, read-only; where file systems can be mounted, more are made on real ones that are too
small, or become read-only. Each must end with exit code 2 and one sentence that says what cannot be written,
why, and what to do, with no file in its folder that is none of a whole run; started again with room, it must
come to the bytes of a run left alone (times aside). The exit code is 1 where one does not.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import io
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from thesisrecon.cli.main import run_command
from thesisrecon.errors import MEND
from validation.studies.kill_anywhere import COURTYARD, different, outputs

REFUSED = 2
ROOM = "64m"
SMALL_MODEL = ["--set", "dense.max_side=160", "--set", "dense.match_side=160"]
"""Every stage writes its files; what is in them may be coarse."""


@dataclass(frozen=True)
class Refusal:
    """One run that could not write: where its disk was full, how it ended and what it said, which of its
    files are none of a whole run, and what differs after it was started again."""

    when: str
    code: int
    said: str
    strange: tuple[str, ...]
    different: tuple[str, ...]

    @property
    def wrong(self) -> str:
        """What is not as it should be, in a few words; empty where all is well."""
        found = {
            f"exit code {self.code}": self.code != REFUSED,
            "not one sentence": self.said.count("\n") != 1 or "Traceback" in self.said,
            "names no place": " cannot be written: " not in self.said,
            "does not say what to do": not any(words in self.said for words in MEND.values()),
            f"strange files: {', '.join(self.strange)}": bool(self.strange),
            f"differs: {', '.join(self.different)}": bool(self.different),
        }
        return "; ".join(words for words, here in found.items() if here)


@contextlib.contextmanager
def disk_ends(first: int, number: int) -> Iterator[list[int]]:
    """In this block the ``first``-th file (counted from 1) and all after it end in the error ``number``;
    nothing ends where ``first`` is 0. Counts the files that were written."""
    written, sync = [0], os.fsync

    def synced(descriptor: int) -> None:
        written[0] += 1
        if first and written[0] >= first:
            os.ftruncate(descriptor, os.fstat(descriptor).st_size // 2)
            raise OSError(number, os.strerror(number))
        sync(descriptor)

    os.fsync = synced  # type: ignore[assignment]
    try:
        yield written
    finally:
        os.fsync = sync


class SmallRuns:
    """Runs of the same few photographs in this process."""

    def __init__(self, place: Path, views: int, size_px: int, until: str) -> None:
        self.place = place
        self.images = place / "images"
        self.images.mkdir()
        for path in sorted((COURTYARD / "images").iterdir())[:views]:
            (self.images / path.name).symlink_to(path)
        self.options = ["--max-size", str(size_px), "--until", until, "--threads", "1", *SMALL_MODEL]

    def run(self, out: Path) -> tuple[int, str]:
        """Exit code, and what was said on the error stream."""
        said = io.StringIO()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            code = run_command(["reconstruct", str(self.images), "-o", str(out), *self.options])
        return code, said.getvalue()

    def whole(self, out: Path) -> dict[str, bytes]:
        """The outputs of a run with nothing in its way.

        Raises ``RuntimeError`` where it does not end well.
        """
        code, said = self.run(out)
        if code:
            raise RuntimeError(f"a run with room ended with {code}: {said}")
        return outputs(out)


def refused_at(runs: SmallRuns, write: int, number: int, wanted: dict[str, bytes]) -> Refusal:
    """A run whose ``write``-th file and all after it cannot be written, and its second start."""
    out = runs.place / f"write-{write}"
    with disk_ends(write, number):
        ended = runs.run(out)
    strange = _strange(outputs(out), wanted)
    return Refusal(
        f"file {write}: {os.strerror(number)}", *ended, strange, different(runs.whole(out), wanted)
    )


def _strange(there: dict[str, bytes], wanted: dict[str, bytes]) -> tuple[str, ...]:
    return tuple(name for name, content in there.items() if wanted.get(name) != content)


@contextlib.contextmanager
def small_disk(place: Path, size: str) -> Iterator[Path]:
    """A file system of that size in memory.

    Raises ``PermissionError`` where none can be mounted.
    """
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    try:
        mounted = subprocess.run(command, check=False, capture_output=True).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        raise PermissionError("file systems cannot be mounted here")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def remount(place: Path, options: str) -> None:
    """Give a file system of :func:`small_disk` more room (``size=64m``), or make it read-only (``ro``)."""
    subprocess.run(["mount", "-o", f"remount,{options}", str(place)], check=True)


def filled(runs: SmallRuns, share: float, wanted: dict[str, bytes]) -> Refusal:
    """A run on a disk that has room for this share of its files, and its second start with more."""
    size = int(share * sum(map(len, wanted.values())))
    with small_disk(runs.place / f"disk-{size}", f"{size}") as disk:
        ended = runs.run(disk / "out")
        strange = _strange(outputs(disk / "out"), wanted)
        remount(disk, f"size={ROOM}")
        again = runs.whole(disk / "out")
    return Refusal(f"a disk of {size // 1024} KiB", *ended, strange, different(again, wanted))


def locked(runs: SmallRuns, write: int, wanted: dict[str, bytes]) -> Refusal:
    """A run whose disk becomes read-only before its ``write``-th file, and its second start."""
    with small_disk(runs.place / f"locked-{write}", ROOM) as disk:
        with disk_ends(write, errno.EIO):
            runs.run(disk / "out")
        remount(disk, "ro")
        ended = runs.run(disk / "out")
        strange = _strange(outputs(disk / "out"), wanted)
        remount(disk, "rw")
        again = runs.whole(disk / "out")
    return Refusal(f"read-only at file {write}", *ended, strange, different(again, wanted))


def measure(runs: SmallRuns, every: int, disks: int) -> list[Refusal]:
    """The run left alone, and all others; each is told as it ends."""
    runs.whole(runs.place / "first")
    with disk_ends(0, 0) as written:
        wanted = runs.whole(runs.place / "whole")
    rows: list[Refusal] = []
    for write in range(1, written[0] + 1, every):
        number = errno.ENOSPC if len(rows) % 2 == 0 else errno.EROFS
        rows.append(refused_at(runs, write, number, wanted))
        print(rows[-1], flush=True)
    try:
        for k in range(disks):
            rows.append(filled(runs, (k + 0.5) / disks, wanted))
            print(rows[-1], flush=True)
            rows.append(locked(runs, 2 + k * (written[0] - 2) // disks, wanted))
            print(rows[-1], flush=True)
    except PermissionError as error:
        print(f"left out: {error}", flush=True)
    return rows


def table(rows: list[Refusal]) -> str:
    """Every run in Markdown."""
    lines = ["| the run could not write | exit code | it said | wrong |", "| --- " * 4 + "|"]
    return "\n".join(
        [*lines, *(f"| {r.when} | {r.code} | {r.said.strip()} | {r.wrong or 'nothing'} |" for r in rows)]
    )


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and say whether every run could go on."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.full_disk", description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="only every n-th file")
    parser.add_argument("--disks", type=int, default=10)
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--max-size", type=int, default=320)
    parser.add_argument("--until", default="model")
    wishes = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as place:
        runs = SmallRuns(Path(place), wishes.views, wishes.max_size, wishes.until)
        rows = measure(runs, wishes.every, wishes.disks)
    print(table(rows))
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
