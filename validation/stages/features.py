"""Chapter 4: our corners and matches compared with SIFT and OpenCV's Harris corners."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from thesisrecon.arrays import F64
from thesisrecon.config import preset
from thesisrecon.features.harris import HarrisCorners
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import fundamental_from_cameras, symmetric_residuals
from thesisrecon.io._images import read_images
from thesisrecon.pipeline.matching import match_views
from thesisrecon.records import Image, TwoView
from validation.metrics.fundamental_precision import RIGHT_PX, rms_epipolar_distance
from validation.references.libraries import NoReference
from validation.references.opencv import harris_corners, sift_corners
from validation.references.sift import sift_front_end
from validation.runs.records import (
    IMAGE_SCENES,
    Judgement,
    Outcome,
    ReportOptions,
    Stage,
    Task,
    load_images,
    read_arrays,
)
from validation.runs.tables import OURS, Metric, Values, each, row
from validation.scenes.real import Scene, load_fixture_depth
from validation.scenes.real_pairs import RealPair, camera_pairs
from validation.stages.fundamental import MATCHES

THESIS, SIFT, HARRIS = "ours (thesis)", "SIFT", "cv2.cornerHarris"
FRONT_ENDS = (OURS, THESIS, SIFT)
CORNERS = 1000
VERIFIED = "mean over the pairs; none if F is wrong"
NOISE = "median over the pairs of the noise of the verified matches"
FROM_TRUTH = "mean over the pairs of the RMS distance of verified matches, at most 1 px each"
MAX_SIZE_PX = 1600
WITH_DEPTH = ("courtyard",)  # Scenes with true depth, which gives the position of a corner in the next image


class FeaturesStage(Stage):
    """Repeatability of corners, and verified matches of front ends."""

    name = "features"
    scenes, own = IMAGE_SCENES, True

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return super().takes(scene, options) and load_images(scene, options).has_truth

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        if options.gates_only:
            return (OURS, THESIS) if scene in WITH_DEPTH else (OURS,)
        return (*FRONT_ENDS, HARRIS) if scene in WITH_DEPTH else FRONT_ENDS

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        # The judgement evaluates F on these matches, moved onto the true epipolar lines.
        return () if method else (("fundamental", MATCHES),)

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        scene = load_images(task.scene, options)
        images = read_images(scene.image_paths, max_size_px=MAX_SIZE_PX).images
        if task.scene in WITH_DEPTH:
            corners: dict[str, Any] = {f"{i}": _corners(task.method, m) for i, m in enumerate(images)}
            np.savez(folder / "corners.npz", **corners)
        if task.method != HARRIS:
            np.savez(folder / "matches.npz", **_matches(task.method, images, scene, options))

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        images = load_images(scene, options)
        cache = options.folder("fundamental", scene, MATCHES)
        found = {n: read_arrays(outcomes[n], "matches.npz") if n in outcomes else None for n in FRONT_ENDS}
        metrics, notes = list[Metric](), list[str]()
        try:
            for gap in _gaps(options):
                metrics += _match_metrics(scene, gap, list(camera_pairs(images, cache, (gap,))), found)
        except NoReference as error:
            metrics = []
            notes.append(f"Matches are not evaluated: true correspondences need SIFT: {error}.")
        if scene in WITH_DEPTH:
            metrics.append(_repeatability(images, outcomes))
        return Judgement(metrics, notes=notes)


def _gaps(options: ReportOptions) -> tuple[int, ...]:
    return (1,) if options.quick else (1, 2)


def _corners(method: str, image: Image) -> F64:
    """Return the strongest corners (N, 2) of an image."""
    if method in (OURS, THESIS):
        config = HarrisCorners() if method == THESIS else preset("default").features
        found = config.detect(image)
        strongest = np.argsort(-found.response, kind="stable")[:CORNERS]
        return np.asarray(found.xy[strongest], dtype=np.float64)
    return sift_corners(image, CORNERS) if method == SIFT else harris_corners(image, CORNERS)


def _matches(method: str, images: tuple[Image, ...], scene: Scene, options: ReportOptions) -> dict[str, Any]:
    # All with the estimator of F and the verification of the default.
    config, thesis = preset("default"), preset("thesis")
    if method == SIFT:
        config = sift_front_end(config)
    elif method == THESIS:
        config = replace(config, features=thesis.features, matching=thesis.matching)
    prepared = [config.matching.prepare(image, config.features.detect(image)) for image in images]
    arrays: dict[str, Any] = {}
    for gap in _gaps(options):
        views: list[TwoView] = [
            match_views(config, prepared[i], prepared[i + gap], (i, i + gap), options.seed)
            for i in range(len(images) - gap)
        ]
        arrays[f"F{gap}"] = np.array([in_original_pixels(v.F, images[v.i], images[v.j]) for v in views])
        arrays[f"inliers{gap}"] = np.array([view.inliers for view in views])
        arrays[f"sigma{gap}"] = np.array([view.sigma_px for view in views])
        arrays[f"off{gap}"] = np.array([_distance_from_truth(v, images, scene) for v in views])
    return arrays


def _distance_from_truth(view: TwoView, images: tuple[Image, ...], scene: Scene) -> float:
    """RMS distance (working px) of the matches from their true epipolar lines, at most ``RIGHT_PX`` each."""
    K, R, C = scene.cameras_of((view.i, view.j))
    F = fundamental_from_cameras(*camera_from_centre(K, R, C))
    first, second = (images[k].original_from_working for k in (view.i, view.j))
    d = symmetric_residuals(second.T @ F @ first, view.xy1, view.xy2) / np.sqrt(2.0)
    return float(np.sqrt(np.mean(np.minimum(d, RIGHT_PX) ** 2)))


def in_original_pixels(F: F64, first: Image, second: Image) -> F64:
    """Return the F (3, 3) of original pixels from that of two images at working size."""
    here, there = (np.linalg.inv(image.original_from_working) for image in (first, second))
    return np.asarray(there.T @ F @ here)


def _match_metrics(
    scene: str, gap: int, pairs: list[RealPair], found: Mapping[str, dict[str, Any] | None]
) -> list[Metric]:
    verified, right, sigma, off = (Values(dict.fromkeys(found)) for _ in range(4))
    for name, arrays in found.items():
        if arrays is not None:
            F, inliers, noise, distance = (arrays[f"{n}{gap}"] for n in ("F", "inliers", "sigma", "off"))
            truths = [pair.truth for pair in pairs if pair.truth is not None]
            good = np.array([rms_epipolar_distance(*both) < RIGHT_PX for both in zip(F, truths, strict=True)])
            verified[name] = float(inliers[good].sum() / len(pairs))
            right[name] = float(100.0 * good.mean())
            sigma[name] = float(np.median(noise[good])) if good.any() else None
            off[name] = float(np.mean(distance[good])) if good.any() else None
    where = f"(i, i+{gap})"
    return [
        row(scene, f"{THESIS}: verified matches {where}", "", verified[THESIS], VERIFIED, more=True),
        row(scene, f"{THESIS}: noise {where}", "px", sigma[THESIS], NOISE),
        row(scene, f"verified matches {where}", "", verified, VERIFIED, more=True),
        row(scene, f"right F {where}", "%", right, "share of the pairs whose F is right", more=True),
        row(scene, f"noise {where}", "px", sigma, NOISE),
        row(scene, f"{THESIS}: distance from true lines {where}", "px", off[THESIS], FROM_TRUTH),
        row(scene, f"distance from true lines {where}", "px", off, FROM_TRUTH),
    ]


def _repeatability(scene: Scene, outcomes: Mapping[str, Outcome]) -> Metric:
    found = {name: read_arrays(outcome, "corners.npz") for name, outcome in outcomes.items()}
    views = range(len(scene.image_paths))
    shares = each(found, lambda f: 100.0 * _share_repeated(scene, [f[f"{i}"] for i in views]))
    text = (
        "share of the 1000 strongest corners visible in the next image that are detected there within 1.5 px"
    )
    return row(scene.name, "repeatability", "%", shares, text, more=True)


def _share_repeated(scene: Scene, corners: list[F64]) -> float:
    again, asked = 0, 0
    transfer = _transfer(scene)
    for i in range(len(corners) - 1):
        there = transfer(i, i + 1, corners[i])
        distance, _ = cKDTree(corners[i + 1]).query(there)
        again, asked = again + int((distance <= 1.5).sum()), asked + len(there)
    return again / max(asked, 1)


def _transfer(scene: Scene) -> Callable[[int, int, F64], F64]:
    """Transfer points (N, 2) of view i to view j by true depth; only mutually visible ones."""
    K, R, C = scene.cameras
    P = camera_from_centre(K, R, C)
    depths = [load_fixture_depth(view, scene.name) for view in range(len(K))]

    def read(view: int, xy: F64) -> F64:
        depth, stride = depths[view]
        at = np.rint(xy / stride).astype(int)
        inside = (at >= 0).all(axis=1) & (at[:, 0] < depth.shape[1]) & (at[:, 1] < depth.shape[0])
        found = np.full(len(xy), np.nan)
        found[inside] = depth[at[inside, 1], at[inside, 0]]
        return found

    def transfer(i: int, j: int, xy: F64) -> F64:
        rays = homogenize(xy) @ np.linalg.inv(K[i]).T
        X = (read(i, xy)[:, None] * rays) @ R[i] + C[i]
        X = X[np.isfinite(X).all(axis=1)]
        x = homogenize(X) @ P[j].T
        z = ((X - C[j]) @ R[j].T)[:, 2]
        there = x[:, :2] / x[:, 2:]
        seen = (z > 0) & (np.abs(read(j, there) / z - 1.0) < 0.01)
        return np.asarray(there[seen], dtype=np.float64)

    return transfer
