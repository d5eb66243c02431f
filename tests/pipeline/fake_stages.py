"""Fake stages that return the truth of a small scene, for tests of the code around the real ones.

Every call that computes something is written to ``CALLS``.
"""

# ruff: noqa: ARG002 (a fake takes what the real stage takes, and ignores most of it)

import hashlib
import json
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
import PIL.Image

from tests.synthetic import reconstruction_of
from thesisrecon import records
from thesisrecon.camera import compose_camera
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.stereo.depth import MultiViewScene, SparsePoints


class Calls(list):
    """No plain list, whose content would be a part of the code that the fakes reach."""

    def __reduce__(self):
        return Calls, ()


CALLS = Calls()
WIDTH, HEIGHT, POINTS = 96, 80, 30
K = np.array([[100.0, 0.0, 47.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]])


def photographs(n):
    """n different pictures named 00.png, 01.png, ..."""
    rng = np.random.default_rng(5)
    pictures = []
    for i in range(n):
        coarse = PIL.Image.fromarray(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8))
        rgb = np.array(coarse.resize((WIDTH, HEIGHT), PIL.Image.Resampling.BICUBIC))
        pictures.append(records.Image(f"{i:02d}.png", rgb, (WIDTH, HEIGHT)))
    return pictures


def scene_points():
    X = np.random.default_rng(1).uniform(-1.0, 1.0, (POINTS, 3)) + np.array([0.0, 0.0, 5.0])
    return np.column_stack([X, np.ones(POINTS)])


def scene_camera(i):
    angle = 0.1 * i
    R = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], dtype=np.float64
    )
    return compose_camera(K, R, -R @ np.array([0.5 * i, 0.02 * i, 0.0]))


def view_of(image):
    return int(image.name[:2])


@dataclass(frozen=True)
class FakeDetector:
    version: int = 0

    def detect(self, image):
        CALLS.append(f"detect {image.name}")
        xy = project(scene_camera(view_of(image)), scene_points())
        return records.Features(xy, np.ones(POINTS, np.float32), np.ones(POINTS, np.float32))


@dataclass(frozen=True)
class FakeMatcher:
    fail_pair: tuple[int, int] = (-1, -1)
    interrupt_after: int = -1

    def prepare(self, image, features):
        CALLS.append(f"prepare {image.name}")
        return features

    def match(self, view1, view2, *, pair, estimate_fundamental, rng):
        CALLS.append(f"match {pair}")
        assert callable(estimate_fundamental)
        if pair == self.fail_pair:
            raise StageFailure("only 3 matches", "8 are needed")
        xy1 = view1.xy + 0.01 * rng.standard_normal(view1.xy.shape)
        every = np.arange(POINTS)
        affine = np.broadcast_to(np.eye(2), (POINTS, 2, 2)).copy()
        score = np.ones(POINTS, np.float32)
        return records.Matches(pair[0], pair[1], every, every, xy1, view2.xy.copy(), score, affine)


@dataclass(frozen=True)
class FakeEstimator:
    def estimate(self, xy1, xy2, rng):
        assert xy1.shape == xy2.shape
        rng.standard_normal()
        F = np.eye(3) / np.sqrt(3.0)
        return records.FundamentalFit(F, np.ones(len(xy1), np.bool_), 0.1, np.eye(9))


@dataclass(frozen=True)
class FakeVerifier:
    accept: bool = True

    def verify(self, matches, fit, rng):
        return records.TwoView(
            i=matches.i, j=matches.j, F=fit.F, sigma_px=fit.sigma_px, index1=matches.index1,
            index2=matches.index2, xy1=matches.xy1, xy2=matches.xy2, affine=matches.affine,
            candidates=len(matches.xy1), homography_inlier_ratio=0.1, accepted=self.accept,
            reason="" if self.accept else "too few verified matches",
        )  # fmt: skip


@dataclass(frozen=True)
class FakeTracks:
    def build(self, prepared, pairs, *, map_all, rng):
        CALLS.append("tracks")
        views = len(prepared)
        point, view = (a.ravel() for a in np.meshgrid(np.arange(POINTS), np.arange(views), indexing="ij"))
        xy = np.stack([prepared[i].xy for i in range(views)], axis=1).reshape(-1, 2)
        return records.Tracks(view, point, xy + 0.01 * rng.standard_normal(xy.shape), views, POINTS)


@dataclass(frozen=True)
class FakeProjective:
    """Fails in the first attempts; the noise is one more than the number of the attempt."""

    fail_below: int = 0

    def reconstruct(self, tracks, pairs, sizes, *, rng, attempt=0):
        CALLS.append(f"projective {attempt}")
        assert sizes.shape == (tracks.n_views, 2)
        if attempt < self.fail_below:
            raise StageFailure("the initial pair is bad", f"attempt {attempt}")
        P = np.stack([scene_camera(i) for i in range(tracks.n_views)])
        found = reconstruction_of(P, sizes, X=scene_points(), tracks=tracks, stratum="projective")
        return replace(found, sigma_px=1.0 + attempt)


@dataclass(frozen=True)
class FakeCalibrator:
    identifiable: bool = True
    skew_px: float = 0.0

    def calibrate(self, reconstruction, *, prior, rng):
        CALLS.append(f"calibrate prior={prior.focal_known.any()}")
        Ks = np.broadcast_to(K, (len(prior.mean), 3, 3)).copy()
        Ks[:, 0, 1] = self.skew_px
        upgrade = records.Upgrade(np.eye(4), Ks, 0.0, "fake")
        why = () if self.identifiable else ("the camera only rotates",)
        return records.SelfCalibration(np.eye(4), Ks, np.zeros_like(Ks), self.identifiable, why, (upgrade,))


@dataclass(frozen=True)
class FakeMetric:
    trusted_from: int = 0
    failed_checks: tuple[str, ...] = ("odd focal",)

    def refine(self, reconstruction, calibration, *, prior, rng, threads):
        attempt = sum(call.startswith("metric") for call in CALLS)
        CALLS.append(f"metric {attempt}")
        views = len(prior.mean)
        intervals = {
            "focal_px": records.IntrinsicInterval(100.0, 1.0, "fake"),
            "principal_x_px": records.IntrinsicInterval(47.0, 0.5, "fake"),
            "principal_y_px": records.IntrinsicInterval(40.0, 0.5, "fake"),
            "k1": records.IntrinsicInterval(0.0, 0.0, "fake"),
        }
        P = calibration.K @ np.linalg.inv(K) @ reconstruction.P
        metric = replace(
            reconstruction, stratum="metric", P=P, K=calibration.K, distortion=np.zeros((views, 3))
        )
        trusted = attempt >= self.trusted_from
        return records.MetricResult(
            metric, (intervals,) * views, {"x": 1.0}, trusted, () if trusted else self.failed_checks
        )


@dataclass(frozen=True)
class FakeDense:
    """A wall across the scene, 8 from the first camera, and views that do not confirm it."""

    unknown: tuple[int, ...] = ()

    def prepare(self, images, reconstruction, *, depth_range=None, threads=1):
        CALLS.append("prepare dense")
        P = reconstruction.P
        views = {
            i: records.PinholeView(i, P[i], image.rgb, np.ones(image.rgb.shape[:2], dtype=bool))
            for i, image in enumerate(images)
            if reconstruction.registered[i]
        }
        points = SparsePoints(np.zeros((0, 3)), np.zeros((len(P), 0), dtype=bool))
        return MultiViewScene(views, points, dict.fromkeys(views, ()))

    def required_views(self, scene, view):
        return frozenset({view, *list(scene.views)[:2]})

    def depth_map(self, scene, view, *, pool=None):
        CALLS.append(f"depth {view}")
        shape, P = scene.views[view].rgb.shape[:2], scene.views[view].P
        y, x = np.indices(shape)
        rays = np.stack([x, y, np.ones(shape)], axis=-1) @ np.linalg.inv(P[:, :3]).T
        depth = ((8.0 + np.linalg.solve(P[:, :3], P[:, 3])[2]) / rays[..., 2]).astype(np.float32)
        return records.DepthMap(view, P, depth, np.full_like(depth, 0.01), np.ones(shape, dtype=np.uint8))

    def confirm(self, scene, depth_maps, view):
        depth = depth_maps[view].depth
        return replace(depth_maps[view], depth=np.full_like(depth, np.nan) if view in self.unknown else depth)


def fake_config(**changes):
    """A pipeline of fakes."""
    config = PipelineConfig(
        features=FakeDetector(), matching=FakeMatcher(), epipolar=FakeEstimator(),
        verification=FakeVerifier(), tracks=FakeTracks(), projective=FakeProjective(),
        selfcalibration=FakeCalibrator(), metric=FakeMetric(), dense=FakeDense(),
    )  # fmt: skip
    return replace(config, **changes)


def read(path):
    return json.loads(path.read_text(encoding="utf-8"))


def kept_bytes(out):
    """Every result file of a run up to metric, and its hash."""
    files = [*out.glob("0*/*.npz"), *(out / "sparse" / "0").iterdir()]
    files += [out / "points.ply", out / "cameras.json"]
    return {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(files)}


def interrupt_at(stage, done):
    """A progress listener that presses Ctrl-C when so much of a stage is done."""
    heard = count()

    def hear(name, finished, _total):
        next(heard)
        if name == stage and finished == done:
            raise KeyboardInterrupt

    return hear
