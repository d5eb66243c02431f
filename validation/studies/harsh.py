"""Harsh synthetic image sets: trusted answers whose focal length is wrong and outside its interval.

Noisy tracks and verified pairs of random sets become metric cameras as in the pipeline. A trusted focal
length that errs by more than 3 % and by more than its 95 % interval is a silent error.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64, I64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError
from thesisrecon.records import MetricResult, Tracks, TwoView
from validation.metrics.cameras import LEVEL
from validation.runs.study import Part, report_progress
from validation.runs.tables import Rows, text_table
from validation.scenes.critical import SIZE, filling_focal
from validation.scenes.dinosaur import pairs_from_tracks
from validation.scenes.pose import look_at, turntable
from validation.scenes.rigs import observe
from validation.studies.subsets import Matched, solve


@dataclass(frozen=True)
class HarshSet:
    """True cameras and points; ``lens`` (k1, k2); errors: ``sigma_px``, shares of ``wrong`` matches and of
    points ``moving`` with an object; and the camera assumption ``cameras``.
    """

    K: F64
    R: F64
    C: F64
    X: F64
    sigma_px: float = 0.5
    lens: tuple[float, float] = (0.0, 0.0)
    wrong: float = 0.0
    moving: float = 0.0
    cameras: Literal["shared", "per-image"] = "shared"

    @property
    def sizes(self) -> I64:
        """(V, 2)."""
        return np.tile(SIZE, (len(self.K), 1))

    @property
    def focal_px(self) -> F64:
        """(V,) the geometric mean where pixels are not square."""
        return np.asarray(np.sqrt(self.K[:, 0, 0] * self.K[:, 1, 1]))

    def observe(self, rng: np.random.Generator) -> Tracks:
        """Return tracks of the visible points with all observation errors."""
        X = np.repeat(self.X[None], len(self.K), axis=0)
        object_ = rng.random(len(self.X)) < self.moving
        step = 0.15 * rng.normal(size=(len(self.K), 1, 3))
        X = np.where(object_[None, :, None], X + step, X)
        Y = np.einsum("vab,vnb->vna", self.R, X - self.C[:, None])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = Y[..., :2] / Y[..., 2:]
        r2 = np.sum(x**2, axis=-1, keepdims=True)
        x = x * (1.0 + self.lens[0] * r2 + self.lens[1] * r2**2)
        # Beyond its turning point the polynomial is not invertible.
        whole = 1.0 + 3.0 * self.lens[0] * r2[..., 0] + 5.0 * self.lens[1] * r2[..., 0] ** 2 > 0.1
        xy = np.einsum("vab,vnb->vna", self.K[:, :2, :2], x) + self.K[:, None, :2, 2]
        seen = (Y[..., 2] > 0.1) & whole & ((xy >= 0) & (xy <= SIZE - 1)).all(axis=2)
        tracks = observe(xy, seen & (rng.random(seen.shape) < 0.85), self.sigma_px, rng)
        lost = rng.random(len(tracks.xy)) < self.wrong
        tracks.xy[lost] = rng.uniform(0.0, SIZE - 1.0, (int(lost.sum()), 2))
        return tracks


def _points(rng: np.random.Generator, n: int = 400) -> F64:
    return rng.uniform(-1.0, 1.0, (n, 3)) * rng.uniform(0.6, 1.0, 3)


def _cap(rng: np.random.Generator, views: int, half_deg: float = 30.0) -> tuple[F64, F64]:
    """Cameras on a cap of the sphere, at several distances and rolls, with an inexact aim."""
    azimuth, height = np.radians(rng.uniform(-half_deg, half_deg, (2, views)))
    C = np.stack([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)], axis=1)
    C *= 4.0 * rng.uniform(0.8, 1.25, (views, 1))
    R = [look_at(c, 0.2 * rng.normal(size=3), float(rng.uniform(-0.3, 0.3))) for c in C]
    return np.array(R), C


def _path(rng: np.random.Generator, C: F64, turn_deg: float) -> tuple[F64, F64]:
    """Cameras at C that look one way but for turns of ``turn_deg`` (rms about each axis)."""
    start = look_at(C.mean(axis=0), 0.1 * rng.normal(size=3), float(rng.uniform(-0.2, 0.2)))
    turns = Rotation.from_rotvec(np.radians(turn_deg) * rng.normal(size=(len(C), 3))).as_matrix()
    return turns @ start, C


def _set(poses: tuple[F64, F64], X: F64, rng: np.random.Generator) -> HarshSet:
    """One focal that fills the image with the scene, the principal point off by half a hundredth."""
    R, C = poses
    K = np.zeros((len(R), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = filling_focal(R, C, X) * rng.uniform(0.8, 1.1) * SIZE.max()
    K[:, :2, 2], K[:, 2, 2] = (SIZE - 1) / 2 + 0.0035 * SIZE.max() * rng.normal(size=2), 1.0
    return HarshSet(K, R, C, X, float(rng.uniform(0.3, 0.8)))


def _several(rng: np.random.Generator) -> int:
    return int(rng.integers(5, 12))


def _general(rng: np.random.Generator, views: int | None = None) -> HarshSet:
    return _set(_cap(rng, views or _several(rng)), _points(rng), rng)


def _turntable(rng: np.random.Generator) -> HarshSet:
    poses = turntable(rng, _several(rng), 4.0, highest_deg=40.0, widest_deg=300.0)
    return _set(poses, _points(rng), rng)


def _changed(scene: HarshSet, zoom: F64 | float = 1.0, shift: F64 | float = 0.0, **more: Any) -> HarshSet:
    """Focal lengths times ``zoom`` (V,), principal points moved by ``shift`` (V, 2) in width and height."""
    K = scene.K.copy()
    K[:, :2, :2] *= np.reshape(zoom, (-1, 1, 1))
    K[:, :2, 2] += shift * SIZE
    return replace(scene, K=K, **more)


def _own_zooms(scene: HarshSet, rng: np.random.Generator) -> HarshSet:
    return _changed(scene, np.exp(rng.uniform(-0.3, 0.3, len(scene.K))), cameras="per-image")


def _own_crops(rng: np.random.Generator) -> HarshSet:
    scene = _general(rng)
    return _changed(scene, shift=rng.uniform(-0.1, 0.1, (len(scene.K), 2)))


def _two_zooms(rng: np.random.Generator, low: float, high: float) -> HarshSet:
    scene = _general(rng)
    return _changed(scene, np.where(np.arange(len(scene.K)) % 2 == 0, 1.0, rng.uniform(low, high)))


def _one_other(rng: np.random.Generator) -> HarshSet:
    scene = _general(rng)
    factors = np.ones(len(scene.K))
    factors[rng.integers(len(factors))] = rng.uniform(1.05, 1.5)
    return _changed(scene, factors)


def _sideways(rng: np.random.Generator) -> HarshSet:
    C = np.stack([np.full(8, 4.0), np.linspace(-1.2, 1.2, 8), 0.02 * rng.normal(size=8)], axis=1)
    return _set(_path(rng, C, rng.uniform(0.1, 2.0)), _points(rng), rng)


def _forward(rng: np.random.Generator) -> HarshSet:
    C = np.stack([np.linspace(6.0, 3.0, 8), *(0.03 * rng.normal(size=(2, 8)))], axis=1)
    return _set(_path(rng, C, rng.uniform(0.1, 2.0)), _points(rng), rng)


def _nearly_turning(rng: np.random.Generator) -> HarshSet:
    C = np.array([4.0, 0.0, 0.0]) + 4.0 * rng.uniform(0.003, 0.06) * rng.normal(size=(8, 3))
    return _set(_path(rng, C, rng.uniform(4.0, 9.0)), _points(rng), rng)


def _aspect(rng: np.random.Generator) -> HarshSet:
    scene = _general(rng)
    scene.K[:, 1, 1] *= rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.06) + 1.0
    return scene


def _telephoto(rng: np.random.Generator) -> HarshSet:
    R, C = _cap(rng, _several(rng))
    return _set((R, rng.uniform(3.0, 8.0) * C), _points(rng), rng)


def _shallow(rng: np.random.Generator) -> HarshSet:
    X = _points(rng)
    X[:, 0] = rng.uniform(0.005, 0.08) * rng.uniform(-1.0, 1.0, len(X))
    return _set(_cap(rng, _several(rng)), X, rng)


def _strong_lens(rng: np.random.Generator) -> HarshSet:
    return replace(_general(rng), lens=(float(rng.uniform(-0.4, -0.1)), float(rng.uniform(0.0, 0.15))))


def _few_points(rng: np.random.Generator) -> HarshSet:
    return _own_zooms(_set(_cap(rng, 5), _points(rng, int(rng.integers(70, 120))), rng), rng)


def _small_arc(rng: np.random.Generator) -> HarshSet:
    return _set(_cap(rng, _several(rng), rng.uniform(2.5, 5.0)), _points(rng), rng)


KINDS: Mapping[str, Callable[[np.random.Generator], HarshSet]] = {
    "three images": lambda rng: _general(rng, 3),
    "four images, one zoom per image": lambda rng: _own_zooms(_general(rng, 4), rng),
    "a small arc of 5 to 10 degrees": _small_arc,
    "nearly pure rotation": _nearly_turning,
    "sideways, turned by 0.1 to 2 degrees": _sideways,
    "forward, turned by 0.1 to 2 degrees": _forward,
    "sideways or forward, one zoom per image": lambda rng: _own_zooms(
        (_sideways if rng.random() < 0.5 else _forward)(rng), rng
    ),
    "turntable": _turntable,
    "turntable, all cropped equally": lambda r: _changed(_turntable(r), shift=r.uniform(-0.1, 0.1, 2)),
    "turntable, one zoom per image": lambda rng: _own_zooms(_turntable(rng), rng),
    "two alternating zooms, shared camera assumed": lambda rng: _two_zooms(rng, 1.1, 2.0),
    "two similar alternating zooms, shared camera assumed": lambda rng: _two_zooms(rng, 1.02, 1.1),
    "one image with another focal length, shared camera assumed": _one_other,
    "all cropped equally": lambda rng: _changed(_general(rng), shift=rng.uniform(-0.12, 0.12, 2)),
    "each cropped differently": lambda rng: _own_zooms(_own_crops(rng), rng),
    "each cropped differently, shared camera assumed": _own_crops,
    "pixels not square": _aspect,
    "strong lens": _strong_lens,
    "telephoto": _telephoto,
    "shallow scene": _shallow,
    "noise of 2 to 3 px": lambda rng: replace(_general(rng), sigma_px=float(rng.uniform(2.0, 3.0))),
    "a fifth of the matches wrong": lambda rng: replace(_general(rng), wrong=0.2),
    "an object moves with 30 % of the points": lambda rng: replace(_general(rng), moving=0.3),
    "five images of few points, one zoom per image": _few_points,
}
OFF = 0.03


class Trial(NamedTuple):
    """One set: "refused", "not trusted" or "trusted"; relative focal errors of the registered cameras;
    ``silent`` cameras, which err by more than 3 % and by more than their intervals; failed checks or refusal.
    """

    number: int
    outcome: str
    registered: int
    worst: float
    median: float
    silent: int
    failed_checks: tuple[str, ...]


def run_trial(kind: str, number: int) -> Trial:
    rng = np.random.default_rng([number, list(KINDS).index(kind), 7])
    scene = KINDS[kind](rng)
    observed = scene.observe(rng)
    pairs, config = pairs_from_tracks(observed, seed=number), PipelineConfig()
    config = replace(config, intrinsics=replace(config.intrinsics, cameras=scene.cameras))
    matched = Matched(kind, verified_tracks(observed, pairs), pairs, scene.sizes)
    result, failures = solve(matched, config, seed=number)
    if result is None:
        return Trial(number, "refused", 0, np.nan, np.nan, 0, tuple(failures[-1:]))
    error, stated = focal_errors(result, scene.focal_px)
    silent = int(((error > OFF) & (error > stated)).sum())
    outcome = "trusted" if result.trusted else "not trusted"
    worst, median = float(error.max()), float(np.median(error))
    return Trial(number, outcome, len(error), worst, median, silent, tuple(result.failed_checks))


def verified_tracks(t: Tracks, pairs: Sequence[TwoView]) -> Tracks:
    """Return the observations that some verified pair has."""
    kept = np.zeros((t.n_views, t.n_points), dtype=bool)
    for pair in pairs:
        if pair.accepted:
            kept[pair.i, pair.index1] = kept[pair.j, pair.index2] = True
    k = kept[t.view_index, t.point_index]
    return Tracks(t.view_index[k], t.point_index[k], t.xy[k], t.n_views, t.n_points)


def focal_errors(result: MetricResult, truth: F64) -> tuple[F64, F64]:
    """Return |log f / f_true| of the registered cameras and half their 95 % intervals (relative)."""
    views = np.flatnonzero(result.reconstruction.registered)
    found = [result.intrinsics[v]["focal_px"] for v in views]
    value = np.array([interval.value for interval in found])
    error = np.abs(np.log(value / truth[views]))
    return error, LEVEL * np.array([interval.std for interval in found]) / value


def table_row(kind: str, trials: Sequence[Trial]) -> list[object]:
    count = Counter(t.outcome for t in trials)
    trusted = [t for t in trials if t.outcome == "trusted"]
    rejected = [t for t in trials if t.outcome == "not trusted"]
    median = f"{100.0 * float(np.median([t.worst for t in trusted])):.2f}" if trusted else "-"
    good, off = sum(t.worst <= OFF for t in rejected), sum(t.worst > OFF for t in trusted)
    silent = sum(t.silent > 0 for t in trusted)
    return [kind, count["refused"], count["not trusted"], good, count["trusted"], median, off, silent]


HEAD = ["set", "refused", "not trusted", "not trusted though within 3 %", "trusted"]
HEAD += ["their worst focal, median, %", "off by more than 3 %", "and by more than the interval"]


def harsh_study(trials: int = 20, workers: int = 1, kinds: Sequence[str] | None = None) -> Iterator[Part]:
    """Look for trusted answers with a wrong focal length outside its interval, on harsh synthetic sets."""
    chosen = [k for k in KINDS if kinds is None or any(word in k for word in kinds)]
    if not chosen:
        raise UsageError(f"no kind has one of these words; choose from {', '.join(KINDS)}")
    lines, errors, total = [], [], 0
    with ProcessPoolExecutor(workers) as pool:
        for kind in chosen:
            found = list(pool.map(partial(run_trial, kind), range(trials)))
            lines.append(table_row(kind, found))
            total += sum(t.outcome == "trusted" for t in found)
            errors += [f"{kind}: {t}" for t in found if t.outcome == "trusted" and t.silent]
            report_progress(f"{kind} done")
    yield text_table(HEAD, lines)
    yield "\n".join(errors)
    rows = Rows(f"{total} trusted", "ours")
    rows.add("trusted, wrong, outside its interval", len(errors), at_most=0.0)
    yield rows
