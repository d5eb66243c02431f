"""The page as a browser shows it."""

import dataclasses

import numpy as np
import pytest

from tests.report.opened import Witness
from tests.report.synthetic import made_up_run
from thesisrecon.report.page import write_report

pytestmark = pytest.mark.browser

EVIL = [
    "<img src=x onerror=alert(1)>.jpg",
    "\"quote'&.png",
    "</script><script>alert(2)</script>.jpg",
    "c.jpg",
]


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "report.html"
    title = "<img src=x onerror=alert(9)>"
    write_report(path, dataclasses.replace(made_up_run(names=EVIL, points=3000), title=title))
    return path


@pytest.fixture(scope="module", params=[1400, 420], ids=["desktop", "narrow"])
def witness(request, browser, report):
    opened = Witness(browser, report, request.param, drawn=("matrix-figure", "scene-figure"))
    yield opened
    opened.context.close()


def test_nothing_complains_runs_or_reaches_out(witness):
    witness.page.hover("#matrix-figure .nsewdrag")
    assert witness.errors == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in witness.requests)


def test_the_canvas_shows_points_and_cameras(witness):
    witness.page.wait_for_timeout(500)
    pixels = witness.pixels("#scene-figure").astype(int)
    ground = np.median(pixels.reshape(-1, 3), axis=0)
    drawn = (np.abs(pixels - ground).max(axis=2) > 40).mean()
    orange = ((pixels[..., 0] > 200) & (np.abs(pixels[..., 1] - 159) < 40) & (pixels[..., 2] < 110)).sum()
    assert drawn > 0.01
    assert orange > 50


def test_the_matrix_is_drawn_in_colour(witness):
    assert (np.ptp(witness.pixels("#matrix-figure"), axis=2) > 30).mean() > 0.2


def test_names_are_shown_as_they_are(witness):
    shown = witness.page.locator(".card .name").all_inner_texts()
    assert [text.split(" ", 1)[1] for text in shown[: len(EVIL)]] == EVIL
    assert witness.page.locator("h1").inner_text() == "<img src=x onerror=alert(9)>"
    assert witness.page.locator("img[src='x']").count() == 0


def test_the_page_is_no_wider_than_the_screen(witness):
    width = witness.page.evaluate("document.documentElement.scrollWidth")
    assert width <= witness.page.viewport_size["width"]


def test_the_table_of_pairs_shows_its_last_column(witness):
    overhang = witness.page.evaluate(
        "(() => { const t = document.querySelector('.listing'); return t.scrollWidth - t.clientWidth; })()"
    )
    assert overhang <= 0


def test_the_point_of_view_can_be_chosen(witness):
    before = witness.pixels("#scene-figure")
    witness.page.get_by_role("button", name="From above").click()
    witness.page.wait_for_timeout(500)
    after = witness.pixels("#scene-figure")
    assert witness.errors == []
    assert (before != after).any(axis=2).mean() > 0.005


def test_the_numbers_of_the_cameras_unfold(witness):
    table = witness.page.locator("#view details").first
    table.locator("summary").click()
    assert table.locator("tbody tr").count() == 3
    assert "2081.4 ± 1.7" in table.inner_text()
