"""The sharpest frame of each window of N frames, of a video or of a folder of frames.

The focus measure is the variance of the Laplacian (Pech-Pacheco et al., "Diatom autofocusing in brightfield
microscopy", ICPR 2000) of the smoothed image, relative to the variance of its grey levels: brightness and
contrast do not change it.
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from itertools import count, groupby
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
from scipy.ndimage import gaussian_laplace

from thesisrecon.errors import Notice, UsageError, counted
from thesisrecon.io._exports import write_image
from thesisrecon.io._files import FRAMES_FOLDER, printable, read_json, write_json
from thesisrecon.io._images import MAX_DECODED_BYTES, decode_file, list_images
from thesisrecon.io._outputs import OutputFolder, join_claim
from thesisrecon.io._pixels import EXIF_TRANSFORMS, StoredImage, UnusableImage

_CHOICE = "frames.json"
_FRAMES_HELD, _COPY_BYTES = 3, 12
"""Decoded frames in memory at a time without those of threads, and bytes per pixel of their copies as RGB."""
_FRAME_BYTES, _MARGIN_PIXELS = 4, 2**20
_UPRIGHT = {turn: EXIF_TRANSFORMS[k] for turn, k in ((90, 8), (-90, 6), (180, 3), (-180, 3))}
"""Transform to the upright image by the rotation (degrees, counter-clockwise) that a video states."""
MapAll = Callable[[Callable[[Any], Any], list[Any]], Iterable[Any]]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class FrameSource:
    """A video or a folder of frames, from which the sharpest of each ``every`` frames is taken."""

    path: Path
    every: int

    def __post_init__(self) -> None:
        if not isinstance(self.every, int) or isinstance(self.every, bool) or self.every < 1:
            raise UsageError(f"every must be a whole number of frames of at least 1; got {self.every!r}")
        if not self.video and not list_images(self.path):
            raise UsageError(f"there are no frames in {self.path} (subfolders are not searched)")

    @cached_property
    def video(self) -> bool:
        """Whether the source is a file."""
        return self.path.is_file()

    @cached_property
    def identity(self) -> dict[str, str]:
        """Name and digest; equal digests give the same frames under the same names."""
        content = hashlib.sha256(f"{self.every}".encode())
        for path in [self.path] if self.video else list_images(self.path):
            content.update(f"{path.name} ".encode(errors="replace"))
            # Unreadable files are refused when they are decoded; a pipe would block here.
            with suppress(OSError):
                if path.is_file():
                    with path.open("rb") as stream:
                        content.update(hashlib.file_digest(stream, "sha256").digest())
        name = printable(self.path.absolute().name)
        return {"name": f"every {self.every} of {name}", "digest": content.hexdigest()}

    def home(self, out: Path) -> Path:
        """The folder of the chosen frames; those of a video are written to the run folder ``out``."""
        return (out / FRAMES_FOLDER if self.video else self.path).absolute()

    def choose(
        self, out: Path, threads: int = 1, map_all: MapAll = map, progress: Progress = lambda *_: None,
    ) -> tuple[list[Path], int, list[str]]:  # fmt: skip
        """Return the chosen frames, the number of all frames, and warnings, as ``out`` records them."""
        record, home, warnings = out / FRAMES_FOLDER / _CHOICE, self.home(out), list[str]()
        digest = self.identity["digest"]
        with join_claim(out) as outputs:
            if os.path.lexists(record):
                outputs.require_own(record)
            known = read_json(record) if outputs.has_written(record) else {}
            frames = [home / name for name in known.get("names", ()) if self.video]
            damaged = [frame.name for frame in frames if not outputs.has_written(frame)]
            if known.get("digest") != digest or damaged:
                # The record is that of the frames in the folder.
                outputs.remove([Path(FRAMES_FOLDER, _CHOICE)])
                if known.get("digest") == digest:
                    more = f" and {len(damaged) - 1} more" if len(damaged) > 1 else ""
                    first = f"{FRAMES_FOLDER}/{damaged[0]}{more}"
                    warnings = [f"{first}: missing, damaged or exchanged, and extracted again"]
                    self._move_aside(outputs, [home / name for name in damaged])
                if self.video:
                    known = self._write_frames(outputs, threads, progress)
                else:
                    known = self._listed(map_all)
                write_json(record, known | {"digest": digest})
        return [home / name for name in known["names"]], known["total"], known["warnings"] + warnings

    def _listed(self, map_all: MapAll) -> dict[str, Any]:
        def measured(path: Path) -> float:
            try:
                return decode_file(path, _sharpness)
            except UnusableImage:
                return -1.0  # If all of a window are unreadable, one is taken and its reason reported.

        paths = list_images(self.path)
        sharpness = list(map_all(measured, paths))
        starts = range(0, len(paths), self.every)
        best = [max(range(n, min(n + self.every, len(paths))), key=sharpness.__getitem__) for n in starts]
        return {"names": [paths[n].name for n in best], "total": len(paths), "warnings": []}

    @staticmethod
    def _move_aside(outputs: OutputFolder, frames: Sequence[Path]) -> None:
        """Rename files in the place of frames, perhaps of the user, to NAME.other."""
        there = [frame for frame in frames if os.path.lexists(frame)]
        for frame in there:
            if frame.is_symlink() or not frame.is_file():
                outputs.require_own(frame)
        for frame in there:
            others = (frame.with_name(f"{frame.name}.other{n or ''}") for n in count())
            frame.rename(next(other for other in others if not os.path.lexists(other)))

    def _write_frames(self, outputs: OutputFolder, threads: int, progress: Progress) -> dict[str, Any]:
        """Write the best frame of each window of a video, two in memory at a time, and remove older ones."""
        names, warnings, total = list[str](), list[str](), 0

        def measured(numbered: tuple[int, tuple[Any, int]]) -> float:
            nonlocal total
            total = numbered[0] + 1
            return _sharpness(numbered[1][0].to_image())

        frames = enumerate(_decoded(self.path, threads, warnings))
        for _, window in groupby(frames, key=lambda numbered: numbered[0] // self.every):
            number, (frame, stated) = max(window, key=measured)
            turn = _UPRIGHT.get(frame.rotation)
            image = frame.to_image()
            names.append(f"{self.path.stem}-{number:06d}.png")
            upright = image if turn is None else image.transpose(turn)
            write_image(outputs.path / FRAMES_FOLDER / names[-1], np.array(upright))
            progress("frames", total, max(total, stated))
        if not names:
            raise UsageError(f"{self.path} contains no video frame that can be decoded")
        listed = [Path(name) for name in outputs.digests if name.startswith(f"{FRAMES_FOLDER}/")]
        outputs.remove([path for path in listed if path.name not in names])
        return {"names": names, "total": total, "warnings": warnings}


def _sharpness(image: PIL.Image.Image) -> float:
    stored = StoredImage(image)
    grey = stored.rows(0, image.height).convert("RGBA" if stored.layered else "RGB").convert("L")
    levels = np.asarray(grey.reduce(-(-max(grey.size) // 1024)), dtype=np.float32)
    # The term 8^2 keeps the noise of a dark frame from counting as sharpness.
    return float(gaussian_laplace(levels, 1.0).var() / (levels.var() + 64.0))


def _limit_memory(path: Path, video: Any, threads: int) -> None:
    """Set the threads of a decoder, each of which holds a frame; UsageError if a frame is too large."""
    codec = video.codec_context
    each = max(_FRAME_BYTES, codec.format.padded_bits_per_pixel / 8 if codec.format else 0)
    fixed = _FRAMES_HELD * each + _COPY_BYTES
    size = codec.width * codec.height
    if not size:
        raise UsageError(Notice("undecodable-frames", path, MAX_DECODED_BYTES / 2**30))
    if size * (fixed + each) > MAX_DECODED_BYTES:
        needed, limit = size * (fixed + each) / 2**30, MAX_DECODED_BYTES / 2**30
        raise UsageError(Notice("large-frames", path, codec.width, codec.height, needed, limit))
    threads = max(1, min(threads, int((MAX_DECODED_BYTES / max(size, 1) - fixed) / each)))
    video.thread_type, codec.thread_count = "AUTO", threads
    # The size may change within a video; decoders count a margin around the frame.
    largest = int(MAX_DECODED_BYTES / (fixed + threads * each)) + _MARGIN_PIXELS
    codec.options = {"max_pixels": str(largest)}


def _decoded(path: Path, threads: int, warnings: list[str]) -> Iterator[tuple[Any, int]]:
    """PyAV frames of a video, each with the stated number of all frames (0: not stated); adds a warning."""
    try:
        av = import_module("av")
    except ImportError:
        raise UsageError(Notice("no-video-reader", path)) from None
    damaged = 0
    try:
        # A stream, since FFmpeg reads some names as addresses, and playlists name other files.
        # To open a video FFmpeg decodes its first frame.
        smallest = MAX_DECODED_BYTES // (_FRAMES_HELD * _FRAME_BYTES + _COPY_BYTES) + _MARGIN_PIXELS
        options = {"max_pixels": str(smallest)}
        with path.open("rb") as stream, av.open(stream, options=options) as container:
            if not container.streams.video:
                raise UsageError(f"{path} contains no video frame that can be decoded")
            video = container.streams.video[0]
            _limit_memory(path, video, threads)
            for packet in container.demux(video):
                try:
                    yield from ((frame, video.frames) for frame in packet.decode())
                except av.FFmpegError:
                    damaged += 1
    except (av.FFmpegError, OSError) as error:
        raise UsageError(f"{path} cannot be read as a video: {error.strerror}") from None
    if damaged:
        warnings.append(Notice("damaged-video", path.name, counted(damaged, "packet")))
