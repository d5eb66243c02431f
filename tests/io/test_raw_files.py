"""Raw files and reduced first images: each is refused by name, ordinary TIFF files are read."""

import struct

import numpy as np
import pytest

from tests.bad_input import files
from tests.conftest import refuses
from thesisrecon import reconstruct
from thesisrecon.errors import UsageError
from thesisrecon.io._images import list_images, read_images, read_mask

SENSOR, RGB, GREY = 32803, 2, 1
RAW = "is a raw file: convert it to JPEG, PNG or TIFF"


def image(width, height, photometric=RGB, seed=0, **tags):
    """Tags of an uncompressed image and its pixels."""
    bands = 3 if photometric == RGB else 1
    pixels = np.asarray(files.picture(seed, (width, height)))[..., :bands].tobytes()
    strip = {
        "strip": pixels, 256: width, 257: height, 258: 8, 259: 1, 262: photometric, 277: bands, 278: height,
    }  # fmt: skip
    return strip | {279: len(pixels)} | {int(tag[1:]): value for tag, value in tags.items()}


def tiff(pages, inner=(), *, order="<", big=False, header=b""):
    """A TIFF file of pages; the images ``inner`` stand in the SubIFDs of the first."""
    kinds = ("H", "HHI", "I") if not big else ("Q", "HHQ", "Q")
    count, entry, offset = (order + kind for kind in kinds)
    width = struct.calcsize(offset)
    data = bytearray({"<": b"II", ">": b"MM"}[order])
    data += struct.pack(order + "HHH", 43, 8, 0) if big else struct.pack(order + "H", 42)
    start = len(data)
    data += bytes(width) + header

    def write(tags, place):
        tags = dict(tags)
        if "strip" in tags:
            tags[273] = len(data)
            data.extend(tags.pop("strip"))
        data[place : place + width] = struct.pack(offset, len(data))
        data.extend(struct.pack(count, len(tags)))
        places = {}
        for tag, value in sorted(tags.items()):
            values = value if isinstance(value, tuple) else (value,)
            data.extend(struct.pack(entry, tag, 4, len(values)))
            places[tag] = len(data), values
            data.extend(struct.pack(f"{order}I", values[0]).ljust(width, b"\0"))
        data.extend(bytes(width))
        end = len(data) - width
        for tag, (at, values) in places.items():
            if 4 * len(values) > width:
                data[at : at + width] = struct.pack(offset, len(data))
                places[tag] = len(data), values
                data.extend(struct.pack(f"{order}{len(values)}I", *values))
        return end, places

    following, first = start, None
    for tags in pages:
        following, places = write(tags | ({330: (0,) * len(inner)} if inner and not first else {}), following)
        first = first or places
    for n, tags in enumerate(inner):
        at = [len(data)]
        data.extend(bytes(width))
        write(tags, at[0])
        # SubIFDs are 4-byte offsets of the directories.
        (found,) = struct.unpack(offset, data[at[0] : at[0] + width])
        data[first[330][0] + 4 * n : first[330][0] + 4 * n + 4] = struct.pack(order + "I", found)
    return bytes(data)


def reason(path):
    found = read_images(path.parent, max_size_px=1600)
    assert not found.images
    return found.refused[path.name]


THUMBNAIL, LARGE = image(96, 72, _254=1), image(288, 216, SENSOR, _254=0)
RAW_FILES = {
    "DSC_1.NEF": tiff([THUMBNAIL], [LARGE]),
    "DSC_2.nef": tiff([THUMBNAIL], [image(192, 144), LARGE], order=">"),
    "a.tif": tiff([image(96, 72)], [LARGE]),
    "b.tiff": tiff([image(96, 72)], [image(288, 216, GREY)], order=">"),
    "big.tif": tiff([THUMBNAIL], [LARGE], big=True), "c.DNG": tiff([image(96, 72, _50706=0x01040000)]),
    "d.tif": tiff([image(96, 72, _50706=0x01040000)]),
    "e.cr2": tiff([image(96, 72)], header=b"CR\2\0\0\0\0\0"),
    "e.tif": tiff([image(96, 72)], header=b"CR\2\0\0\0\0\0"), "f.arw": tiff([image(96, 72)]),
    "g.tif": tiff([image(96, 72), image(96, 72, 34892)]), "h.pef": tiff([image(288, 216, SENSOR)]),
    "i.tif": tiff([image(288, 216, SENSOR)]), "j.RAF": b"FUJIFILMCCD-RAW 0201" + bytes(99),
    "k.orf": b"IIRO\x08\0\0\0" + bytes(99), "l.rw2": b"IIU\0\x18\0\0\0" + bytes(99),
    "m.CR3": b"\0\0\0\x18ftypcrx " + bytes(99), "n": tiff([THUMBNAIL], [LARGE]), "o.mos": b"something else",
}  # fmt: skip


@pytest.mark.parametrize("name", RAW_FILES)
def test_raw_files_are_refused_by_name(tmp_path, name):
    (tmp_path / name).write_bytes(RAW_FILES[name])
    assert reason(tmp_path / name) == RAW


def test_a_jpeg_beside_its_raw_file_is_used_and_no_raw_file_is_a_mask(tmp_path):
    files.picture(1).save(tmp_path / "DSC_1.JPG", "JPEG")
    (tmp_path / "DSC_1.NEF").write_bytes(RAW_FILES["DSC_1.NEF"])
    # The content decides, not the suffix.
    files.picture(2).save(tmp_path / "DSC_2.NEF", "JPEG")
    found = read_images(tmp_path, max_size_px=1600)
    assert [one.name for one in found.images] == ["DSC_1.JPG", "DSC_2.NEF"]
    assert found.refused == {"DSC_1.NEF": RAW}
    words = r"the mask .*DSC_1\.NEF is a raw file"
    refuses(UsageError, words, read_mask, tmp_path / "DSC_1.NEF", found.images[0])


FIRST = image(96, 72)
REDUCED = [
    [image(96, 72, _254=1), image(90, 80)], [image(96, 72, _255=2), image(90, 80)], [FIRST, image(288, 216)],
]  # fmt: skip
ORDINARY = [
    tiff([FIRST]), tiff([FIRST], order=">"), tiff([image(96, 72, _254=1)]),
    tiff([FIRST, image(48, 36, _254=1)]), tiff([FIRST], [image(48, 36, _254=1), image(24, 18)]),
    tiff([FIRST, FIRST]), tiff([FIRST, image(100, 200)]),
]  # fmt: skip


@pytest.mark.parametrize("pages", REDUCED)
def test_a_reduced_image_before_the_full_one_is_refused(tmp_path, pages):
    (tmp_path / "a.tif").write_bytes(tiff(pages))
    words = "begins with a reduced image of 96 x 72 pixels: save the full image alone"
    assert reason(tmp_path / "a.tif") == words


@pytest.mark.parametrize("content", ORDINARY)
def test_ordinary_tiff_files_are_read(tmp_path, content):
    """Pyramids and pages of other images are no thumbnails."""
    (tmp_path / "a.tif").write_bytes(content)
    (found,) = read_images(tmp_path, max_size_px=1600).images
    np.testing.assert_array_equal(found.rgb, np.asarray(files.picture(0, (96, 72))))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("seed", range(20))
def test_damaged_tags_end_with_a_sentence(tmp_path, order, seed):
    """Loops, offsets behind the end, and counts that no file holds."""
    rng = np.random.default_rng(seed)
    content = bytearray(tiff([image(16, 12), image(16, 12)], [image(32, 24)], order=order))
    for place in rng.integers(4, len(content), 60):
        content[place] = rng.integers(256)
    (tmp_path / "a.tif").write_bytes(content[: rng.integers(8, len(content))])
    assert reason(tmp_path / "a.tif")


def test_files_are_listed_by_their_content(tmp_path):
    kinds = {
        "a.jfif": "JPEG", "b.mpo": "JPEG", "c.insp": "JPEG", "d": "PNG", "e.jpg_large": "WEBP",
        "f.x": "TIFF", "g.image": "BMP", "h.anim": "GIF", "i.dat": "PPM", "j.j2k": "JPEG2000",
        "k.png": "JPEG",
    }  # fmt: skip
    for seed, (name, kind) in enumerate(kinds.items()):
        files.picture(seed).save(tmp_path / name, kind)
    others = {
        "notes.txt": b"P3 is the third point\n", "BMW": b"BMW 320, and more about the car",
        "a.xmp": b"<x:xmpmeta>", ".DS_Store": b"\0\0\0\1Bud1",
        "Thumbs.db": b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "x.json": b"{}", "empty": b"",
        "._a.jfif": b"\0\5\x16\7\0\2\0\0Mac OS X", ".b.jpg": files.encoded("JPEG"),
        "MVI.THM": files.encoded("JPEG"), "clip.mp4": b"\0\0\0\x18ftypmp42",
        "mesh.ply": b"ply\nformat ascii 1.0\n",
    }  # fmt: skip
    for name, content in others.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder").mkdir()
    files.pipe(tmp_path / "pipe")
    assert [path.name for path in list_images(tmp_path)] == list(kinds)
    found = read_images(tmp_path, max_size_px=1600)
    assert [one.name for one in found.images] == list(kinds)
    assert not found.refused


def test_numbers_in_names_are_compared_as_numbers(tmp_path):
    ordered = [
        "IMG (2).png", "IMG (10).png", "f-3.png", "f.png", "f001.png", "f1.png", "f1b2.png", "f1b10.png",
        "f2.png", "f9.png", "f10.png", "f0100.png", "g.png",
    ]  # fmt: skip
    for seed, name in enumerate(sorted(ordered)):
        files.picture(seed).save(tmp_path / name)
    assert [path.name for path in list_images(tmp_path)] == ordered
    for given in (tmp_path, sorted(tmp_path.iterdir())):
        assert [one.name for one in read_images(given, max_size_px=1600).images] == ordered


def test_many_files_left_out_for_one_reason_are_counted(tmp_path):
    for n in range(8):
        (tmp_path / f"DSC_{n}.NEF").write_bytes(RAW_FILES["DSC_1.NEF"])
        if n < 2:
            files.picture(n).save(tmp_path / f"DSC_{n}.JPG")
            (tmp_path / f"cut{n}.jpg").write_bytes(b"\xff\xd8\xff")
    found = reconstruct(tmp_path, tmp_path / "out", until="features", max_size=80, threads=1)
    warnings = [warning for warning in found.warnings if "left out" in warning]
    assert warnings[0].startswith("DSC_0.NEF and 7 more files are left out: each is a raw file: ")
    assert [warning[:20] for warning in warnings[1:]] == ["cut0.jpg is left out", "cut1.jpg is left out"]
    assert len(found.refused) == 10


def test_pictures_of_formats_that_are_not_read_are_named(tmp_path):
    files.picture(0).save(tmp_path / "a.png")
    files.picture(1).save(tmp_path / "b.tga")
    (tmp_path / "c.PSD").write_bytes(b"8BPS\0\1")
    refused = read_images(tmp_path, max_size_px=1600).refused
    assert dict.fromkeys(["b.tga", "c.PSD"], "is not an image of a known format") == refused
