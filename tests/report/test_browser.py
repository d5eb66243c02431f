"""The page as a browser shows it."""

from __future__ import annotations

import dataclasses
import io
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PillowImage

from tests.report.synthetic import made_up_run
from thesisrecon.report import write_report

pytestmark = pytest.mark.browser

ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # The 3D view needs WebGL; without a graphics card Chromium draws it in software only when told so.
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
EVIL = [
    "<img src=x onerror=alert(1)>.jpg",
    "\"quote'&.png",
    "</script><script>alert(2)</script>.jpg",
    "c.jpg",
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("no chromium on this machine (Debian: apt-get install chromium)")
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "report.html"
    title = "<img src=x onerror=alert(9)>"
    write_report(path, dataclasses.replace(made_up_run(names=EVIL, points=3000), title=title))
    return path


class Witness:
    """An opened page with all it complained of and asked for."""

    def __init__(self, browser: Any, path: Path, width: int) -> None:
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page = browser.new_page(viewport={"width": width, "height": 900})
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("dialog", self._dialog)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("#matrix-figure[data-drawn]", timeout=60_000)
        self.page.wait_for_selector("#scene-figure[data-drawn]", timeout=60_000)

    def _dialog(self, dialog: Any) -> None:
        self.errors.append(f"dialog {dialog.message}")
        dialog.dismiss()

    def pixels(self, selector: str) -> np.ndarray:
        """(H, W, 3) of an element as it is shown."""
        shot = self.page.locator(selector).screenshot()
        return np.asarray(PillowImage.open(io.BytesIO(shot)).convert("RGB"))


@pytest.fixture(scope="module", params=[1400, 420], ids=["desktop", "narrow"])
def witness(request: pytest.FixtureRequest, browser: Any, report: Path) -> Iterator[Witness]:
    opened = Witness(browser, report, request.param)
    yield opened
    opened.page.close()


def test_nothing_complains_runs_or_reaches_out(witness: Witness) -> None:
    witness.page.hover("#matrix-figure .nsewdrag")
    assert witness.errors == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in witness.requests)


def test_the_canvas_shows_points_and_cameras(witness: Witness) -> None:
    witness.page.wait_for_timeout(500)
    pixels = witness.pixels("#scene-figure").astype(int)
    ground = np.median(pixels.reshape(-1, 3), axis=0)
    drawn = (np.abs(pixels - ground).max(axis=2) > 40).mean()
    orange = ((pixels[..., 0] > 200) & (np.abs(pixels[..., 1] - 159) < 40) & (pixels[..., 2] < 110)).sum()
    assert drawn > 0.01
    assert orange > 50


def test_the_matrix_is_drawn_in_colour(witness: Witness) -> None:
    assert (np.ptp(witness.pixels("#matrix-figure"), axis=2) > 30).mean() > 0.2


def test_names_are_shown_as_they_are(witness: Witness) -> None:
    shown = witness.page.locator(".card .name").all_inner_texts()
    assert [text.split(" ", 1)[1] for text in shown[: len(EVIL)]] == EVIL
    assert witness.page.locator("h1").inner_text() == "<img src=x onerror=alert(9)>"
    assert witness.page.locator("img[src='x']").count() == 0


def test_the_page_is_no_wider_than_the_screen(witness: Witness) -> None:
    width = witness.page.evaluate("document.documentElement.scrollWidth")
    assert width <= witness.page.viewport_size["width"]


def test_the_table_of_pairs_shows_its_last_column(witness: Witness) -> None:
    overhang = witness.page.evaluate(
        "(() => { const t = document.querySelector('.listing'); return t.scrollWidth - t.clientWidth; })()"
    )
    assert overhang <= 0


def test_the_point_of_view_can_be_chosen(witness: Witness) -> None:
    before = witness.pixels("#scene-figure")
    witness.page.get_by_role("button", name="From above").click()
    witness.page.wait_for_timeout(500)
    after = witness.pixels("#scene-figure")
    assert witness.errors == []
    assert (before != after).any(axis=2).mean() > 0.005


def test_the_numbers_of_the_cameras_unfold(witness: Witness) -> None:
    table = witness.page.locator("#view details").first
    table.locator("summary").click()
    assert table.locator("tbody tr").count() == 3
    assert "2081.4 ± 1.7" in table.inner_text()
