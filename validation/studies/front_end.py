"""The front end of chapter 4 beside SIFT and COLMAP on real images.

``pairs``: verified matches of fountain-P11 and Herz-Jesus-P8 (:mod:`validation.studies.front_end_pairs`).
``kermit``: the 55 pairs of a hand-held set with wide baselines and without true cameras. A pair contradicts a
model if the RMS Sampson distance of its verified, undistorted matches to the F of the model exceeds
``CONTRADICTS_PX``. The models are ours and COLMAP's, which is independent of our pairs. ``time``: features
and matching of all pairs of fountain-P11, each program in its own process on the same cores. ``invariance``:
rotated, scaled and darkened copies of images, whose true map is known. The copy rotated by 45 degrees shows a
third of the image and gets as many corners as the whole, most of which the image lacks. SIFT is OpenCV's with
all features, ratio 0.8 and mutual best matches.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thesisrecon import reconstruct
from thesisrecon.arrays import F64, U8
from thesisrecon.config import PipelineConfig
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals
from thesisrecon.io.images import list_images, read_images
from thesisrecon.pipeline.image_pair import detect_features, match_views
from thesisrecon.records import Features, Image, Reconstruction, RunResult, TwoView
from thesisrecon.runtime.executors import Workers
from validation.harness.process import own_cores, run_process
from validation.metrics.record import Metric
from validation.references.colmap_run import reconstruct_with_pycolmap
from validation.references.pictures import shrink, warp_affine
from validation.scenes.real_pairs import SCENES_WITH_CAMERAS
from validation.studies.front_end_pairs import (
    MAX_SIZE_PX,
    OURS,
    SIFT,
    THESIS,
    PreparedViews,
    check_pairs,
    front_ends,
    measure_pairs,
    pair_table,
)
from validation.studies.measuring import ONE_BLAS_THREAD as BLAS
from validation.studies.measuring import call_apart
from validation.studies.rectification import undistorted
from validation.studies.runner import CACHE, Part, Rows, load_scene, text_table

# ---------------------------------------------------------------- kermit

OUR_MODEL, COLMAP_MODEL = "our model", "COLMAP's"
CONTRADICTS_PX = 3.0
FEW, MANY = 30, 100
PAIRS_WITH_FEW, PAIRS_WITH_MANY = 38, 30


@dataclass(frozen=True)
class JudgedPair:
    """A pair by one front end and its distance from each model, NaN if a model lacks a view."""

    view: TwoView
    disagreement_px: Mapping[str, float]

    def contradicts(self, model: str) -> bool:
        """Whether the pair contradicts the geometry of this model."""
        return self.disagreement_px[model] > CONTRADICTS_PX


@dataclass(frozen=True)
class KermitRun:
    """The pairs of each front end, and the registered views of each model."""

    by: Mapping[str, list[JudgedPair]]
    registered: Mapping[str, int]


def measure_kermit() -> KermitRun | None:
    """Relate all pairs with every front end; None if the images are not on this machine.

    The pairs of the default front end are those that our model was made of.
    """
    scene = load_scene("kermit")
    if scene is None:
        return None
    images = scene.image_paths[0].parent
    with tempfile.TemporaryDirectory() as folder:
        result = reconstruct(images, Path(folder) / "ours", until="metric")
        reference = reconstruct_with_pycolmap(images, Path(folder) / "colmap")
    assert result.metric is not None
    models = {OUR_MODEL: result.metric.reconstruction, COLMAP_MODEL: reference.reconstruction}
    by = {name: [judge(v, models) for v in _all_pairs(name, result)] for name in (OURS, THESIS, SIFT)}
    return KermitRun(by, {name: int(model.registered.sum()) for name, model in models.items()})


def judge(view: TwoView, models: Mapping[str, Reconstruction]) -> JudgedPair:
    """Compare the pair with the models."""
    return JudgedPair(view, {name: disagreement(view, model) for name, model in models.items()})


def _all_pairs(name: str, result: RunResult) -> list[TwoView]:
    if name == OURS:
        return list(result.pairs)
    prepared = PreparedViews(front_ends()[name], result.images)
    return [prepared.relate(i, j) for i, j in combinations(range(len(result.images)), 2)]


def disagreement(view: TwoView, model: Reconstruction) -> float:
    """Return the RMS Sampson distance (px) of the verified matches to the F of the model.

    NaN without matches or if the model lacks one of the views.
    """
    if view.inliers == 0 or not (model.registered[view.i] and model.registered[view.j]):
        return float("nan")
    F = fundamental_from_cameras(model.P[view.i], model.P[view.j])
    d = sampson_residuals(F, undistorted(model, view.i, view.xy1), undistorted(model, view.j, view.xy2))
    return float(np.sqrt(np.mean(d**2)))


def check_kermit(run: KermitRun) -> list[Metric]:
    """Return pairs with many verified matches, and those that contradict a model."""

    def count(wanted: Callable[[JudgedPair], bool]) -> dict[str, float | None]:
        return {name: float(sum(map(wanted, pairs))) for name, pairs in run.by.items()}

    rows = Rows("kermit", OURS)
    for least, target in ((FEW, PAIRS_WITH_FEW), (MANY, PAIRS_WITH_MANY)):
        many = count(lambda p, least=least: p.view.inliers >= least)  # type: ignore[misc]
        rows.add(f"pairs with >= {least} verified, of 55", many, at_least=float(target))
    rows.add("pairs accepted", count(lambda p: p.view.accepted))
    verified = {name: float(sum(p.view.inliers for p in pairs)) for name, pairs in run.by.items()}
    rows.add("verified, all pairs", verified)
    for model, views in run.registered.items():
        against = count(lambda p, m=model: p.view.accepted and p.contradicts(m))  # type: ignore[misc]
        among = count(lambda p, m=model: p.view.inliers >= FEW and p.contradicts(m))  # type: ignore[misc]
        title = f"contradict {model} ({views} views)"
        rows.add(f"accepted pairs that {title}", against, at_most=0.0)
        rows.add(f"pairs with >= {FEW} that {title}", among, at_most=0.0)
        worst = {name: _worst_agreeing(pairs, model) for name, pairs in run.by.items()}
        rows.add(f"largest disagreement with {model} below {CONTRADICTS_PX:g} px", worst)
    return rows


def _worst_agreeing(pairs: list[JudgedPair], model: str) -> float | None:
    """Return the largest disagreement of a pair that counts as agreeing."""
    agreeing = [
        p.disagreement_px[model]
        for p in pairs
        if p.view.inliers >= FEW and p.disagreement_px[model] <= CONTRADICTS_PX
    ]
    return max(agreeing, default=None)


def kermit_table(run: KermitRun) -> str:
    """Return verified matches / disagreement with each model (px) of every related pair."""
    head = [" / ".join(("verified", *run.registered)), *run.by]
    related = (p for p in zip(*run.by.values(), strict=True) if max(one.view.inliers for one in p) >= FEW)
    return text_table(head, ([f"{p[0].view.i}-{p[0].view.j}", *map(_kermit_cell, p)] for p in related))


def _kermit_cell(pair: JudgedPair) -> str:
    models = " / ".join(f"{px:.2f}" for px in pair.disagreement_px.values())
    return f"{pair.view.inliers} / {models}{'' if pair.view.accepted else ', refused'}"


# ---------------------------------------------------------------- time

SCENE = "fountain-P11"
COLMAP = "COLMAP"
SHARE = 0.5
CPU = "processor time"


@dataclass(frozen=True)
class Timed:
    """Time of one front end.

    ``seconds``: wall seconds by stage; ``cpu_s``: processor seconds of the stages (COLMAP: of the process);
    ``peak_mb``: peak memory.
    """

    seconds: Mapping[str, float]
    cpu_s: float
    peak_mb: float

    @property
    def wall_s(self) -> float:
        """Wall seconds of all stages."""
        return sum(self.seconds.values())


def relate_all(folder: str, threads: int) -> dict[str, float]:
    """Read, detect, prepare and match all pairs in this process; return seconds by stage.

    One pair is related first, so that the compiled kernels are loaded.
    """
    paths, workers = list_images(Path(folder)), Workers(threads)
    _relate(paths[:2], workers)
    start = time.process_time()
    return {**_relate(paths, workers), CPU: time.process_time() - start}


def _relate(paths: Sequence[Path], workers: Workers) -> dict[str, float]:
    config, seconds = PipelineConfig(), dict[str, float]()

    def run(stage: str, function: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> list[Any]:
        start = time.perf_counter()
        found: dict[int, Any] = {}
        workers.run(function, arguments, found.__setitem__)
        seconds[stage] = time.perf_counter() - start
        return [found[n] for n in range(len(arguments))]

    start = time.perf_counter()
    images = read_images(paths, max_size_px=MAX_SIZE_PX, map_all=workers.map_all).images
    seconds["read"] = time.perf_counter() - start
    features = run("corners", detect_features, [(config, image) for image in images])
    views = run("prepare", config.matching.prepare, list(zip(images, features, strict=True)))
    pairs = combinations(range(len(images)), 2)
    run("match and verify", match_views, [(config, views[i], views[j], (i, j), 0) for i, j in pairs])
    return seconds


def measure_time(*, threads: int = 2) -> dict[str, Timed] | None:
    """Time both front ends on the same cores; None if the images are not on this machine."""
    scene = load_scene(SCENE)
    if scene is None:
        return None
    images = scene.image_paths[0].parent
    ours, used = call_apart(relate_all, images, threads, cores=threads, environment=BLAS)
    cpu_s = ours.pop(CPU)
    with tempfile.TemporaryDirectory() as name:
        folder, log = Path(name) / "colmap", Path(name) / "log"
        command = [sys.executable, "-m", "validation.references.colmap_run", str(images), str(folder)]
        command += ["--only-matches", "--threads", str(threads)]
        theirs = run_process(command, log=log, cores=own_cores()[:threads], environment=BLAS)
        if theirs.code:
            raise RuntimeError(log.read_text(encoding="utf-8")[-2000:])
        seconds = json.loads((folder / "seconds.json").read_text(encoding="utf-8"))
    return {
        OURS: Timed(ours, cpu_s, used.peak_mb),
        COLMAP: Timed(seconds, theirs.cpu_s, theirs.peak_mb),
    }


def check_time(runs: Mapping[str, Timed]) -> list[Metric]:
    """Return wall time, which is judged, memory and stages."""
    wall, rows = {name: run.wall_s for name, run in runs.items()}, Rows(SCENE, OURS)
    rows.add("features and matching of 55 pairs", wall, "s", at_most=SHARE * wall[COLMAP])
    rows.add("ratio to COLMAP", {n: s / wall[COLMAP] for n, s in wall.items()}, at_most=SHARE)
    rows.add("peak memory", {n: run.peak_mb for n, run in runs.items()}, "MB")
    rows.add("processor time", {n: r.cpu_s for n, r in runs.items()}, "s")
    for name, run in runs.items():
        for stage, seconds in run.seconds.items():
            rows.add(stage, {name: seconds}, "s")
    return rows


# ---------------------------------------------------------------- invariance

REPEATED_PX, RIGHT_PX = 1.5, 1.5
IMAGES = (("fountain-P11", 5), ("Herz-Jesus-P8", 3))


@dataclass(frozen=True)
class Copy:
    """A copy ``rgb`` of an image; ``copy_from_image`` (2, 3) maps its pixels to those of the copy."""

    name: str
    rgb: U8
    copy_from_image: F64


def make_copies(rgb: U8) -> Iterator[Copy]:
    """Make all copies of an image (H, W, 3)."""
    same = np.eye(3)[:2]
    width = rgb.shape[1]
    turned = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, width - 1.0]])
    yield Copy("turned by 90 degrees", np.ascontiguousarray(np.rot90(rgb)), turned)
    yield _turned(rgb, 45.0)
    for scale in (0.7, 0.5):
        yield _scaled(rgb, scale)
    for factor in (0.5, 0.25):
        yield Copy(f"times {factor:g}", np.rint(rgb * factor).astype(np.uint8), same)
    darker = np.rint(255.0 * (rgb / 255.0) ** 2.0).astype(np.uint8)
    yield Copy("to the power of 2", darker, same)


def _turned(rgb: U8, degrees: float) -> Copy:
    """Rotate about the middle and keep the square without empty corners."""
    height, width = rgb.shape[:2]
    side = int(min(height, width) / np.sqrt(2.0))
    middle = ((width - 1) / 2.0, (height - 1) / 2.0)
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[cos, sin], [-sin, cos]])
    A = np.column_stack([turn, (side - 1) / 2.0 - turn @ middle])
    return Copy(f"turned by {degrees:g} degrees", warp_affine(rgb, A, (side, side)), A)


def _scaled(rgb: U8, scale: float) -> Copy:
    """Shrink by area means."""
    height, width = (round(scale * n) for n in rgb.shape[:2])
    sx, sy = width / rgb.shape[1], height / rgb.shape[0]
    A = np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5]])
    return Copy(f"scaled by {scale:g}", shrink(rgb, (width, height)), A)


@dataclass(frozen=True)
class CopyScore:
    """One front end on one copy.

    ``repeated``: share of the corners that are found in both images; ``corners``: corners in the part of
    the image that the copy shows; ``right``, ``verified``: verified matches within ``RIGHT_PX`` of their
    place, and all of them.
    """

    repeated: float
    corners: int
    right: int
    verified: int


def score_copy(config: PipelineConfig, image: Image, copy: Copy) -> CopyScore:
    """Detect, match and verify an image and its copy."""
    images = (image, Image(copy.name, copy.rgb, (copy.rgb.shape[1], copy.rgb.shape[0])))
    features = [detect_features(config, one) for one in images]
    views = [config.matching.prepare(one, f) for one, f in zip(images, features, strict=True)]
    pair = match_views(config, views[0], views[1], (0, 1), 0)
    error = np.linalg.norm(_mapped(copy.copy_from_image, pair.xy1) - pair.xy2, axis=1)
    repeated, corners = repeatability(features[0], features[1], image.size, copy)
    return CopyScore(repeated, corners, int(np.sum(error < RIGHT_PX)), pair.inliers)


def repeatability(first: Features, second: Features, size: tuple[int, int], copy: Copy) -> tuple[float, int]:
    """Return the share of corners found in both images, and the number of corners that the copy shows.

    Two corners are the same if they are mutually nearest and within ``REPEATED_PX`` (Mikolajczyk and Schmid,
    PAMI 2005). The share is of the smaller number of corners in the common part. SIFT keypoints at one place
    count once.
    """
    A = copy.copy_from_image
    inverse = np.linalg.inv(np.vstack([A, [0.0, 0.0, 1.0]]))[:2]
    there, found = _mapped(A, _places(first)), _places(second)
    there = there[_inside(there, (copy.rgb.shape[1], copy.rgb.shape[0]))]
    found = found[_inside(_mapped(inverse, found), size)]
    if not len(there) or not len(found):
        return 0.0, len(there)
    distance, nearest = cKDTree(found).query(there)
    mutual = cKDTree(there).query(found)[1][nearest] == np.arange(len(there))
    same = np.count_nonzero(mutual & (distance < REPEATED_PX))
    return float(same / min(len(there), len(found))), len(there)


def _places(features: Features) -> F64:
    return np.unique(features.xy, axis=0)


def _mapped(A: F64, xy: F64) -> F64:
    return np.asarray(xy @ A[:, :2].T + A[:, 2], dtype=np.float64)


def _inside(xy: F64, size: tuple[int, int]) -> NDArray[np.bool_]:
    return np.asarray(((xy >= 0.0) & (xy <= np.array(size) - 1.0)).all(axis=1))


def measure_invariance() -> dict[str, dict[str, dict[str, CopyScore]]]:
    """Return image -> copy -> front end -> score."""
    configs = {name: config for name, config in front_ends().items() if name in (OURS, SIFT)}
    found: dict[str, dict[str, dict[str, CopyScore]]] = {}
    for scene_name, view in IMAGES:
        scene = load_scene(scene_name)
        if scene is None:
            continue
        image = read_images(scene.image_paths[view : view + 1], max_size_px=MAX_SIZE_PX).images[0]
        found[f"{scene_name}, image {view}"] = {
            copy.name: {name: score_copy(config, image, copy) for name, config in configs.items()}
            for copy in make_copies(image.rgb)
        }
    return found


def check_invariance(title: str, copies: dict[str, dict[str, CopyScore]]) -> list[Metric]:
    """Return right matches and repeatability of every copy; SIFT, which is made for this, is no bound."""
    quantities: tuple[tuple[str, str, Callable[[CopyScore], float]], ...] = (
        ("right matches", "", lambda s: float(s.right)),
        ("right of the verified", "%", lambda s: 100.0 * s.right / max(s.verified, 1)),
        ("repeatability", "%", lambda s: 100.0 * s.repeated),
        ("corners in the copy's part", "", lambda s: float(s.corners)),
    )
    rows = Rows(title, OURS)
    for name, unit, read in quantities:
        for copy, by in copies.items():
            rows.add(f"{copy}: {name}", {m: read(score) for m, score in by.items()}, unit)
    return rows


# ---------------------------------------------------------------- the study

Name = Literal["pairs", "kermit", "time", "invariance"]


def front_end_study(
    parts: Sequence[Name] = ("pairs", "kermit", "time", "invariance"),
    gaps: Sequence[int] = (1, 2, 3),
    cache: Path = CACHE,
) -> Iterator[Part]:
    """Compare the front end of chapter 4 with SIFT and COLMAP on real images.

    Parameters
    ----------
    gaps : sequence of int
        Gaps of the pairs (i, i + gap).
    """
    for scene in SCENES_WITH_CAMERAS if "pairs" in parts else ():
        for gap in gaps:
            pairs = list(measure_pairs(scene, (gap,), cache))
            if pairs:
                yield check_pairs(scene, gap, pairs)
                yield pair_table(scene, pairs)
    kermit = measure_kermit() if "kermit" in parts else None
    if kermit is not None:
        yield check_kermit(kermit)
        yield kermit_table(kermit)
    runs = measure_time() if "time" in parts else None
    if runs is not None:
        yield check_time(runs)
    for title, copies in measure_invariance().items() if "invariance" in parts else ():
        yield check_invariance(f"Copies of {title}", copies)
