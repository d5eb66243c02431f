"""Text, JSON, pair lists and atomic file output: a file appears under its name only when it is complete.

If the program is killed at any moment, the old file or the new one is there.
"""

import json
import math
import os
import re
import shlex
import shutil
import stat
import unicodedata
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from thesisrecon.errors import Notice, OutputError, UsageError, in_words, shortened
from thesisrecon.io._outputs import OutputFolder, claim_of, digest_of, has_content, not_ours

MAX_TEXT_BYTES = 2**26  # Limit of text files: far above any list of pairs, far below the memory of a computer
IMAGE_NAME_RULE = "an image name must be a relative path inside the folder of images, without '..'"
_ABSOLUTE = re.compile(r"[A-Za-z]:|/|\\(?!x[0-9a-f]{2}|u[0-9a-f]{4})")
"""Beginning of an absolute path of any system; printable names have \\x.. and \\u.... for characters."""
FRAMES_FOLDER = "00-frames"
"""The frames of a video in a run folder, written before the run is identified by their pixels."""
SPECIAL_FILE = "a pipe, a device or a socket"
_PARTIAL = ".partial"
_CODED = (*range(0x20), *range(0x7F, 0xA0), *range(0x2028, 0x202F), *range(0x2066, 0x206A))
"""Control characters, line and paragraph separators, and marks that change the direction of a text."""
_CODES = {c: f"\\x{c:02x}" if c < 256 else f"\\u{c:04x}" for c in _CODED}


def printable(name: str) -> str:
    """Escape a file name for one line: invalid UTF-8, control characters and direction marks become codes."""
    from_bytes = all("\udc80" <= c <= "\udcff" for c in name if "\ud800" <= c <= "\udfff")
    text = name.encode("utf-8", "surrogateescape" if from_bytes else "backslashreplace")
    return text.decode("utf-8", "backslashreplace").translate(_CODES)


def require_image_name(name: Any, source: object) -> str:
    """Return the name of an image in ``source``; UsageError if it breaks ``IMAGE_NAME_RULE``."""
    if not is_image_name(name):
        raise UsageError(f"{source} names an image {in_words(name)}; {IMAGE_NAME_RULE}")
    return str(name)


def is_image_name(name: Any) -> bool:
    """Whether an image has a name of ``IMAGE_NAME_RULE``, by the rules of every system: models are copied."""
    parts = name.replace("\\", "/").split("/") if isinstance(name, str) else [".."]
    return not (".." in parts or parts[-1] in ("", ".") or "\0" in name or _ABSOLUTE.match(name))


def name_without_suffix(name: str) -> str:
    """The name without folder and suffix; a suffix of digits belongs to a time."""
    path = Path(name)
    return path.name if path.suffix[1:].isdigit() else path.stem


def first_repeated(names: Iterable[str], *, as_files: bool = False) -> str | None:
    """Return the first repeated name, if any; ``as_files`` ignores case and Unicode normalisation."""
    seen = set[str]()
    for name in names:
        key = unicodedata.normalize("NFC", PurePosixPath(name).as_posix().casefold()) if as_files else name
        if key in seen:
            return name
        seen.add(key)
    return None


def natural_key(name: str) -> tuple[list[tuple[str, int, str]], str]:
    """Sorting key of names in the order of characters, but of numbers by value: frame9 before frame10."""
    # A run of digits stands where its first digit would; int() refuses thousands of digits.
    parts = [
        ("0", len(part.lstrip("0")), part.lstrip("0")) if part[0] in "0123456789" else (part, 0, "")
        for part in re.findall(r"[0-9]+|[^0-9]", name, re.DOTALL)
    ]
    return parts, name


def as_path(caller: str, name: str, path: Any) -> Path:
    """Return the path of a file or folder; UsageError for anything that is none."""
    if not isinstance(path, str | os.PathLike) or isinstance(os.fspath(path), bytes):
        rule = f"a path (str or pathlib.Path) as {name}"
        raise UsageError(f"{caller} needs {rule}; got a {type(path).__name__}")
    return Path(path)


def shorten_middle(text: str, longest: int = 600) -> str:
    """Cut the middle of a long text; its end often states the rule."""
    cut = f"{text[: longest - longest // 4 - 5]} ... {text[-(longest // 4) :]}"
    return text if len(text) <= longest else cut


def read_bytes(path: Path, *, largest: int = MAX_TEXT_BYTES) -> bytes:
    """Read a regular file of at most ``largest`` bytes; OSError with the reason in ``strerror``."""
    found = path.stat()
    # Reading a pipe or a device may never end.
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
        raise OSError(0, f"it is {SPECIAL_FILE}, not a file", str(path))
    if found.st_size > largest:
        raise OSError(0, f"it is larger than {largest / 2**20:.0f} MiB", str(path))
    with path.open("rb") as file:
        # Files in /proc and /sys report size 0, and some have no end.
        return file.read(found.st_size or largest)


def read_text(path: Path) -> str:
    """Read a UTF-8 text, without a byte order mark; UsageError if that fails."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UsageError(f"{path} is not a UTF-8 text") from None
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}") from None


def is_partial(name: str) -> bool:
    """Whether a file is the remainder of an interrupted write."""
    return name.startswith(".") and name.endswith(_PARTIAL)


def write_atomically(path: Path, content: bytes, *, cached: bool = False) -> None:
    """Write a file completely or not at all, flushed to the disk; OutputError, and the old file stays.

    ``cached``: a stored result of a stage, which belongs to its run by name (:meth:`OutputFolder.admit`).
    """
    partial = path.with_name(f".{path.name}{_PARTIAL}")
    claim = claim_of(path)
    changed = claim is None or claim.admit(path, content, cached=cached)
    try:
        if changed:
            _make_parents(path, claim)
        # A link of this name must not be followed.
        partial.unlink(missing_ok=True)
        if not changed:
            return
        with partial.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if claim is not None and not cached and os.path.lexists(path):
            # Another program may have written it meanwhile.
            claim.require_own(path)
        partial.replace(path)
    except Exception as error:
        with suppress(OSError):
            partial.unlink()
        if claim is not None:
            claim.written.pop(claim.name_of(path), None)
        raise OutputError(path, error) if isinstance(error, OSError) else error from None


def _make_parents(path: Path, claim: OutputFolder | None) -> None:
    if claim is None:
        path.parent.mkdir(parents=True, exist_ok=True)
    else:
        claim.make_parents(path)


def write_text(path: Path, text: str, *, cached: bool = False) -> None:
    """Write a text as UTF-8; surrogates become question marks."""
    write_atomically(path, text.encode("utf-8", "replace"), cached=cached)


def write_json(path: Path, value: Any, *, cached: bool = False) -> None:
    """Write mappings, sequences, numbers, text and arrays as JSON of :func:`json_text`."""
    write_text(path, json_text(value), cached=cached)


def json_text(value: Any) -> str:
    """Indented JSON in which NaN and infinity are null."""
    return json.dumps(_plain(value), indent=2, ensure_ascii=False) + "\n"


def write_new(path: Path, text: str, *, overwrite: bool) -> None:
    """Write a single text; UsageError if another file would be replaced."""
    content = text.encode("utf-8", "replace")
    if has_content(path, [digest_of(content)]):
        return
    if not overwrite and os.path.lexists(path):
        raise not_ours(path)
    write_atomically(path, content)


def as_read(value: Any) -> Any:
    """The value that :func:`read_json` returns after :func:`write_json`."""
    return json.loads(json.dumps(_plain(value)))


def _plain(value: Any) -> Any:
    # No NumPy here: `thesisrecon --help` should start fast.
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_json(path: Path) -> Any:
    """Read a JSON file; None if it is absent, damaged, too large or not regular."""
    try:
        return json.loads(read_bytes(path).decode("utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        return None


def link(source: Path, target: Path) -> None:
    """Give a file a second name, by a hard link if possible, else by a copy."""
    # Several programs may link the same target in a shared folder at the same time.
    partial = target.with_name(f".{target.name}.{os.getpid()}{_PARTIAL}")
    claim = claim_of(target)
    try:
        if claim is not None:
            claim.admit(target, b"", cached=True)
        _make_parents(target, claim)
        partial.unlink(missing_ok=True)
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)
        partial.replace(target)
    except OSError as error:
        raise OutputError(target, error) from None
    finally:
        # POSIX rename does nothing if both names are links to one file.
        with suppress(OSError):
            partial.unlink()


def read_pairs(path: Path) -> list[tuple[str, str]]:
    """Read pairs of file names, one per line, separated by blanks (then quoted if needed) or a tab."""
    pairs = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        names = _names(line)
        if len(names) != 2:
            raise UsageError(Notice("no-pair-in-line", number, path, shortened(line.strip())))
        pairs.append((names[0], names[1]))
    return pairs


def _names(line: str) -> list[str]:
    if len(line) > 2**14:  # Two file names with folders are shorter on every system.
        return []
    if "\t" in line and '"' not in line:
        return [name.strip() for name in line.strip().split("\t")]
    try:
        return shlex.split(line)
    except ValueError:  # No closing quote.
        return []
