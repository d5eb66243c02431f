"""The page of a run, its assessment, its data and figures of residuals."""

import base64
import hashlib
import html
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.report import synthetic
from thesisrecon.errors import StageFailure
from thesisrecon.lens import angles_from_axis, image_of_directions, lens_row
from thesisrecon.records import IntrinsicInterval, Reconstruction, TexturedMesh, Tracks
from thesisrecon.report import _assessment
from thesisrecon.report._data import ResidualSummary, reprojection_distances, summarize_distances
from thesisrecon.report._page import render_report


@pytest.fixture(scope="module")
def page():
    return render_report(synthetic.made_up_run())


def require_closed(page):
    """Require that a page fetches nothing and its links lead to elements; return them and its structure."""
    structure = synthetic.Structure(page)
    assert all(address.startswith(("data:", "#")) for address in structure.addresses)
    wanted = {address[1:] for address in structure.addresses if address.startswith("#")}
    assert wanted <= set(structure.ids)
    assert len(structure.ids) == len(set(structure.ids))
    assert structure.handlers == []
    return wanted, structure


def test_the_page_holds_every_section_and_is_small_and_the_same_each_time(page):
    wanted, structure = require_closed(page)
    assert wanted == {"main", "view", "images", "pairs", "stages", "warnings", "config"}
    assert structure.count("img") == 9 + 2 + 2  # thumbnails, best and weakest pair, straightened image
    texts = ("Computing time", "2081.4 ± 1.7", "Trusted, but incomplete", "2 pairs lie on one plane")
    for text in (*texts, "peak_memory_mb"):
        assert text in page
    # Nothing of a model is on a page without one.
    for trace in ('id="model', 'id="depth"', 'id="held-out"', "model.glb", "WebGL 2"):
        assert trace not in page
    assert len(page.encode()) < 4_000_000
    assert synthetic.unpacked(page, "plotly").count("plotly.js v") == 1
    assert render_report(synthetic.made_up_run()) == page


def test_runs_that_stopped_early_say_how_far_they_got():
    early = synthetic.projective_run()
    page = render_report(early)
    assert "Stopped early" in page
    assert 'id="scene-figure"' not in page
    assert page.count(" · 95 % below ") == 8
    only_features = replace(early, projective=None, pairs=(), until="features")
    page = render_report(only_features)
    assert "corners were detected" in page
    assert 'id="plotly"' not in page  # nothing to draw, nothing to carry
    failure = StageFailure("no photograph was found", "", "put JPEG files in the folder")
    page = render_report(synthetic.report_data(title="empty", end=failure))
    for text in ("No photograph was found.", "No stage finished.", "Put JPEG files in the folder."):
        assert text in page


def test_strata_are_told_apart_and_captions_state_omitted_points(page):
    projective = render_report(synthetic.projective_run())
    assert projective.count('<span class="state open">projective camera</span>') == 8
    assert ">registered<" not in projective
    assert page.count('<span class="state good">registered</span>') == 8
    data = synthetic.made_up_run(points=200)
    assert "All 200 points are shown." in render_report(data)
    X = data.metric.reconstruction.X.copy()
    X[0, :3] = 1e6
    metric = replace(data.metric, reconstruction=replace(data.metric.reconstruction, X=X))
    assert "199 of 200 points are shown, without outliers." in render_report(replace(data, metric=metric))


def test_pairs_without_an_epipolar_geometry_are_listed_but_not_drawn():
    data = replace(synthetic.projective_run(), projective=None, until="matches")
    nothing = replace(
        data.pairs[0], F=np.zeros((3, 3)), sigma_px=float("nan"), homography_inlier_ratio=float("nan"),
        xy1=np.zeros((0, 2)), xy2=np.zeros((0, 2)), accepted=False, reason="too few matches for an F",
    )  # fmt: skip
    page = render_report(replace(data, pairs=[nothing]))
    assert "too few matches for an F" in page
    assert "<td>–</td><td>–</td>" in page
    assert synthetic.Structure(page).count("figure") == 1  # the matrix


def test_a_thousand_views_stay_below_ten_megabytes(monkeypatch):
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (320, 480, 3), dtype=np.uint8)  # the hardest picture for a JPEG
    monkeypatch.setattr(synthetic, "made_up_photograph", lambda *_: noise)
    data = synthetic.made_up_run(names=[f"IMG_{n:04}.JPG" for n in range(1000)], points=200)
    cameras = [{"name": image.name, "focal_px": {"value": 520.3, "std": 0.4}} for image in data.images]
    depth = np.tile(rng.normal(5, 1, (120, 160)).astype(np.float32), (2, 2))
    # Like the largest model and scene of a page.
    steps = np.arange(150 * 151).reshape(150, 151)[:, :-1].ravel()
    faces = np.concatenate([steps[:, None] + (0, 1, 152), steps[:, None] + (0, 152, 151)])
    uv, vertices = rng.uniform(0, 2047, (151 * 151, 2)), rng.normal(size=(151 * 151, 3))
    texture = np.repeat(np.repeat(rng.integers(60, 190, (512, 512, 3), dtype=np.uint8), 4, 0), 4, 1)
    model = TexturedMesh(vertices, faces, uv=uv[faces], texture=texture)
    summary, maps = data.summary | {"cameras": cameras}, dict.fromkeys(range(1000), depth)
    page = render_report(replace(data, model=model, summary=summary, depths=maps))
    structure = synthetic.Structure(page)
    # 25,000 coloured points take 0.7 MB more than those of this run.
    assert len(page.encode()) < 9_300_000
    assert structure.count("img") == 100 + 2 + 100 + 2
    assert "900 images without pictures" in page
    assert "1000 entries, see summary.json" in page
    assert all(image.name in page for image in data.images)


def test_a_page_with_a_model_holds_its_viewer_depth_and_comparison():
    data = synthetic.sphere_run()
    page = render_report(data)
    _, structure = require_closed(page)
    assert {"model", "depth", "held-out", "model-data", "model-figure"} <= set(structure.ids)
    assert structure.count("img") == 8 + 7 + 3
    assert structure.count("option") == 8 + 1
    texels = f"{data.model.texture.shape[1]} × {data.model.texture.shape[0]} texels"
    for text in (texels, "27.3 dB", "0.912", html.escape(synthetic.SPHERE_NAMES[2])):
        assert text in page
    assert "<b>.jpg" not in page
    assert render_report(synthetic.sphere_run()) == page
    empty = replace(data.model, faces=np.zeros((0, 3), dtype=np.int64))
    bare = render_report(replace(data, model=empty, held_out=None, depths={}))
    for trace in ("model-data", 'id="model"', 'id="depth"', 'id="held-out"'):
        assert trace not in bare


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
    nothing = render_report(replace(synthetic.projective_run(), projective=None, pairs=()))
    assert "script-src 'none'" in html.unescape(nothing)
    assert "<script" not in nothing


def test_the_table_of_cameras_has_a_column_for_every_estimate():
    data = synthetic.made_up_run()

    def reported(aspect, skew):
        more = {"aspect": IntrinsicInterval(*aspect, "a"), "skew_px": IntrinsicInterval(*skew, "a")}
        views = tuple({**view, **more} if view else {} for view in data.metric.intrinsics)
        return render_report(replace(data, metric=replace(data.metric, intrinsics=views)))

    assert "Aspect (fy/fx)" not in reported((1.0, 0.0), (0.0, 0.0))
    page = reported((1.0023, 0.0004), (0.5, 0.1))
    assert page.index("Aspect (fy/fx)") < page.index("Skew (px)") < page.index("Principal x (px)")
    assert "1.0023 ± 0.0004" in page
    # At a quarter of the size: four times as much in the photograph.
    assert "2.0 ± 0.4" in page


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
    without = reprojection_distances(synthetic.projective_run().projective)
    assert summarize_distances(np.concatenate(without)).rms_px > 2 * synthetic.NOISE_PX


def test_points_beyond_90_degrees_of_a_fisheye_camera_have_their_residuals():
    rng = np.random.default_rng(0)
    row = lens_row("fisheye", np.array([0.02, -0.003]))
    K = np.array([[200.0, 0.0, 400.0], [0.0, 200.0, 400.0], [0.0, 0.0, 1.0]])
    X = rng.normal(size=(400, 3))
    X = X[angles_from_axis(X) < np.radians(115.0)]
    assert (X[:, 2] < 0.0).sum() > 50
    n, moved = len(X), X + np.array([0.3, 0.0, 0.0])
    cameras = [np.column_stack([K, np.zeros(3)]), K @ np.column_stack([np.eye(3), [0.3, 0.0, 0.0]])]
    xy = [image_of_directions(x, row) @ K[:2, :2].T + K[:2, 2] for x in (X, moved)]
    view, point = np.repeat([0, 1], n), np.tile(np.arange(n), 2)
    # The sign of a homogeneous point is arbitrary.
    Xh = np.column_stack([X, np.ones(n)]) * rng.choice([-1.0, 1.0], (n, 1))
    every = np.ones(n, dtype=bool)
    found = Reconstruction(
        "metric", np.array(cameras), Xh, np.ones(2, dtype=bool), every, np.ones(2 * n, dtype=bool),
        Tracks(view, point, np.concatenate(xy), 2, n), np.full((2, 2), 800), 0.0, ("", ""),
        K=np.array([K, K]), distortion=np.array([row, row]),
    )  # fmt: skip
    assert max(part.max() for part in reprojection_distances(found)) < 1e-9


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1520.34, 1.84, "1520.3 ± 1.8"), (1520.34, 4.2, "1520 ± 4"), (1520.34, 0.42, "1520.3 ± 0.4"),
        (-0.03012, 0.00042, "-0.0301 ± 0.0004"), (512.0, 0.0, "512 (fixed)"),
        (1520.34, float("inf"), "1520 (not determined)"),
    ],
)  # fmt: skip
def test_numbers_carry_as_many_digits_as_they_deserve(value, std, text):
    assert _assessment.plus_minus(value, std) == text


def test_the_assessment_and_the_key_facts_are_honest():
    data, early = synthetic.made_up_run(points=100), synthetic.projective_run()
    doubt = replace(data.metric, trusted=False, failed_checks=("pure rotation",))
    phone = replace(data.metric, limitations=("image #1 is blurred",))
    failure = StageFailure("no pair overlaps", "23 matches, 60 needed", "take more photographs")
    failed = replace(early, projective=None, until=None, end=failure, reports=early.reports[:2])
    done = "The last stage that finished was matches."
    for run, level, reasons in (
        (data, "good", ()), (replace(data, metric=phone), "good", ("Image #1 is blurred.",)),
        (replace(data, metric=doubt), "doubt", ("Pure rotation.",)), (early, "open", ()),
        (failed, "bad", ("23 matches, 60 needed.", done)),
    ):  # fmt: skip
        found = _assessment.assess(run)
        assert (found.level, found.reasons) == (level, reasons)
    assert (found.sentence, found.advice) == ("No pair overlaps.", "Take more photographs.")
    facts = _assessment.key_facts(data, ResidualSummary(1000, 0.8, 1.0, 2.0))
    assert facts[3].value == "0.80 px median"
    assert facts[3].note == "1.00 px RMS over 1\u202f000 observations; at working size 0.20 px median"
    # A warning of a stage stands once.
    summary = {"warnings": [early.reports[1].warnings[0], "2 initial pairs were tried"]}
    page = render_report(replace(early, summary=summary))
    assert page[page.index('id="warnings"') : page.index('id="config"')].count("<li>") == 2
