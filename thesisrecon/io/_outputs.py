"""The rule for output files: without ``overwrite`` nothing is replaced or removed that was not written here.

A command claims its output folder. The record of the folder (its lock file) lists name and digest of each
file before it is written: a file with one of its digests was written by thesisrecon and is unchanged. Nothing
is replaced or removed through a link, and a refused command leaves no trace.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from io import BufferedReader
from pathlib import Path

from thesisrecon.errors import Notice, OutputError, StageFailure, UsageError, WorkersLost

LOCK_FILE = ".lock"
NOFOLLOW = getattr(os, "O_NOFOLLOW", 0)  # Windows has no such flags
_claims: list[OutputFolder] = []


def digest_of(content: bytes) -> str:
    """Size and SHA-256 of the content of a file."""
    return f"{len(content)} {hashlib.sha256(content).hexdigest()}"


def has_content(path: Path, digests: Collection[str]) -> bool:
    """Whether a regular file (no link) has the content of one of these digests."""
    try:
        with _open_regular(path) as file:
            size = f"{os.fstat(file.fileno()).st_size} "
            # A file of another size may be too large to be read.
            return any(known.startswith(size) for known in digests) and (
                size + hashlib.file_digest(file, "sha256").hexdigest() in digests
            )
    except OSError:
        return False


def _open_regular(path: Path) -> BufferedReader:
    """Open a regular file; OSError for links and others (opening a pipe would block)."""
    file = os.fdopen(os.open(path, os.O_RDONLY | NOFOLLOW | getattr(os, "O_NONBLOCK", 0)), "rb")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "it is not a regular file")
    return file


def _absolute(path: Path) -> str:
    return os.path.abspath(path)  # noqa: PTH100 (Path.resolve follows links)


def not_ours(path: Path, *, optional: bool = True) -> UsageError:
    """The error for a file that must not be replaced; ``optional``: the command has ``--overwrite``."""
    ways = "move it, choose another place, or use --overwrite (overwrite=True) to replace it"
    ways = ways if optional else "move it, or choose another place"
    return UsageError(f"{path} was not written by thesisrecon, or was changed since; {ways}")


class OutputFolder:
    """A claimed folder: which of its files may be replaced or removed."""

    def __init__(self, path: Path, *, overwrite: bool | None) -> None:
        self.path, self.overwrite = path, overwrite
        self.root = _absolute(path)
        self.digests: dict[str, set[str]] = {}  #: of the files that thesisrecon wrote
        self.written: dict[str, str] = {}  #: those of this command
        self.kept = False  #: whether the work of a command that fails is kept
        self._created: list[Path] = []
        self._stored: set[Path] = set()
        self._used = False
        self._folder = self._record = -1

    def name_of(self, path: Path) -> str:
        """The name of a file relative to the folder."""
        return Path(_absolute(path)).relative_to(self.root).as_posix()

    def lists(self, name: str) -> bool:
        """Whether thesisrecon wrote files of this name, or in the folder of this name."""
        return any(known == name or known.startswith(f"{name}/") for known in self.digests)

    def owns(self, path: Path) -> bool:
        """Whether a file may be replaced or removed."""
        if self._link_above(path) is not None or stat.S_ISDIR(os.lstat(path).st_mode):
            return False
        return bool(self.overwrite) or self.has_written(path)

    def has_written(self, path: Path) -> bool:
        """Whether thesisrecon wrote the content of a file."""
        return has_content(path, self.digests.get(self.name_of(path), ()))

    def _link_above(self, path: Path) -> Path | None:
        """The outermost link among the folders between this one and a file."""
        folders = [Path(self.root, part) for part in Path(self.name_of(path)).parents if part.name]
        return next((folder for folder in reversed(folders) if folder.is_symlink()), None)

    def _require_no_link(self, path: Path) -> None:
        if (link := self._link_above(path)) is not None:
            raise UsageError(Notice("link-above", path, link))

    def require(self, names: Sequence[str | Path]) -> None:
        """Raise ``UsageError`` if a file of these names must not be written."""
        for name in names:
            self._require_no_link(self.path / name)
        for path in self._existing(names):
            self.require_own(path)

    def require_own(self, path: Path) -> None:
        """Raise ``UsageError`` if an existing file must not be replaced."""
        if path.is_dir() and not path.is_symlink():
            raise OutputError(path, IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR)))
        self._require_no_link(path)
        if not self.owns(path):
            raise not_ours(path, optional=self.overwrite is not None)

    def _existing(self, names: Sequence[str | Path]) -> list[Path]:
        """The existing files of these names; texts with ``*`` or ``[`` are glob patterns, paths are not."""
        patterns = [isinstance(name, str) and ("*" in name or "[" in name) for name in names]
        found = [
            sorted(self.path.glob(str(name))) if pattern else [self.path / name]
            for name, pattern in zip(names, patterns, strict=True)
        ]
        return [path for paths in found for path in paths if os.path.lexists(path)]

    def admit(self, path: Path, content: bytes, *, cached: bool) -> bool:
        """Check and record that a file is written, unless it is ``cached``; False if it has this content."""
        self.require_present()
        there = os.path.lexists(path)
        if there or not cached:
            self._require_no_link(path)
        if cached:
            self._stored.add(path.parent)
            self._used = True
            return True
        name, digest = self.name_of(path), digest_of(content)
        same = there and has_content(path, [digest])
        if there and not same:
            self.require_own(path)
        self.note(name, digest)
        if not there:
            self._created.append(path)
        return not same

    def note(self, name: str, digest: str) -> None:
        """Record the digest of a file that is written; an empty one for a folder."""
        new = digest not in self.digests.setdefault(name, set())
        if new and self._record >= 0:
            before = os.fstat(self._record)
            try:
                # A new line first: the last one of a killed command may be incomplete.
                os.write(self._record, f"\n{json.dumps([name, digest])}".encode())
            except OSError as error:
                raise OutputError(self.path / LOCK_FILE, error) from None
            # Its time is that at which the command began.
            os.utime(self._record, ns=(before.st_atime_ns, before.st_mtime_ns))
        self.digests[name].add(digest)
        self.written[name] = digest
        self._used = True

    def make_parents(self, path: Path) -> None:
        """Create the folders of a file below this one, which is never created again."""
        folder = Path(_absolute(path)).parent
        if str(folder) != self.root and not folder.is_dir():
            self.make_parents(folder)
            folder.mkdir(exist_ok=True)

    def remove(self, names: Sequence[str | Path]) -> None:
        """Remove own files of these names, and the folders that are empty afterwards."""
        try:
            for path in self._existing(names):
                if self.owns(path):
                    self._unlink(path)
        except OSError as error:
            place = f"the output folder {self.path}, whose old results must be removed,"
            raise OutputError(place, error) from None

    def _unlink(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        self.written.pop(self.name_of(path), None)
        for parent in list(path.parents)[: len(Path(self.name_of(path)).parents) - 1]:
            if any(parent.iterdir()):
                break
            parent.rmdir()

    def require_present(self) -> None:
        """Raise ``UsageError`` if the folder was moved or removed since it was claimed."""
        with suppress(OSError):
            found = self.path.stat()
            # Windows opens no folders, and keeps one in which a file is open.
            if self._folder < 0 or os.path.samestat(found, os.fstat(self._folder)):
                return
        raise UsageError(Notice("folder-gone", self.path))

    def require_complete(self, names: Iterable[str]) -> None:
        """Raise ``UsageError`` if these files, or others that the command wrote, are no longer there."""
        self.require_present()
        files = [*(self.path / name for name in (*names, *self.written)), *self._stored]
        if (gone := next((path for path in files if not os.path.lexists(path)), None)) is not None:
            raise UsageError(f"{gone} was removed while the command was writing to {self.path}; repeat it")

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Create and lock the folder for a block; without a trace if it is not used."""
        missing = [folder for folder in (self.path, *self.path.parents) if not folder.exists()]
        lock, new = self.path / LOCK_FILE, not os.path.lexists(self.path / LOCK_FILE)
        try:
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                if hasattr(os, "O_DIRECTORY"):
                    self._folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
                self._record = _locked(lock)
            except OSError as error:
                raise OutputError(f"the output folder {self.path}", error) from None
            yield
        finally:
            with suppress(OSError):
                if new and self._record >= 0 and not self._used:
                    lock.unlink()
                for folder in missing if not self._used else ():
                    folder.rmdir()
            for handle in (self._record, self._folder):
                if handle >= 0:
                    os.close(handle)

    def read_record(self) -> None:
        """Add the files that the record lists."""
        lock = self.path / LOCK_FILE
        if not os.path.lexists(lock):
            return
        try:
            # At most 64 MiB: far above any record, far below the memory of a computer.
            with _open_regular(lock) as file:
                lines = [line for line in file.read(2**26).decode().splitlines() if line]
        except (OSError, UnicodeDecodeError):
            lines = ["of another program"]
        if not all(line.startswith('["') or line == "[" for line in lines):
            raise UsageError(f"{lock} was not written by thesisrecon; move it, or choose another folder")
        for line in lines:
            # The last line of a killed command may be incomplete.
            with suppress(ValueError):
                name, digest = json.loads(line)
                self.digests.setdefault(name, set()).add(digest)

    def withdraw(self) -> None:
        """Remove the files that this command created."""
        with suppress(OSError, UsageError):
            self.require_present()
            replaced = len(self._created) < len(self.written)
            for path in self._created:
                if os.path.lexists(path) and self.owns(path):
                    self._unlink(path)
            self._used = replaced


def lock_file(handle: int, *, shared: bool = False) -> None:
    """Lock an open file until it is closed, ``OSError`` if another process has it; Windows does not lock."""
    try:
        import fcntl
    except ImportError:
        return
    fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def _locked(lock: Path) -> int:
    """Open and lock a file, which is created; the lock ends with the process."""
    while True:
        handle = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_APPEND | NOFOLLOW, 0o644)
        try:
            lock_file(handle)
        except OSError:
            os.close(handle)
            raise UsageError(Notice("folder-in-use", lock.parent)) from None
        # A command that was refused removes the file that it created.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), lock.stat()):
                # The time at which a run began or was resumed.
                os.utime(handle)
                return handle
        os.close(handle)


@contextmanager
def claim_folder(
    path: Path, *, overwrite: bool | None = False, names: Sequence[str | Path] = (),
    check: Callable[[OutputFolder], object] = lambda _: None,
) -> Iterator[OutputFolder]:  # fmt: skip
    """Lock an output folder, unless ``check`` refuses it, for the block; the command writes ``names`` there.

    ``overwrite``: None if the command has no such option.
    """
    outputs = OutputFolder(path, overwrite=overwrite)

    def judge() -> None:
        try:
            outputs.read_record()
            check(outputs)
        except OSError as error:
            raise OutputError(f"the output folder {path}", error) from None
        outputs.require(names)

    # A refused command creates nothing; a folder in use is locked before it is judged.
    if not os.path.lexists(path / LOCK_FILE):
        judge()
    with outputs.opened():
        judge()
        _claims.append(outputs)
        try:
            yield outputs
            outputs.require_present()
        except (UsageError, StageFailure) as refusal:
            if not outputs.kept and not isinstance(refusal, OutputError | WorkersLost):
                outputs.withdraw()
            raise
        finally:
            _claims.remove(outputs)


@contextmanager
def join_claim(path: Path) -> Iterator[OutputFolder]:
    """The claim that holds a folder already, or a new one, in which the work of a failure is kept."""
    claim = claim_of(path / LOCK_FILE)
    with nullcontext(claim) if claim is not None else claim_folder(path, overwrite=None) as outputs:
        outputs.kept = outputs.kept or claim is None
        yield outputs


def clear_folder(folder: Path) -> None:
    """Remove a folder that is empty or was cleared before: its whole content belongs to the commands."""
    with join_claim(folder.parent) as outputs:
        name = outputs.name_of(folder)
        there = os.path.lexists(folder) and not (folder.is_dir() and not any(folder.iterdir()))
        if folder.is_symlink() or (there and name not in outputs.digests):
            raise not_ours(folder, optional=False)
        outputs.note(name, "")
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def lock_part(outputs: OutputFolder, folder: Path) -> Iterator[None]:
    """Create and lock a folder in a claimed one."""
    try:
        outputs.make_parents(folder / LOCK_FILE)
        handle = _locked(folder / LOCK_FILE)
    except OSError as error:
        raise OutputError(f"the output folder {folder}", error) from None
    try:
        yield
    finally:
        os.close(handle)


def claim_of(path: Path) -> OutputFolder | None:
    """The innermost claimed folder that holds a file."""
    place = _absolute(path)
    found = [claim for claim in _claims if place.startswith(claim.root.rstrip(os.sep) + os.sep)]
    return max(found, key=lambda claim: len(claim.root), default=None)
