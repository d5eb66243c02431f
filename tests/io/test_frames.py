"""Frames of a video and of a folder: the sharpest of each window, names, resuming and refusals."""

import shutil
import sys

import numpy as np
import PIL.Image
import pytest
from scipy.ndimage import gaussian_filter

from tests.bad_input import files
from tests.conftest import refuses
from thesisrecon import reconstruct
from thesisrecon.errors import UsageError
from thesisrecon.io._frames import FrameSource

SHARP = [2, 3, 7]
"""One frame of each window of three; the last window has two."""


def frames():
    """Eight frames that differ in blur, brightness and contrast; the sharp ones are dark."""
    for n in range(8):
        picture = gaussian_filter(np.array(files.picture(n, (160, 120))), (1.0, 1.0, 0.0)).astype(np.float64)
        blurred = gaussian_filter(picture, (1.5, 1.5, 0.0))
        yield (0.5 * picture + 20 if n in SHARP else blurred).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "frames"
    place.mkdir()
    for n, frame in enumerate(frames()):
        PIL.Image.fromarray(frame).save(place / f"{n}.png")
    return place


@pytest.fixture
def video(tmp_path):
    av = pytest.importorskip("av", reason="the extra video is not installed")
    path = tmp_path / "my clip.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=24)
        stream.width, stream.height, stream.bit_rate = 160, 120, 20_000_000
        for frame in frames():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def test_the_sharpest_frame_of_each_window_of_a_folder_is_used(folder, tmp_path):
    (folder / "0.png").write_bytes(b"damaged")
    result = reconstruct(folder, tmp_path / "out", every=3, until="features")
    assert [image.name for image in result.images] == [f"{n}.png" for n in SHARP]
    assert result.summary["images_folder"] == str(folder)
    assert result.reports[0].counts["frames"] == 8
    sentence = r"from every 3 of frames .* starts from every 2 of frames"
    refuses(UsageError, sentence, reconstruct, folder, tmp_path / "out", every=2, until="features")


def test_masks_follow_the_frames_that_are_used(folder, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    for n in range(8):
        mask = np.arange(160 * 120).reshape(120, 160) >= 60 * 160
        PIL.Image.fromarray(mask).save(masks / f"{n}.png.png")
    result = reconstruct(folder, tmp_path / "out", every=3, until="features", masks=masks)
    assert [image.mask.mean() for image in result.images] == [0.5] * 3
    assert not [warning for warning in result.warnings if "mask" in warning]


def test_frames_of_a_video_are_decoded_once(video, tmp_path, monkeypatch):
    out = tmp_path / "out"
    result = reconstruct(video, out, every=3, until="features", threads=2)
    assert [image.name for image in result.images] == [f"my clip-{n:06d}.png" for n in SHARP]
    assert result.summary["images_folder"] == str(out / "00-frames")
    truth = list(frames())
    for image, n in zip(result.images, SHARP, strict=True):
        assert np.abs(image.rgb.astype(float) - truth[n]).mean() < 6.0
    reconstruct(video, tmp_path / "other", every=3, until="features", threads=1)
    for path in (out / "00-frames").iterdir():
        assert path.read_bytes() == (tmp_path / "other" / "00-frames" / path.name).read_bytes()
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "av", None)
        reconstruct(video, out, every=3, until="features")
    (out / "00-frames" / "my clip-000003.png").unlink()
    assert "features" in reconstruct(video, out, every=3, until="features").summary["resumed"]


def test_an_interrupted_extraction_is_no_obstacle(video, tmp_path):
    def interrupt(stage, *_):
        if stage == "frames":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(video, tmp_path / "out", every=1, until="features", progress=interrupt)
    assert [path.name for path in (tmp_path / "out" / "00-frames").iterdir()] == ["my clip-000000.png"]
    result = reconstruct(video, tmp_path / "out", every=3, until="features")
    names = {image.name for image in result.images}
    assert {path.name for path in (tmp_path / "out" / "00-frames").iterdir()} == names | {"frames.json"}


def test_a_video_of_a_turned_phone_is_upright(video, tmp_path):
    """The transform in the header of a track turns the stored frames by 90 degrees clockwise."""
    one, minus, scale = b"\0\1\0\0", b"\xff\xff\0\0", b"\x40\0\0\0"
    upright, header = b"".join([one, bytes(12), one, bytes(12), scale]), video.read_bytes()
    turned = b"".join([bytes(4), one, bytes(4), minus, bytes(16), scale])
    place = header.rindex(upright)
    (tmp_path / "b.mp4").write_bytes(header[:place] + turned + header[place + 36 :])
    paths, *_ = FrameSource(tmp_path / "b.mp4", 3).choose(tmp_path)
    stored, *_ = FrameSource(video, 3).choose(tmp_path / "stored")
    expected = np.rot90(np.asarray(PIL.Image.open(stored[0])), -1)
    np.testing.assert_array_equal(np.asarray(PIL.Image.open(paths[0])), expected)


def test_a_cut_video_gives_the_frames_that_are_left(video, tmp_path):
    av = pytest.importorskip("av")
    content = bytearray(video.read_bytes())
    with av.open(str(video)) as container:
        first = next(p for n, p in enumerate(container.demux(video=0)) if n == 4)
    content[first.pos : first.pos + first.size] = bytes(first.size)
    (tmp_path / "cut.mp4").write_bytes(content)
    paths, total, warnings = FrameSource(tmp_path / "cut.mp4", 3).choose(tmp_path / "out")
    assert (len(paths), total) == (3, 7)
    assert warnings == ["cut.mp4: 1 packet of the video cannot be decoded"]


def test_bad_sources_of_frames_are_one_sentence(folder, tmp_path, monkeypatch, refused):
    out, clip, empty = tmp_path / "out", tmp_path / "clip.mp4", tmp_path / "empty"
    empty.mkdir()
    clip.write_bytes(b"no video at all" * 100)
    for words, source, options in (
        ("at least 1; got 0", folder, {"every": 0}),
        ("at least 1; got 2.5", folder, {"every": 2.5}),
        ("not a list of images", [folder / "1.png"], {"every": 2}),
        ("pairs by name cannot be combined with every", folder, {"every": 2, "pairs": [("1.png", "2.png")]}),
        ("there are no frames in", empty, {"every": 2}),
        ("there is no folder", tmp_path / "nothing.mp4", {"every": 2}),
        ("is a file; give a folder of images, or a video and --every N", clip, {}),
    ):
        refuses(UsageError, words, reconstruct, source, out, **options)
    assert "with --from" in refused(["reconstruct", "--from", clip, "--every", "2", "-o", out])
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "av", None)
        assert "install the extra video" in refused(["reconstruct", clip, "--every", "2", "-o", out])
    pytest.importorskip("av", reason="the extra video is not installed")
    assert "cannot be read as a video" in refused(["reconstruct", clip, "--every", "2", "-o", out])
    shutil.copy(files.__file__, clip)
    assert "cannot be read as a video" in refused(["reconstruct", clip, "--every", "2", "-o", out])


def test_a_video_of_frames_that_do_not_fit_in_memory_is_refused(video, tmp_path, monkeypatch):
    monkeypatch.setattr("thesisrecon.io._frames.MAX_DECODED_BYTES", 160 * 120 * 28)
    choose, words = FrameSource(video, 3).choose, "frames of 160 x 120 pixels; .* the limit of"
    assert len(choose(tmp_path / "fits", threads=64)[0]) == 3
    monkeypatch.setattr("thesisrecon.io._frames.MAX_DECODED_BYTES", 160 * 120 * 27)
    refuses(UsageError, words, choose, tmp_path / "o")
    assert not list(tmp_path.rglob("o/*/*.png"))
