"""The page of a run, its data and figures of residuals, and the page of interpolated images."""

import base64
import hashlib
import html
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.report import synthetic
from thesisrecon.errors import StageFailure
from thesisrecon.io._files import write_text
from thesisrecon.records import IntrinsicInterval, TexturedMesh
from thesisrecon.report._data import ReportData, reprojection_distances, summarize_distances
from thesisrecon.report._page import render_report, strip_page


@pytest.fixture(scope="module")
def page():
    return render_report(synthetic.made_up_run())


def test_the_page_fetches_nothing_is_small_and_the_same_each_time(page):
    structure = synthetic.Structure(page)
    assert all(address.startswith(("data:", "#")) for address in structure.addresses)
    assert len(page.encode()) < 4_000_000
    assert synthetic.unpacked(page, "plotly").count("plotly.js v") == 1
    assert render_report(synthetic.made_up_run()) == page


def test_the_page_holds_every_section_and_its_links_lead_somewhere(page):
    structure = synthetic.Structure(page)
    wanted = {address[1:] for address in structure.addresses if address.startswith("#")}
    assert wanted == {"main", "view", "images", "pairs", "stages", "warnings", "config"}
    assert wanted <= set(structure.ids)
    assert structure.count("svg") == 8  # a histogram of each registered view
    assert structure.count("img") == 9 + 2  # thumbnails, best and weakest pair
    for text in (
        "Computing time",
        "2081.4 ± 1.7",
        "Trusted, but incomplete",
        "2 pairs lie on one plane",
        "peak_memory_mb",
    ):
        assert text in page


def test_runs_that_stopped_early_say_how_far_they_got():
    early = synthetic.projective_run()
    page = render_report(early)
    assert "Stopped early" in page
    assert 'id="scene-figure"' not in page
    assert synthetic.Structure(page).count("svg") == 8
    only_features = replace(early, reconstruction=None, pairs=(), until="features")
    page = render_report(only_features)
    assert "corners were detected" in page
    assert 'id="plotly"' not in page  # nothing to draw, nothing to carry


def test_strata_are_told_apart(page):
    projective = render_report(synthetic.projective_run())
    assert projective.count('<span class="state open">projective camera</span>') == 8
    assert ">registered<" not in projective
    assert page.count('<span class="state good">registered</span>') == 8
    assert 'id="affine-figure"' in page
    without = render_report(replace(synthetic.made_up_run(), affine=None))
    assert 'id="affine-figure"' not in without


def test_the_caption_states_omitted_points():
    data = synthetic.made_up_run(points=200)
    assert "All 200 points are shown." in render_report(data)
    X = data.metric.reconstruction.X.copy()
    X[0, :3] = 1e6
    metric = replace(data.metric, reconstruction=replace(data.metric.reconstruction, X=X))
    assert "199 of 200 points are shown, without outliers." in render_report(replace(data, metric=metric))


@pytest.mark.parametrize("count", [0, 1, 3, 8])
@pytest.mark.parametrize("offset", [0.0, 1e-13, 1e-6])
def test_affine_cameras_at_infinity_are_left_out_by_number(count, offset):
    data = synthetic.made_up_run(points=200)
    P = data.affine.P.copy()
    views = np.flatnonzero(data.affine.registered)[:count]
    # Nearly so: with the centre 1e6 or more units away.
    P[views, 2, :3] = P[views, 0, :3] / 3000.0 + offset * P[views, 2, :3]
    warnings = []
    page = render_report(replace(data, affine=replace(data.affine, P=P)), warnings)
    assert warnings == []
    assert 'id="scene-figure"' in page
    words = {0: [], 1: ["1 camera at infinity, or nearly so, is not drawn."]}
    expected = words.get(count, [f"{count} cameras at infinity, or nearly so, are not drawn."])
    assert re.findall(r"\d+ camera[^.]*at infinity[^.]*\.", page) == expected
    assert ('id="affine-figure"' in page) == (count < 8)


def test_a_failed_run_without_anything_has_a_page():
    failure = StageFailure("no photograph was found", "", "put JPEG files in the folder")
    page = render_report(ReportData("empty", (), (), "", {}, "0.1.0", failure=failure))
    for text in ("No photograph was found.", "No stage finished.", "Put JPEG files in the folder."):
        assert text in page


def test_pairs_without_an_epipolar_geometry_are_listed_but_not_drawn():
    data = replace(synthetic.projective_run(), reconstruction=None, until="matches")
    nothing = replace(
        data.pairs[0], F=np.zeros((3, 3)), sigma_px=float("nan"), homography_inlier_ratio=float("nan"),
        xy1=np.zeros((0, 2)), xy2=np.zeros((0, 2)), accepted=False, reason="too few matches for an F",
    )  # fmt: skip
    page = render_report(replace(data, pairs=[nothing]))
    assert "too few matches for an F" in page
    assert "<td>–</td><td>–</td>" in page
    assert synthetic.Structure(page).count("figure") == 1  # the matrix


def test_warnings_of_the_run_stand_beside_those_of_its_stages():
    data = synthetic.projective_run()
    stage_warning = data.reports[1].warnings[0]
    summary = {"warnings": [stage_warning, "2 initial pairs were tried"]}
    page = render_report(replace(data, summary=summary))
    section = page[page.index('id="warnings"') : page.index('id="config"')]
    assert section.count("<li>") == 2
    assert "2 initial pairs were tried" in section


def test_a_name_that_is_not_unicode_can_be_written(tmp_path):
    page = render_report(synthetic.made_up_run(names=["a\udcff.jpg", "b.jpg", "c.jpg"], points=60))
    write_text(tmp_path / "report.html", page)
    assert "a?.jpg" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_thousand_views_stay_below_ten_megabytes(monkeypatch):
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (160, 240, 3), dtype=np.uint8)  # the hardest picture for a JPEG
    monkeypatch.setattr(synthetic, "made_up_photograph", lambda *_: noise)
    data = synthetic.made_up_run(names=[f"IMG_{n:04}.JPG" for n in range(1000)], points=200)
    cameras = [{"name": image.name, "focal_px": {"value": 520.3, "std": 0.4}} for image in data.images]
    depth = np.tile(rng.normal(5, 1, (120, 160)).astype(np.float32), (2, 2))
    # Like the largest model and scene of a page.
    steps = np.arange(150 * 151).reshape(150, 151)[:, :-1].ravel()
    faces = np.concatenate([steps[:, None] + (0, 1, 152), steps[:, None] + (0, 152, 151)])
    vertices = rng.normal(size=(151 * 151, 3))
    texture = np.repeat(np.repeat(rng.integers(60, 190, (512, 512, 3), dtype=np.uint8), 4, 0), 4, 1)
    model = TexturedMesh(
        vertices, faces, uv=rng.uniform(0, 2047, vertices[:, :2].shape)[faces], texture=texture
    )
    page = render_report(
        replace(
            data,
            model=model,
            summary={**data.summary, "cameras": cameras},
            depth_maps=dict.fromkeys(range(1000), depth),
        )
    )
    structure = synthetic.Structure(page)
    # 25,000 coloured points take 0.7 MB more than those of this run.
    assert len(page.encode()) < 9_300_000
    assert structure.count("img") == 100 + 2 + 100
    assert "900 images without pictures" in page
    assert "1000 entries, see summary.json" in page
    assert all(image.name in page for image in data.images)


def test_a_page_with_a_model_holds_its_viewer_depth_and_comparison():
    data = synthetic.sphere_run()
    page = render_report(data)
    structure = synthetic.Structure(page)
    assert {"model", "depth", "held-out", "model-data", "model-figure"} <= set(structure.ids)
    assert len(structure.ids) == len(set(structure.ids))
    wanted = {address[1:] for address in structure.addresses if address.startswith("#")}
    assert wanted <= set(structure.ids)
    assert all(address.startswith(("data:", "#")) for address in structure.addresses)
    assert structure.handlers == []
    assert structure.count("img") == 8 + 7 + 3
    assert structure.count("option") == 8 + 1
    texels = f"{data.model.texture.shape[1]} × {data.model.texture.shape[0]} texels"
    for text in (texels, "27.3 dB", "0.912", html.escape(synthetic.SPHERE_NAMES[2])):
        assert text in page
    assert "<b>.jpg" not in page
    assert render_report(synthetic.sphere_run()) == page


def test_only_the_scripts_of_the_page_may_run():
    for data, scripts in ((synthetic.sphere_run(), 4), (synthetic.made_up_run(points=50), 3)):
        page = render_report(data)
        policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
        assert policy is not None
        allowed = re.findall(r"'(sha256-[^']+)'", html.unescape(policy.group(1)))
        bodies = [*re.findall(r"<script>(.*?)</script>", page, re.S), synthetic.unpacked(page, "plotly")]
        digests = [hashlib.sha256(body.encode()).digest() for body in bodies]
        assert len(allowed) == len(bodies) == scripts
        assert sorted(allowed) == sorted("sha256-" + base64.b64encode(d).decode() for d in digests)
    nothing = render_report(replace(synthetic.projective_run(), reconstruction=None, pairs=()))
    assert "script-src 'none'" in html.unescape(nothing)
    assert "<script" not in nothing


def test_without_a_model_nothing_of_it_is_on_the_page(page):
    for trace in ('id="model', 'id="depth"', 'id="held-out"', "model.glb", "WebGL 2"):
        assert trace not in page
    empty = replace(synthetic.sphere_run().model, faces=np.zeros((0, 3), dtype=np.int64))
    bare = render_report(replace(synthetic.sphere_run(), model=empty, held_out=None, depth_maps={}))
    for trace in ("model-data", 'id="model"', 'id="depth"', 'id="held-out"'):
        assert trace not in bare


def test_the_table_of_cameras_has_a_column_for_every_estimate():
    data = synthetic.made_up_run()
    square = {
        "aspect": IntrinsicInterval(1.0, 0.0, "assumed"),
        "skew_px": IntrinsicInterval(0.0, 0.0, "assumed"),
    }
    own = {"aspect": IntrinsicInterval(1.0023, 0.0004, "b"), "skew_px": IntrinsicInterval(0.5, 0.1, "b")}

    def reported(more):
        views = tuple({**view, **more} if view else {} for view in data.metric.intrinsics)
        metric = replace(data.metric, intrinsics=views)
        return render_report(replace(data, metric=metric))

    assert "Aspect (fy/fx)" not in reported(square)
    page = reported(own)
    assert page.index("Aspect (fy/fx)") < page.index("Skew (px)") < page.index("Principal x (px)")
    assert "1.0023 ± 0.0004" in page
    # At a quarter of the size: four times as much in the photograph.
    assert "2.0 ± 0.4" in page


LEVELS = (20, 120, 220)


def strip():
    frames = [(f"picture <{k}>", np.full((60, 80, 3), level, np.uint8)) for k, level in enumerate(LEVELS)]
    return strip_page("Between <a> and b", frames, notes=["all is well"])


def test_a_strip_has_its_notes():
    assert "all is well." in strip()


@pytest.mark.browser
def test_one_turns_through_the_pictures(browser, tmp_path):
    path = tmp_path / "strip.html"
    path.write_text(strip(), encoding="utf-8")
    seen = synthetic.Witness(browser, path, 900, drawn=())
    assert abs(int(seen.pixels("#shown")[30, 40, 0]) - LEVELS[0]) < 4
    seen.page.locator("#place").press("ArrowRight")
    assert seen.page.inner_text("#caption") == "picture <1>"
    assert abs(int(seen.pixels("#shown")[30, 40, 0]) - LEVELS[1]) < 4
    seen.page.click("#play")
    for caption in ("picture <2>", "picture <0>"):
        seen.page.locator("#caption", has_text=caption).wait_for()
    seen.page.click("#play")
    assert seen.page.inner_text("#play") == "Play"
    assert seen.errors == []
    assert not [url for url in seen.requests if not url.startswith(("file:", "data:"))]
    seen.context.close()


def test_intrinsics_are_reported_in_pixels_of_the_file():
    data = synthetic.made_up_run(points=100)  # worked at a quarter of the size
    working, original = data.metric.intrinsics[0], data.original_intrinsics[0]
    assert original["focal_px"].value == pytest.approx(4 * working["focal_px"].value)
    assert original["focal_px"].std == pytest.approx(4 * working["focal_px"].std)
    # The middle of the file stays the middle: (x + 0.5) / s - 0.5.
    assert original["principal_x_px"].value == pytest.approx(
        4 * (working["principal_x_px"].value + 0.5) - 0.5
    )
    assert original["k1"] == working["k1"]
    assert data.original_intrinsics[-1] == {}
    assert replace(data, metric=None, colors=None).original_intrinsics == ({},) * 9


def test_the_residuals_are_the_noise_that_was_added():
    data = synthetic.made_up_run(points=1500)
    reconstruction = data.metric.reconstruction
    distances = reprojection_distances(reconstruction)
    assert len(distances[-1]) == 0  # the last view is not registered
    assert sum(map(len, distances)) == reconstruction.used.sum()
    summary = summarize_distances(np.concatenate(distances))
    # Two independent coordinates make a Rayleigh distribution: RMS sqrt(2) sigma, median sigma sqrt(2 ln 2).
    assert summary.rms_px == pytest.approx(np.sqrt(2) * synthetic.NOISE_PX, rel=0.03)
    assert summary.median_px == pytest.approx(np.sqrt(2 * np.log(2)) * synthetic.NOISE_PX, rel=0.03)
    # Without the distortion the residuals grow by what it moved.
    without = reprojection_distances(synthetic.projective_run().reconstruction)
    assert summarize_distances(np.concatenate(without)).rms_px > 2 * synthetic.NOISE_PX
