"""Hostile names of images, folders and headers cannot inject elements, attributes or scripts into a page."""

import json
import re
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from tests.report.synthetic import Structure, Witness, unpacked
from thesisrecon.cli.commands import run_command
from thesisrecon.runtime._precompilation import precompile

COURTYARD = Path(__file__).parents[2] / "fixtures" / "courtyard" / "images"
MARK = "header-of-a-photograph"
SNARES = [
    "<img src=x onerror=alert(1)>", "\"><script>alert('2')", "' onload='alert(3)' x='",
    "]]>--><svg onload=alert(4)>", "{{ self }}{% raw %}${alert(5)}`",
    "\u2028<\u202ebody onpageshow=alert(6)>",
]  # fmt: skip
PLAIN = ["a", "b", "c", "d", "e", "f"]
TEXTS = (0x010E, 0x010F, 0x0110, 0x013B, 0x8298)
"""Description, make, model, artist and copyright."""


def images(folder, names, *, snare):
    """Two photographs of a scene, an animation, and three files that are none, by these names."""
    folder.mkdir()
    exif = PIL.Image.Exif()
    for tag in TEXTS:
        exif[tag] = f"{MARK}{snare}</script></style></textarea>"
    exif[0x8769] = {0x9286: b"ASCII\0\0\0" + f"{MARK}{snare}".encode(), 0xA434: f"{MARK}{snare}"}
    for k, name in enumerate(names[:2]):
        with PIL.Image.open(COURTYARD / f"000{k + 6}.jpg") as picture:
            picture.reduce(4).save(folder / f"{name}.jpg", exif=exif, comment=f"{MARK}{snare}", quality=95)
    rng = np.random.default_rng(0)
    film = [PIL.Image.fromarray(rng.integers(0, 256, (96, 128), dtype=np.uint8)) for _ in range(2)]
    film[0].save(folder / f"{names[2]}.gif", save_all=True, append_images=film[1:], comment=snare.encode())
    for name in names[3:]:
        (folder / f"{name}.png").write_text(snare, encoding="utf-8")
    return folder


def page_of(place, names, title, snare):
    """The page of a run."""
    place.mkdir()
    folder, out = images(place / title, names, snare=snare), place / f"out {title}"
    command = ["reconstruct", str(folder), "-o", str(out), "--until", "matches", "--threads", "2"]
    assert run_command([*command, "--set", "pairs.kind=all-pairs"]) == 0
    return out / "report.html"


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The same run with plain names and with evil ones."""
    # A run that compiles says so on its page.
    precompile("matches", 2, lambda *_: None)
    place = tmp_path_factory.mktemp("pages")
    return (
        page_of(place / "plain", PLAIN, "scene", "nothing"),
        page_of(place / "evil", SNARES, "<script>alert(7)", SNARES[0]),
    )


def scripts(page):
    """The programs on a page, unpacked; data are none."""
    library = [unpacked(page, "plotly")] if 'id="plotly"' in page else []
    return re.findall(r"<script>(.*?)</script>", page, re.S) + library


def test_names_add_no_element_and_no_attribute_and_headers_are_nowhere(pages):
    plain, evil = (path.read_text(encoding="utf-8") for path in pages)
    one, other = Structure(plain), Structure(evil)
    # How a number is worded may differ between runs; what stands around it may not.
    assert one.elements == other.elements
    assert other.handlers == []
    assert scripts(plain) == scripts(evil)
    assert len(scripts(evil)) == len(re.findall(r"sha256-", evil))
    reported = "".join(other.words)
    for name in SNARES[:5]:
        assert name in reported
    assert "\\u2028<\\u202ebody" in reported
    assert "<script>alert(7)" in reported
    for block in re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', evil, re.S):
        json.loads(block)
    for path in pages[1].parent.rglob("*"):
        if path.is_file():
            assert MARK.encode() not in path.read_bytes()


@pytest.mark.browser
def test_nothing_of_theirs_runs_in_a_browser(pages, browser):
    opened = Witness(browser, pages[1], 1000, drawn=("matrix-figure",))
    opened.page.hover("#matrix-figure .nsewdrag")
    opened.page.wait_for_timeout(300)
    assert opened.errors == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in opened.requests)
    assert opened.page.locator("img[src='x'], [onload], [onerror], [onpageshow]").count() == 0
    shown = opened.page.locator(".card .name").all_inner_texts()
    assert any(f"{SNARES[0]}.jpg" in text for text in shown)
    opened.context.close()
