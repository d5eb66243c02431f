"""The pages of a report as a browser shows them."""

import numpy as np
import PIL.Image
import pytest

from tests.report.synthetic import Witness
from tests.validation.runs.toy_stages import STAGES, WAYS
from validation.runs.page import write_pages
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions
from validation.runs.results import Gate, collect
from validation.runs.tables import Metric, Plot

pytestmark = pytest.mark.browser
EVIL = "<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A report of two numbers, one of which breaks its gate, with a flat and a solid plot and a picture."""
    out = tmp_path_factory.mktemp("pages")
    options = ReportOptions(out, ("yard",), ("toy",))
    values = dict.fromkeys(WAYS, 1.5)
    metrics = [
        Metric("yard", "wheels, lost", "px", values, "ours", definition=EVIL),
        Metric("yard", EVIL, "%", {"ours": 3.0}, "ours"),
    ]
    xyz = np.random.default_rng(0).normal(size=(3, 60)).round(3).tolist()
    dots = {"type": "scatter3d", "mode": "markers", **dict(zip("xyz", xyz, strict=True))}
    line = {"type": "scatter", "y": [1, 3, 2], "line": {"color": "#d01010", "width": 6}}
    solid, flat = {"data": [dots], "layout": {"scene": {}}}, {"data": [line], "layout": {}}
    options.folder("toy", "yard").mkdir(parents=True)
    PIL.Image.new("RGB", (40, 30), (10, 10, 200)).save(options.folder("toy", "yard") / "blue.png")
    pictures = [Picture("blue.png", EVIL, EVIL)]
    judgement = Judgement(metrics, [EVIL], [Plot("Flat", flat), Plot("Solid", solid)], pictures)
    failed = Outcome(out, EVIL)
    judged = {("toy", "yard"): (judgement, {"ours": Outcome(out), "crashing": failed})}
    gates = {"toy/yard/wheels-lost": Gate("toy/yard/wheels-lost", 1.0, True, EVIL)}
    write_pages(options, STAGES, judged, collect(options, judged, gates))
    return out


@pytest.mark.parametrize("width", [1300, 420])
def test_the_page_of_a_scene(width, browser, pages):
    scene = Witness(browser, pages / "scene-yard.html", width, drawn=("plot-toy-0", "plot-toy-1"))
    try:
        assert scene.errors == []
        assert all(url.startswith(("file:", "data:", "blob:")) for url in scene.requests)
        first = scene.page.locator("main > section").first.inner_text()
        assert "toy/yard/wheels-lost: 1.5 px, at most 1" in first
        assert scene.page.locator("tr.missed").count() == 1
        assert scene.page.locator("img[src='x']").count() == 0
        assert EVIL in scene.page.locator("#failures").inner_text()
        assert scene.page.evaluate("document.documentElement.scrollWidth") <= width
        red, blue = (scene.pixels(place).astype(int) for place in ("#plot-toy-0", ".scene-pictures img"))
        assert ((red[..., 0] > 180) & (red[..., 1] < 90) & (red[..., 2] < 90)).sum() > 200
        assert np.median(blue[..., 2]) > 180 > np.median(blue[..., 0])
    finally:
        scene.context.close()


def test_the_whole_leads_to_the_scene(browser, pages):
    whole = Witness(browser, pages / "index.html", 1300, drawn=("plot-overview",))
    whole.page.get_by_role("link", name="yard").click()
    assert whole.page.locator("h1").inner_text() == "yard"
    assert whole.errors == []
    whole.context.close()
