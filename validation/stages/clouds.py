"""Point clouds of ours and COLMAP after similarity alignment: distances both ways, ICP, renderings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.records import Reconstruction
from validation.references.open3d_geometry import refine_by_icp
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
from validation.runs.tables import OURS, Metric, Plot, number, row, slug
from validation.scenes.real import Scene
from validation.stages.cameras import COLMAP, COLMAP_PP, read_model

ICP = "Open3D, ICP"
FEW_PCT = 50.0  # Share of points with a partner below which the motion of ICP is that of a part
NEAR_PCT = 0.5  # A point has a partner if the other cloud has a point within this share of its depth (%)


SHARED = "points that both observe within a pixel"


class CloudsStage(Stage):
    """Two clouds of one scene, aligned by their cameras."""

    name = "clouds"
    scenes, own = IMAGE_SCENES, True
    required = (("cameras", OURS), ("cameras", COLMAP), ("cameras", COLMAP_PP))

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        return () if options.gates_only else (ICP,)

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        images = load_images(task.scene, options)
        for name, clouds in _all_clouds(images, _models(images, options)).items():
            np.savez(
                folder / f"{slug(name)}.npz",
                transform=refine_by_icp(clouds.mine, clouds.other, NEAR_PCT / 100.0 * clouds.unit),
            )

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        images = load_images(scene, options)
        models = _models(images, options)
        if OURS not in models or len(models) == 1:
            names = ", ".join(name for name in (OURS, COLMAP, COLMAP_PP) if name not in models)
            return Judgement((), [f"There is no model of {names} to compare."])
        found = _all_clouds(images, models)
        metrics = list[Metric]()
        for name, clouds in found.items():
            metrics += _same_points(scene, name, models[OURS], models[name], clouds)
            metrics += _metrics(scene, name, clouds)
            metrics += _icp_metrics(scene, name, clouds, outcomes.get(ICP))
        few = [name for name in models if name not in (OURS, *found)]
        notes = [f"{name}: too few common cameras to align the clouds." for name in few]
        return Judgement(metrics, notes, [_plot(name, clouds) for name, clouds in found.items()])


class Clouds(NamedTuple):
    """Points of ours (N, 3) and of a reference (M, 3) in one frame, and their distance from the cameras. The
    frame is the true one, or theirs without truth; ``unit`` is the median distance.
    """

    mine: F64
    other: F64
    unit: float

    def distances_pct(self) -> F64:
        """Return the distance of each point of ours to the nearest of theirs."""
        return np.asarray(100.0 * cKDTree(self.other).query(self.mine)[0] / self.unit)


def _models(scene: Scene, options: ReportOptions) -> dict[str, Reconstruction]:
    """Return the models of the stage cameras that there are."""
    models = {}
    for name in (OURS, COLMAP, COLMAP_PP):
        folder = options.folder("cameras", scene.name, name)
        model = read_model(scene, name, Outcome(folder)) if folder.is_dir() else None
        if model is not None:
            models[name] = model
    return models


def _all_clouds(scene: Scene, models: Mapping[str, Reconstruction]) -> dict[str, Clouds]:
    """Return the clouds of ours and of each reference whose cameras could be aligned."""
    others = [name for name in models if name != OURS and OURS in models]
    pairs = {name: common_frame(scene, models[OURS], models[name]) for name in others}
    return {name: clouds for name, clouds in pairs.items() if clouds is not None}


def common_frame(scene: Scene, ours: Reconstruction, theirs: Reconstruction) -> Clouds | None:
    """Align both models by the centres of their common cameras; None if these are too few."""
    both = ours.registered & theirs.registered
    if both.sum() < 3:
        return None
    centres = [dehomogenize(camera_centre(model.P[both])) for model in (ours, theirs)]
    target = scene.C[both] if scene.C is not None and scene.known.all() else centres[1]
    try:
        moves = [estimate_similarity(C, target) for C in centres]
    except ValueError:
        return None
    mine, other = (
        np.asarray(move.apply(dehomogenize(model.X[model.valid])))
        for model, move in zip((ours, theirs), moves, strict=True)
    )
    distance = np.linalg.norm(other[:, None] - target[None], axis=2)
    return Clouds(mine, other, float(np.median(distance)))


def same_points(ours: Reconstruction, theirs: Reconstruction) -> I64:
    """Return pairs (M, 2) of indices of valid points that are the same scene point. They were seen within a
    pixel of each other in more images than any other pair of either.
    """
    votes: Counter[tuple[int, int]] = Counter()
    for view in np.flatnonzero(ours.registered & theirs.registered):
        (xy1, point1), (xy2, point2) = (_supported(model, int(view)) for model in (ours, theirs))
        if not len(xy1) or not len(xy2):
            continue
        distance, nearest = cKDTree(xy2).query(xy1, distance_upper_bound=1.0)
        near = np.isfinite(distance)
        votes.update(zip(point1[near].tolist(), point2[nearest[near]].tolist(), strict=True))
    taken1, taken2, pairs = set[int](), set[int](), []
    for (a, b), _ in sorted(votes.items(), key=lambda item: (-item[1], item[0])):
        if a not in taken1 and b not in taken2:
            taken1.add(a)
            taken2.add(b)
            pairs.append((a, b))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _supported(model: Reconstruction, view: int) -> tuple[F64, I64]:
    """Return inlier observations of a view: pixels and indices among the valid points."""
    number = np.cumsum(model.valid) - 1
    tracks = model.tracks
    here = (tracks.view_index == view) & model.inlier & model.valid[tracks.point_index]
    return tracks.xy[here], np.asarray(number[tracks.point_index[here]], dtype=np.int64)


def _same_points(
    scene: str, name: str, ours: Reconstruction, theirs: Reconstruction, clouds: Clouds
) -> list[Metric]:
    pairs = same_points(ours, theirs)
    if not len(pairs):
        return []
    apart = 100.0 * np.linalg.norm(clouds.mine[pairs[:, 0]] - clouds.other[pairs[:, 1]], axis=1) / clouds.unit
    text = "distance of ours to theirs, for points observed by both within a pixel"
    most = f"90 % quantile of the {text}"
    return [
        row(scene, f"points shared with {name}", "", float(len(pairs)), SHARED, more=True, ranked=False),
        _distance(scene, f"shared with {name}: median apart", np.median(apart), f"median {text}"),
        _distance(scene, f"shared with {name}: 90 % within", np.quantile(apart, 0.9), most),
    ]


def _metrics(scene: str, name: str, clouds: Clouds) -> list[Metric]:
    forth = clouds.distances_pct()
    back = Clouds(clouds.other, clouds.mine, clouds.unit).distances_pct()
    share = 100.0 * float(np.mean(forth <= NEAR_PCT))
    text = "median distance of a point of ours to the nearest"
    back_text = "median distance of one of their points to the nearest"
    near = f"share of our points with one of theirs within {NEAR_PCT} %"
    return [
        _distance(scene, f"ours to {name}", np.median(forth), text),
        _distance(scene, f"{name} to ours", np.median(back), back_text),
        row(scene, f"near {name}", "%", share, near, more=True),
    ]


def _icp_metrics(scene: str, name: str, clouds: Clouds, outcome: Outcome | None) -> list[Metric]:
    """Return the motion and the inlier share of Open3D's ICP."""
    found = read_arrays(outcome, f"{slug(name)}.npz")
    if found is None:
        return []
    R, t = found["transform"][:3, :3], found["transform"][:3, 3]
    turn = float(np.degrees(np.linalg.norm(Rotation.from_matrix(R).as_rotvec())))
    middle = np.median(clouds.mine, axis=0)
    shift = 100.0 * float(np.linalg.norm(R @ middle + t - middle)) / clouds.unit
    share = 100.0 * float(np.mean(clouds._replace(mine=clouds.mine @ R.T + t).distances_pct() <= NEAR_PCT))
    turned = "rotation by which ICP still turns our cloud after the similarity"
    near = f"share of our points with a partner after ICP; below {FEW_PCT:g} % its motion says nothing"
    inliers = row(scene, f"ICP to {name}: inliers", "%", share, near, more=True)
    if share < FEW_PCT:
        return [inliers]
    return [
        row(scene, f"ICP to {name}: turn", "deg", turn, turned),
        _distance(scene, f"ICP to {name}: shift", shift, "shift of the cloud centre"),
        inliers,
    ]


def _distance(scene: str, name: str, value: float, text: str) -> Metric:
    return row(scene, name, "% of distance", float(value), text)


def _plot(name: str, clouds: Clouds) -> Plot:
    """Plot both clouds: ours coloured by the distance to theirs, theirs grey."""
    low, high = np.quantile(clouds.mine, [0.02, 0.98], axis=0)
    margin = 0.3 * (high - low).max()
    apart = clouds.distances_pct()
    most = float(np.quantile(apart, 0.9))
    shades = _thinned(apart).round(3).tolist()
    scale = {"colorscale": "Viridis", "cmin": 0.0, "cmax": most, "showscale": True}
    bar = {"colorbar": {"title": {"text": "% of distance"}}}
    traces = [
        _trace("ours", clouds.mine, {"size": 2, "color": shades, **scale, **bar}),
        _trace(name, clouds.other, {"size": 1.5, "color": "#9aa5ad"}),
    ]
    axes = {
        f"{axis}axis": {"range": [float(low[k] - margin), float(high[k] + margin)], "visible": False}
        for k, axis in enumerate("xyz")
    }
    # The legend below, apart from the colour bar and the buttons.
    places = {"legend": {"orientation": "h", "y": 0}, "margin": {"l": 0, "r": 0, "t": 36, "b": 30}}
    layout = {"scene": {"aspectmode": "data", **axes}, **places}
    text = (
        "Ours is coloured by the distance of each point to the nearest of theirs, "
        f"up to {number(most)} % for the farthest tenth; drag to turn."
    )
    return Plot(f"Ours and {name}", {"data": traces, "layout": layout}, text)


def _trace(name: str, X: F64, marker: dict[str, Any]) -> dict[str, Any]:
    xyz = dict(zip("xyz", np.round(_thinned(X), 4).T.tolist(), strict=True))
    return {"type": "scatter3d", "mode": "markers", "name": name, "marker": marker, **xyz}


def _thinned(X: F64) -> F64:
    """Every n-th point, 6000 to 12,000 of many."""
    return X[:: max(1, len(X) // 6000)]
