"""Runs made up for the report, a painted sphere with its model, and a page opened in a browser."""

import base64
import gzip
import io
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

import numpy as np
from PIL import Image as PillowImage

from tests.surface.sphere import SHAPE, photograph, ring_of
from tests.surface.sphere import K as SPHERE_K
from tests.synthetic import looking_along, reconstruction_of
from thesisrecon.camera import compose_camera, project_camera
from thesisrecon.geometry.homogeneous import cross_matrix, homogenize
from thesisrecon.records import HeldOut, Image, IntrinsicInterval, MetricResult, StageReport, Tracks, TwoView
from thesisrecon.report._data import ReportData
from thesisrecon.surface._simplification import reduce_faces
from thesisrecon.surface.fusion import VolumetricFusion
from thesisrecon.surface.model import texture_mesh

SIZE = (480, 320)
K = np.array([[520.0, 0.0, 231.0], [0.0, 520.0, 166.0], [0.0, 0.0, 1.0]])
K1 = -0.03
NOISE_PX = 0.3
CONFIG = (
    '[features]\nkind = "corners"\n\n[matching]\n# a </script> in a comment must not hurt\nradius = 0.2\n'
)


def made_up_cameras(count):
    """World-to-camera R (C, 3, 3) and t (C, 3) of cameras on an arc that all look at the wall, y down."""
    angle = np.linspace(-0.45, 0.45, count)
    centres = np.stack([6 * np.sin(angle), 0.2 * np.cos(9 * angle), 5.5 - 6 * np.cos(angle)], axis=1)
    R = np.stack([looking_along(np.array([0.0, 0.1, 5.5]) - centre) for centre in centres])
    return R, -np.einsum("vij,vj->vi", R, centres)


def made_up_photograph(rng):
    """(H, W, 3) uint8: smooth shading."""
    coarse = PillowImage.fromarray(rng.integers(0, 256, (15, 21, 3), dtype=np.uint8))
    return np.asarray(coarse.resize(SIZE, PillowImage.Resampling.BICUBIC))


def made_up_pair(i, j, cameras, xy, seen):
    """The true epipolar geometry of two of the cameras with the points both see."""
    R = cameras[0][j] @ cameras[0][i].T
    t = cameras[1][j] - R @ cameras[1][i]
    F = np.linalg.inv(K).T @ cross_matrix(t) @ R @ np.linalg.inv(K)
    both = np.flatnonzero(seen[i] & seen[j])
    # Fewer points survive between views far apart, as with photographs.
    both = both[: max(8, len(both) // (1 + abs(i - j)))]
    accepted = abs(i - j) < 5
    return TwoView(
        i=i, j=j, F=F / np.linalg.norm(F), sigma_px=0.2, index1=both, index2=both, xy1=xy[i][both],
        xy2=xy[j][both], affine=np.tile(np.eye(2), (len(both), 1, 1)), candidates=2 * len(both),
        homography_inlier_ratio=0.35, accepted=accepted,
        reason="" if accepted else "too few verified matches",
    )  # fmt: skip


def report_data(images=(), **more):
    """A page of these images, without a folder."""
    given = {"unread": {}, "features": (), "pairs": (), "groups": np.zeros(len(images), int), "settings": {}}
    return ReportData(None, images, **(given | more))


def made_up_run(*, names=None, points=1500, seed=4):
    """A whole run with one refused view (the last) and one file that is no photograph."""
    rng = np.random.default_rng(seed)
    names = names or [f"IMG_{2040 + n}.JPG" for n in range(9)]
    count = len(names)
    X = rng.uniform([-3.2, -1.9, 4.5], [3.2, 1.9, 6.5], (points, 3))
    colors = rng.integers(0, 256, (points, 3), dtype=np.uint8)
    cameras = made_up_cameras(count)
    xy = [project_camera(K, R, t, X, distortion=K1) for R, t in zip(*cameras, strict=True)]
    seen = [((p > 5) & (p < np.array(SIZE) - 6)).all(axis=1) & (rng.random(points) < 0.7) for p in xy]
    reconstruction = _reconstruction(X, cameras, xy, seen, rng)
    images = tuple(Image(name, made_up_photograph(rng), (SIZE[0] * 4, SIZE[1] * 4)) for name in names)
    interval = {
        "focal_px": IntrinsicInterval(520.34, 0.42, "metric bundle adjustment, shared by all views"),
        "principal_x_px": IntrinsicInterval(231.2, 0.9, "metric bundle adjustment under a weak prior"),
        "principal_y_px": IntrinsicInterval(165.7, 0.8, "metric bundle adjustment under a weak prior"),
        "k1": IntrinsicInterval(-0.0301, 0.0004, "metric bundle adjustment"),
    }
    metric = MetricResult(
        reconstruction,
        tuple(interval if registered else {} for registered in reconstruction.registered),
        {"positive_depth_share_rel": 1.0, "focal_spread_rel": 0.0008, "residual_rms_px": 0.42},
        trusted=True,
    )
    pairs = [
        made_up_pair(i, j, cameras, xy, seen) for i in range(count) for j in range(i + 1, min(i + 7, count))
    ]
    return report_data(
        images, title="Courtyard wall", reports=_reports(), config_text=CONFIG,
        summary={"images": count, "registered": count - 1, "peak_memory_mb": 312.5},
        unread={"notes.jpg": "it is no image that Pillow can read"}, pairs=pairs, metric=metric,
        colors=colors,
    )  # fmt: skip


def projective_run():
    """The same run as it is when the user asked to end after the projective reconstruction."""
    data = made_up_run()
    before = data.metric.reconstruction
    undistorted = replace(before, stratum="projective", K=None, distortion=None)
    return replace(data, metric=None, colors=None, projective=undistorted, until="projective")


def _reconstruction(X, cameras, xy, seen, rng):
    count = len(xy)
    point, view = np.nonzero(np.stack(seen, axis=1))
    clean = np.stack(xy, axis=1)[point, view]
    registered = np.arange(count) < count - 1
    P = np.stack([compose_camera(K, R, t) for R, t in zip(*cameras, strict=True)])
    tracks = Tracks(view, point, clean + rng.normal(0, NOISE_PX, clean.shape), count, len(X))
    return reconstruction_of(
        P * registered[:, None, None], SIZE, X=homogenize(X), tracks=tracks, registered=registered,
        inlier=rng.random(len(point)) < 0.97, sigma_px=NOISE_PX,
        reasons=(*[""] * (count - 1), "only 14 matches lead to known points (20 are needed)"),
        K=np.tile(K, (count, 1, 1)) * registered[:, None, None],
        distortion=np.tile([K1, 0.0, 0.0], (count, 1)),
    )  # fmt: skip


def _reports():
    return (
        StageReport("features", 1.4, {"corners": 27_000}, {}),
        StageReport(
            "matches", 6.2, {"pairs": 36, "accepted": 26}, {"sigma_px": 0.19}, ("2 pairs lie on one plane",)
        ),
        StageReport("projective", 2.3, {"cameras": 8}, {"rms_px": 0.47}),
        StageReport("metric", 1.1, {"cameras": 8, "points": 1500}, {"rms_px": 0.42}),
    )


# The 3D views need WebGL; without a graphics card Chromium needs the last two to draw it.
ARGUMENTS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]  # fmt: skip


def unpacked(page, name):
    """Compressed text of a page by the id of its element."""
    packed = re.search(f'<script type="application/octet-stream" id="{name}">(.*?)</script>', page, re.S)
    return gzip.decompress(base64.b64decode(packed.group(1))).decode("utf-8")


class Witness:
    """An opened page with all it complained of and asked for."""

    def __init__(self, browser, path, width, *, drawn, script="", **context):
        self.errors = []
        self.requests = []
        self.context = browser.new_context(viewport={"width": width, "height": 900}, **context)
        self.page = self.context.new_page()
        if script:
            self.page.add_init_script(script)
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("dialog", self._dialog)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        for name in drawn:
            self.page.wait_for_selector(f"#{name}[data-drawn]", timeout=60_000)

    def _dialog(self, dialog):
        self.errors.append(f"dialog {dialog.message}")
        dialog.dismiss()

    def pixels(self, selector):
        """(H, W, 3) of an element as it is shown."""
        shot = self.page.locator(selector).screenshot()
        return np.asarray(PillowImage.open(io.BytesIO(shot)).convert("RGB"))


SPHERE_SIZE = (SHAPE[1], SHAPE[0])
SPHERE_NAMES = tuple(f"sphere {k} <b>.jpg" for k in range(8))


@cache
def sphere_model():
    """The sphere in at most 6000 triangles with the texture of its photographs."""
    mesh = reduce_faces(VolumetricFusion().fuse(ring_of()), 6_000)
    return texture_mesh(mesh, [photograph(m) for m in ring_of()])


@cache
def sphere_reconstruction():
    maps = ring_of()
    X = np.random.default_rng(2).normal(size=(300, 3))
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    P, K = np.stack([m.P for m in maps]), np.tile(SPHERE_K, (len(maps), 1, 1))
    return reconstruction_of(P, SPHERE_SIZE, X=homogenize(X), sigma_px=0.3, K=K)


def sphere_run():
    """The whole page of it: model, depth of all photographs but the last, the third held out."""
    maps = ring_of()
    rgb = [photograph(m).rgb for m in maps]
    seen = np.isfinite(maps[2].depth)
    shifted = np.roll(rgb[2], 1, axis=1)
    return report_data(
        tuple(map(Image, SPHERE_NAMES, rgb, [SPHERE_SIZE] * len(rgb))), title="Sphere",
        reports=(StageReport("dense", 2.0), StageReport("model", 1.0)),
        metric=MetricResult(sphere_reconstruction(), ({},) * len(maps), {}, trusted=True),
        model=sphere_model(), depths={m.view: m.depth for m in maps[:-1]},
        held_out=HeldOut(2, rgb[2], shifted, seen, psnr_db=27.3456, ssim=0.9123),
    )  # fmt: skip


class Structure(HTMLParser):
    """Elements of a page with the names of their attributes, in order, and its text without scripts."""

    def __init__(self, page):
        super().__init__()
        self.elements, self.words, self._inside, self._attributes = [], [], "", []
        self.feed(page)
        self.close()
        self.addresses = [value for name, value in self._attributes if name in ("src", "href")]
        self.ids = [value for name, value in self._attributes if name == "id"]
        self.handlers = [name for name, _ in self._attributes if name.startswith("on")]

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, tuple(name for name, _ in attrs)))
        self._attributes += [(name, value or "") for name, value in attrs]
        self._inside = tag

    def handle_endtag(self, tag):
        self.elements.append((f"/{tag}", ()))
        self._inside = ""

    def handle_comment(self, data):
        self.elements.append((f"comment {data}", ()))

    def handle_data(self, data):
        if self._inside not in ("script", "style"):
            self.words.append(data)

    def count(self, tag):
        return sum(element == tag for element, _ in self.elements)
