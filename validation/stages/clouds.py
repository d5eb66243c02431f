"""Point clouds of ours and COLMAP after similarity alignment: distances both ways, ICP, renderings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.records import Reconstruction, Similarity
from validation.references.open3d_geometry import refine_by_icp
from validation.runs.records import (
    OURS,
    Judgement,
    Outcome,
    Plot,
    ReportOptions,
    Stage,
    Task,
    read_arrays,
    row,
    slug,
)
from validation.runs.scenes import has_images, load_images
from validation.runs.tables import Metric
from validation.scenes.real import Scene
from validation.stages.cameras import COLMAP, COLMAP_PP, read_model

ICP = "Open3D, ICP"
NEAR_PCT = 0.5
"""A point has a partner if the other cloud has a point within this share of its depth (%)."""
PLOTTED = 6000
SAME_PX = 1.0
"""Points of two models are the same if observed within this distance (px)."""


class CloudsStage(Stage):
    """Two clouds of one scene, aligned by their cameras."""

    name = "clouds"
    title = "Point clouds"
    definition = (
        "The points of ours and of COLMAP, aligned by the least-squares similarity of their camera "
        "centres (both to the true ones where they are known). Distances are in per cent of the median "
        "distance of the points from the cameras. ICP refines rotation and translation, the scale is kept."
    )

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return has_images(scene, options)

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        return () if options.gates_only else (ICP,)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        return (("cameras", OURS), ("cameras", COLMAP), ("cameras", COLMAP_PP))

    def run(self, task: Task, options: ReportOptions) -> None:
        folder = options.folder(task.stage, task.scene, task.method)
        images = load_images(task.scene, options)
        for name, (mine, other, unit) in _pairs_of_clouds(images, _models(images, options)).items():
            transform = refine_by_icp(mine, other, NEAR_PCT / 100.0 * unit)
            np.savez(folder / f"{slug(name)}.npz", transform=transform)

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        images = load_images(scene, options)
        models = _models(images, options)
        ours = models[OURS]
        if ours is None or (models[COLMAP] is None and models[COLMAP_PP] is None):
            names = ", ".join(name for name, model in models.items() if model is None)
            return Judgement((), notes=[f"There is no model of {names} to compare."])
        metrics, plots = list[Metric](), list[Plot]()
        clouds = _pairs_of_clouds(images, models)
        for name, (mine, other, unit) in clouds.items():
            theirs = models[name]
            assert theirs is not None
            metrics += _same_points(scene, name, ours, theirs, (mine, other, unit))
            metrics += _metrics(scene, name, mine, other, unit)
            metrics += _icp_metrics(scene, name, mine, other, unit, outcomes.get(ICP))
            plots.append(_plot(name, mine, other, unit))
        few = [name for name in (COLMAP, COLMAP_PP) if models[name] is not None and name not in clouds]
        notes = [f"{name}: too few common cameras to align the clouds." for name in few]
        return Judgement(metrics, plots, notes=notes)


def _models(scene: Scene, options: ReportOptions) -> dict[str, Reconstruction | None]:
    """Return the models of the stage cameras, None if missing."""
    models = {}
    for name in (OURS, COLMAP, COLMAP_PP):
        folder = options.folder("cameras", scene.name, name)
        models[name] = read_model(scene, name, Outcome(folder)) if folder.is_dir() else None
    return models


def _pairs_of_clouds(
    scene: Scene, models: Mapping[str, Reconstruction | None]
) -> dict[str, tuple[F64, F64, float]]:
    """Return :func:`_common_frame` of ours and each reference cloud."""
    ours, found = models[OURS], {}
    for name in (COLMAP, COLMAP_PP):
        theirs = models[name]
        clouds = None if ours is None or theirs is None else _common_frame(scene, ours, theirs)
        if clouds is not None:
            found[name] = clouds
    return found


def _common_frame(
    scene: Scene, ours: Reconstruction, theirs: Reconstruction
) -> tuple[F64, F64, float] | None:
    """Return both clouds (N, 3), (M, 3) in a common frame, and the median distance of points from cameras.

    The frame is the true one, or theirs without truth.
    """
    both = ours.registered & theirs.registered
    if both.sum() < 3:
        return None
    centres = {name: _centres(model, both) for name, model in (("ours", ours), ("theirs", theirs))}
    target = centres["theirs"] if scene.C is None else scene.C[both]
    try:
        moves = {name: estimate_similarity(c, target) for name, c in centres.items()}
    except ValueError:
        return None
    mine, other = (_moved(m, moves[n]) for n, m in (("ours", ours), ("theirs", theirs)))
    distance = np.linalg.norm(other[:, None] - target[None], axis=2)
    return mine, other, float(np.median(distance))


def same_points(ours: Reconstruction, theirs: Reconstruction) -> I64:
    """Return pairs (M, 2) of indices of valid points that are the same scene point.

    They were seen within ``SAME_PX`` of each other in more images than any other pair of either.
    """
    votes: Counter[tuple[int, int]] = Counter()
    for view in np.flatnonzero(ours.registered & theirs.registered):
        (xy1, point1), (xy2, point2) = (_is_supported(model, int(view)) for model in (ours, theirs))
        if not len(xy1) or not len(xy2):
            continue
        distance, nearest = cKDTree(xy2).query(xy1, distance_upper_bound=SAME_PX)
        near = np.isfinite(distance)
        votes.update(zip(point1[near].tolist(), point2[nearest[near]].tolist(), strict=True))
    taken1, taken2, pairs = set[int](), set[int](), []
    for (a, b), _ in sorted(votes.items(), key=lambda item: (-item[1], item[0])):
        if a not in taken1 and b not in taken2:
            taken1.add(a)
            taken2.add(b)
            pairs.append((a, b))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _is_supported(model: Reconstruction, view: int) -> tuple[F64, I64]:
    """Return inlier observations of a view: pixels and indices among the valid points."""
    number = np.cumsum(model.valid) - 1
    tracks = model.tracks
    here = (tracks.view_index == view) & model.inlier & model.valid[tracks.point_index]
    return tracks.xy[here], np.asarray(number[tracks.point_index[here]], dtype=np.int64)


def _same_points(
    scene: str, name: str, ours: Reconstruction, theirs: Reconstruction, clouds: tuple[F64, F64, float]
) -> list[Metric]:
    mine, other, unit = clouds
    pairs = same_points(ours, theirs)
    if not len(pairs):
        return []
    apart = 100.0 * np.linalg.norm(mine[pairs[:, 0]] - other[pairs[:, 1]], axis=1) / unit
    text = "distance of ours to theirs, for points observed by both within a pixel"
    most = f"90 % quantile of the {text}"
    return [
        row(scene, f"points shared with {name}", "", float(len(pairs)), text, more=True),
        _distance(scene, f"shared with {name}: median apart", np.median(apart), f"median {text}"),
        _distance(scene, f"shared with {name}: 90 % within", np.quantile(apart, 0.9), most),
    ]


def _centres(model: Reconstruction, views: np.ndarray[Any, Any]) -> F64:
    C = camera_centre(model.P[views])
    return np.asarray(C[:, :3] / C[:, 3:], dtype=np.float64)


def _moved(model: Reconstruction, move: Similarity) -> F64:
    X = model.X[model.valid]
    return np.asarray(move.apply(X[:, :3] / X[:, 3:]), dtype=np.float64)


def _metrics(scene: str, name: str, mine: F64, other: F64, unit: float) -> list[Metric]:
    forth, back = (100.0 * cKDTree(b).query(a)[0] / unit for a, b in ((mine, other), (other, mine)))
    share = 100.0 * float(np.mean(forth <= NEAR_PCT))
    text = "median distance of a point of ours to the nearest"
    back_text = "median distance of one of their points to the nearest"
    near = f"share of our points with one of theirs within {NEAR_PCT} %"
    return [
        _distance(scene, f"ours to {name}", np.median(forth), text),
        _distance(scene, f"{name} to ours", np.median(back), back_text),
        row(scene, f"near {name}", "%", share, near, more=True),
    ]


def _icp_metrics(
    scene: str, name: str, mine: F64, other: F64, unit: float, outcome: Outcome | None
) -> list[Metric]:
    """Return the motion and the inlier share of Open3D's ICP."""
    found = read_arrays(outcome, f"{slug(name)}.npz")
    if found is None:
        return []
    R, t = found["transform"][:3, :3], found["transform"][:3, 3]
    turn = float(np.degrees(np.linalg.norm(Rotation.from_matrix(R).as_rotvec())))
    middle = np.median(mine, axis=0)
    shift = float(np.linalg.norm(R @ middle + t - middle))
    share = 100.0 * float(np.mean(cKDTree(other).query(mine @ R.T + t)[0] <= NEAR_PCT / 100.0 * unit))
    turned = "rotation by which ICP still turns our cloud after the similarity"
    near = "share of our points with a partner after ICP"
    return [
        row(scene, f"ICP to {name}: turn", "deg", turn, turned),
        _distance(scene, f"ICP to {name}: shift", 100.0 * shift / unit, "shift of the cloud centre"),
        row(scene, f"ICP to {name}: inliers", "%", share, near, more=True),
    ]


def _distance(scene: str, name: str, value: float, text: str) -> Metric:
    return row(scene, name, "% of distance", float(value), text)


def _plot(name: str, mine: F64, other: F64, unit: float) -> Plot:
    """Plot both clouds: ours coloured by the distance to theirs, theirs grey."""
    distance = 100.0 * cKDTree(other).query(mine)[0] / unit
    low, high = np.quantile(mine, [0.02, 0.98], axis=0)
    margin = 0.3 * (high - low).max()
    shades = np.minimum(distance[_thinned(mine)], 2.0).round(3).tolist()
    scale = {"colorscale": "Viridis", "cmin": 0.0, "cmax": 1.0, "showscale": True}
    bar = {"colorbar": {"title": {"text": "% of distance"}}}
    traces = [
        _trace("ours", mine, {"size": 2, "color": shades, **scale, **bar}),
        _trace(name, other, {"size": 1.5, "color": "#9aa5ad"}),
    ]
    axes = {
        f"{axis}axis": {"range": [float(low[k] - margin), float(high[k] + margin)], "visible": False}
        for k, axis in enumerate("xyz")
    }
    layout = {"scene": {"aspectmode": "data", **axes}, "margin": {"l": 0, "r": 0, "t": 0, "b": 0}}
    text = "Ours is coloured by the distance of each point to the nearest of theirs; drag to turn."
    return Plot(f"Ours and {name}", {"data": traces, "layout": layout}, text)


def _trace(name: str, X: F64, marker: dict[str, Any]) -> dict[str, Any]:
    shown = np.round(X[_thinned(X)], 4)
    xyz = {axis: shown[:, k].tolist() for k, axis in enumerate("xyz")}
    return {"type": "scatter3d", "mode": "markers", "name": name, "marker": marker, **xyz}


def _thinned(X: F64) -> np.ndarray[Any, Any]:
    """Every n-th point."""
    return np.arange(0, len(X), max(1, len(X) // PLOTTED))
