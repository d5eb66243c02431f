"""The model as a browser shows it."""

import numpy as np
import pytest

from tests.report.opened import Witness
from tests.report.sphere_run import sphere_run
from tests.surface.sphere import SHAPE, K, photograph, ring_of
from thesisrecon.report.page import write_report

pytestmark = pytest.mark.browser
CANVAS = "#model-figure canvas"
RECORD_VIEWS = """
window.views = new Set();
const before = WebGL2RenderingContext.prototype.uniformMatrix4fv;
WebGL2RenderingContext.prototype.uniformMatrix4fv = function (place, turned, values) {
  if (values[15] === 1) { views.add(values.join()); }
  return before.call(this, place, turned, values);
};
"""
WITHOUT_WEBGL = """
const before = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : before.call(this, kind, ...rest);
};
"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "report.html"
    write_report(path, sphere_run())
    return path


@pytest.fixture(scope="module", params=[1400, 420], ids=["desktop", "narrow"])
def opened(request, browser, report):
    witness = Witness(browser, report, request.param, drawn=("model-figure",), reduced_motion="reduce")
    yield witness
    witness.context.close()


@pytest.fixture
def witness(opened):
    opened.page.locator("#model-reset").click()
    return opened


def shown(witness):
    witness.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return witness.pixels(CANVAS).astype(int)


def where(picture):
    """Row and column in the picture of every pixel of a photograph whose stand the viewer takes."""
    height, width = picture.shape[:2]
    side, up = (SHAPE[1] / 2 / K[0, 0], SHAPE[0] / 2 / K[1, 1])
    field = max(up, side * height / width)
    y, x = np.indices(SHAPE)
    column = width / 2 * (1 + (x - K[0, 2]) / K[0, 0] / (field * width / height)) - 0.5
    row = height / 2 * (1 + (y - K[1, 2]) / K[1, 1] / field) - 0.5
    return np.rint(row).astype(int), np.rint(column).astype(int)


def apart(one, two):
    """Share of the pixels that differ clearly."""
    return float((np.abs(one - two).max(axis=2) > 30).mean())


def inner(view):
    """The pixels of a photograph where the sphere is, off its rim."""
    seen = np.isfinite(ring_of()[view].depth).astype(float)
    near = np.lib.stride_tricks.sliding_window_view(np.pad(seen, 3), (7, 7))
    return np.asarray(near.min(axis=(2, 3)) > 0)


@pytest.mark.parametrize("view", [0, 3, 6])
def test_where_a_photograph_was_taken_the_model_looks_like_it(witness, view):
    witness.page.select_option("#model-stand", str(view))
    picture = shown(witness)
    expected = photograph(ring_of()[view]).rgb.astype(int)
    difference = picture[where(picture)] - expected
    assert np.sqrt(np.mean(difference[inner(view)] ** 2)) < 14.0
    ground = np.array([0x13, 0x1A, 0x22])
    off = picture[where(picture)][:, [0, -1]]
    assert np.abs(off - ground).max() <= 2


def test_it_starts_at_a_photograph_and_comes_back_to_it(witness):
    start = shown(witness)
    witness.page.get_by_role("button", name="Shape").click()
    witness.page.locator("#model").get_by_role("button", name="From above").click()
    assert witness.page.input_value("#model-stand") == ""
    assert apart(shown(witness), start) > 0.1
    witness.page.locator("#model-reset").click()
    assert apart(shown(witness), start) == 0.0
    assert witness.page.input_value("#model-stand") != ""


def test_every_point_of_view_shows_all_of_the_model_in_its_middle(witness):
    pictures = []
    for name in ("Behind the cameras", "From above", "From the left", "From the right"):
        witness.page.locator("#model").get_by_role("button", name=name).click()
        picture = shown(witness)
        drawn = np.abs(picture - picture[2, picture.shape[1] // 2]).max(axis=2) > 12
        rows, columns = (np.flatnonzero(drawn.any(axis=d)) for d in (1, 0))
        height, width = drawn.shape
        assert max(np.ptp(rows) / height, np.ptp(columns) / width) > 0.7
        assert abs((rows[0] + rows[-1]) / height - 1.0) < 0.1
        assert abs((columns[0] + columns[-1]) / width - 1.0) < 0.1
        pictures.append(picture)
    for k, one in enumerate(pictures):
        assert all(apart(one, two) > 0.1 for two in pictures[:k])


def test_shape_is_grey_and_texture_is_not(witness):
    coloured = np.ptp(shown(witness), axis=2)
    witness.page.get_by_role("button", name="Shape").click()
    grey = np.ptp(shown(witness), axis=2)
    middle = tuple(slice(n // 2 - n // 8, n // 2 + n // 8) for n in coloured.shape)
    assert np.median(coloured[middle]) > 50
    assert grey[middle].max() < 16
    pressed = witness.page.locator("button[data-paint][aria-pressed=true]")
    assert pressed.all_inner_texts() == ["Shape"]
    witness.page.get_by_role("button", name="Texture").click()
    assert np.median(np.ptp(shown(witness), axis=2)[middle]) > 50


def test_dragging_and_keys_turn_it(witness):
    start = shown(witness)
    box = witness.page.locator(CANVAS).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    witness.page.mouse.move(x, y)
    witness.page.mouse.down()
    witness.page.mouse.move(x + 90, y + 20, steps=3)
    witness.page.mouse.up()
    dragged = shown(witness)
    assert apart(dragged, start) > 0.1
    witness.page.mouse.move(x - 30, y)
    assert apart(shown(witness), dragged) == 0.0  # the button is up again
    witness.page.locator(CANVAS).focus()
    for key in ("ArrowLeft", "ArrowUp", "+", "t"):
        before = shown(witness)
        witness.page.keyboard.press(key)
        assert apart(shown(witness), before) > 0.02, key
    witness.page.keyboard.press("Home")
    witness.page.locator(CANVAS).blur()  # the ring about what has the focus
    assert apart(shown(witness), start) == 0.0


def test_the_wheel_moves_the_page_until_the_picture_was_clicked(witness):
    start = shown(witness)
    witness.page.locator(CANVAS).hover()
    before = witness.page.evaluate("scrollY")
    witness.page.mouse.wheel(0, 200)
    witness.page.wait_for_timeout(500)
    assert witness.page.evaluate("scrollY") > before
    assert apart(shown(witness), start) == 0.0
    witness.page.locator(CANVAS).click()
    scrolled = witness.page.evaluate("scrollY")
    witness.page.mouse.wheel(0, 300)
    assert apart(shown(witness), start) > 0.05
    assert witness.page.evaluate("scrollY") == scrolled
    witness.page.locator("#model h2").click()
    assert "awake" not in witness.page.locator("#model-figure").get_attribute("class")


def test_it_comes_back_after_the_graphics_card_was_lost(witness):
    start = shown(witness)
    witness.page.evaluate(
        f"""new Promise(function (done) {{
          const canvas = document.querySelector("{CANVAS}");
          const lose = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
          canvas.addEventListener("webglcontextlost", function () {{
            setTimeout(function () {{ lose.restoreContext(); }}, 50);
          }});
          canvas.addEventListener("webglcontextrestored", function () {{ setTimeout(done, 400); }});
          lose.loseContext();
        }})"""
    )
    assert apart(shown(witness), start) == 0.0


def test_nothing_complains_reaches_out_or_is_too_wide(witness):
    assert witness.errors == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in witness.requests)
    assert (
        witness.page.evaluate("document.documentElement.scrollWidth") <= (witness.page.viewport_size["width"])
    )


def test_pictures_of_depth_and_comparison_are_shown(witness):
    widths = witness.page.evaluate(
        "[...document.querySelectorAll('#depth img, #held-out img')].map(i => i.complete && i.naturalWidth)"
    )
    assert widths == [SHAPE[1]] * (7 + 3)


def test_a_fine_screen_gets_at_most_twice_the_pixels_and_the_eye_glides(browser, report):
    drawn = ("model-figure", "scene-figure")
    screen = {"device_scale_factor": 3, "has_touch": True}
    witness = Witness(browser, report, 420, drawn=drawn, script=RECORD_VIEWS, **screen)
    canvas = witness.page.locator(CANVAS)
    assert canvas.evaluate("c => c.width") == 2 * canvas.evaluate("c => c.clientWidth")
    ways = []
    for motion, name in (("no-preference", "From above"), ("reduce", "From the left")):
        witness.page.emulate_media(reduced_motion=motion)
        witness.page.evaluate("views.clear()")
        witness.page.locator("#model").get_by_role("button", name=name).click()
        witness.page.wait_for_timeout(700)
        ways.append(witness.page.evaluate("views.size"))
    assert ways[0] > 1  # how many depends on how fast the machine draws
    assert ways[1] == 1  # at once where motion is unwelcome
    before = shown(witness)
    spread_fingers(witness)
    assert apart(shown(witness), before) > 0.1
    awake = "document.querySelector('#model-figure').classList.contains('awake')"
    assert witness.page.evaluate(awake)
    witness.page.locator("#model h2").tap()
    assert not witness.page.evaluate(awake)
    witness.context.close()


def spread_fingers(witness):
    """Two fingers on the middle of the canvas go apart."""
    hand = witness.context.new_cdp_session(witness.page)
    box = witness.page.locator(CANVAS).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for kind, reach in (("touchStart", 30), ("touchMove", 40), ("touchMove", 60), ("touchEnd", 0)):
        points = [{"x": x + side * reach, "y": y, "id": side + 1} for side in (-1, 1)] if reach else []
        hand.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def test_without_webgl_a_sentence_says_so(browser, report):
    witness = Witness(browser, report, 1000, drawn=(), script=WITHOUT_WEBGL)
    text = witness.page.locator("#model-figure").inner_text()
    assert "no WebGL 2" in text
    assert "model.glb" in text
    assert not witness.page.locator("#model-reset").is_visible()
    assert all("viewer" not in error.lower() for error in witness.errors)
    witness.context.close()
