"""The viewer of the model and the pages of runs as a browser shows them."""

import base64
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PillowImage

from tests.report import synthetic
from tests.surface.sphere import SHAPE, K, photograph, ring_of
from thesisrecon.camera import decompose_camera
from thesisrecon.records import TexturedMesh
from thesisrecon.report import _figures
from thesisrecon.report._figures import LEVELS, numbered_cameras, upright_rotation, viewer_data
from thesisrecon.report._page import render_report


def unpacked(text, kind, columns):
    return np.frombuffer(base64.b64decode(text), dtype=kind).reshape(-1, columns)


def upright():
    P = synthetic.sphere_reconstruction().P
    return upright_rotation(np.stack([decompose_camera(p)[1] for p in P]))


def data_of(mesh, reconstruction=None):
    cameras = reconstruction or synthetic.sphere_reconstruction()
    return viewer_data(mesh, numbered_cameras(cameras, synthetic.SPHERE_NAMES))


def corners(data):
    """(M, 3, 3) of every triangle as the viewer places it."""
    low, high = np.array(data["low"]), np.array(data["high"])
    positions = low + unpacked(data["positions"], "<u2", 3) / LEVELS * (high - low)
    return positions[unpacked(data["indices"], "<u4", 3)]


def test_every_triangle_arrives_where_it_is_with_its_texture():
    mesh = synthetic.sphere_model()
    assert mesh.uv is not None
    data = json.loads(json.dumps(data_of(mesh), allow_nan=False))
    step = max(np.array(data["high"]) - data["low"]) / LEVELS
    expected = (mesh.vertices @ upright().T)[mesh.faces]
    assert np.abs(corners(data) - expected).max() <= 0.51 * step
    uv = unpacked(data["uv"], "<u2", 2)[unpacked(data["indices"], "<u4", 3)] / LEVELS
    height, width = mesh.texture.shape[:2]
    assert np.abs(uv * (width, height) - 0.5 - mesh.uv).max() < 0.51 * max(width, height) / LEVELS
    picture = PillowImage.open(io.BytesIO(base64.b64decode(data["texture"].split(",")[1])))
    assert picture.size == (width, height)
    assert np.abs(np.asarray(picture).astype(int) - mesh.texture).mean() < 6.0


def test_a_model_with_colours_or_none_needs_no_texture():
    mesh = synthetic.sphere_model()
    colors = np.random.default_rng(0).integers(0, 255, mesh.vertices.shape, dtype=np.uint8)
    bare = replace(mesh, uv=None, texture=None, untextured=None)
    coloured = data_of(replace(bare, colors=colors))
    assert "texture" not in coloured
    np.testing.assert_array_equal(unpacked(coloured["colors"], "u1", 3), colors)
    plain = unpacked(data_of(bare)["colors"], "u1", 3)
    assert (plain == (200, 200, 200)).all()
    assert len(plain) == len(unpacked(data_of(bare)["positions"], "<u2", 3))


def test_the_viewer_stands_where_photographs_were_taken():
    data, cameras = data_of(synthetic.sphere_model()), synthetic.sphere_reconstruction()
    some = np.arange(8) != 3
    without = replace(cameras, registered=some, P=cameras.P * some[:, None, None])
    shown = data_of(synthetic.sphere_model(), without)["viewpoints"]
    assert [stand["name"][0] for stand in shown] == list("1235678")
    names = [f"{k + 1} · {name}" for k, name in enumerate(synthetic.SPHERE_NAMES)]
    assert [stand["name"] for stand in data["viewpoints"]] == names
    turn = upright()
    for stand, P in zip(data["viewpoints"], synthetic.sphere_reconstruction().P, strict=True):
        R, t = decompose_camera(P)[1:]
        np.testing.assert_allclose(stand["eye"], turn @ (-R.T @ t), atol=1e-9)
        ahead = np.array(stand["target"]) - stand["eye"]
        np.testing.assert_allclose(ahead / np.linalg.norm(ahead), turn @ R[2], atol=1e-9)
        # Looking at the sphere from 3.8 away, the middle depth lies between its front and its back.
        assert 2.5 < np.linalg.norm(ahead) < 4.9
        np.testing.assert_allclose(
            stand["field"], (synthetic.SPHERE_SIZE[0] / 300.0, synthetic.SPHERE_SIZE[1] / 300.0)
        )
    assert 0 <= data["start"] < len(synthetic.SPHERE_NAMES)


def test_a_texture_beyond_the_limit_is_reduced(monkeypatch):
    monkeypatch.setattr(_figures, "MAX_TEXELS", 100 * 100)
    data = data_of(synthetic.sphere_model())
    picture = PillowImage.open(io.BytesIO(base64.b64decode(data["texture"].split(",")[1])))
    assert 0.9 * 100 * 100 < picture.width * picture.height <= 100 * 100


def test_flat_models_are_shown_and_strays_take_no_resolution():
    flat = TexturedMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]), np.array([[0, 1, 2]]))
    data = data_of(flat)
    assert np.isfinite(corners(data)).all()
    assert (np.array(data["high"]) > data["low"]).all()
    angle = np.linspace(0.0, 2.0 * np.pi, 41)[:-1]
    rim = np.column_stack([np.cos(angle), np.sin(angle), np.full(40, 4.0)])
    faces = np.array([[k, (k + 1) % 40, 40] for k in range(40)])
    assert len(corners(data_of(TexturedMesh(np.vstack([rim, [[0.0, 0.0, 1000.0]]]), faces)))) == 40
    mesh = synthetic.sphere_model()
    far = np.array([[500.0, 0, 0], [501, 0, 0], [500, 1, 0]])
    n = len(mesh.vertices)
    spoiled = replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, far]),
        faces=np.concatenate([mesh.faces, [[n, n + 1, n + 2]]]),
        uv=np.concatenate([mesh.uv, mesh.uv[:1]]),
    )
    assert data_of(spoiled) == data_of(mesh)
    bare = replace(spoiled, uv=None, texture=None)
    np.testing.assert_array_equal(
        corners(data_of(bare)), corners(data_of(replace(mesh, uv=None, texture=None)))
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "report.html"
    path.write_text(render_report(synthetic.made_up_run(points=3000)), "utf-8")
    return path


@pytest.fixture(scope="module", params=[1400, 420], ids=["desktop", "narrow"])
def witness(request, browser, report):
    opened = synthetic.Witness(browser, report, request.param, drawn=("matrix-figure", "scene-figure"))
    yield opened
    opened.context.close()


def require_quiet(witness):
    """Require that a page does not complain, reaches nothing outside, and is not too wide."""
    assert witness.errors == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in witness.requests)
    width = witness.page.evaluate("document.documentElement.scrollWidth")
    assert width <= witness.page.viewport_size["width"]


@pytest.mark.browser
def test_nothing_complains_runs_reaches_out_or_is_too_wide(witness):
    witness.page.hover("#matrix-figure .nsewdrag")
    require_quiet(witness)
    overhang = "(t => t.scrollWidth - t.clientWidth)(document.querySelector('.listing'))"
    assert witness.page.evaluate(overhang) <= 0


@pytest.mark.browser
def test_points_and_cameras_are_drawn_from_a_chosen_point_of_view(witness):
    witness.page.wait_for_timeout(500)
    before = witness.pixels("#scene-figure").astype(int)
    ground = np.median(before.reshape(-1, 3), axis=0)
    assert (np.abs(before - ground).max(axis=2) > 40).mean() > 0.01
    assert ((before[..., 0] > 200) & (np.abs(before[..., 1] - 159) < 40) & (before[..., 2] < 110)).sum() > 50
    witness.page.get_by_role("button", name="From above").click()
    witness.page.wait_for_timeout(500)
    assert witness.errors == []
    assert (before != witness.pixels("#scene-figure")).any(axis=2).mean() > 0.005


CANVAS = "#model-figure canvas"
WITHOUT_WEBGL = """
const before = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : before.call(this, kind, ...rest);
};
"""


@pytest.fixture(scope="module")
def model_report(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "report.html"
    path.write_text(render_report(synthetic.sphere_run()), "utf-8")
    return path


@pytest.fixture(scope="module", params=[1400, 420], ids=["desktop", "narrow"])
def opened(request, browser, model_report):
    model_page = synthetic.Witness(
        browser, model_report, request.param, drawn=("model-figure",), reduced_motion="reduce"
    )
    yield model_page
    model_page.context.close()


@pytest.fixture
def model_page(opened):
    opened.page.locator("#model-reset").click()
    return opened


def shown(model_page):
    model_page.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return model_page.pixels(CANVAS).astype(int)


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


@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("cameras", [{}, numbered_cameras(synthetic.sphere_reconstruction(), "abcdefgh")])
def test_a_notebook_shows_the_model_in_a_frame(browser, tmp_path, scheme, cameras):
    path = tmp_path / "notebook.html"
    frame = synthetic.sphere_model().show(cameras)._repr_html_()
    path.write_text(f"<!DOCTYPE html><meta charset='utf-8'>{frame}", "utf-8")
    context = browser.new_context(color_scheme=scheme, viewport={"width": 900, "height": 700})
    page, errors = context.new_page(), []
    page.on("pageerror", lambda error: errors.append(error))
    page.on("request", lambda request: request.url.startswith("http") and errors.append(request.url))
    page.goto(path.as_uri())
    inside = page.frame_locator("iframe")
    inside.locator("#model-figure[data-drawn=yes]").wait_for()
    picture = PillowImage.open(io.BytesIO(inside.locator("canvas").screenshot()))
    coloured = np.ptp(np.asarray(picture)[..., :3].astype(int), axis=2) > 30
    assert coloured.mean() > 0.1
    inside.get_by_role("button", name="From above").click()
    assert inside.locator("option").count() == 1 + max(1, len(cameras))
    assert errors == []
    context.close()


@pytest.mark.browser
@pytest.mark.parametrize("view", [0, 3, 6])
def test_where_a_photograph_was_taken_the_model_looks_like_it(model_page, view):
    model_page.page.select_option("#model-viewpoint", str(view))
    picture = shown(model_page)
    expected = photograph(ring_of()[view]).rgb.astype(int)
    difference = picture[where(picture)] - expected
    assert np.sqrt(np.mean(difference[inner(view)] ** 2)) < 14.0
    ground = np.array([0x13, 0x1A, 0x22])
    off = picture[where(picture)][:, [0, -1]]
    assert np.abs(off - ground).max() <= 2


@pytest.mark.browser
def test_every_point_of_view_shows_all_of_the_model_in_its_middle(model_page):
    pictures = []
    for name in ("Behind the cameras", "From above", "From the left", "From the right"):
        model_page.page.locator("#model").get_by_role("button", name=name).click()
        picture = shown(model_page)
        drawn = np.abs(picture - picture[2, picture.shape[1] // 2]).max(axis=2) > 12
        rows, columns = (np.flatnonzero(drawn.any(axis=d)) for d in (1, 0))
        height, width = drawn.shape
        assert max(np.ptp(rows) / height, np.ptp(columns) / width) > 0.7
        assert abs((rows[0] + rows[-1]) / height - 1.0) < 0.1
        assert abs((columns[0] + columns[-1]) / width - 1.0) < 0.1
        pictures.append(picture)
    for k, one in enumerate(pictures):
        assert all(apart(one, two) > 0.1 for two in pictures[:k])


@pytest.mark.browser
def test_shape_is_grey_and_texture_is_not(model_page):
    coloured = np.ptp(shown(model_page), axis=2)
    model_page.page.get_by_role("button", name="Shape").click()
    grey = np.ptp(shown(model_page), axis=2)
    middle = tuple(slice(n // 2 - n // 8, n // 2 + n // 8) for n in coloured.shape)
    assert np.median(coloured[middle]) > 50
    assert grey[middle].max() < 16
    pressed = model_page.page.locator("button[data-paint][aria-pressed=true]")
    assert pressed.all_inner_texts() == ["Shape"]
    model_page.page.get_by_role("button", name="Texture").click()
    assert np.median(np.ptp(shown(model_page), axis=2)[middle]) > 50


@pytest.mark.browser
def test_dragging_and_keys_turn_it(model_page):
    start = shown(model_page)
    box = model_page.page.locator(CANVAS).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    model_page.page.mouse.move(x, y)
    model_page.page.mouse.down()
    model_page.page.mouse.move(x + 90, y + 20, steps=3)
    model_page.page.mouse.up()
    dragged = shown(model_page)
    assert apart(dragged, start) > 0.1
    model_page.page.mouse.move(x - 30, y)
    assert apart(shown(model_page), dragged) == 0.0  # the button is up again
    model_page.page.locator(CANVAS).focus()
    for key in ("ArrowLeft", "ArrowUp", "+", "t"):
        before = shown(model_page)
        model_page.page.keyboard.press(key)
        assert apart(shown(model_page), before) > 0.02, key
    model_page.page.keyboard.press("Home")
    model_page.page.locator(CANVAS).blur()  # the ring about what has the focus
    assert apart(shown(model_page), start) == 0.0


@pytest.mark.browser
def test_the_wheel_moves_the_page_until_the_picture_was_clicked(model_page):
    start = shown(model_page)
    model_page.page.locator(CANVAS).hover()
    before = model_page.page.evaluate("scrollY")
    model_page.page.mouse.wheel(0, 200)
    model_page.page.wait_for_timeout(500)
    assert model_page.page.evaluate("scrollY") > before
    assert apart(shown(model_page), start) == 0.0
    model_page.page.locator(CANVAS).click()
    scrolled = model_page.page.evaluate("scrollY")
    model_page.page.mouse.wheel(0, 300)
    assert apart(shown(model_page), start) > 0.05
    assert model_page.page.evaluate("scrollY") == scrolled
    model_page.page.locator("#model h2").click()
    assert "awake" not in model_page.page.locator("#model-figure").get_attribute("class")


@pytest.mark.browser
def test_it_comes_back_after_the_graphics_card_was_lost(model_page):
    start = shown(model_page)
    model_page.page.evaluate(
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
    assert apart(shown(model_page), start) == 0.0


@pytest.mark.browser
def test_all_is_shown_and_nothing_complains_reaches_out_or_is_too_wide(model_page):
    require_quiet(model_page)
    widths = model_page.page.evaluate(
        "[...document.querySelectorAll('#depth img, #held-out img')].map(i => i.complete && i.naturalWidth)"
    )
    assert widths == [SHAPE[1]] * (7 + 3)


@pytest.mark.browser
def test_a_fine_screen_gets_at_most_twice_the_pixels_and_fingers_zoom(browser, model_report):
    screen = {"device_scale_factor": 3, "has_touch": True}
    model_page = synthetic.Witness(
        browser, model_report, 420, drawn=("model-figure", "scene-figure"), **screen
    )
    canvas = model_page.page.locator(CANVAS)
    assert canvas.evaluate("c => c.width") == 2 * canvas.evaluate("c => c.clientWidth")
    before = shown(model_page)
    spread_fingers(model_page)
    assert apart(shown(model_page), before) > 0.1
    model_page.context.close()


def spread_fingers(model_page):
    """Two fingers on the middle of the canvas go apart."""
    hand = model_page.context.new_cdp_session(model_page.page)
    box = model_page.page.locator(CANVAS).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for kind, reach in (("touchStart", 30), ("touchMove", 40), ("touchMove", 60), ("touchEnd", 0)):
        points = [{"x": x + side * reach, "y": y, "id": side + 1} for side in (-1, 1)] if reach else []
        hand.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


@pytest.mark.browser
def test_missing_webgl_is_reported(browser, model_report):
    model_page = synthetic.Witness(browser, model_report, 1000, drawn=(), script=WITHOUT_WEBGL)
    text = model_page.page.locator("#model-figure").inner_text()
    assert "no WebGL 2" in text
    assert "model.glb" in text
    assert not model_page.page.locator("#model-reset").is_visible()
    assert all("viewer" not in error.lower() for error in model_page.errors)
    model_page.context.close()
