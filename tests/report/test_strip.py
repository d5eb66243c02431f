"""The page of pictures in a row."""

import numpy as np
import pytest

from tests.report.opened import Witness
from thesisrecon.report.page import strip_page

LEVELS = (20, 120, 220)


def page():
    frames = [(f"picture <{k}>", np.full((60, 80, 3), level, np.uint8)) for k, level in enumerate(LEVELS)]
    return strip_page("Between <a> and b", frames, notes=["all is well"])


def test_names_are_escaped_and_nothing_is_loaded():
    text = page()
    assert "Between &lt;a&gt; and b" in text
    assert "picture <1>" not in text
    assert "all is well." in text
    assert 'src="http' not in text
    with pytest.raises(ValueError, match="at least one"):
        strip_page("nothing", [])


@pytest.mark.browser
def test_one_turns_through_the_pictures(browser, tmp_path):
    path = tmp_path / "strip.html"
    path.write_text(page(), encoding="utf-8")
    seen = Witness(browser, path, 900, drawn=())
    assert abs(int(seen.pixels("#shown")[30, 40, 0]) - LEVELS[0]) < 4
    seen.page.locator("#place").press("ArrowRight")
    assert seen.page.inner_text("#told") == "picture <1>"
    assert abs(int(seen.pixels("#shown")[30, 40, 0]) - LEVELS[1]) < 4
    seen.page.click("#play")
    for caption in ("picture <2>", "picture <0>"):
        seen.page.locator("#told", has_text=caption).wait_for()
    seen.page.click("#play")
    assert seen.page.inner_text("#play") == "Play"
    assert seen.errors == []
    assert not [url for url in seen.requests if not url.startswith(("file:", "data:"))]
    seen.context.close()
